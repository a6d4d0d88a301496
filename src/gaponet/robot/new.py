"""Robot folders from vendors' models: unlogged joints become fixed, and every number states its source."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path

import mujoco
import numpy as np

from gaponet.base.errors import RobotError, UsageError
from gaponet.base.files import whole_folder, write_text
from gaponet.robot.drives import ON_JOINT, Drive, drives
from gaponet.robot.freeze import freeze
from gaponet.robot.mjcf import compile_spec
from gaponet.robot.self_contained import self_contained_text
from gaponet.robot.spec import Follower, RobotSpec, load_robot
from gaponet.robot.vendor import read_vendor

PICTURE = "picture.png"  # of a robot folder
HAND_PREFIXES = ("attachment", "tcp", "tool", "flange", "palm", "grip", "hand", "wrist")
IMPLICIT_INTEGRATORS = (
    mujoco.mjtIntegrator.mjINT_IMPLICIT,
    mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
)


@dataclass(frozen=True)
class RobotOptions:
    """Options of `gaponet robot new`; joints are given by name or pattern (*_elbow_*).

    Attributes:
        joints: Logged joints; all others are fixed. Default: those with an actuator, or all hinges if none has one.
        kp, kd, effort_limit: "100" or "*wrist*=20", N·m/rad, N·m·s/rad, N·m; a later value overrides earlier ones.
        servo: "STS3215" or "*wrist*=XL330-M288-T": types whose measured values and torque limits replace the model's.
        packages: "NAME=FOLDER" of package://NAME.
        rate: Rate of commands, Hz.
        keyframe: Home position, also of fixed joints; default: the first keyframe.
        contacts: Keep geoms that can collide, and simulate contacts.
    """

    joints: tuple[str, ...] = ()
    kp: tuple[str, ...] = ()
    kd: tuple[str, ...] = ()
    effort_limit: tuple[str, ...] = ()
    servo: tuple[str, ...] = ()
    packages: tuple[str, ...] = ()
    rate: float = 50.0
    keyframe: str = ""
    contacts: bool = False
    name: str = ""


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
    """Write the robot folder `out` from the MJCF or URDF at `path`; the folder is complete or absent.

    Args:
        draw: Returns the PNG of picture.png, or None for no picture.

    Raises:
        RobotError: The model is damaged, or has no joint to log.
        UsageError: An option does not fit the model, or a gain is stated nowhere.
    """
    spec, notes = read_vendor(path, {k: Path(v) for k, v in map(_pair, options.packages)})
    model = compile_spec(spec, path)
    logged = _logged_joints(model, options.joints, path)
    pose, source = _home(model, options.keyframe, path)
    given = {name: getattr(options, name) for name in ("kp", "kd", "effort_limit", "servo")}
    followers = _followers(model, logged, options.joints)
    motors = [name for name in logged if name not in followers]
    logged = [name for name in _joint_names(model) if name in (*motors, *followers)]
    joint_drives = drives(model, motors, pose, given, path.name)
    notes += _notes(spec, model, logged, pose, path)
    notes += [f"{name} follows {led.joint}, without a motor" for name, led in followers.items()]
    for d in joint_drives:
        for name, value in d.passive.items():
            polynomial = np.ndim(
                getattr(spec.joint(d.name), name)
            )  # of newer MuJoCo; a number of older
            setattr(spec.joint(d.name), name, [[value], [0.0], [0.0]] if polynomial else value)
    text = _robot_xml(spec, model, logged, pose, path, options.contacts)
    robot_toml = _robot_toml(model, joint_drives, options, path, source, followers)
    for name in (*_joint_names(model), *(model.body(b).name for b in range(model.nbody))):
        if "/" in name:  # a joint name may become a file name
            text, robot_toml = (
                t.replace(f'"{name}"', f'"{name.replace("/", "_")}"') for t in (text, robot_toml)
            )
    if _holds_another_robot(out, text, robot_toml):
        raise UsageError(f"{out}: holds a robot; choose another --out, or move it away")
    with whole_folder(out, "robot", last="robot.toml") as place:
        write_text(place / "robot.xml", text)
        write_text(place / "robot.toml", robot_toml)
        made = NewRobot(load_robot(place), joint_drives, model, pose, notes)
        picture = draw(made)
        if picture is not None:
            (place / PICTURE).write_bytes(picture)
    return replace(made, robot=load_robot(out))


def _holds_another_robot(folder: Path, xml: str, toml: str) -> bool:
    """True if a folder holds a robot that is not the one to be written: the same command may be given again."""
    if not (folder / "robot.toml").exists():
        return False
    for name, text in (("robot.toml", toml), ("robot.xml", xml)):
        file = folder / name
        if not file.is_file() or file.read_text(encoding="utf-8", errors="replace") != text:
            return True
    return False


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
            f"--joints {name}: is a {kind} joint, and gaponet supports angles only (rad, N·m); leave it out, then it "
            "is fixed at home"
        )
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in hinges):
            raise UsageError(f"--joints {pattern}: no such joint; there are: {', '.join(hinges)}")
    if patterns:
        return [name for name in hinges if any(fnmatchcase(name, p) for p in patterns)]
    actuated = {
        model.joint(j).name
        for j in model.actuator_trnid[np.isin(model.actuator_trntype, ON_JOINT), 0]
    }
    return [name for name in hinges if name in actuated] or hinges


def _followers(
    model: mujoco.MjModel, logged: list[str], patterns: tuple[str, ...]
) -> dict[str, Follower]:
    """Return the hinges that an equality lets follow a logged hinge in proportion: URDF's mimic joints.

    A joint that the user names counts as driven by a motor of its own.
    """
    followers = {}
    for e in np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_JOINT):
        name, leader = (
            model.joint(j).name if j >= 0 else "" for j in (model.eq_obj1id[e], model.eq_obj2id[e])
        )
        constant, ratio, *curved = model.eq_data[e, :5].tolist()
        hinges = all(
            x and model.joint(x).type == mujoco.mjtJoint.mjJNT_HINGE for x in (name, leader)
        )
        if not hinges or any(curved) or leader not in logged or name in patterns:
            continue
        zero, leader_zero = (
            float(model.qpos0[model.jnt_qposadr[model.joint(x).id]]) for x in (name, leader)
        )
        followers[name] = Follower(leader, ratio, zero + constant - ratio * leader_zero)
    return {name: f for name, f in followers.items() if f.joint not in followers}


def _joint_names(model: mujoco.MjModel) -> list[str]:
    return [model.joint(j).name for j in range(model.njnt)]


def _home(model: mujoco.MjModel, keyframe: str, path: Path) -> tuple[np.ndarray, str]:
    """Return the home pose (nq) within the joint ranges, and its source."""
    keys = [model.key(k).name for k in range(model.nkey)]
    if keyframe and keyframe not in keys:
        raise UsageError(f"--keyframe {keyframe}: {path.name} has {', '.join(keys) or 'none'}")
    source = f'keyframe "{keyframe or keys[0]}"' if keys else "the model's zero"
    pose = (model.key_qpos[keys.index(keyframe) if keyframe else 0] if keys else model.qpos0).copy()
    for j in np.flatnonzero(model.jnt_limited):
        at, (low, high) = model.jnt_qposadr[j], model.jnt_range[j]
        if not low - 1e-6 <= pose[at] <= high + 1e-6:
            pose[at] = (low + high) / 2
        pose[at] = np.clip(pose[at], low, high)
    return pose, source


def _notes(
    spec: mujoco.MjSpec, model: mujoco.MjModel, logged: list[str], pose: np.ndarray, path: Path
) -> list[str]:
    """Describe what is fixed and omitted."""
    notes, fixed = [], []
    for name, kind, at in zip(_joint_names(model), model.jnt_type, model.jnt_qposadr, strict=True):
        unit = {int(mujoco.mjtJoint.mjJNT_HINGE): "rad", int(mujoco.mjtJoint.mjJNT_SLIDE): "m"}.get(
            int(kind)
        )
        if name not in logged:
            fixed.append(
                f"{name or 'unnamed'} {f'at {pose[at]:.3g} {unit}' if unit else f'where {path.name} has it'}"
            )
    if fixed:
        notes.append(f"frozen: {', '.join(fixed)}")
    for e in spec.equalities:
        pair = [name for name in (e.name1, e.name2) if name in logged]
        if e.type == mujoco.mjtEq.mjEQ_JOINT and len(pair) == 1 and e.name2:
            other = e.name2 if e.name1 in pair else e.name1
            notes.append(
                f"{other} moves with {pair[0]} and is fixed here: identified kp, friction and armature of {pair[0]} "
                f"are those of its own link, smaller in proportion to the mass of both links"
            )
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
            "integrator: implicitfast, which takes servos' kd into account; the model's own does not"
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
    removed = {name for name in values if name not in logged}
    tendons = {model.tendon(t).name for t in range(model.ntendon) if _wraps(model, t) & removed}
    for kind in (spec.actuators, spec.sensors, spec.keys):
        for element in list(kind):
            spec.delete(element)
    for equality in [e for e in spec.equalities if {e.name1, e.name2} & (removed | tendons)]:
        spec.delete(equality)
    for tendon in [t for t in spec.tendons if t.name in tendons]:
        spec.delete(tendon)
    for joint in [
        j for j in spec.joints if j.type in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL)
    ]:
        spec.delete(joint)
    if spec.option.integrator not in IMPLICIT_INTEGRATORS:
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    plain = mujoco.MjSpec.from_string(
        self_contained_text(spec, path)
    )  # explicit inertias, quaternions, no classes
    for joint in [j for j in plain.joints if j.name not in logged]:
        freeze(plain, joint, values[joint.name])
    for joint in plain.joints:
        joint.actfrclimited = (
            mujoco.mjtLimited.mjLIMITED_FALSE
        )  # effort_limit of robot.toml is the limit
    if not contacts:
        _disable_contacts(plain)
    return self_contained_text(plain, path)


def _wraps(model: mujoco.MjModel, tendon: int) -> set[str]:
    part = slice(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
    on_joint = model.wrap_type[part] == mujoco.mjtWrap.mjWRAP_JOINT
    return {model.joint(j).name for j in model.wrap_objid[part][on_joint]}


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
    if not (0 < options.rate <= 1000):
        raise UsageError(f"--rate {options.rate}: give the rate of the commands in Hz, up to 1000")
    names = [d.name for d in joint_drives]
    by_name = {d.name: d for d in joint_drives}
    dt = 1 / options.rate
    steps = max(1, math.ceil(dt / model.opt.timestep - 1e-6))
    stem = path.resolve().parent.name if path.stem in ("robot", "model", "scene") else path.stem
    robot_name = options.name or "".join(c if c.isalnum() or c in "-_" else "_" for c in stem)
    lines = [
        f"# Made from {path.name} by gaponet robot new; every number may be changed here.",
        f"name = {json.dumps(robot_name)}",
        f"dt = {dt!r}  # control period, s: --rate",
        f"timestep = {dt / steps!r}  # physics step, s; {path.name} has {model.opt.timestep:g}",
        f"contacts = {str(options.contacts).lower()}  # --contacts keeps geoms that touch, and lets them",
    ]
    for name in (n for n in _joint_names(model) if n in by_name or n in followers):
        if name in followers:
            lines += _follower_lines(name, followers[name], path)
            continue
        d = by_name[name]
        lines += [
            "", "[[joint]]", f"name = {json.dumps(d.name)}",
            *([f"aliases = [{json.dumps(d.actuator)}]  # its actuator"] if d.actuator not in ("", *names) else []),
            f"kp = {d.kp!r}  # N·m/rad: {d.kp_source}", f"kd = {d.kd!r}  # N·m·s/rad: {d.kd_source}",
            f"effort_limit = {d.limit!r}  # N·m: {d.limit_source}",
            *([f"servo = {json.dumps(d.servo.name, ensure_ascii=False)}  # --servo"] if d.servo else []),
            f"home = {float(d.home)!r}  # rad: {source}", "operated = true",
        ]  # fmt: skip
    for side, body, pos, why in _mounts(model, names):
        lines += ["", f"[[payload_mount]]  # {why}", f"side = {json.dumps(side)}",
                  f"body = {json.dumps(body)}", f"pos = {[round(float(x), 6) for x in pos]}"]  # fmt: skip
    return "\n".join("".join(c if c.isprintable() else "?" for c in line) for line in lines) + "\n"


def _follower_lines(name: str, follower: Follower, path: Path) -> list[str]:
    return [
        "", "[[joint]]", f"name = {json.dumps(name)}",
        f"follows = {json.dumps(follower.joint)}  # a mimic joint of {path.name}: no motor of its own",
        f"ratio = {follower.ratio!r}  # its angle per rad of that joint", f"at_zero = {follower.at_zero!r}  # rad",
        "kp = 0.0", "effort_limit = 1.0  # of no use without kp", "operated = false",
    ]  # fmt: skip


def _mounts(model: mujoco.MjModel, joints: list[str]) -> list[tuple[str, str, np.ndarray, str]]:
    """Guess payload mounts: side, body, position in it (m), and source."""
    moved = {int(model.jnt_bodyid[model.joint(name).id]) for name in joints}
    ends = tips = [
        b for b in sorted(moved) if not moved & set(_beyond(model, b)[1:])
    ]  # nothing moves beyond them
    if len(ends) > 1:
        ends = _palms(
            model, [e for e in ends if any(_hand(model.body(b).name) for b in _beyond(model, e))]
        )
    result: list[tuple[str, str, np.ndarray, str]] = []
    for end in ends:
        beyond = _beyond(model, end)
        sites = [
            s
            for s in range(model.nsite)
            if model.site_bodyid[s] in beyond and _hand(model.site(s).name)
        ]
        bodies = (
            [b for b in beyond if b != end and _hand(model.body(b).name)] if end in tips else []
        )
        if sites:
            body, pos, why = (
                int(model.site_bodyid[sites[0]]),
                model.site_pos[sites[0]],
                model.site(sites[0]).name,
            )
        elif bodies:
            body, pos, why = bodies[-1], np.zeros(3), model.body(bodies[-1]).name
        else:
            body, pos, why = end, model.body_ipos[end], "the last link's centre of mass"
        name = model.body(end).name.lower()
        side = next(
            (word for word in ("left", "right") if word in name), f"hand{len(result) or ''}"
        )
        result.append(
            (side, model.body(body).name, pos, f"a guess: {why}; correct side, body and pos")
        )
    return result


def _palms(model: mujoco.MjModel, ends: list[int]) -> list[int]:
    """Replace the fingers of one side by the body that carries them."""
    sides: dict[str, list[int]] = {}
    for end in ends:
        name = model.body(end).name.lower()
        sides.setdefault(next((word for word in ("left", "right") if word in name), ""), []).append(
            end
        )
    result = []
    for side_ends in sides.values():
        palm = max(set.intersection(*(set(_chain(model, end)) for end in side_ends)))
        result += [palm] if model.body_parentid[palm] else side_ends
    return sorted(result)


def _chain(model: mujoco.MjModel, body: int) -> list[int]:
    """Return a body and its ancestors up to the world."""
    chain = [body]
    while chain[-1]:
        chain.append(int(model.body_parentid[chain[-1]]))
    return chain


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
