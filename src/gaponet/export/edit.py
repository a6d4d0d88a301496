"""Someone's MJCF with identified servos: a copy in which attributes of named joints and servos change, nothing else.

Edits are made in the text, so comments, includes, defaults, meshes, sensors, tendons and keyframes stay as they were
written. What has no place in the file (a table, a payload) stands at its end or at the beginning of its body.
"""

from __future__ import annotations

import difflib
import math
import os
import re
import shutil
import xml.parsers.expat as expat
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import mujoco
import numpy as np

from gaponet.base.errors import RobotError
from gaponet.base.files import lock_folder
from gaponet.export.facts import PLAIN_FIELDS, Joints
from gaponet.robot.mjcf import compile_spec, inspect_mjcf, read_mjcf
from gaponet.robot.spec import RobotSpec
from gaponet.sim.model import PAYLOAD_DENSITY, STIFF_SOLIMP, STIFF_SOLREF, TOLERANCE, build_model
from gaponet.sim.table import TABLE

KEPT_OF_SERVO = ("name", "class", "group", "user")
START_TAG = re.compile(rb"""<(?:[^"'>]|"[^"]*"|'[^']*')*>""")
COUNTED = ("njnt", "nsite", "nsensor", "ntendon", "neq", "nkey", "ncam", "nlight", "nmesh", "nq")


@dataclass
class Tag:
    """An element: where its start tag and where it ends, in bytes of its file."""

    file: Path
    name: str
    attributes: dict[str, str]
    inside: str
    start: int
    open_end: int
    end: int = 0


@dataclass
class Source:
    """A file and those that it includes, as text, and what is to be changed in it."""

    main: Path
    text: dict[Path, bytes] = field(default_factory=dict)
    tags: list[Tag] = field(default_factory=list)
    edits: list[tuple[Path, int, int, bytes]] = field(default_factory=list)
    last: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        inspect_mjcf(self.main)
        self._read(self.main)

    def _read(self, file: Path) -> None:
        text = self.text[file] = file.read_bytes()
        if text[:2] in (b"\xff\xfe", b"\xfe\xff"):
            raise RobotError(f"{file}: is in UTF-16; write it in UTF-8")
        parser, open_tags = expat.ParserCreate(), list[Tag]()

        def begin(name: str, attributes: dict[str, str]) -> None:
            start, found = parser.CurrentByteIndex, START_TAG.match(text, parser.CurrentByteIndex)
            assert found is not None
            inside = open_tags[-1].name if open_tags else ""
            open_tags.append(Tag(file, name, attributes, inside, start, found.end()))
            self.tags.append(open_tags[-1])

        def end(name: str) -> None:
            tag = open_tags.pop()
            closed = text[: tag.open_end].endswith(b"/>")
            tag.end = tag.open_end if closed else text.index(b">", parser.CurrentByteIndex) + 1

        parser.StartElementHandler, parser.EndElementHandler = begin, end
        try:
            parser.Parse(text, True)
        except expat.ExpatError as error:
            raise RobotError(f"{file}: not valid MJCF: {error}") from None
        for tag in [t for t in self.tags if t.file == file and t.name == "include"]:
            self._read(self.main.parent / tag.attributes["file"])

    def set(self, tag: Tag, **values: object) -> None:
        """Change attributes of a start tag, and add those that it has not."""
        text = self.text[tag.file][tag.start : tag.open_end]
        for name, value in values.items():
            own = re.compile(rb"""(\s%s\s*=\s*)("[^"]*"|'[^']*')""" % name.encode())
            written = f'"{value}"'.encode()
            if own.search(text):
                text = own.sub(lambda m, w=written: m[1] + w, text, count=1)  # type: ignore[misc]
            else:
                head = re.match(rb"(.*?)(\s*/?>)$", text, re.DOTALL)
                assert head is not None
                text = head[1] + f" {name}=".encode() + written + head[2]
        self.edits.append((tag.file, tag.start, tag.open_end, text))

    def replace(self, tag: Tag, text: str) -> None:
        """Write another element in its place."""
        self.edits.append((tag.file, tag.start, tag.end, text.encode()))

    def insert(self, at: Tag, text: str) -> None:
        """Write something at the beginning of an element."""
        self.edits.append((at.file, at.open_end, at.open_end, f"\n{text}".encode()))

    def append(self, section: str, text: str) -> None:
        """Write something into a section at the end of the main file."""
        self.last[section] = self.last.get(section, "") + text

    def edited(self) -> dict[Path, bytes]:
        """The files with all changes."""
        out = dict(self.text)
        root = next(t for t in self.tags if t.file == self.main)
        place = self.text[self.main].rindex(b"</", 0, root.end)
        ends = "".join(
            f"  <{name}>\n{text}  </{name}>\n" if text else f"  <{name}/>\n" for name, text in self.last.items()
        )
        edits = [*self.edits, (self.main, place, place, ends.encode())]
        # From the back; where something is put right before an element that changes, the element comes first.
        for _, (file, start, end, new) in sorted(enumerate(edits), key=lambda e: (-e[1][1], e[1][1] == e[1][2], -e[0])):
            out[file] = out[file][:start] + new + out[file][end:]
        return out

    def one(self, what: str, wanted: Callable[[Tag], bool]) -> Tag | None:
        """The only element of that kind; None where there is none."""
        found = [tag for tag in self.tags if wanted(tag)]
        if len(found) > 1:
            raise RobotError(f"{self.main}: has {len(found)} {what}; one is needed. Delete or rename the others")
        return found[0] if found else None


def edit_mjcf(
    path: Path,
    out: Path,
    robot: RobotSpec,
    joints: Joints,
    longest: dict[str, float],
    prefix: str = "",
    payload_mass: float = 0.0,
) -> tuple[Path, str, tuple[str, ...]]:
    """Write a copy of an MJCF and of all its files, with the servos of a robot.

    Args:
        path: The file.
        out: Folder for the copy.
        robot: The robot whose table and payload mounts are put in.
        joints: Name → numbers of its servo (facts.json); joints that are not operated are changed only where the file
            has no servo for them.
        longest: Name → the longest delay that its servo is to hold, s.
        prefix: What the file has before each joint's name, as where two robots stand in one scene.
        payload_mass: In each hand, kg.

    Returns:
        The copied main file, what was changed as a unified diff, and joints whose targets were not in rad.

    Raises:
        RobotError: A joint is not in the text, has several servos, or the result does not compile to what was wanted.
    """
    path = path.resolve()
    before = compile_spec(spec := read_mjcf(path), path)
    source, added, other = Source(path), list[str](), list[str]()
    for name, servo in joints.items():
        full = prefix + name
        tag = source.one(f"joints '{full}'", partial(_is_joint, name=full))
        if tag is None:
            known = ", ".join(before.joint(i).name for i in range(before.njnt))
            raise RobotError(
                f"{path}: has no joint '{full}' in its text (--prefix says what stands before names); it has {known}"
            )
        drives = source.one(f"servos of '{full}'", partial(_drives, joint=full))
        if drives is not None and name not in robot.operated:
            continue
        changed = {f: text_of(servo[f]) for f in PLAIN_FIELDS}
        if servo["zero"]:
            ref = before.qpos0[before.joint(full).qposadr[0]] - servo["zero"]
            changed["ref"] = text_of(math.degrees(ref) if spec.compiler.degree else ref)
        changed |= {"solreffriction": text_of(*STIFF_SOLREF), "solimpfriction": text_of(*STIFF_SOLIMP)}
        source.set(tag, **changed)
        samples = math.ceil(longest[name] / before.opt.timestep - 1e-9) + 2 if longest[name] else 0
        if drives is not None:
            source.replace(drives, _servo(servo, samples, _kept(drives, before, full)))
            other += [full] * (abs(_radians(before, full) - 1) > 1e-3)
        else:
            source.append("actuator", f"    {_servo(servo, samples, {'name': full, 'joint': full})}\n")
            added.append(text_of(servo["home"]))
    for key in source.tags if added else ():
        if key.name == "key" and "ctrl" in key.attributes:
            source.set(key, ctrl=" ".join([key.attributes["ctrl"], *added]))
    _surroundings(source, robot, prefix, payload_mass, before)
    target = _write(source, out)
    _require(compile_spec(read_mjcf(target), target), before, joints, robot, prefix, target)
    return target, difference(source), tuple(other)


def _is_joint(tag: Tag, name: str) -> bool:
    return tag.name == "joint" and tag.attributes.get("name") == name and tag.inside != "equality"


def _drives(tag: Tag, joint: str) -> bool:
    return tag.inside == "actuator" and tag.attributes.get("joint") == joint


def _servo(servo: dict[str, float], samples: int, kept: dict[str, str]) -> str:
    """A servo as MJCF says it: <position>, or <general> where it has an offset."""
    kp, kd, limit = servo["kp"], servo["kd"], servo["effort_limit"]
    bias = kp * servo["offset"]
    attributes = kept | {
        "gear": "1", "dyntype": "none", "gaintype": "fixed", "gainprm": text_of(kp), "biastype": "affine",
        "biasprm": text_of(bias, -kp, -kd), "forcelimited": "true", "forcerange": text_of(-limit, limit),
    }  # fmt: skip
    if samples:
        attributes |= {"delay": text_of(servo["delay"]), "nsample": str(samples), "interp": "linear"}
    return "<general " + " ".join(f'{k}="{v}"' for k, v in attributes.items()) + "/>"


def _kept(tag: Tag, model: mujoco.MjModel, joint: str) -> dict[str, str]:
    """What stays of someone's servo: its name and class, and the range of its targets where it takes targets."""
    kept = {k: tag.attributes[k] for k in KEPT_OF_SERVO if k in tag.attributes} | {"joint": joint}
    i = int(np.flatnonzero(model.actuator_trnid[:, 0] == model.joint(joint).id)[0])
    if model.actuator_ctrllimited[i] and model.actuator_biasprm[i, 1]:
        limits = sorted(_radians(model, joint) * model.actuator_ctrlrange[i])
        return kept | {"ctrllimited": "true", "ctrlrange": text_of(*limits)}
    return kept | {"ctrllimited": "false"}


def _radians(model: mujoco.MjModel, joint: str) -> float:
    """Where a servo aims at a target of 1, rad: 0.0175 where it takes degrees; 1 where it takes no targets."""
    i = int(np.flatnonzero(model.actuator_trnid[:, 0] == model.joint(joint).id)[0])
    stiffness = -float(model.actuator_biasprm[i, 1] * model.actuator_gear[i, 0])
    return float(model.actuator_gainprm[i, 0]) / stiffness if stiffness > 0 else 1.0


def _surroundings(source: Source, robot: RobotSpec, prefix: str, payload_mass: float, model: mujoco.MjModel) -> None:
    """The solver's tolerance, the table and the payload."""
    option = {"tolerance": text_of(TOLERANCE)} if model.opt.tolerance > TOLERANCE else {}

    def body(name: str, what: str) -> Tag:
        found = source.one(f"bodies '{name}'", lambda t: t.name == "body" and t.attributes.get("name") == name)
        if found is None:
            raise RobotError(f"{source.main}: a [[{what}]] names body '{name}', which is not in its text")
        return found

    off = bool(model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT)
    if robot.table is not None and not (off and (model.geom_contype | model.geom_conaffinity).any()):
        own, table = build_model(robot), prefix + TABLE
        option["cone"] = "elliptic"  # a pyramid's stiffness depends on friction
        if off:  # nothing in the file would touch anything but for the pairs below
            source.append("option", '    <flag contact="enable"/>\n')
        source.append("worldbody", f'    <geom name="{table}" type="plane" size="2 2 0.1" contype="0" conaffinity="0" '
                      f'pos="0 0 {text_of(robot.table.height)}" rgba="0.55 0.5 0.45 1"/>\n')  # fmt: skip
        for i, tip in enumerate(robot.tips):
            name, size = f"{table}_tip_{i}", text_of(tip.radius)
            source.insert(body(prefix + tip.body, "tip"), f'<geom name="{name}" type="sphere" size="{size}"'
                          f' pos="{text_of(*tip.pos)}" mass="0" contype="0" conaffinity="0" group="3"/>')  # fmt: skip
            figures = {f: text_of(*getattr(own, f"pair_{f}")[i]) for f in ("friction", "solref", "solimp")}
            words = " ".join(f'{k}="{v}"' for k, v in figures.items())
            source.append("contact", f'    <pair geom1="{name}" geom2="{table}" condim="3" {words}/>\n')
    for mount in robot.payload_mounts:
        if mass := payload_mass + mount.mass:
            radius = (3 * mass / (4 * math.pi * PAYLOAD_DENSITY)) ** (1 / 3)
            ball = f'<geom type="sphere" size="{text_of(radius)}" mass="{mass}" contype="0" conaffinity="0"/>'
            source.insert(body(prefix + mount.body, "payload_mount"), f'<body name="{prefix}payload_{mount.side}" '
                          f'pos="{text_of(*mount.pos)}">{ball}</body>')  # fmt: skip
    if option:
        words = " ".join(f'{k}="{v}"' for k, v in option.items())
        source.append(f"option {words}", "")


def _write(source: Source, out: Path) -> Path:
    """The edited files and all that they name, where they lay to each other; returns the main one."""
    needed = {Path(os.path.abspath(f)) for f in mujoco.mju_getXMLDependencies(str(source.main))} | set(source.text)
    root = Path(os.path.commonpath([f.parent for f in needed]))
    with lock_folder(out, "engine"):
        for file in sorted(needed):
            place = out / file.relative_to(root)
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, place)
        for file, text in source.edited().items():
            (out / file.relative_to(root)).write_bytes(text)
    return out / source.main.relative_to(root)


def _require(
    now: mujoco.MjModel, before: mujoco.MjModel, joints: Joints, robot: RobotSpec, prefix: str, path: Path
) -> None:
    """Refuse a copy that does not have the servos that were wanted, or has lost something."""
    wrong = [f"{f} {getattr(before, f)} → {getattr(now, f)}" for f in COUNTED if getattr(before, f) != getattr(now, f)]
    for name in robot.operated:
        servo, joint = joints[name], now.joint(prefix + name)
        i = int(np.flatnonzero(now.actuator_trnid[:, 0] == joint.id)[0])
        found = [now.dof_armature[joint.dofadr[0]], np.ravel(now.dof_damping[joint.dofadr[0]])[0],
                 now.dof_frictionloss[joint.dofadr[0]], now.actuator_gainprm[i, 0], *now.actuator_biasprm[i, :3],
                 now.actuator_forcerange[i, 1]]  # fmt: skip
        kp = servo["kp"]
        wanted = [*(servo[f] for f in ("armature", "damping", "frictionloss")), kp, kp * servo["offset"], -kp,
                  -servo["kd"], servo["effort_limit"]]  # fmt: skip
        if not np.allclose(found, wanted, rtol=1e-5, atol=1e-9):
            wrong.append(f"{name}: {np.round(found, 6)} instead of {np.round(wanted, 6)}")
    if wrong:
        raise RobotError(f"{path}: the edited copy is not what was wanted: {'; '.join(wrong[:3])}")


def difference(source: Source) -> str:
    edited, lines = source.edited(), list[str]()
    for file, old in source.text.items():
        a, b = (text.decode("utf-8").splitlines(keepends=True) for text in (old, edited[file]))
        lines += difflib.unified_diff(a, b, f"a/{file.name}", f"b/{file.name}", n=1)
    return "".join(lines)


def text_of(*figures: float) -> str:
    return " ".join(f"{float(x):.9g}" for x in figures)
