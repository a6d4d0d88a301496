"""A vendor's model, MJCF or URDF, as it lies in its repository: with what it names, and without what is not there."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco

from gaponet.data.checks.finding import some
from gaponet.errors import RobotError
from gaponet.mjcf import read_mjcf, require_size

MESHES = (".stl", ".obj", ".msh")  # what MuJoCo reads
KEEP = {"strippath": "false", "fusestatic": "false", "discardvisual": "false", "balanceinertia": "true",
        "autolimits": "true"}  # fmt: skip


def read_vendor(path: Path, packages: dict[str, Path]) -> tuple[mujoco.MjSpec, list[str]]:
    """A model file as a specification, and what was left out of it.

    Args:
        path: .xml (MJCF) or .urdf.
        packages: Folders of package://NAME; one that is not named is looked for around the file.

    Raises:
        RobotError: Neither MJCF nor URDF, or broken.
    """
    if path.is_dir():
        inside = sorted(p.relative_to(path).as_posix() for e in ("xml", "urdf") for p in path.rglob(f"*.{e}"))
        raise RobotError(f"{path}: is a folder; name the model in it: {some(inside) or 'there is no .xml or .urdf'}")
    if path.suffix == ".xacro":
        raise RobotError(f"{path}: expand it first: xacro {path.name} > {path.name.split('.')[0]}.urdf")
    require_size(path)
    root = ET.parse(path).getroot()
    return _urdf(root, path, packages) if root.tag == "robot" else _mjcf(path)


def _mjcf(path: Path) -> tuple[mujoco.MjSpec, list[str]]:
    spec = read_mjcf(path)
    place = path.parent / spec.meshdir
    missing = {m.name or Path(m.file).stem: m for m in spec.meshes if m.file and not (place / m.file).is_file()}
    for geom in [g for g in spec.geoms if g.meshname in missing]:
        spec.delete(geom)
    for mesh in missing.values():
        spec.delete(mesh)
    return spec, _left_out(sorted(missing), f"are not in {place}")


def _urdf(root: ET.Element, path: Path, packages: dict[str, Path]) -> tuple[mujoco.MjSpec, list[str]]:
    missing: list[str] = []
    unread: list[str] = []
    for element in [e for e in root if e.tag in ("transmission", "gazebo", "ros2_control")]:
        root.remove(element)
    for link in root.iter("link"):
        for shape in [s for s in link if s.tag in ("visual", "collision")]:
            mesh = shape.find("geometry/mesh")
            if mesh is None:
                continue
            name = mesh.get("filename", "")
            file = _resolve(name, path, packages)
            if file is None or file.suffix.lower() not in MESHES:
                (missing if file is None else unread).append(name)
                link.remove(shape)
            else:
                mesh.set("filename", str(file.resolve()))
    own = root.find("mujoco")
    own = ET.SubElement(root, "mujoco") if own is None else own
    for compiler in own.findall("compiler"):
        own.remove(compiler)
    ET.SubElement(own, "compiler", KEEP)
    try:
        spec = mujoco.MjSpec.from_string(ET.tostring(root, encoding="unicode"))
    except (ValueError, mujoco.FatalError) as error:
        raise RobotError(f"{path}: not valid URDF: {' '.join(str(error).split())}") from None
    hint = "were not found; --packages NAME=FOLDER says where package://NAME is"
    return spec, _left_out(missing, hint) + _left_out(unread, f"are none of {', '.join(MESHES)}")


def _left_out(names: list[str], why: str) -> list[str]:
    return [f"{len(names)} mesh(es) {why}; left out: {some(names)}"] if names else []


def _resolve(name: str, path: Path, packages: dict[str, Path]) -> Path | None:
    """Where a mesh is, or None."""
    kind, _, rest = name.rpartition("://")
    if kind not in ("package", "model"):
        places = [path.parent / rest]
    else:
        package, _, inner = rest.partition("/")
        above = path.resolve().parents
        places = [packages[package] / inner] if package in packages else []
        places += [p / inner for p in above if p.name == package] + [p / rest for p in above]
        places += [p / inner for p in above if (p / "package.xml").is_file()]
    return next((p for p in places if p.is_file()), None)
