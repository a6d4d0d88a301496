"""Vendors' models, MJCF or URDF: found by name on this disk, and read with the meshes that
exist.
"""

from __future__ import annotations

import importlib
import os
import re
import sys
import xml.etree.ElementTree as ET
from collections.abc import Container
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from gaponet.base.errors import RobotError
from gaponet.base.sandbox import sandboxed
from gaponet.robot.finding import abbreviate
from gaponet.robot.freeze import compiler_of
from gaponet.robot.mjcf import (
    compile_spec,
    inspect_mjcf,
    mujoco_errors,
    read_mjcf,
    require_simulable,
)

MESHES = (".stl", ".obj", ".msh")  # formats that MuJoCo reads
FOREIGN_TAGS = ("transmission", "gazebo", "ros2_control")  # of a URDF, for other programs
URDF_COMPILER = {
    "strippath": "false",
    "fusestatic": "false",
    "discardvisual": "false",
    "balanceinertia": "true",
    "boundmass": "1e-6",  # kg, of links with less
    "boundinertia": "1e-9",  # kg·m²
    "autolimits": "true",
}
AXES = ("xx", "yy", "zz", "xy", "xz", "yz")  # of an inertia tensor
BALL_DENSITY = 1000.0  # kg/m³, of the ball that replaces an impossible inertia


# Where collections of models lie: variables that name their folder, and usual folders.
MENAGERIE_VARIABLES = ("MUJOCO_MENAGERIE", "MUJOCO_MENAGERIE_PATH", "MENAGERIE_PATH")
EXAMPLE_VARIABLES = ("EXAMPLE_ROBOT_DATA_MODEL_DIR", "EXAMPLE_ROBOT_DATA")
CACHE_VARIABLE = "ROBOT_DESCRIPTIONS_CACHE"  # of the package robot_descriptions
COLLECTIONS = ("menagerie", "robot_descriptions", "example-robot-data")


def find_model(name: str) -> Path:
    """Return the model file of a name such as menagerie:franka_fr3, on this disk; nothing is
    downloaded.

    Args:
        name: menagerie:FOLDER or menagerie:FOLDER/FILE of MuJoCo Menagerie; robot_descriptions:NAME
            with or without _description; example-robot-data:NAME, such as panda.

    Raises:
        RobotError: It is not there; the message says how to get it.
    """
    collection, _, rest = name.partition(":")
    strange = collection == "robot_descriptions" and not rest.isidentifier()
    if collection not in COLLECTIONS or not rest or ".." in Path(rest).parts or strange:
        known = ", ".join(f"{collection}:NAME" for collection in COLLECTIONS)
        raise RobotError(f"'{name}': use one of {known}")
    if collection == "menagerie":
        return _of_menagerie(rest)
    if collection == "robot_descriptions":
        return _of_robot_descriptions(rest)
    return _of_example_robot_data(rest)


def _cache() -> Path:
    """Return the folder into which the package robot_descriptions clones repositories."""
    return Path(os.environ.get(CACHE_VARIABLE, "~/.cache/robot_descriptions")).expanduser()


def _stated(variables: tuple[str, ...]) -> list[Path]:
    """Return the folders that environment variables name, in their order."""
    return [Path(os.environ[v]).expanduser() for v in variables if os.environ.get(v)]


def _of_menagerie(name: str) -> Path:
    """Return the model of FOLDER or FOLDER/FILE in a copy of MuJoCo Menagerie."""
    versions = sorted(_cache().glob("mujoco_menagerie-*/mujoco_menagerie"))
    usual = [
        _cache() / "mujoco_menagerie",
        *versions,
        Path("mujoco_menagerie"),
        Path.home() / "mujoco_menagerie",
    ]
    roots = [p for p in (*_stated(MENAGERIE_VARIABLES), *usual) if p.is_dir()]
    place = next((p / name for p in roots if (p / name).exists()), None)
    if place is None:
        where = "it is not on this disk"
        if roots:
            there = sorted(p.name for p in roots[0].iterdir() if any(p.glob("*.xml")))
            where = f"{roots[0]} has {abbreviate(there)}"
        raise RobotError(
            f"menagerie:{name}: {where}. Get MuJoCo Menagerie (git clone "
            "https://github.com/google-deepmind/mujoco_menagerie) and name its folder in "
            "MUJOCO_MENAGERIE"
        )
    return place if place.is_file() else _main_model(place, f"menagerie:{name}")


def _main_model(folder: Path, name: str) -> Path:
    """Return the robot's own file in a folder of Menagerie: franka_fr3/fr3.xml, not its scenes."""
    models = []
    for file in sorted(folder.glob("*.xml")):
        if not re.search(r"scene|keyframe|mjx", file.stem):
            models.append(file)
    named = [f for f in models if folder.name.endswith(f.stem)]
    if len(models) == 1 or named:
        return max(named or models, key=lambda f: len(f.stem))
    files = ", ".join(f.name for f in models) or "no model"
    raise RobotError(f"{name}: {folder} has {files}; name one: {name}/FILE.xml")


def _of_robot_descriptions(name: str) -> Path:
    """Return the model of a description of the package robot_descriptions, if it was pulled."""
    try:
        cache: Any = importlib.import_module("robot_descriptions._cache")
        repositories = importlib.import_module("robot_descriptions._repositories").REPOSITORIES
    except ImportError:
        raise RobotError(
            f"robot_descriptions:{name}: the package is not installed: pip install "
            f"robot_descriptions, and robot_descriptions pull {name}"
        ) from None
    pulled = f"robot_descriptions pull {name}"

    def cached(repository: str, commit: str | None = None) -> str:
        path = repositories[repository].cache_path
        place = _cache() / (f"{path}-{commit}/{path}" if commit else path)
        if not place.is_dir():
            raise RobotError(f"robot_descriptions:{name}: {place} is not there; get it: {pulled}")
        return str(place)

    original = cache.clone_to_cache
    cache.clone_to_cache = cached  # its modules would download at import
    try:
        description = _description(name)
    finally:
        cache.clone_to_cache = original
    paths = [getattr(description, kind, "") for kind in ("MJCF_PATH", "URDF_PATH", "XACRO_PATH")]
    path = next((Path(entry) for entry in paths if entry), Path())
    if not path.is_file():
        raise RobotError(f"robot_descriptions:{name}: {path} is not there; get it: {pulled}")
    return path


def _description(name: str) -> Any:
    """Return the module of a description, such as fr3_mj_description for fr3."""
    for module in (name, f"{name}_mj_description", f"{name}_description"):
        full = f"robot_descriptions.{module}"
        try:
            return importlib.import_module(full)
        except ModuleNotFoundError as error:
            if error.name != full:
                raise
        finally:
            sys.modules.pop(full, None)
    raise RobotError(
        f"robot_descriptions:{name}: no such description; robot_descriptions list shows them"
    )


def _of_example_robot_data(name: str) -> Path:
    """Return the URDF of a name in example-robot-data."""
    roots = [place for place in _places_of_example_robot_data() if place.is_dir()]
    if not roots:
        raise RobotError(
            f"example-robot-data:{name}: it is not on this disk; pip install example-robot-data, "
            f"or name its folder robots in {EXAMPLE_VARIABLES[0]}"
        )
    root = roots[0]
    if (root / name).is_file():
        return root / name
    stems = {name, f"{name}_robot"}
    found = sorted(file for file in root.rglob("*.urdf") if file.stem in stems)
    if len(found) == 1:
        return found[0]
    if found:
        files = ", ".join(file.relative_to(root).as_posix() for file in found)
        raise RobotError(
            f"example-robot-data:{name}: several files have this name; name one: {files}"
        )
    there = sorted(file.stem for file in root.rglob("*.urdf"))
    raise RobotError(f"example-robot-data:{name}: not among {', '.join(there)} of {root}")


def _places_of_example_robot_data() -> list[Path]:
    """Return folders that may hold its robots: stated ones first, then those of installations."""
    share = Path("share/example-robot-data/robots")
    prefixes = []
    for variable in ("CONDA_PREFIX", "AMENT_PREFIX_PATH"):
        prefixes += [Path(p) for p in os.environ.get(variable, "").split(os.pathsep) if p]
    prefixes += [Path(p) / "cmeel.prefix" for p in sys.path]
    return [
        *_stated(EXAMPLE_VARIABLES),
        *(prefix / share for prefix in prefixes),
        _cache() / "example-robot-data/robots",
        Path("/opt/openrobots") / share,
        Path("/usr") / share,
    ]


def read_vendor(path: Path, packages: dict[str, Path]) -> tuple[mujoco.MjSpec, list[str]]:
    """Read a model file as a specification, with notes on what was omitted or corrected.

    Args:
        path: .xml (MJCF) or .urdf.
        packages: Folders of package://NAME; others are searched for around the file.

    Raises:
        RobotError: The file is neither MJCF nor URDF, or is damaged.
    """
    if path.is_dir():
        files = (*path.rglob("*.xml"), *path.rglob("*.urdf"))
        models = sorted(file.relative_to(path).as_posix() for file in files)
        raise RobotError(
            f"{path}: is a folder; name the model in it: "
            f"{abbreviate(models) or 'there is no .xml or .urdf'}"
        )
    if path.suffix == ".xacro":
        raise RobotError(
            f"{path}: expand it first: xacro {path.name} > {path.name.split('.')[0]}.urdf"
        )
    inspect_mjcf(path)
    packages = {name: folder.absolute() for name, folder in packages.items()}
    _try(path, packages)
    return _read(path, packages)


@sandboxed(RobotError, "mujoco", 0.5)
def _try(path: Path, packages: dict[str, Path]) -> None:
    """Read a model and simulate a step in a process of its own, which it may crash."""
    spec, _ = _read(path, packages)
    require_simulable(compile_spec(spec, path), path)


def _read(path: Path, packages: dict[str, Path]) -> tuple[mujoco.MjSpec, list[str]]:
    """Return a model as a specification, and notes."""
    root = ET.parse(path).getroot()
    if root.tag == "robot":
        return _urdf(root, path, packages)
    return _mjcf(path)


def _mjcf(path: Path) -> tuple[mujoco.MjSpec, list[str]]:
    """Return an MJCF as a specification without the meshes that are missing, and notes."""
    spec = read_mjcf(path, tried=True)
    notes = []
    if _compile_error(spec):
        notes += _drop_missing_meshes(spec, path)
    notes += _drop_unreadable_meshes(spec)
    return spec, notes


def _compile_error(spec: mujoco.MjSpec) -> str:
    """Return why a specification does not compile, in one line; "" if it does."""
    try:
        spec.copy().compile()
    except (ValueError, mujoco.FatalError) as error:
        return " ".join(str(error).split())
    return ""


def _drop_missing_meshes(spec: mujoco.MjSpec, path: Path) -> list[str]:
    """Delete the meshes of an MJCF whose files are not there; return notes."""
    folders = [path.parent, *_folders_of_attached_models(path)]
    missing = {}
    for mesh in spec.meshes:
        place = compiler_of(spec, mesh).meshdir
        files = [folder / place / mesh.file for folder in folders]
        if mesh.file and not any(file.is_file() for file in files):
            missing[_mesh_name(mesh)] = mesh
    notes = _left_out(sorted(missing), f"are not in {path.parent / spec.meshdir}")
    notes += _delete_geoms(spec, missing)
    for mesh in missing.values():
        spec.delete(mesh)
    return notes


def _folders_of_attached_models(path: Path) -> list[Path]:
    """Return the folders of the models that an MJCF attaches, each of which finds its meshes from
    there.
    """
    files = [tag.get("file", "") for tag in ET.parse(path).getroot().iter("model")]
    return [(path.parent / file).parent for file in files if file]


def _mesh_name(mesh: mujoco.MjsMesh) -> str:
    """Return the name by which geoms refer to a mesh."""
    return mesh.name or Path(mesh.file).stem


def _urdf(
    root: ET.Element, path: Path, packages: dict[str, Path]
) -> tuple[mujoco.MjSpec, list[str]]:
    """Return the URDF at `path` as a specification, and notes.

    `root` is its element, which is changed into one that MuJoCo reads.
    """
    for element in list(root):
        if element.tag in FOREIGN_TAGS:
            root.remove(element)
    notes = _resolve_meshes(root, path, packages)
    notes_on_inertias = _correct_inertias(root)
    _set_compiler(root)
    with mujoco_errors(path, "not valid URDF"):
        spec = mujoco.MjSpec.from_string(ET.tostring(root, encoding="unicode"))
    _add_mimic_joints(spec, root)
    notes += _drop_unreadable_meshes(spec)
    return spec, notes + notes_on_inertias


def _resolve_meshes(root: ET.Element, path: Path, packages: dict[str, Path]) -> list[str]:
    """Write the paths of meshes into a URDF, and remove the shapes of meshes that are missing or
    have another format; return notes.
    """
    missing = []
    of_other_format = []
    for link in root.iter("link"):
        for shape in [part for part in link if part.tag in ("visual", "collision")]:
            mesh = shape.find("geometry/mesh")
            if mesh is None:
                continue
            name = mesh.get("filename", "")
            file = _resolve(name, path, packages)
            if file is None:
                missing.append(name)
                link.remove(shape)
            elif file.suffix.lower() not in MESHES:
                of_other_format.append(name)
                link.remove(shape)
            else:
                mesh.set("filename", str(file.resolve()))
    hint = "were not found; --packages NAME=FOLDER says where package://NAME is"
    notes = _left_out(missing, hint)
    notes += _left_out(of_other_format, f"are none of {', '.join(MESHES)}")
    return notes


def _set_compiler(root: ET.Element) -> None:
    """Give a URDF the options of URDF_COMPILER in place of its own."""
    extension = root.find("mujoco")
    if extension is None:
        extension = ET.SubElement(root, "mujoco")
    for compiler in extension.findall("compiler"):
        extension.remove(compiler)
    ET.SubElement(extension, "compiler", URDF_COMPILER)


def _add_mimic_joints(spec: mujoco.MjSpec, root: ET.Element) -> None:
    """Let joints follow others as URDF's <mimic> says; MuJoCo before 4 does not read it.

    As in MuJoCo 4, joints that do not move and leaders that do not exist are passed over.
    """
    known = {equality.name1 for equality in spec.equalities}
    for joint in root.iter("joint"):
        mimic = joint.find("mimic")
        name = joint.get("name", "")
        if mimic is None or name in known:
            continue
        leader = mimic.get("joint", "")
        if spec.joint(name) is None or spec.joint(leader) is None:
            continue
        multiplier = 1.0
        if "multiplier" in mimic.attrib:
            multiplier = _number(mimic, "multiplier")
        equality = spec.add_equality(
            type=mujoco.mjtEq.mjEQ_JOINT,
            name1=name,
            name2=leader,
        )
        equality.data[:5] = [_number(mimic, "offset"), multiplier, 0.0, 0.0, 0.0]  # polynomial


def _left_out(names: list[str], why: str) -> list[str]:
    """Return a note on meshes that are left out; nothing if there are none."""
    if not names:
        return []
    return [f"{len(names)} mesh(es) {why}; left out: {abbreviate(names)}"]


def _correct_inertias(root: ET.Element) -> list[str]:
    """Replace impossible inertias, such as zeros, by those of a ball of the link's mass, and remove
    those of links without mass; return notes.

    A tensor with a number that is not finite stays as it is.
    """
    impossible = []
    massless = []
    for link in root.iter("link"):
        name = link.get("name", "")
        inertial = link.find("inertial")
        stated = None if inertial is None else inertial.find("mass")
        if inertial is None or stated is None:
            massless.append(name)
            continue
        mass = _number(stated, "value")
        if mass <= 0:
            link.remove(inertial)
            massless.append(name)
            continue
        inertia = inertial.find("inertia")
        if inertia is not None and _is_impossible(inertia):
            _set_ball(inertia, mass)
            impossible.append(name)
    notes = []
    if impossible:
        notes.append(
            "inertia that no body has, taken as a ball's of the link's mass: "
            f"{abbreviate(impossible)}"
        )
    moved = _moved_links(root)
    moved_massless = [name for name in massless if name in moved]
    if moved_massless:  # MuJoCo gives them the least mass of URDF_COMPILER
        links = abbreviate(moved_massless)
        notes.append(f"links without mass behind a joint, taken as 1 mg: {links}")
    return notes


def _is_impossible(inertia: ET.Element) -> bool:
    """Return True for a finite inertia tensor that is not positive definite."""
    xx, yy, zz, xy, xz, yz = [_number(inertia, f"i{axes}") for axes in AXES]
    matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return bool(np.isfinite(matrix).all() and np.linalg.eigvalsh(matrix)[0] <= 0)


def _set_ball(inertia: ET.Element, mass: float) -> None:
    """Write the inertia of a ball of BALL_DENSITY: 2/5 m r²."""
    squared_radius = (3 * mass / (4 * np.pi * BALL_DENSITY)) ** (2 / 3)
    ball = 0.4 * mass * squared_radius
    for axes in AXES:
        on_diagonal = axes[0] == axes[1]
        inertia.set(f"i{axes}", repr(float(ball)) if on_diagonal else "0")


def _moved_links(root: ET.Element) -> set[str]:
    """Return the links that a joint moves."""
    moved = set()
    for joint in root.iter("joint"):
        child = joint.find("child")
        if child is not None and joint.get("type") != "fixed":
            moved.add(child.get("link", ""))
    return moved


def _number(element: ET.Element, name: str) -> float:
    """Return a number of an element: 0 if it is missing, NaN if it is no number."""
    try:
        return float(element.get(name, "0"))
    except ValueError:
        return float("nan")


def _drop_unreadable_meshes(spec: mujoco.MjSpec) -> list[str]:
    """Delete meshes that MuJoCo cannot read; return notes.

    A mesh that gives its body no mass needs no volume, so it counts as a shell. One that does is
    first tried as its convex hull.
    """
    convex = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
    weighed = {geom.meshname for geom in spec.geoms if _gives_mass(spec, geom)}
    for mesh in spec.meshes:
        if _mesh_name(mesh) not in weighed:
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    hulls = []
    notes = []
    while len(spec.meshes):
        why = _compile_error(spec)
        bad = _named_mesh(spec, why)
        if bad is None:
            break
        name = _mesh_name(bad)
        if name in weighed and name not in hulls:
            bad.inertia = convex
            hulls.append(name)
            continue
        notes.append(f"mesh left out: {why}")
        notes += _delete_geoms(spec, [name])
        spec.delete(bad)
    kept = {_mesh_name(mesh) for mesh in spec.meshes}
    for name in hulls:
        if name in kept:
            notes.append(f"mesh {name} has no volume of its own: its mass is its hull's")
    return notes


def _gives_mass(spec: mujoco.MjSpec, geom: mujoco.MjsGeom) -> bool:
    """Return True if the mass of a body is, or contains, that of one of its geoms."""
    compiler = compiler_of(spec, geom)
    body = geom.parent
    always = compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    if body.name == "world" or (body.explicitinertial and not always):
        return False
    first, last = compiler.inertiagrouprange
    if not first <= geom.group <= last:
        return False
    return bool(geom.density > 0 if np.isnan(geom.mass) else geom.mass > 0)


def _delete_geoms(spec: mujoco.MjSpec, meshes: Container[str]) -> list[str]:
    """Delete the geoms of these meshes, by name; return a note on the mass that goes with them."""
    lost: dict[str, float] = {}  # body → kg, NaN if unknown
    for geom in list(spec.geoms):
        if geom.meshname not in meshes:
            continue
        if _gives_mass(spec, geom):
            body = geom.parent.name or "unnamed"
            lost[body] = lost.get(body, 0.0) + geom.mass
        spec.delete(geom)
    if not lost:
        return []
    texts = []
    for body, mass in lost.items():
        texts.append(f"{body} by " + ("an unknown mass" if np.isnan(mass) else f"{mass:g} kg"))
    return [
        f"without these meshes bodies are lighter: {abbreviate(texts)}; write <inertial> in the "
        "model"
    ]


def _named_mesh(spec: mujoco.MjSpec, message: str) -> mujoco.MjsMesh | None:
    """Return the mesh that a message of MuJoCo names by its file or its name; None without one."""
    for mesh in spec.meshes:
        if (mesh.file and Path(mesh.file).name in message) or f"'{mesh.name}'" in message:
            return mesh
    return None


def _resolve(name: str, path: Path, packages: dict[str, Path]) -> Path | None:
    """Return the file of a mesh that a URDF at `path` names; None if there is none.

    package://NAME/FILE is looked for in the folder that the user gave, then around the URDF.
    """
    scheme, _, rest = name.rpartition("://")
    places = [path.parent / rest]
    if scheme in ("package", "model"):
        places = _places_in_package(rest, path, packages)
    for place in places:
        if place.is_file():
            return place
    return None


def _places_in_package(name: str, path: Path, packages: dict[str, Path]) -> list[Path]:
    """Return where PACKAGE/FILE may be, the most likely place first."""
    package, _, file = name.partition("/")
    above = path.resolve().parents
    places = []
    if package in packages:
        places.append(packages[package] / file)
    places += [folder / file for folder in above if folder.name == package]
    places += [folder / name for folder in above]
    places += [folder / file for folder in above if (folder / "package.xml").is_file()]
    return places
