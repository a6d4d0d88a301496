"""Write a copy of a user's MJCF with identified servos.

Only attributes of named joints and servos change. Edits are made in the text, so comments,
includes, defaults, meshes, sensors, tendons and keyframes stay as they were written. A table is
added at the end of the file, a payload at the beginning of its body.
"""

from __future__ import annotations

import difflib
import math
import os
import re
import shutil
import tempfile
import xml.parsers.expat as expat
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from gaponet.base.errors import RobotError
from gaponet.base.files import atomic_write, lock_folder, write_text
from gaponet.export.simulator_facts import Joints
from gaponet.robot.mjcf import compile_spec, inspect_mjcf, read_mjcf
from gaponet.robot.spec import RobotSpec
from gaponet.robot.toml_file import Link
from gaponet.sim.model import (
    PAYLOAD_DENSITY,
    STIFF_SOLIMP,
    STIFF_SOLREF,
    TABLE,
    TOLERANCE,
    build_model,
    carried,
    driven_joints,
    numbers_of_pairs,
    require_payload_mass,
)

MUJOCO_HAS_RAMPS = hasattr(mujoco.MjsActuator, "set_to_pid")  # from MuJoCo 4 on

SERVO_ATTRIBUTES = ("name", "class", "group", "user")  # that a servo keeps
JOINT_ATTRIBUTES = ("armature", "damping", "frictionloss")  # that are identified
SAME_REFERENCE_RAD = 1e-6  # between two joints' references; files have at least seven digits
ACTUATORS = (
    "general",
    "motor",
    "position",
    "velocity",
    "intvelocity",
    "damper",
    "cylinder",
    "muscle",
    "adhesion",
    "dcmotor",
    "pid",
)
# What a servo may inherit from a default class, and the values of a servo without it.
INHERITED_ATTRIBUTES = {"armature": "0", "damping": "0 0 0", "delay": "0", "nsample": "0"}
START_TAG = re.compile(rb"""<(?:[^"'>]|"[^"]*"|'[^']*')*>""")
UNCHANGED_COUNTS = (
    "njnt",
    "nsite",
    "nsensor",
    "ntendon",
    "neq",
    "nkey",
    "ncam",
    "nlight",
    "nmesh",
    "nq",
)


@dataclass
class Tag:
    """An XML element.

    Attributes:
        parent: Name of the element around it; of the first elements of an included file, the one
            around its <include>.
        start, open_end: Start and end of its start tag, bytes of the file.
        end: End of the element, bytes of the file.
    """

    file: Path
    name: str
    attributes: dict[str, str]
    parent: str
    start: int
    open_end: int
    end: int = 0
    is_closed: bool = False  # written <name/>, with no end tag


Edit = tuple[Path, int, int, bytes]  # file, start and end of the bytes to replace, new bytes


@dataclass
class Source:
    """Text of a file and of those that it includes, and the changes to make in it.

    Attributes:
        encoding: File → the encoding that it declares.
        edits: Changes, in the order in which they were asked for.
        insertions: Texts to insert at the beginning of an element, in this order.
        sections: Name of a section → text to add in such a section at the end of the main file.
    """

    main: Path
    text: dict[Path, bytes] = field(default_factory=dict)
    encoding: dict[Path, str] = field(default_factory=dict)
    tags: list[Tag] = field(default_factory=list)
    edits: list[Edit] = field(default_factory=list)
    insertions: list[tuple[Tag, str]] = field(default_factory=list)
    sections: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        inspect_mjcf(self.main)
        self._read(self.main)

    def _read(self, file: Path, around: str = "") -> None:
        """Read a file and those that it includes.

        Args:
            around: Name of the element around its <include>; "" for the main file.
        """
        text = file.read_bytes()
        self.text[file] = text
        self.encoding[file] = "utf-8"
        if text[:2] in (b"\xff\xfe", b"\xfe\xff"):
            raise RobotError(f"{file}: is in UTF-16; write it in UTF-8")
        parser = expat.ParserCreate()
        open_tags = list[Tag]()

        def declare(version: str, encoding: str | None, standalone: int) -> None:
            self.encoding[file] = encoding or "utf-8"

        def begin(name: str, attributes: dict[str, str]) -> None:
            start = parser.CurrentByteIndex
            match = START_TAG.match(text, parser.CurrentByteIndex)
            assert match is not None
            parent = open_tags[-1].name if open_tags else ""
            if around and len(open_tags) == 1:
                parent = around
            open_tags.append(Tag(file, name, attributes, parent, start, match.end()))
            self.tags.append(open_tags[-1])

        def end(name: str) -> None:
            tag = open_tags.pop()
            tag.is_closed = text.endswith(b"/>", tag.start, tag.open_end)
            if tag.is_closed:
                tag.end = tag.open_end
            else:
                tag.end = text.index(b">", parser.CurrentByteIndex) + 1

        parser.XmlDeclHandler = declare
        parser.StartElementHandler = begin
        parser.EndElementHandler = end
        try:
            parser.Parse(text, True)
        except expat.ExpatError as error:
            raise RobotError(f"{file}: not valid MJCF: {error}") from None
        for tag in list(self.tags):  # the included files add theirs
            if tag.file == file and tag.name == "include":
                self._read(self.main.parent / tag.attributes["file"], tag.parent)

    def set(self, tag: Tag, **values: object) -> None:
        """Change attributes of a start tag, and add missing ones."""
        text = self.text[tag.file][tag.start : tag.open_end]
        for name, value in values.items():
            own = re.compile(rb"""(\s%s\s*=\s*)("[^"]*"|'[^']*')""" % name.encode())
            written = self._encoded(tag.file, f'"{value}"')
            if own.search(text):
                text = own.sub(lambda m, w=written: m[1] + w, text, count=1)  # type: ignore[misc]
            else:
                head = re.match(rb"(.*?)(\s*/?>)$", text, re.DOTALL)
                assert head is not None
                text = head[1] + f" {name}=".encode() + written + head[2]
        self.edits.append((tag.file, tag.start, tag.open_end, text))

    def replace(self, tag: Tag, text: str) -> None:
        """Replace an element."""
        self.edits.append((tag.file, tag.start, tag.end, self._encoded(tag.file, text)))

    def insert(self, at: Tag, text: str) -> None:
        """Insert text at the beginning of an element."""
        self.insertions.append((at, text))

    def append(self, section: str, text: str) -> None:
        """Add text to a section at the end of the main file."""
        self.sections[section] = self.sections.get(section, "") + text

    def edited(self) -> dict[Path, bytes]:
        """Return the files with all changes."""
        out = dict(self.text)
        root = next(t for t in self.tags if t.file == self.main)
        place = self.text[self.main].rindex(b"</", 0, root.end)
        ends = ""
        for name, text in self.sections.items():
            ends += f"  <{name}>\n{text}  </{name}>\n" if text else f"  <{name}/>\n"
        sections = (self.main, place, place, self._encoded(self.main, ends))
        edits = [*self.edits, *self._insertion_edits(), sections]
        edits.reverse()  # of changes at one place, the last that was asked for is made first
        edits.sort(key=_from_the_back)
        for file, start, end, new in edits:
            out[file] = out[file][:start] + new + out[file][end:]
        return out

    def _insertion_edits(self) -> list[Edit]:
        """Return the changes that make the insertions.

        An element that is written <name/> gets an end tag, else it would end before the insertion.
        """
        inserted = dict[tuple[Path, int], str]()
        tags = dict[tuple[Path, int], Tag]()
        for tag, text in self.insertions:
            place = tag.file, tag.open_end
            tags[place] = tag
            inserted[place] = inserted.get(place, "") + f"\n{text}"
        edits = list[Edit]()
        for place, text in inserted.items():
            file, open_end = place
            start = open_end
            new = text
            if tags[place].is_closed:
                start -= len(b"/>")
                new = f">{text}</{tags[place].name}>"
            edits.append((file, start, open_end, self._encoded(file, new)))
        return edits

    def _encoded(self, file: Path, text: str) -> bytes:
        """Return text in the encoding of a file."""
        return text.encode(self.encoding[file], "xmlcharrefreplace")

    def one(self, what: str, kind: str, **attribute: str) -> Tag | None:
        """Return the only element with an attribute, None if there is none; refuse several.

        Args:
            kind: Name of the element, or "actuator/" for any element in an <actuator>.
        """
        kinds = {"actuator": "actuator/", "equality": ""}  # parent → kind; else the element's name
        same = [tag for tag in self.tags if kinds.get(tag.parent, tag.name) == kind]
        tags = [tag for tag in same if attribute.items() <= tag.attributes.items()]
        if len(tags) > 1:
            raise RobotError(
                f"{self.main}: has {len(tags)} {what}; one is needed. Delete or rename the others"
            )
        return tags[0] if tags else None

    def child(self, parent: Tag, name: str) -> Tag | None:
        """Return the first element of a name in another one, which is in no body in between."""
        inside = []
        for tag in self.tags:
            if tag.file == parent.file and parent.open_end <= tag.start < parent.end:
                inside.append(tag)
        bodies = [tag for tag in inside if tag.name == "body"]
        for tag in inside:
            in_body = any(body.start < tag.start < body.end for body in bodies)
            if tag.name == name and not in_body:
                return tag
        return None

    def changes(self) -> str:
        """Return the changes as a unified diff."""
        edited = self.edited()
        lines = list[str]()
        for file, old in self.text.items():
            encoding = self.encoding[file]
            before = old.decode(encoding).splitlines(keepends=True)
            after = edited[file].decode(encoding).splitlines(keepends=True)
            lines += difflib.unified_diff(before, after, f"a/{file.name}", f"b/{file.name}", n=1)
        return "".join(lines)

    def require_outside(self, out: Path) -> None:
        """Refuse to write into a folder that has the file itself."""
        if self.main.is_relative_to(out.resolve()):
            raise RobotError(
                f"{self.main}: lies in {out}, where the copy is written; name another folder with "
                "--out, or give the original file if this one is a copy of an earlier export"
            )


def _from_the_back(edit: Edit) -> tuple[int, bool]:
    """Return the key by which edits are made: later places first.

    Of an insertion right before an element that changes, the element comes first.
    """
    _, start, end, _ = edit
    return -start, start == end


def edit_mjcf(
    path: Path, out: Path, robot: RobotSpec, facts: dict[str, Any], payload_mass: float = 0.0
) -> tuple[Path, list[str]]:
    """Write a copy of an MJCF and of all its files, with the servos of a robot.

    Args:
        path: The file.
        out: Folder for the copy.
        robot: Robot with the table and payload mounts to add.
        facts: facts.json, with the prefix of joint names in the file. The plain form is written;
            delay buffers are long enough for both forms. A joint that is not operated changes only
            if the file has no servo for it.
        payload_mass: In each hand, kg.

    Returns:
        The copied main file, and joints with targets in another unit than rad. changes.diff in
        `out` has the changes.

    Raises:
        RobotError: A joint is not in the text or has several servos, or the compiled copy lacks the
            wanted servos.
    """
    path = path.resolve()
    joints = facts["plain"]
    prefix = facts["prefix"]
    spec = read_mjcf(path)
    before = compile_spec(spec, path)
    source = Source(path)
    source.require_outside(out)
    nominal = build_model(robot.before_identification)
    inherited = _inherited_attributes(source)
    homes_of_added = []  # targets of servos that the file did not have, for keyframes
    not_rad = []
    for name, servo in joints.items():
        full = prefix + name
        tag = _joint_tag(source, full, before)
        actuator = _servo_tag(source, full)
        if actuator is not None and name not in robot.operated:
            continue
        if has_earlier_zero(before, full, nominal, name):
            raise RobotError(
                f"{path}: joint '{full}' has the encoder zero of an earlier export; give the "
                "original file"
            )
        source.set(tag, **_joint_attributes(servo, full, before, spec.compiler.degree))
        delay = max(servo["delay"], facts["joints"][name]["delay"])
        samples = _buffer_length(delay, before.opt.timestep)
        if actuator is None:
            added = _servo(servo, samples, inherited | {"name": full, "joint": full})
            source.append("actuator", f"    {added}\n")
            homes_of_added.append(text_of(servo["home"]))
            continue
        own = inherited | _servo_attributes(actuator, before, full)
        source.replace(actuator, _servo(servo, samples, own))
        if abs(_radians_per_unit(before, full) - 1) > 1e-3:
            not_rad.append(full)
    if homes_of_added:
        _extend_keyframes(source, homes_of_added)
    _add_surroundings(source, robot, prefix, payload_mass, before)
    places = _places(source)
    target = out / places[source.main]
    changes = source.changes()
    with tempfile.TemporaryDirectory() as trial:
        _write_files(source, places, Path(trial))
        copied = _compile(Path(trial) / places[source.main], target)
    _require(copied, before, joints, robot, prefix, target)
    _require_payload(copied, robot, prefix, payload_mass, target)
    with lock_folder(out, "engine"):
        _write_files(source, places, out)
        write_text(out / "changes.diff", changes)
    return target, not_rad


def has_earlier_zero(model: mujoco.MjModel, joint: str, nominal: mujoco.MjModel, name: str) -> bool:
    """Return True if gaponet has subtracted an encoder's zero from a joint of a model already.

    Such a joint has gaponet's stiff friction, and its reference is not that of the nominal robot.
    A second subtraction would move the joint.

    Args:
        joint: Name in the model.
        nominal: The robot before identification.
        name: Name in the robot.
    """
    dof = model.joint(joint).dofadr[0]
    solref = model.dof_solref[dof]
    solimp = model.dof_solimp[dof]
    if not np.allclose(solref, STIFF_SOLREF) or not np.allclose(solimp, STIFF_SOLIMP):
        return False
    reference = float(model.joint(joint).qpos0[0])
    original = float(nominal.joint(name).qpos0[0])
    return abs(reference - original) > SAME_REFERENCE_RAD


def _joint_tag(source: Source, name: str, model: mujoco.MjModel) -> Tag:
    """Return the element of a joint."""
    tag = source.one(f"joints '{name}'", "joint", name=name)
    if tag is None:
        have = ", ".join(model.joint(i).name for i in range(model.njnt))
        raise RobotError(
            f"{source.main}: has no joint '{name}' in its text (--prefix is the text before "
            f"names); it has {have}"
        )
    return tag


def _servo_tag(source: Source, joint: str) -> Tag | None:
    """Return the element of the actuator that drives a joint, None if there is none."""
    what = f"servos of '{joint}'"
    on_joint = source.one(what, "actuator/", joint=joint)
    in_parent = source.one(what, "actuator/", jointinparent=joint)
    if on_joint is not None and in_parent is not None:
        raise RobotError(f"{source.main}: has 2 {what}; one is needed. Delete or rename the others")
    return on_joint or in_parent


def _joint_attributes(
    servo: dict[str, Any], joint: str, model: mujoco.MjModel, in_degrees: bool
) -> dict[str, str]:
    """Return the attributes of a joint that change.

    Args:
        servo: Wanted values.
        joint: Name in the file.
        model: The file, compiled.
        in_degrees: The file has angles in degrees.
    """
    changed = {field: text_of(servo[field]) for field in JOINT_ATTRIBUTES}
    higher_orders = model.dof_dampingpoly[model.joint(joint).dofadr[0]]
    if higher_orders.any():  # they may come from a default class
        changed["damping"] = text_of(servo["damping"], *np.zeros(higher_orders.size))
    if servo["zero"]:
        ref = model.qpos0[model.joint(joint).qposadr[0]] - servo["zero"]
        changed["ref"] = text_of(math.degrees(ref) if in_degrees else ref)
    changed["solreffriction"] = text_of(*STIFF_SOLREF)
    changed["solimpfriction"] = text_of(*STIFF_SOLIMP)
    return changed


def _buffer_length(delay: float, timestep: float) -> int:
    """Return the length of a delay buffer in physics steps, 0 without a delay; both in s."""
    if not delay:
        return 0
    return math.ceil(delay / timestep - 1e-9) + 2


def _inherited_attributes(source: Source) -> dict[str, str]:
    """Return the attributes of INHERITED_ATTRIBUTES that a default of the file gives servos.

    Others are not written, because older versions of MuJoCo refuse them.
    """
    inherited = {}
    for tag in source.tags:
        if tag.parent != "default" or tag.name not in ACTUATORS:
            continue
        for name, none in INHERITED_ATTRIBUTES.items():
            if name in tag.attributes:
                inherited[name] = none
    return inherited


def _extend_keyframes(source: Source, homes: list[str]) -> None:
    """Append the targets of added servos to the keyframes that have targets."""
    for key in source.tags:
        if key.name == "key" and "ctrl" in key.attributes:
            source.set(key, ctrl=" ".join([key.attributes["ctrl"], *homes]))


def _servo(servo: dict[str, Any], samples: int, own: dict[str, str]) -> str:
    """Return a servo as a <general> actuator.

    Args:
        samples: Length of its delay buffer, physics steps; 0 for no delay.
        own: Attributes that stay as they are in the file.
    """
    kp = servo["kp"]
    limit = servo["effort_limit"]
    attributes = own | {
        "gear": "1",
        "dyntype": "none",
        "gaintype": "fixed",
        "gainprm": text_of(kp),
        "biastype": "affine",
        "biasprm": text_of(kp * servo["offset"], -kp, -servo["kd"]),
        "forcelimited": "true",
        "forcerange": text_of(-limit, limit),
    }
    if _is_ramped(servo):
        attributes |= {
            "dyntype": "pid",
            "dynprm": text_of(0.0, servo["target_speed"]),
            "gaintype": "pid",
            "gainprm": "0",
            "input": "pos",
        }
    if samples:
        attributes |= {
            "delay": text_of(servo["delay"]),
            "nsample": str(samples),
            "interp": "linear",
        }
    return f"<general {_attributes(attributes)}/>"


def _is_ramped(servo: dict[str, Any]) -> bool:
    """Return True for a servo that limits its targets' speed, if MuJoCo can (<pid slewmax>)."""
    return MUJOCO_HAS_RAMPS and servo["target_speed"] > 0


def _servo_attributes(tag: Tag, model: mujoco.MjModel, joint: str) -> dict[str, str]:
    """Return the attributes that a servo keeps.

    Name, class, and the range of its targets if it is a position servo.
    """
    own = {}
    for name in SERVO_ATTRIBUTES:
        if name in tag.attributes:
            own[name] = tag.attributes[name]
    own["joint"] = joint
    i = _actuator(model, joint)
    if model.actuator_ctrllimited[i] and model.actuator_biasprm[i, 1]:
        limits = sorted(_radians_per_unit(model, joint) * model.actuator_ctrlrange[i])
        return own | {"ctrllimited": "true", "ctrlrange": text_of(*limits)}
    return own | {"ctrllimited": "false"}


def _actuator(model: mujoco.MjModel, joint: str) -> int:
    return int(np.flatnonzero(driven_joints(model) == model.joint(joint).id)[0])


def _radians_per_unit(model: mujoco.MjModel, joint: str) -> float:
    """Return the position of a servo for a target of 1, rad: 0.0175 if targets are degrees.

    It is negative for a servo that turns against its targets, such as one with gear −1, and 1 for
    an actuator without targets.
    """
    i = _actuator(model, joint)
    stiffness = -float(model.actuator_biasprm[i, 1])
    gear = float(model.actuator_gear[i, 0])
    gain = float(model.actuator_gainprm[i, 0])
    if model.actuator_gaintype[i] == getattr(mujoco.mjtGain, "mjGAIN_PID", None):
        gain = stiffness  # a <pid> has its stiffness in biasprm alone
    if stiffness <= 0 or gain == 0 or gear == 0:
        return 1.0
    return gain / (stiffness * gear)


def _add_surroundings(
    source: Source, robot: RobotSpec, prefix: str, payload_mass: float, model: mujoco.MjModel
) -> None:
    """Add the solver's tolerance, table and payload, and write inertias of identified links."""
    option = {}
    if model.opt.tolerance > TOLERANCE:
        option["tolerance"] = text_of(TOLERANCE)
    if robot.scene.table is not None and _may_touch_table(model):
        option["cone"] = "elliptic"  # a pyramid's stiffness depends on friction
        if not _has_contacts(model):  # the pairs with the table are then the only ones
            source.append("option", '    <flag contact="enable"/>\n')
        _add_table(source, robot, robot.scene.table.height, prefix)
    for name, link in robot.links.items():
        tag = _body(source, prefix + name, "identified_link")
        _write_inertia(source, tag, link)
    for mount in robot.payload_mounts:
        mass = carried(robot, mount, payload_mass)
        if mass:
            tag = _body(source, prefix + mount.body, "payload_mount")
            name = f"{prefix}payload_{mount.side}"
            _require_free(source, "body", name)
            source.insert(tag, _payload(name, mass, mount.pos))
    if option:
        source.append(f"option {_attributes(option)}", "")


def _has_contacts(model: mujoco.MjModel) -> bool:
    return not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT


def _may_touch_table(model: mujoco.MjModel) -> bool:
    """Return False if enabled contacts would also let geoms of the file meet, which do not now."""
    return _has_contacts(model) or not (model.geom_contype | model.geom_conaffinity).any()


def _body(source: Source, name: str, what: str) -> Tag:
    """Return the element of a body that a table of robot.toml, `what`, names."""
    tag = source.one(f"bodies '{name}'", "body", name=name)
    if tag is None:
        raise RobotError(
            f"{source.main}: a [[{what}]] names body '{name}', which is not in its text"
        )
    return tag


def _require_free(source: Source, kind: str, name: str) -> None:
    """Refuse a file that has an element of a name which the copy adds."""
    if source.one(f"elements <{kind}> '{name}'", kind, name=name) is not None:
        raise RobotError(
            f"{source.main}: has a {kind} '{name}' of an earlier export; give the original file, "
            f"or delete this {kind}"
        )


def _add_table(source: Source, robot: RobotSpec, height: float, prefix: str) -> None:
    """Add a plane at a height, m, and its contacts with the robot's tips."""
    own = build_model(robot)
    table = prefix + TABLE
    _require_free(source, "geom", table)
    plane = (
        f'<geom name="{table}" type="plane" size="2 2 0.1" contype="0" conaffinity="0" '
        f'pos="0 0 {text_of(height)}" rgba="0.55 0.5 0.45 1"/>'
    )
    source.append("worldbody", f"    {plane}\n")
    pairs = numbers_of_pairs(own)
    for i, tip in enumerate(robot.scene.tips):
        name = f"{table}_tip_{i}"
        sphere = (
            f'<geom name="{name}" type="sphere" size="{text_of(tip.radius)}" '
            f'pos="{text_of(*tip.pos)}" mass="0" contype="0" conaffinity="0" group="3"/>'
        )
        source.insert(_body(source, prefix + tip.body, "tip"), sphere)
        k = pairs[frozenset((TABLE, f"{TABLE}_tip_{i}"))]
        contact = {
            "friction": text_of(*own.pair_friction[k]),
            "solref": text_of(*own.pair_solref[k]),
            "solimp": text_of(*own.pair_solimp[k]),
        }
        pair = f'<pair geom1="{name}" geom2="{table}" condim="3" {_attributes(contact)}/>'
        source.append("contact", f"    {pair}\n")


def _write_inertia(source: Source, body: Tag, link: Link) -> None:
    """Write the mass, centre and inertia of a link in the place of the file's own."""
    attributes = {
        "mass": text_of(link.mass),
        "pos": text_of(*link.pos),
        "fullinertia": text_of(*link.inertia),
    }
    inertial = f"<inertial {_attributes(attributes)}/>"
    own = source.child(body, "inertial")
    if own is None:
        source.insert(body, inertial)
    else:
        source.replace(own, inertial)


def _payload(name: str, mass: float, pos: ListOf[float]) -> str:
    """Return a body with a ball of a mass, kg, at pos, m."""
    radius = (3 * mass / (4 * math.pi * PAYLOAD_DENSITY)) ** (1 / 3)
    ball = (
        f'<geom type="sphere" size="{text_of(radius)}" mass="{mass}" contype="0" conaffinity="0"/>'
    )
    return f'<body name="{name}" pos="{text_of(*pos)}">{ball}</body>'


def _attributes(values: dict[str, str]) -> str:
    return " ".join(f'{name}="{value}"' for name, value in values.items())


def _places(source: Source) -> dict[Path, Path]:
    """Return the files of a source, and all that they name: file → place in a copy's folder.

    The places are relative to each other as the files are.
    """
    named = mujoco.mju_getXMLDependencies(str(source.main))
    needed = {Path(os.path.abspath(file)) for file in named} | set(source.text)
    root = Path(os.path.commonpath([file.parent for file in needed]))
    return {file: file.relative_to(root) for file in sorted(needed)}


def _write_files(source: Source, places: dict[Path, Path], folder: Path) -> None:
    """Write the edited files and those that they name into a folder, at their places in it."""
    edited = source.edited()
    for file, place in places.items():
        copy = folder / place
        copy.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(copy) as temporary:
            if file in edited:
                temporary.write_bytes(edited[file])
            else:
                shutil.copyfile(file, temporary)


def _compile(file: Path, target: Path) -> mujoco.MjModel:
    """Return the compiled copy; its errors name the place where it would be written."""
    try:
        return compile_spec(read_mjcf(file), target)
    except RobotError as error:
        raise RobotError(str(error).replace(str(file), str(target))) from None


def _require(
    now: mujoco.MjModel,
    before: mujoco.MjModel,
    joints: Joints,
    robot: RobotSpec,
    prefix: str,
    path: Path,
) -> None:
    """Refuse a copy that lacks the wanted servos, or another element of the original."""
    wrong = []
    for count in UNCHANGED_COUNTS:
        old = getattr(before, count)
        new = getattr(now, count)
        if old != new:
            wrong.append(f"{count} {old} → {new}")
    for name in robot.operated:
        servo = joints[name]
        dof = now.joint(prefix + name).dofadr[0]
        i = _actuator(now, prefix + name)
        passive = []
        wanted_passive = []
        for attribute in JOINT_ATTRIBUTES:
            values = np.ravel(getattr(now, f"dof_{attribute}")[dof])  # of newer MuJoCo a polynomial
            passive.append(float(values[0]))
            wanted_passive.append(servo[attribute])
        higher_orders = now.dof_dampingpoly[dof]
        actual = [
            *passive,
            *higher_orders,
            *_own_effects(now, i),
            now.actuator_gear[i, 0],
            now.actuator_delay[i],
            now.actuator_gainprm[i, 0],
            *now.actuator_biasprm[i, :3],
            now.actuator_forcerange[i, 1],
        ]
        kp = servo["kp"]
        wanted = [
            *wanted_passive,
            *np.zeros(higher_orders.size),
            *np.zeros(len(_own_effects(now, i))),
            1.0,
            servo["delay"],
            0.0 if _is_ramped(servo) else kp,
            kp * servo["offset"],
            -kp,
            -servo["kd"],
            servo["effort_limit"],
        ]
        if not np.allclose(actual, wanted, rtol=1e-5, atol=1e-9):
            wrong.append(f"{name}: {np.round(actual, 6)} instead of {np.round(wanted, 6)}")
    for name, link in robot.links.items():
        body = now.body(prefix + name)
        if not np.allclose([*body.mass, *body.ipos], [link.mass, *link.pos], rtol=1e-5, atol=1e-9):
            wrong.append(
                f"body {name}: {body.mass[0]:.6g} kg instead of {link.mass:.6g} (inertiafromgeom?)"
            )
    if wrong:
        raise RobotError(f"{path}: the edited copy differs from the robot: {'; '.join(wrong[:3])}")


def _own_effects(model: mujoco.MjModel, actuator: int) -> list[float]:
    """Return the armature and the damping of an actuator itself, which add to those of its
    joint.
    """
    polynomial = np.ravel(model.actuator_dampingpoly[actuator])
    armature = float(model.actuator_armature[actuator])
    damping = float(model.actuator_damping[actuator])
    return [armature, damping, *polynomial.tolist()]


def _require_payload(
    model: mujoco.MjModel, robot: RobotSpec, prefix: str, payload_mass: float, path: Path
) -> None:
    """Refuse a copy in which a payload has another mass or place than in the robot."""
    for mount in robot.payload_mounts:
        wanted = carried(robot, mount, payload_mass)
        if not wanted:
            continue
        name = f"{prefix}payload_{mount.side}"
        number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
        if number < 0:
            raise RobotError(
                f"{path}: its <compiler> joins the payload '{name}' to another body; delete "
                "fusestatic"
            )
        require_payload_mass(path, mount, wanted, float(model.body_mass[number]))
        parent = model.body(model.body_parentid[number]).name
        place = model.body_pos[number]
        if parent != prefix + mount.body or not np.allclose(place, mount.pos, atol=1e-6):
            raise RobotError(
                f"{path}: the payload '{name}' is in body '{parent}' at {np.round(place, 4)} m "
                f"instead of '{prefix + mount.body}' at {np.round(mount.pos, 4)} m"
            )


def text_of(*numbers: float) -> str:
    """Return numbers as an attribute of MJCF or URDF has them."""
    return " ".join(f"{float(number):.9g}" for number in numbers)
