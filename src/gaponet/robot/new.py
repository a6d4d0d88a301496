"""A robot folder from a vendor's model: joints that are not logged are frozen, and every number has its source."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path

import mujoco
import numpy as np

from gaponet.base.errors import RobotError, UsageError
from gaponet.base.files import lock_folder, write_text
from gaponet.robot.drives import ON_JOINT, Drive, drives
from gaponet.robot.freeze import freeze
from gaponet.robot.mjcf import compile_spec
from gaponet.robot.self_contained import self_contained_text
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.robot.vendor import read_vendor

HANDS = ("attachment", "tcp", "tool", "flange", "palm", "grip", "hand", "wrist")  # beginnings of words
IMPLICIT = (mujoco.mjtIntegrator.mjINT_IMPLICIT, mujoco.mjtIntegrator.mjINT_IMPLICITFAST)


@dataclass(frozen=True)
class RobotOptions:
    """What the user says about the robot; joints are named by name or pattern (*_elbow_*).

    Attributes:
        joints: That are logged; all others are frozen. None: those with an actuator, or all hinges if none has one.
        operated: Those of them that are to be corrected; none: all.
        kp, kd, effort_limit: "100", or "*wrist*=20"; the later wins. In N·m/rad, N·m·s/rad, N·m.
        mounts: "hand=BODY" or "hand=BODY:x,y,z", m: where payloads go; none: found by name.
        packages: "NAME=FOLDER" of package://NAME.
        rate: How many commands a second, Hz.
        keyframe: At which frozen joints stand, and home; "": the first.
        contacts: Keep geoms that touch, and let them.
    """

    joints: tuple[str, ...] = ()
    operated: tuple[str, ...] = ()
    kp: tuple[str, ...] = ()
    kd: tuple[str, ...] = ()
    effort_limit: tuple[str, ...] = ()
    mounts: tuple[str, ...] = ()
    packages: tuple[str, ...] = ()
    rate: float = 50.0
    keyframe: str = ""
    contacts: bool = False
    name: str = ""


@dataclass(frozen=True)
class NewRobot:
    """A robot folder that was written; the vendor's own model with its pose at home, (nq); what to know about it."""

    robot: RobotSpec
    drives: tuple[Drive, ...]
    vendor: mujoco.MjModel
    pose: np.ndarray
    notes: list[str] = field(default_factory=list)


def new_robot(path: Path, out: Path, wanted: RobotOptions) -> NewRobot:
    """Write the robot folder `out` from the MJCF or URDF at `path`.

    Raises:
        RobotError: The model is broken, or a joint of it cannot be what it should be.
        UsageError: A name or number that does not fit the model, or a gain that neither says.
    """
    spec, notes = read_vendor(path, {k: Path(v) for k, v in map(_pair, wanted.packages)})
    model = compile_spec(spec, path)
    kept = _kept(model, wanted.joints, path)
    pose, source = _home(model, wanted.keyframe, path)
    given = {name: getattr(wanted, name) for name in ("kp", "kd", "effort_limit")}
    found = drives(model, kept, pose, given, path.name)
    notes += _spoken(spec, model, kept, pose, path)
    text = _text(spec, model, kept, pose, path, wanted.contacts)
    robot_toml = _toml(model, found, wanted, path, source)
    for name in (*_joint_names(model), *(model.body(b).name for b in range(model.nbody))):
        if "/" in name:  # a name may become a file's
            text, robot_toml = (t.replace(f'"{name}"', f'"{name.replace("/", "_")}"') for t in (text, robot_toml))
    if (out / "robot.toml").exists():
        raise UsageError(f"{out}: holds a robot; choose another --out, or move it away")
    with lock_folder(out, "robot"):
        write_text(out / "robot.xml", text)
        write_text(out / "robot.toml", robot_toml)
    return NewRobot(load_robot(out), found, model, pose, notes)


def matching(names: Iterable[str], patterns: Iterable[str], what: str) -> list[str]:
    """Names that match any of the patterns, in the names' order.

    Raises:
        UsageError: A pattern matches none.
    """
    names = list(names)
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in names):
            raise UsageError(f"{what} {pattern}: no such joint; there are: {', '.join(names)}")
    return [name for name in names if any(fnmatchcase(name, p) for p in patterns)]


def _pair(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not equals or not name or not value:
        raise UsageError(f"'{text}': write NAME=VALUE")
    return name, value


def _kept(model: mujoco.MjModel, patterns: tuple[str, ...], path: Path) -> list[str]:
    """Hinges to keep, by name, in the model's order."""
    kinds = dict(zip(_joint_names(model), map(mujoco.mjtJoint, model.jnt_type), strict=True))
    kinds.pop("", None)
    hinges = [name for name, kind in kinds.items() if kind == mujoco.mjtJoint.mjJNT_HINGE]
    if not hinges:
        raise RobotError(f"{path}: has no named hinge joint, so no joint angle to log")
    for name in set(patterns) & set(kinds) - set(hinges):
        kind = kinds[name].name.removeprefix("mjJNT_").lower()
        raise UsageError(
            f"--joints {name}: is a {kind} joint, and gaponet knows angles alone (rad, N·m); leave it out and it is "
            "frozen at home"
        )
    if patterns:
        return matching(hinges, patterns, "--joints")
    actuated = {model.joint(j).name for j in model.actuator_trnid[np.isin(model.actuator_trntype, ON_JOINT), 0]}
    return [name for name in hinges if name in actuated] or hinges


def _joint_names(model: mujoco.MjModel) -> list[str]:
    return [model.joint(j).name for j in range(model.njnt)]


def _home(model: mujoco.MjModel, keyframe: str, path: Path) -> tuple[np.ndarray, str]:
    """Pose (nq) in which frozen joints stand, inside the joint ranges, and where it is from."""
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


def _spoken(spec: mujoco.MjSpec, model: mujoco.MjModel, kept: list[str], pose: np.ndarray, path: Path) -> list[str]:
    """What is frozen and dropped, in words."""
    said, frozen = [], []
    for name, kind, at in zip(_joint_names(model), model.jnt_type, model.jnt_qposadr, strict=True):
        unit = {int(mujoco.mjtJoint.mjJNT_HINGE): "rad", int(mujoco.mjtJoint.mjJNT_SLIDE): "m"}.get(int(kind))
        if name not in kept:
            frozen.append(f"{name or 'unnamed'} {f'at {pose[at]:.3g} {unit}' if unit else f'where {path.name} has it'}")
    if frozen:
        said.append(f"frozen: {', '.join(frozen)}")
    for e in spec.equalities:
        pair = [name for name in (e.name1, e.name2) if name in kept]
        if e.type == mujoco.mjtEq.mjEQ_JOINT and len(pair) == 1 and e.name2:
            other = e.name2 if e.name1 in pair else e.name1
            said.append(
                f"{other} moves with {pair[0]} and is held still here: kp, friction and armature that are "
                f"identified of {pair[0]} are those of its own link alone, as much smaller as both are heavier"
            )
    if (model.jnt_type == mujoco.mjtJoint.mjJNT_FREE).any():
        said.append("the base is held still here: fasten the robot while it is recorded, a base that hangs swings")
    dropped = {"actuator": model.nu, "keyframe": model.nkey, "sensor": model.nsensor}
    gone = ", ".join(f"{count} {kind}(s)" for kind, count in dropped.items() if count)
    if gone:
        said.append(f"left out: {gone}; gains and limits stand in robot.toml")
    if spec.option.integrator not in IMPLICIT:
        said.append("integrator: implicitfast, which takes servos' kd into account; the model's own does not")
    return said


def _text(
    spec: mujoco.MjSpec, model: mujoco.MjModel, kept: list[str], pose: np.ndarray, path: Path, contacts: bool
) -> str:
    """robot.xml: one file without the joints that are frozen and what names them."""
    values = dict(zip(_joint_names(model), pose[model.jnt_qposadr], strict=True))
    lost = {name for name in values if name not in kept}
    tendons = {model.tendon(t).name for t in range(model.ntendon) if _wraps(model, t) & lost}
    for kind in (spec.actuators, spec.sensors, spec.keys):
        for element in list(kind):
            spec.delete(element)
    for equality in [e for e in spec.equalities if {e.name1, e.name2} & (lost | tendons)]:
        spec.delete(equality)
    for tendon in [t for t in spec.tendons if t.name in tendons]:
        spec.delete(tendon)
    for joint in [j for j in spec.joints if j.type in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL)]:
        spec.delete(joint)
    if spec.option.integrator not in IMPLICIT:
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    plain = mujoco.MjSpec.from_string(self_contained_text(spec, path))  # explicit inertias, quaternions, no classes
    for joint in [j for j in plain.joints if j.name not in kept]:
        freeze(plain, joint, values[joint.name])
    for joint in plain.joints:
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE  # effort_limit says it, in one place
    if not contacts:
        _untouching(plain)
    return self_contained_text(plain, path)


def _wraps(model: mujoco.MjModel, tendon: int) -> set[str]:
    part = slice(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
    on_joint = model.wrap_type[part] == mujoco.mjtWrap.mjWRAP_JOINT
    return {model.joint(j).name for j in model.wrap_objid[part][on_joint]}


def _untouching(spec: mujoco.MjSpec) -> None:
    """Nothing touches; shapes for touching go where there are others to look at."""
    for body in spec.bodies:
        touch = [g for g in body.geoms if g.contype or g.conaffinity]
        for geom in touch:
            if len(touch) < len(body.geoms):
                spec.delete(geom)
            else:
                geom.contype = geom.conaffinity = 0
    for pair in [*spec.pairs, *spec.excludes]:
        spec.delete(pair)


def _toml(model: mujoco.MjModel, found: tuple[Drive, ...], wanted: RobotOptions, path: Path, source: str) -> str:
    if not (0 < wanted.rate <= 1000):
        raise UsageError(f"--rate {wanted.rate}: give the rate of the commands in Hz, up to 1000")
    names = [d.name for d in found]
    operated = matching(names, wanted.operated, "--operated") if wanted.operated else names
    dt = 1 / wanted.rate
    steps = max(1, math.ceil(dt / model.opt.timestep - 1e-6))
    stem = path.resolve().parent.name if path.stem in ("robot", "model", "scene") else path.stem
    name = wanted.name or "".join(c if c.isalnum() or c in "-_" else "_" for c in stem)
    lines = [
        f"# Made from {path.name} by gaponet robot new; every number may be changed here.",
        f"name = {json.dumps(name)}",
        f"dt = {dt!r}  # control period, s: --rate",
        f"timestep = {dt / steps!r}  # physics step, s; {path.name} has {model.opt.timestep:g}",
        f"contacts = {str(wanted.contacts).lower()}  # --contacts keeps geoms that touch, and lets them",
    ]
    for d in found:
        lines += [
            "", "[[joint]]", f"name = {json.dumps(d.name)}",
            *([f"aliases = [{json.dumps(d.actuator)}]  # its actuator"] if d.actuator not in ("", *names) else []),
            f"kp = {d.kp!r}  # N·m/rad: {d.kp_source}", f"kd = {d.kd!r}  # N·m·s/rad: {d.kd_source}",
            f"effort_limit = {d.limit!r}  # N·m: {d.limit_source}",
            f"home = {float(d.home)!r}  # rad: {source}", f"operated = {str(d.name in operated).lower()}",
        ]  # fmt: skip
    for side, body, pos, why in _mounts(model, operated, wanted.mounts):
        lines += ["", f"[[payload_mount]]  # {why}", f"side = {json.dumps(side)}",
                  f"body = {json.dumps(body)}", f"pos = {[round(float(x), 6) for x in pos]}"]  # fmt: skip
    return "\n".join("".join(c if c.isprintable() else "?" for c in line) for line in lines) + "\n"


def _mounts(
    model: mujoco.MjModel, operated: list[str], asked: tuple[str, ...]
) -> list[tuple[str, str, np.ndarray, str]]:
    """Side, body, place in it (m), and why."""
    if asked:
        return [_mount(model, *_pair(word)) for word in asked]
    ends = tips = _ends(model, operated)
    if len(ends) > 1:
        ends = _palms(model, [e for e in ends if any(_hand(model.body(b).name) for b in _beyond(model, e))])
    found: list[tuple[str, str, np.ndarray, str]] = []
    for end in ends:
        beyond = _beyond(model, end)
        sites = [s for s in range(model.nsite) if model.site_bodyid[s] in beyond and _hand(model.site(s).name)]
        bodies = [b for b in beyond if b != end and _hand(model.body(b).name)] if end in tips else []
        if sites:
            body, pos, why = int(model.site_bodyid[sites[0]]), model.site_pos[sites[0]], model.site(sites[0]).name
        elif bodies:
            body, pos, why = bodies[-1], np.zeros(3), model.body(bodies[-1]).name
        else:
            body, pos, why = end, model.body_ipos[end], "the last link's centre of mass"
        name = model.body(end).name.lower()
        side = next((word for word in ("left", "right") if word in name), f"hand{len(found) or ''}")
        found.append((side, model.body(body).name, pos, f"a guess: {why}; --mounts SIDE=BODY:x,y,z says it"))
    return found


def _mount(model: mujoco.MjModel, side: str, where: str) -> tuple[str, str, np.ndarray, str]:
    body, _, place = where.partition(":")
    try:
        pos = np.array([float(x) for x in place.split(",")] if place else [0.0, 0.0, 0.0])
    except ValueError:
        pos = np.zeros(0)
    bodies = [model.body(b).name for b in range(1, model.nbody)]
    if body not in bodies or pos.shape != (3,) or not np.isfinite(pos).all():
        raise UsageError(f"--mounts {side}={where}: write SIDE=BODY or SIDE=BODY:x,y,z; bodies: {', '.join(bodies)}")
    return side, body, pos, "--mounts"


def _ends(model: mujoco.MjModel, operated: list[str]) -> list[int]:
    """Bodies with an operated joint, beyond which there is none."""
    moved = {int(model.jnt_bodyid[model.joint(name).id]) for name in operated}
    return [b for b in sorted(moved) if not moved & set(_beyond(model, b)[1:])]


def _palms(model: mujoco.MjModel, ends: list[int]) -> list[int]:
    """Ends of one side, the fingers of a hand, as the body that carries them all; others as they are."""
    sides: dict[str, list[int]] = {}
    for end in ends:
        name = model.body(end).name.lower()
        sides.setdefault(next((word for word in ("left", "right") if word in name), ""), []).append(end)
    found = []
    for part in sides.values():
        palm = max(set.intersection(*(set(_chain(model, end)) for end in part)))
        found += [palm] if model.body_parentid[palm] else part
    return sorted(found)


def _chain(model: mujoco.MjModel, body: int) -> list[int]:
    """A body and all that carry it, the world among them."""
    found = [body]
    while found[-1]:
        found.append(int(model.body_parentid[found[-1]]))
    return found


def _beyond(model: mujoco.MjModel, body: int) -> list[int]:
    """A body and all that hangs on it."""
    found = [body]
    for b in range(body + 1, model.nbody):
        if model.body_parentid[b] in found:
            found.append(b)
    return found


def _hand(name: str) -> bool:
    words = re.split(r"[\W\d_]+", name.lower())
    return any(word == "ee" or word.startswith(HANDS) for word in words)
