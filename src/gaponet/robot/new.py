"""Robot folders from vendors' models: unlogged joints become fixed, and every number states its
source.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path

import mujoco
import numpy as np

from gaponet.base.errors import RobotError, UsageError
from gaponet.base.files import whole_folder, write_text
from gaponet.robot.drives import ON_JOINT, Drive, drives
from gaponet.robot.freeze import (
    chain,
    delete_mocap_welds,
    delete_references,
    freeze,
    freeze_free,
    require_open,
)
from gaponet.robot.log_joints import Follower
from gaponet.robot.mjcf import compile_spec
from gaponet.robot.self_contained import self_contained_text
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.robot.toml_file import RobotOptions
from gaponet.robot.vendor import read_vendor

PICTURE = "picture.png"  # of a robot folder
HAND_PREFIXES = ("attachment", "tcp", "tool", "flange", "palm", "grip", "hand", "wrist")
COORDINATES = {mujoco.mjtJoint.mjJNT_FREE: 7, mujoco.mjtJoint.mjJNT_BALL: 4}  # of such a joint
IMPLICIT_INTEGRATORS = (
    mujoco.mjtIntegrator.mjINT_IMPLICIT,
    mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
)


@dataclass(frozen=True)
class NewRobot:
    """Result of new_robot."""

    robot: RobotSpec
    drives: tuple[Drive, ...]
    vendor: mujoco.MjModel  # the vendor's compiled model
    pose: np.ndarray  # its home pose, (nq)
    notes: list[str] = field(default_factory=list)  # what was omitted, fixed or corrected


def new_robot(
    path: Path,
    out: Path,
    options: RobotOptions,
    draw: Callable[[NewRobot], bytes | None] = lambda made: None,
) -> NewRobot:
    """Write the robot folder `out` from the MJCF or URDF at `path`; the folder is complete or
    absent.

    Args:
        draw: Returns the PNG of picture.png, or None for no picture.

    Raises:
        RobotError: The model is damaged, or has no joint to log.
        UsageError: An option does not fit the model, or a gain is stated nowhere.
    """
    spec, notes = read_vendor(path, _package_folders(options.packages))
    model = compile_spec(spec, path)
    recorded = _logged_joints(model, options.joints, path)
    pose, source = _home(model, options.keyframe, path)
    given = {name: getattr(options, name) for name in ("kp", "kd", "effort_limit", "servo")}
    followers = _followers(model, recorded, options.joints)
    motors = [name for name in recorded if name not in followers]
    logged = [name for name in _joint_names(model) if name in (*motors, *followers)]
    joint_drives = drives(model, motors, pose, given, path.name)
    notes += delete_mocap_welds(spec, model)
    require_open(spec, model, logged, path)
    notes += _notes(spec, model, logged, pose, source)
    for name, led in followers.items():
        notes.append(f"{name} follows {led.joint}, without a motor")
    _set_passive(spec, joint_drives)
    xml = _without_slashes(_robot_xml(spec, model, logged, pose, path, options.contacts), model)
    toml = _robot_toml(model, joint_drives, options, path, source, followers)
    toml = _without_slashes(toml, model)
    if _holds_another_robot(out, xml, toml):
        raise UsageError(f"{out}: holds a robot; choose another --out, or move it away")
    with whole_folder(out, "robot", last="robot.toml") as place:
        write_text(place / "robot.xml", xml)
        write_text(place / "robot.toml", toml)
        made = NewRobot(load_robot(place), joint_drives, model, pose, notes)
        picture = draw(made)
        if picture is not None:
            (place / PICTURE).write_bytes(picture)
    return replace(made, robot=load_robot(out))


def _set_passive(spec: mujoco.MjSpec, drives: ListOf[Drive]) -> None:
    """Give driven joints damping, friction and armature, SI."""
    for drive in drives:
        joint = spec.joint(drive.name)
        for name, value in drive.passive.items():
            is_polynomial = np.ndim(getattr(joint, name))  # of newer MuJoCo; a number of older
            setattr(joint, name, [[value], [0.0], [0.0]] if is_polynomial else value)


def _without_slashes(text: str, model: mujoco.MjModel) -> str:
    """Return a text with _ for / in the names of joints and bodies, which may become file names."""
    bodies = [model.body(body).name for body in range(model.nbody)]
    for name in (*_joint_names(model), *bodies):
        if "/" in name:
            text = text.replace(f'"{name}"', f'"{name.replace("/", "_")}"')
    return text


def _holds_another_robot(folder: Path, xml: str, toml: str) -> bool:
    """True if a folder holds a robot that is not the one to be written: the same command may be
    given again.
    """
    if not (folder / "robot.toml").exists():
        return False
    for name, text in (("robot.toml", toml), ("robot.xml", xml)):
        file = folder / name
        if not file.is_file() or file.read_text(encoding="utf-8", errors="replace") != text:
            return True
    return False


def _package_folders(texts: tuple[str, ...]) -> dict[str, Path]:
    """Return package → folder, from texts NAME=FOLDER."""
    folders = {}
    for text in texts:
        name, folder = _pair(text)
        folders[name] = Path(folder)
    return folders


def _pair(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not equals or not name or not value:
        raise UsageError(f"'{text}': write NAME=VALUE")
    return name, value


def _logged_joints(model: mujoco.MjModel, patterns: tuple[str, ...], path: Path) -> list[str]:
    """Return the names of the hinges to log, in the model's order."""
    kinds = dict(zip(_joint_names(model), map(mujoco.mjtJoint, model.jnt_type), strict=True))
    kinds.pop("", None)
    hinges = [name for name, kind in kinds.items() if kind == mujoco.mjtJoint.mjJNT_HINGE]
    if not hinges:
        raise RobotError(f"{path}: has no named hinge joint, so no joint angle to log")
    for name in set(patterns) & set(kinds) - set(hinges):
        kind = kinds[name].name.removeprefix("mjJNT_").lower()
        raise UsageError(
            f"--joints {name}: is a {kind} joint, and gaponet supports angles only (rad, N·m); "
            "leave it out, then it is fixed at home"
        )
    named: set[str] = set()
    for pattern in patterns:
        found = [name for name in hinges if fnmatchcase(name, pattern)]
        if not found:
            raise UsageError(f"--joints {pattern}: no such joint; there are: {', '.join(hinges)}")
        named.update(found)
    if patterns:
        return [name for name in hinges if name in named]
    actuated = _actuated_joints(model)
    return [name for name in hinges if name in actuated] or hinges


def _actuated_joints(model: mujoco.MjModel) -> set[str]:
    """Return the names of the joints that an actuator drives."""
    on_joint = np.isin(model.actuator_trntype, ON_JOINT)
    return {model.joint(joint).name for joint in model.actuator_trnid[on_joint, 0]}


def _followers(
    model: mujoco.MjModel, logged: list[str], patterns: tuple[str, ...]
) -> dict[str, Follower]:
    """Return the hinges that an equality lets follow a logged hinge in proportion: URDF's mimic
    joints.

    A joint that has an actuator, or that the user names, counts as driven by a motor of its own.
    """
    followers = {}
    motors = {*_actuated_joints(model), *patterns}
    couples = (model.eq_type == mujoco.mjtEq.mjEQ_JOINT) & model.eq_active0.astype(bool)
    for equality in np.flatnonzero(couples):
        name = _hinge_name(model, model.eq_obj1id[equality])
        leader = _hinge_name(model, model.eq_obj2id[equality])
        constant, ratio, *curved = model.eq_data[equality, :5].tolist()
        if not (name and leader) or any(curved) or leader not in logged or name in motors:
            continue
        zero = _reference(model, name)
        leader_zero = _reference(model, leader)
        followers[name] = Follower(leader, ratio, zero + constant - ratio * leader_zero)
    behind_motors = {}
    for name in followers:
        follower = _behind_motor(name, followers)
        if follower is not None:
            behind_motors[name] = follower
    return behind_motors


def _behind_motor(name: str, followers: dict[str, Follower]) -> Follower | None:
    """Return a follower by the joint with a motor at the head of its chain; None for a circle."""
    follower = followers[name]
    seen = {name}
    while follower.joint in followers:
        if follower.joint in seen:
            return None
        seen.add(follower.joint)
        leader = followers[follower.joint]
        at_zero = follower.ratio * leader.at_zero + follower.at_zero
        follower = Follower(leader.joint, follower.ratio * leader.ratio, at_zero)
    return follower


def _hinge_name(model: mujoco.MjModel, joint: int) -> str:
    """Return the name of a hinge; "" for another joint, or none (−1)."""
    if joint < 0 or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_HINGE:
        return ""
    return str(model.joint(joint).name)


def _reference(model: mujoco.MjModel, joint: str) -> float:
    """Return the angle of a hinge in the model's zero, rad."""
    return float(model.qpos0[model.jnt_qposadr[model.joint(joint).id]])


def _joint_names(model: mujoco.MjModel) -> list[str]:
    return [model.joint(j).name for j in range(model.njnt)]


def _home(model: mujoco.MjModel, keyframe: str, path: Path) -> tuple[np.ndarray, str]:
    """Return the home pose (nq) within the joint ranges, and its source."""
    keys = [model.key(k).name for k in range(model.nkey)]
    if keyframe and keyframe not in keys:
        raise UsageError(f"--keyframe {keyframe}: {path.name} has {', '.join(keys) or 'none'}")
    source = "the model's zero"
    pose = model.qpos0.copy()
    if keys:
        source = f'keyframe "{keyframe or keys[0]}"'
        chosen = keys.index(keyframe) if keyframe else 0
        pose = model.key_qpos[chosen].copy()
    for j in np.flatnonzero(model.jnt_limited):
        if mujoco.mjtJoint(model.jnt_type[j]) in COORDINATES:
            continue  # its range limits an angle, which is no coordinate
        at = model.jnt_qposadr[j]
        low, high = model.jnt_range[j]
        if not low - 1e-6 <= pose[at] <= high + 1e-6:
            pose[at] = (low + high) / 2
        pose[at] = np.clip(pose[at], low, high)
    return pose, source


def _notes(
    spec: mujoco.MjSpec, model: mujoco.MjModel, logged: list[str], pose: np.ndarray, source: str
) -> list[str]:
    """Describe what is fixed and omitted.

    Args:
        source: Of the home pose.
    """
    notes = []
    fixed = _fixed_joints(model, logged, pose, source)
    if fixed:
        notes.append(f"frozen: {', '.join(fixed)}")
    notes += _coupled_joints(spec, logged)
    if (model.jnt_type == mujoco.mjtJoint.mjJNT_FREE).any():
        notes.append(
            "the base is fixed here: fasten the robot while it is recorded, a hanging base swings"
        )
    dropped = {"actuator": model.nu, "keyframe": model.nkey, "sensor": model.nsensor}
    gone = ", ".join(f"{count} {kind}(s)" for kind, count in dropped.items() if count)
    if gone:
        notes.append(f"left out: {gone}; gains and limits stand in robot.toml")
    if spec.option.integrator not in IMPLICIT_INTEGRATORS:
        notes.append(
            "integrator: implicitfast, which takes servos' kd into account; the model's own does "
            "not"
        )
    return notes


def _fixed_joints(
    model: mujoco.MjModel, logged: list[str], pose: np.ndarray, source: str
) -> list[str]:
    """Return the names of the joints that become fixed, and where."""
    units = {mujoco.mjtJoint.mjJNT_HINGE: "rad", mujoco.mjtJoint.mjJNT_SLIDE: "m"}
    fixed = []
    for joint in range(model.njnt):
        name = model.joint(joint).name
        if name in logged:
            continue
        unit = units.get(mujoco.mjtJoint(model.jnt_type[joint]))
        where = f"as in {source}"
        if unit:
            where = f"at {pose[model.jnt_qposadr[joint]]:.3g} {unit}"
        body = model.body(model.jnt_bodyid[joint]).name
        fixed.append(f"{name or body or 'unnamed'} {where}")
    return fixed


def _coupled_joints(spec: mujoco.MjSpec, logged: list[str]) -> list[str]:
    """Return a note on each fixed joint that moves with a logged one."""
    notes = []
    for equality in spec.equalities:
        if equality.type != mujoco.mjtEq.mjEQ_JOINT or not equality.name2 or not equality.active:
            continue
        pair = [name for name in (equality.name1, equality.name2) if name in logged]
        if len(pair) != 1:
            continue
        own = pair[0]
        other = equality.name2 if equality.name1 == own else equality.name1
        notes.append(
            f"{other} moves with {own} and is fixed here: identified kp, friction and armature of "
            f"{own} are those of its own link, smaller in proportion to the mass of both links"
        )
    return notes


def _robot_xml(
    spec: mujoco.MjSpec,
    model: mujoco.MjModel,
    logged: list[str],
    pose: np.ndarray,
    path: Path,
    contacts: bool,
) -> str:
    """Return robot.xml: one file without fixed joints and the elements that refer to them."""
    values = dict(zip(_joint_names(model), pose[model.jnt_qposadr], strict=True))
    delete_references(spec, set(values) - set(logged))
    # The specification has the model's order; a list, because a deletion renumbers its joints.
    for joint, first in zip(list(spec.joints), model.jnt_qposadr, strict=True):
        if joint.type in COORDINATES:
            place = slice(first, first + COORDINATES[joint.type])
            freeze_free(spec, joint, model.qpos0[place], pose[place])
    if spec.option.integrator not in IMPLICIT_INTEGRATORS:
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # explicit inertias, quaternions, no classes
    plain = mujoco.MjSpec.from_string(self_contained_text(spec, path))
    for joint in list(plain.joints):
        if joint.name not in logged:
            freeze(plain, joint, values[joint.name])
    for joint in plain.joints:
        # effort_limit of robot.toml is the limit
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
    if not contacts:
        _disable_contacts(plain)
    return self_contained_text(plain, path)


def _disable_contacts(spec: mujoco.MjSpec) -> None:
    """Disable contacts; delete collision geoms of bodies that also have visual ones."""
    for body in spec.bodies:
        colliding = [g for g in body.geoms if g.contype or g.conaffinity]
        for geom in colliding:
            if len(colliding) < len(body.geoms):
                spec.delete(geom)
            else:
                geom.contype = geom.conaffinity = 0
    for pair in [*spec.pairs, *spec.excludes]:
        spec.delete(pair)


def _robot_toml(
    model: mujoco.MjModel,
    joint_drives: tuple[Drive, ...],
    options: RobotOptions,
    path: Path,
    source: str,
    followers: dict[str, Follower],
) -> str:
    """Return robot.toml, with the source of every number as a comment.

    Args:
        source: Of the home position.
    """
    drive_of = {drive.name: drive for drive in joint_drives}
    lines = _head_lines(model, options, path)
    for name in _joint_names(model):
        if name in followers:
            lines += _follower_lines(name, followers[name], path)
        elif name in drive_of:
            lines += _joint_lines(drive_of[name], source, names=set(drive_of))
    for side, body, pos, why in _mounts(model, list(drive_of)):
        lines += [
            "",
            f"[[payload_mount]]  # {why}",
            f"side = {json.dumps(side)}",
            f"body = {json.dumps(body)}",
            f"pos = {[round(float(x), 6) for x in pos]}",
        ]
    return "\n".join(map(_printable, lines)) + "\n"


def _printable(text: str) -> str:
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def _head_lines(model: mujoco.MjModel, options: RobotOptions, path: Path) -> list[str]:
    """Return the lines of robot.toml about the whole robot.

    Raises:
        UsageError: The rate is no rate.
    """
    if not (0 < options.rate <= 1000):
        raise UsageError(f"--rate {options.rate}: give the rate of the commands in Hz, up to 1000")
    dt = 1 / options.rate
    steps = max(1, math.ceil(dt / model.opt.timestep - 1e-6))
    name = options.name
    if not name:
        is_general = path.stem in ("robot", "model", "scene")
        stem = path.resolve().parent.name if is_general else path.stem
        name = re.sub(r"[^\w-]", "_", stem)
    return [
        f"# Made from {path.name} by gaponet robot new; every number may be changed here.",
        f"name = {json.dumps(name)}",
        f"dt = {dt!r}  # control period, s: --rate",
        f"timestep = {dt / steps!r}  # physics step, s; {path.name} has {model.opt.timestep:g}",
        f"contacts = {str(options.contacts).lower()}  # --contacts keeps geoms that touch, and "
        "lets them",
    ]


def _joint_lines(drive: Drive, source: str, names: set[str]) -> list[str]:
    """Return the lines of robot.toml about a joint.

    Args:
        source: Of the home position.
        names: Of all joints; an actuator with another name is an alias.
    """
    lines = ["", "[[joint]]", f"name = {json.dumps(drive.name)}"]
    if drive.actuator and drive.actuator not in names:
        lines.append(f"aliases = [{json.dumps(drive.actuator)}]  # its actuator")
    lines += [
        f"kp = {drive.kp!r}  # N·m/rad: {drive.kp_source}",
        f"kd = {drive.kd!r}  # N·m·s/rad: {drive.kd_source}",
        f"effort_limit = {drive.limit!r}  # N·m: {drive.limit_source}",
    ]
    if drive.servo:
        lines.append(f"servo = {json.dumps(drive.servo.name, ensure_ascii=False)}  # --servo")
    return [*lines, f"home = {float(drive.home)!r}  # rad: {source}", "operated = true"]


def _follower_lines(name: str, follower: Follower, path: Path) -> list[str]:
    return [
        "",
        "[[joint]]",
        f"name = {json.dumps(name)}",
        f"follows = {json.dumps(follower.joint)}  # a mimic joint of {path.name}: no motor of its "
        "own",
        f"ratio = {follower.ratio!r}  # its angle per rad of that joint",
        f"at_zero = {follower.at_zero!r}  # rad",
        "kp = 0.0",
        "effort_limit = 1.0  # of no use without kp",
        "operated = false",
    ]


def _mounts(model: mujoco.MjModel, joints: list[str]) -> list[tuple[str, str, np.ndarray, str]]:
    """Guess payload mounts: side, body, position in it (m), and source."""
    moved = {int(model.jnt_bodyid[model.joint(name).id]) for name in joints}
    tips = []  # nothing moves beyond them
    for body in sorted(moved):
        if moved.isdisjoint(_beyond(model, body)[1:]):
            tips.append(body)
    ends = tips
    if len(tips) > 1:
        hands = [tip for tip in tips if _has_hand(model, tip)]
        ends = _palms(model, _without_fingers(model, hands, moved))
    mounts: list[tuple[str, str, np.ndarray, str]] = []
    for end in ends:
        body, pos, why = _mount(model, end, is_tip=end in tips)
        side = _side(model, end) or f"hand{len(mounts) or ''}"
        text = f"a guess: {why}; correct side, body and pos"
        mounts.append((side, model.body(body).name, pos, text))
    return mounts


def _mount(model: mujoco.MjModel, end: int, *, is_tip: bool) -> tuple[int, np.ndarray, str]:
    """Return where a payload may hang on a body: body, position in it (m), and source.

    A site of a hand is best; then, beyond a tip, a body of a hand; else the centre of mass.
    """
    beyond = _beyond(model, end)
    for site in range(model.nsite):
        name = model.site(site).name
        if model.site_bodyid[site] in beyond and _hand(name):
            return int(model.site_bodyid[site]), model.site_pos[site], name
    bodies = []
    for body in beyond:
        if body != end and _hand(model.body(body).name):
            bodies.append(body)
    if is_tip and bodies:
        return bodies[-1], np.zeros(3), model.body(bodies[-1]).name
    return end, model.body_ipos[end], "the last link's centre of mass"


def _side(model: mujoco.MjModel, body: int) -> str:
    """Return left or right if the name of a body says so; else ""."""
    name = model.body(body).name.lower()
    for word in ("left", "right"):
        if word in name:
            return word
    return ""


def _has_hand(model: mujoco.MjModel, body: int) -> bool:
    """Return True if a body or one beyond it is named as a hand is."""
    return any(_hand(model.body(other).name) for other in _beyond(model, body))


def _without_fingers(model: mujoco.MjModel, ends: list[int], moved: set[int]) -> list[int]:
    """Replace the fingers of one palm by the palm, whatever sides their names say.

    Args:
        moved: Bodies that a logged joint moves.
    """
    palms = set()
    for end in ends:
        palm = end
        for other in ends:
            common = max(set(chain(model, end)) & set(chain(model, other)))
            if common < palm and _is_palm(model, common, [end, other], moved):
                palm = common
        palms.add(palm)
    return sorted(palms)


def _is_palm(model: mujoco.MjModel, body: int, ends: list[int], moved: set[int]) -> bool:
    """Return True if the nearest body that carries some ends is a palm, and no torso.

    A palm is moved by a logged joint, as a torso may be. It is part of a hand by its name or by
    that of a body before it, or carries ends of one joint each.
    """
    before = chain(model, body)
    if moved.isdisjoint(before):
        return False
    if any(_hand(model.body(part).name) for part in before):
        return True
    return all(len(moved.intersection(chain(model, end)) - set(before)) == 1 for end in ends)


def _palms(model: mujoco.MjModel, ends: list[int]) -> list[int]:
    """Replace the fingers of one side by the body that carries them."""
    sides: dict[str, list[int]] = {}
    for end in ends:
        sides.setdefault(_side(model, end), []).append(end)
    palms = []
    for side_ends in sides.values():
        common = set(chain(model, side_ends[0]))  # ancestors of all ends of this side
        for end in side_ends[1:]:
            common.intersection_update(chain(model, end))
        palm = max(common)
        palms += [palm] if model.body_parentid[palm] else side_ends
    return sorted(palms)


def _beyond(model: mujoco.MjModel, body: int) -> list[int]:
    """Return a body and its descendants."""
    bodies = [body]
    for b in range(body + 1, model.nbody):
        if model.body_parentid[b] in bodies:
            bodies.append(b)
    return bodies


def _hand(name: str) -> bool:
    words = re.split(r"[\W\d_]+", name.lower())
    return any(word == "ee" or word.startswith(HAND_PREFIXES) for word in words)
