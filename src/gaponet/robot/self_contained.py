"""MJCF in one text without other files, for runs and datasets that store a robot.

MuJoCo writes the structure, but numbers with six digits only. The numbers of bodies, joints, geoms
and sites are therefore copied from the compiled model in full precision. Inertias are explicit. A
mesh that can collide is written out; a visual mesh becomes its bounding box.
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

Counters = dict[str, Iterator[int]]  # tag → index of the next element in the model

DROPPED_SECTIONS = (
    "actuator",
    "sensor",
    "keyframe",
    "asset",
    "visual",
    "statistic",
    "custom",
    "size",
)
POLYNOMIAL_SIZE = 5  # of a polycoef, the first numbers of eq_data
COMPILER_ATTRIBUTES = {"angle": "radian", "autolimits": "true", "inertiafromgeom": "auto"}
DROPPED_GEOM_ATTRIBUTES = (
    "class",
    "childclass",
    "material",
    "mesh",
    "density",
    "shellinertia",
    "fitscale",
    "fromto",
)


def self_contained_mjcf(path: Path) -> str:
    """Return the MJCF at `path` in one text, without actuators: robot.toml holds their numbers.

    Raises:
        RobotError: It does not compile, or such a text cannot hold it (plugins, tendons with more
            than six digits).
    """
    return self_contained_text(read_mjcf(path), path)


def self_contained_text(spec: mujoco.MjSpec, path: Path) -> str:
    """Return a specification, read from `path`, in one text; errors as for
    `self_contained_mjcf`.
    """
    spec.compiler.discardvisual = spec.compiler.fusestatic = False
    model = compile_spec(spec, path)
    root = ET.fromstring(spec.to_xml())
    for child in list(root):
        if child.tag in (*DROPPED_SECTIONS, "compiler"):
            root.remove(child)
    for element in root.iter("geom"):  # a default class may name a material that was dropped
        element.attrib.pop("material", None)
    root.insert(0, ET.Element("compiler", COMPILER_ATTRIBUTES))
    asset = ET.SubElement(root, "asset")
    world = root.find("worldbody")
    assert world is not None
    _fill(world, 0, model, asset, {tag: count() for tag in ("joint", "geom", "site")}, count(1))
    _copy_couplings(root, model)
    ET.indent(root)
    text = ET.tostring(root, encoding="unicode") + "\n"
    if _fingerprint(model) != _fingerprint(compile_spec(mujoco.MjSpec.from_string(text), path)):
        what = (
            "does not fit into one file that moves the same; write it without <include> and files"
        )
        raise RobotError(f"{path}: {what}")
    return text


def _copy_couplings(root: ET.Element, model: mujoco.MjModel) -> None:
    """Copy the polynomials of couplings of joints and of tendons, in the model's order."""
    elements = root.iterfind("equality/*")
    for number, element in enumerate(elements):
        if element.tag in ("joint", "tendon"):
            set_attributes(element, polycoef=model.eq_data[number, :POLYNOMIAL_SIZE])


def _fingerprint(model: mujoco.MjModel) -> list[str]:
    return [line for line in model_fingerprint(model) if not line.startswith("actuator ")]


def _fill(
    element: ET.Element,
    body: int,
    model: mujoco.MjModel,
    asset: ET.Element,
    counters: Counters,
    bodies: Iterator[int],
) -> None:
    """Copy the model's numbers into a body and its descendants, depth first, which is the model's
    order.
    """
    _unwrap(element)
    for child in list(element):
        if child.tag not in ("joint", "geom", "site", "body"):
            element.remove(child)
    if body:
        set_attributes(element, pos=model.body_pos[body], quat=model.body_quat[body])
        if model.body_mass[body]:
            inertial = ET.Element("inertial")
            set_attributes(
                inertial,
                pos=model.body_ipos[body],
                quat=model.body_iquat[body],
                mass=model.body_mass[body],
                diaginertia=model.body_inertia[body],
            )
            element.insert(0, inertial)
    for child in element:
        if child.tag == "joint":
            _joint(child, model, next(counters["joint"]))
        elif child.tag == "geom":
            _geom(child, model, next(counters["geom"]), asset)
        elif child.tag == "site":
            site = next(counters["site"])
            child.attrib.pop("material", None)
            set_attributes(child, pos=model.site_pos[site], quat=model.site_quat[site])
    for child in element.findall("body"):
        _fill(child, next(bodies), model, asset, counters, bodies)


def _unwrap(element: ET.Element) -> None:
    """Replace frames by their children: the model states positions relative to the body."""
    while element.find("frame") is not None:
        children: list[ET.Element] = []
        for child in element:
            children += child if child.tag == "frame" else [child]
        element[:] = children


def _joint(element: ET.Element, model: mujoco.MjModel, j: int) -> None:
    dof = int(model.jnt_dofadr[j])
    at = int(model.jnt_qposadr[j])
    set_attributes(
        element,
        pos=model.jnt_pos[j],
        axis=model.jnt_axis[j],
        ref=model.qpos0[at],
        springref=model.qpos_spring[at],
        armature=model.dof_armature[dof],
        frictionloss=model.dof_frictionloss[dof],
        margin=model.jnt_margin[j],
    )
    for name, kind, i in (("stiffness", "jnt", j), ("damping", "dof", dof)):
        higher = getattr(model, f"{kind}_{name}poly", np.zeros((model.nv, 0)))[i]
        first = getattr(model, f"{kind}_{name}")[i]
        set_attributes(element, **{name: [first, *higher] if np.any(higher) else first})
    element.attrib.pop("springdamper", None)  # the compiler derived stiffness and damping from it
    for field, attribute in (("", ""), ("actfrc", "actuatorfrc")):
        limited = bool(getattr(model, f"jnt_{field}limited")[j])
        element.set(f"{attribute}limited", str(limited).lower())
        if limited:
            set_attributes(element, **{f"{attribute}range": getattr(model, f"jnt_{field}range")[j]})


def _geom(element: ET.Element, model: mujoco.MjModel, g: int, asset: ET.Element) -> None:
    """Copy a geom without its mass, since inertias are explicit."""
    for name in DROPPED_GEOM_ATTRIBUTES:
        element.attrib.pop(name, None)
    pos = model.geom_pos[g]
    size = model.geom_size[g]
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[g])
    kind = mujoco.mjtGeom(model.geom_type[g]).name.removeprefix("mjGEOM_").lower()
    if kind in ("mesh", "sdf", "hfield"):
        collides = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT
        if collides and (model.geom_contype[g] or model.geom_conaffinity[g]):
            element.set("mesh", _mesh(model, int(model.geom_dataid[g]), asset))
            kind = "mesh"
        else:
            kind = "box"
            pos = pos + rotation.reshape(3, 3) @ model.geom_aabb[g, :3]
            size = np.maximum(model.geom_aabb[g, 3:], 1e-4)
    element.set("type", kind)
    rgba = model.geom_rgba[g] if model.geom_matid[g] < 0 else model.mat_rgba[model.geom_matid[g]]
    set_attributes(
        element,
        pos=pos,
        quat=model.geom_quat[g],
        mass=0.0,
        rgba=rgba,
        friction=model.geom_friction[g],
    )
    for name in ("contype", "conaffinity", "condim", "group", "priority"):
        element.set(name, str(int(getattr(model, f"geom_{name}")[g])))
    set_attributes(
        element,
        solmix=model.geom_solmix[g],
        solref=model.geom_solref[g],
        solimp=model.geom_solimp[g],
        margin=model.geom_margin[g],
        gap=model.geom_gap[g],
    )
    if kind != "mesh":
        set_attributes(element, size=size)
    else:
        element.attrib.pop("size", None)


def _mesh(model: mujoco.MjModel, mesh: int, asset: ET.Element) -> str:
    """Add a compiled mesh to the assets, once, and return its name."""
    name = f"mesh{mesh}"
    if all(child.get("name") != name for child in asset):
        vertices = slice(
            model.mesh_vertadr[mesh], model.mesh_vertadr[mesh] + model.mesh_vertnum[mesh]
        )
        faces = slice(model.mesh_faceadr[mesh], model.mesh_faceadr[mesh] + model.mesh_facenum[mesh])
        element = ET.SubElement(asset, "mesh", {"name": name, "inertia": "shell"})
        set_attributes(element, vertex=model.mesh_vert[vertices].astype(float))
        element.set("face", " ".join(map(str, model.mesh_face[faces].ravel())))
    return name


def set_attributes(element: ET.Element, **numbers: object) -> None:
    """Set attributes of an element in full precision."""
    for name, values in numbers.items():
        element.set(name, " ".join(repr(float(x)) for x in np.ravel(np.asarray(values, float))))
