"""An MJCF that needs no file beside it: what a run or a dataset keeps of a robot whose MJCF includes or names files.

MuJoCo writes the structure, with six digits; the figures of bodies, joints, geoms and sites are then those that it
compiled, with all their digits. Inertias are explicit. A mesh that touches is written out; one that is only looked at
becomes its bounding box.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from itertools import count
from pathlib import Path

import mujoco
import numpy as np

from gaponet.base.errors import RobotError
from gaponet.robot.fingerprint import model_fingerprint
from gaponet.robot.mjcf import compile_spec, read_mjcf

Places = dict[str, Iterator[int]]  # tag → number of the next one in the model

DROPPED = ("actuator", "sensor", "keyframe", "asset", "visual", "statistic", "custom", "size")
COMPILER = {"angle": "radian", "autolimits": "true", "inertiafromgeom": "auto"}
LOOKS = ("class", "childclass", "material", "mesh", "density", "shellinertia", "fitscale", "fromto")
DYNAMICS = ("armature", "frictionloss", "margin")


def self_contained_mjcf(path: Path) -> str:
    """The MJCF at path in one text; its actuators are left out, since robot.toml has them.

    Raises:
        RobotError: It does not compile, or has what such a text cannot hold (tendons with odd figures, plugins).
    """
    return self_contained_text(read_mjcf(path), path)


def self_contained_text(spec: mujoco.MjSpec, path: Path) -> str:
    """The same of a specification that was read from `path`."""
    spec.compiler.discardvisual = spec.compiler.fusestatic = False
    model = compile_spec(spec, path)
    root = ET.fromstring(spec.to_xml())
    for child in [c for c in root if c.tag in (*DROPPED, "compiler")]:
        root.remove(child)
    for element in root.iter("geom"):  # a class may name what was dropped
        element.attrib.pop("material", None)
    root.insert(0, ET.Element("compiler", COMPILER))
    asset, world = ET.SubElement(root, "asset"), root.find("worldbody")
    assert world is not None
    _fill(world, 0, model, asset, {tag: count() for tag in ("joint", "geom", "site")}, count(1))
    ET.indent(root)
    text = ET.tostring(root, encoding="unicode") + "\n"
    if _moves(model) != _moves(compile_spec(mujoco.MjSpec.from_string(text), path)):
        raise RobotError(
            f"{path}: does not fit into one file that moves the same; write it without <include> and files"
        )
    return text


def _moves(model: mujoco.MjModel) -> list[str]:
    return [line for line in model_fingerprint(model) if not line.startswith("actuator ")]


def _fill(
    element: ET.Element, body: int, model: mujoco.MjModel, asset: ET.Element, next_: Places, bodies: Iterator[int]
) -> None:
    """Give a body and all below it the model's figures, depth first, which is the model's order."""
    _unwrap(element)
    for child in [c for c in element if c.tag not in ("joint", "geom", "site", "body")]:
        element.remove(child)
    if body:
        set_attributes(element, pos=model.body_pos[body], quat=model.body_quat[body])
        if model.body_mass[body]:
            inertial = ET.Element("inertial")
            set_attributes(inertial, pos=model.body_ipos[body], quat=model.body_iquat[body], mass=model.body_mass[body],
                 diaginertia=model.body_inertia[body])  # fmt: skip
            element.insert(0, inertial)
    for child in element:
        if child.tag == "joint":
            _joint(child, model, next(next_["joint"]))
        elif child.tag == "geom":
            _geom(child, model, next(next_["geom"]), asset)
        elif child.tag == "site":
            s = next(next_["site"])
            child.attrib.pop("material", None)
            set_attributes(child, pos=model.site_pos[s], quat=model.site_quat[s])
    for child in [c for c in element if c.tag == "body"]:
        _fill(child, next(bodies), model, asset, next_, bodies)


def _unwrap(element: ET.Element) -> None:
    """The children of frames in their place: the model's figures are from the body."""
    while any(c.tag == "frame" for c in element):
        children = [inner for c in element for inner in (list(c) if c.tag == "frame" else [c])]
        element[:] = children


def _joint(element: ET.Element, model: mujoco.MjModel, j: int) -> None:
    dof, at = int(model.jnt_dofadr[j]), int(model.jnt_qposadr[j])
    set_attributes(
        element, pos=model.jnt_pos[j], axis=model.jnt_axis[j], ref=model.qpos0[at], springref=model.qpos_spring[at]
    )
    set_attributes(
        element, **{name: getattr(model, f"{'jnt' if name == 'margin' else 'dof'}_{name}")[dof] for name in DYNAMICS}
    )
    for name, kind, i in (("stiffness", "jnt", j), ("damping", "dof", dof)):
        higher = getattr(model, f"{kind}_{name}poly", np.zeros((model.nv, 0)))[i]
        first = getattr(model, f"{kind}_{name}")[i]
        set_attributes(element, **{name: [first, *higher] if np.any(higher) else first})
    element.attrib.pop("springdamper", None)  # stiffness and damping were made of it
    for ours, theirs in (("", ""), ("actfrc", "actuatorfrc")):
        limited = bool(getattr(model, f"jnt_{ours}limited")[j])
        element.set(f"{theirs}limited", str(limited).lower())
        if limited:
            set_attributes(element, **{f"{theirs}range": getattr(model, f"jnt_{ours}range")[j]})


def _geom(element: ET.Element, model: mujoco.MjModel, g: int, asset: ET.Element) -> None:
    """Without mass: inertias are explicit."""
    for name in LOOKS:
        element.attrib.pop(name, None)
    pos, size, turn = model.geom_pos[g], model.geom_size[g], np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.geom_quat[g])
    kind = mujoco.mjtGeom(model.geom_type[g]).name.removeprefix("mjGEOM_").lower()
    if kind in ("mesh", "sdf", "hfield"):
        meets = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT
        if meets and (model.geom_contype[g] or model.geom_conaffinity[g]):
            element.set("mesh", _mesh(model, int(model.geom_dataid[g]), asset))
            kind = "mesh"
        else:
            kind, pos = "box", pos + turn.reshape(3, 3) @ model.geom_aabb[g, :3]
            size = np.maximum(model.geom_aabb[g, 3:], 1e-4)
    element.set("type", kind)
    rgba = model.geom_rgba[g] if model.geom_matid[g] < 0 else model.mat_rgba[model.geom_matid[g]]
    set_attributes(element, pos=pos, quat=model.geom_quat[g], mass=0.0, rgba=rgba, friction=model.geom_friction[g])
    for name in ("contype", "conaffinity", "condim", "group", "priority"):
        element.set(name, str(int(getattr(model, f"geom_{name}")[g])))
    set_attributes(
        element, **{n: getattr(model, f"geom_{n}")[g] for n in ("solmix", "solref", "solimp", "margin", "gap")}
    )
    if kind != "mesh":
        set_attributes(element, size=size)
    else:
        element.attrib.pop("size", None)


def _mesh(model: mujoco.MjModel, mesh: int, asset: ET.Element) -> str:
    """Write a mesh out as it was compiled, once; returns its name."""
    name = f"mesh{mesh}"
    if all(child.get("name") != name for child in asset):
        vertices = slice(model.mesh_vertadr[mesh], model.mesh_vertadr[mesh] + model.mesh_vertnum[mesh])
        faces = slice(model.mesh_faceadr[mesh], model.mesh_faceadr[mesh] + model.mesh_facenum[mesh])
        element = ET.SubElement(asset, "mesh", {"name": name, "inertia": "shell"})
        set_attributes(element, vertex=model.mesh_vert[vertices].astype(float))
        element.set("face", " ".join(map(str, model.mesh_face[faces].ravel())))
    return name


def set_attributes(element: ET.Element, **figures: object) -> None:
    """Attributes with all digits."""
    for name, values in figures.items():
        element.set(name, " ".join(repr(float(x)) for x in np.ravel(np.asarray(values, float))))
