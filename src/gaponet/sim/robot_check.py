"""Checks for robot files that compile and are probably wrong.

Each finding says which value to change.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from dataclasses import replace
from typing import NamedTuple

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.robot.collision import Collision
from gaponet.robot.finding import LEVELS, Finding, abbreviate
from gaponet.robot.servo_parameters import NO_LIMIT
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import BatchSim, Condition
from gaponet.sim.dynamics import static_torque
from gaponet.sim.model import build_model

# of a hold at home, and distance from home at its start
HOLD_S = 60.0
HOLD_START_RAD = 0.01
MAX_REST_SPEED = 0.05  # rad/s in the last ten seconds of the hold
# in the second half of the hold; at its end
MAX_CREEP_RAD = 1e-3
MAX_SAG_RAD = 0.1
MAX_GROWTH = 1e-3  # relative, of a small motion in one physics step
# phase per step: an unstable step oscillates, a joint that falls does not
MIN_OSCILLATION_RAD = 0.1
MAX_POSTURES = 8  # in which small motions are examined
MIN_ARMATURE = 1e-5  # kg·m²; less is none
MIN_PENETRATION_M = 1e-4  # of links that collide
NEAR_HOME_RAD = 0.1  # of the posture in which joints that seem locked at home are tried again
# Speed of a joint, where the speeds of all joints have length 1, below which equalities lock it. A
# joint that can move at all has 1e-2 or more, and rounding gives 1e-12.
MIN_FREEDOM = 1e-5


class _Growth(NamedTuple):
    """Factor by which a small motion grows in a physics step, the joint that moves most, and if it
    oscillates.
    """

    factor: float
    joint: int
    oscillates: bool


def check_robot(
    robot: RobotSpec, payloads: tuple[float, ...] = (0.0,), postures: Array | None = None
) -> list[Finding]:
    """Step the nominal simulator of a robot and return findings, worst first.

    Args:
        payloads: kg in every mount.
        postures: Postures from the logs, (k, n) rad; default random ones within the joint ranges.

    Raises:
        RobotError: It does not compile.
    """
    prompt = robot.with_servo(delay=np.zeros(len(robot.joint_names)))
    models = {mass: build_model(prompt, mass) for mass in payloads}
    model = models[payloads[0]]
    if (robot.folder / "collision.toml").is_file():
        Collision(robot, model)  # raises where it is wrong
    low, high = np.clip(robot.qpos_range.T, -np.pi, np.pi)
    places = (
        np.random.default_rng(0).uniform(low, high, (100, len(robot.joint_names)))
        if postures is None
        else postures
    )
    findings = [
        *_joints(robot),
        *_loads(robot, models),
        *_limits(robot, model),
        *_couplings(robot, model),
        *_locked(robot, model),
        *_contacts(robot, places, postures is not None),
        *_steps(robot, models, places),
    ]
    if not any(finding.level == "error" for finding in findings):
        findings += _hold(robot, payloads)
    if not robot.payload_mounts:
        text = (
            "no [[payload_mount]]: payloads other than 0 will be refused; add one to robot.toml "
            "if it carries any"
        )
        findings.append(Finding("warning", "payload", text))
    return sorted(findings, key=lambda finding: -LEVELS.index(finding.level))


def _joints(robot: RobotSpec) -> Iterator[Finding]:
    for i, name in enumerate(robot.joint_names):
        low, high = robot.qpos_range[i]
        if name not in robot.log_joints.followers and robot.servo.kp[i] <= 0:
            text = (
                f"{name}: kp is {robot.servo.kp[i]:g}; a position-controlled joint needs kp > 0 in "
                "robot.toml"
            )
            yield Finding("warning", "gains", text, (name,))
        if name in robot.operated and robot.servo.effort_limit[i] >= NO_LIMIT:
            text = f"{name}: its torque limit is not known: write effort_limit in robot.toml"
            yield Finding("warning", "limits", text, (name,))
        if not low <= robot.qpos_home[i] <= high:
            text = (
                f"{name}: home {robot.qpos_home[i]:g} lies outside its range [{low:.2f}, "
                f"{high:.2f}]: write home"
            )
            yield Finding(
                "warning", "home", f"{text} in robot.toml, or range in robot.xml", (name,)
            )
        if not np.isfinite(low):
            text = (
                f"{name}: has no range in the MJCF; commands are not clipped and doctor cannot "
                "judge positions"
            )
            yield Finding("warning", "range", f"{text}: write range in robot.xml", (name,))
        elif not 0.1 <= high - low <= 40.0:  # 6°, 6 turns
            text = (
                f"{name}: its range is {low:.3g} to {high:.3g} rad: are these degrees? Correct it "
                "in robot.xml"
            )
            yield Finding("warning", "range", text, (name,))


def _loads(robot: RobotSpec, models: dict[float, mujoco.MjModel]) -> Iterator[Finding]:
    """Find joints whose torque limit is less than the torque that holds home."""
    for mass, model in models.items():
        load = np.abs(static_torque(model, robot.qpos_home[None])[0])
        for i in np.flatnonzero(load > robot.servo.effort_limit):
            carrying = f" with {mass:g} kg" if mass else ""
            text = (
                f"{robot.joint_names[i]}: needs {load[i]:.3g} N·m to hold its home{carrying}, its "
                f"limit is {robot.servo.effort_limit[i]:g}: check effort_limit in robot.toml, "
                "masses and home"
            )
            yield Finding(
                "warning",
                "load",
                text,
                (robot.joint_names[i],),
                {"torque": load[i], "payload_mass": mass},
            )


def _limits(robot: RobotSpec, model: mujoco.MjModel) -> Iterator[Finding]:
    """Find torque limits that override each other."""
    for i, name in enumerate(robot.joint_names):
        j = model.joint(name).id
        most = np.abs(model.jnt_actfrcrange[j]).min() if model.jnt_actfrclimited[j] else np.inf
        if most < 0.999 * robot.servo.effort_limit[i]:
            text = (
                f"{name}: actuatorfrcrange in robot.xml stops the motor at {most:g} N·m, before "
                f"effort_limit = {robot.servo.effort_limit[i]:g} in robot.toml does: delete one, "
                "or write the right figure at both"
            )
            yield Finding("warning", "limits", text, (name,), {"actuatorfrcrange": most})


def _couplings(robot: RobotSpec, model: mujoco.MjModel) -> Iterator[Finding]:
    """Find constraints, springs and other elements of the model that move or hold a joint."""
    names = np.array(robot.joint_names)
    equalities = int(model.eq_active0.sum())
    for count, kind in ((equalities, "equality"), (model.ntendon, "tendon")):
        if count:
            text = (
                f"robot.xml has {count} <{kind}> constraint(s): the simulator obeys them; delete "
                "what is no part"
            )
            yield Finding("note", "couplings", f"{text} of the robot")
    springs = names[model.jnt_stiffness > 0].tolist()
    if springs:
        yield Finding(
            "note",
            "couplings",
            f"springs at {abbreviate(springs)}: stiffness in robot.xml",
            tuple(springs),
        )
    if abs(np.linalg.norm(model.opt.gravity) - 9.81) > 0.1:
        text = (
            f"gravity in robot.xml is {model.opt.gravity.tolist()} m/s²: write gravity in "
            "<option> if that is not so"
        )
        yield Finding("warning", "couplings", text)
    if (model.body_gravcomp != 0).any():
        text = (
            "gravcomp in robot.xml takes weight off bodies: right where the controller "
            "compensates gravity; else "
        )
        yield Finding("note", "couplings", f"{text}delete it")
    light = names[model.dof_armature < MIN_ARMATURE]
    if len(light):
        text = (
            f"no armature at {abbreviate(light.tolist())}: geared motors have 0.001 to 0.5 kg·m² "
            "(rotor inertia times ratio squared); write armature in robot.xml, gaponet identify "
            "finds it"
        )
        yield Finding("note", "inertia", text, tuple(light))
    led = np.isin(names, list(robot.log_joints.followers))
    free = names[
        (model.dof_damping + robot.servo.kd < 1e-9) & (model.dof_frictionloss < 1e-9) & ~led
    ]
    if len(free):
        text = (
            f"no damping, kd or friction at {abbreviate(free.tolist())}: it swings for ever; "
            "write kd in robot.toml, or damping and frictionloss in robot.xml"
        )
        yield Finding("warning", "damping", text, tuple(free))


def _locked(robot: RobotSpec, model: mujoco.MjModel) -> Iterator[Finding]:
    """Find operated joints that the equalities let not move, whatever the other joints do."""
    home = robot.qpos_home
    low, high = robot.qpos_range.T
    inward = np.where(home + NEAR_HOME_RAD > high, -1.0, 1.0)
    # of different size for each joint: at home a loop may stand at its dead centre
    steps = NEAR_HOME_RAD * np.linspace(0.5, 1.0, len(home))
    near_home = np.clip(home + inward * steps, low, high)
    freedom = np.maximum(_freedom(model, home), _freedom(model, near_home))
    operated = robot.operated_index
    locked = [robot.joint_names[i] for i in operated if freedom[i] < MIN_FREEDOM]
    if locked:
        text = (
            f"{abbreviate(locked)}: cannot move, an <equality> in robot.xml holds it: delete the "
            "<equality> if it is no part of the robot; gaponet cannot simulate a closed loop whose "
            "other joints are frozen"
        )
        yield Finding("error", "couplings", text, tuple(locked))


def _freedom(model: mujoco.MjModel, qpos: Array) -> Array:
    """Return the largest speed of each joint, (n), that the equalities allow in a posture, where
    the speeds of all joints have length 1.

    The allowed speeds are the null space of the equalities' Jacobian.
    """
    model = copy(model)
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    of_equality = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
    jacobian = data.efc_J.reshape(-1, model.nv)[of_equality]  # (rows, n)
    if not len(jacobian):
        return np.ones(model.nv)
    _, sizes, directions = np.linalg.svd(jacobian)
    rank = int((sizes > MIN_FREEDOM * sizes[0]).sum())
    freedom: Array = np.linalg.norm(directions[rank:], axis=0)
    return freedom


def _contacts(robot: RobotSpec, postures: Array, logged: bool) -> Iterator[Finding]:
    """Find links that lie inside each other."""
    scene = replace(robot.scene, contacts=True, table=None)
    model = build_model(replace(robot, scene=scene))
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT:
        yield Finding(
            "ok", "contacts", "robot.xml has contacts off: nothing touches but tips a table"
        )
        return
    data = mujoco.MjData(model)
    home = _penetrating_pairs(model, data, robot.qpos_home)
    seen = [_penetrating_pairs(model, data, q) for q in postures]
    always = set(home)
    if seen:
        always |= set.intersection(*seen)
    if always:
        yield _lasting_contact(robot, sorted(always))
    share = float(np.mean([bool(pairs - always) for pairs in seen])) if seen else 0.0
    if share and (logged or robot.scene.contacts):
        often = sorted(set().union(*seen) - always)
        yield _passing_contact(robot, often, share, logged=logged)
    if not always and not share:
        yield Finding(
            "ok",
            "contacts",
            f"no links lie inside each other at home and in {len(postures)} postures",
        )


def _penetrating_pairs(model: mujoco.MjModel, data: mujoco.MjData, qpos: Array) -> set[str]:
    """Return the pairs of links that lie inside each other in a posture."""
    data.qpos[:] = qpos
    mujoco.mj_fwdPosition(model, data)
    pairs = set()
    for contact in data.contact:
        if contact.dist < -MIN_PENETRATION_M:
            bodies = model.geom_bodyid[[contact.geom1, contact.geom2]]
            pairs.add(" and ".join(sorted(model.body(body).name for body in bodies)))
    return pairs


def _lasting_contact(robot: RobotSpec, pairs: list[str]) -> Finding:
    """Return the finding about links that lie inside each other at home or in every posture."""
    level = "ok"
    effect = "they do not touch: contacts are off in robot.toml"
    if robot.scene.contacts:
        level = "warning"
        effect = (
            "joints carry that for ever: write <exclude> in robot.xml, or contacts = false in "
            "robot.toml"
        )
    text = f"at home {abbreviate(pairs)} lie inside each other; {effect}"
    return Finding(level, "contacts", text, values={"pairs": pairs})


def _passing_contact(robot: RobotSpec, pairs: list[str], share: float, *, logged: bool) -> Finding:
    """Return the finding about links that lie inside each other in a share of the postures."""
    what = "of the logs' postures" if logged else "of random postures"
    does = "(contacts are off)"
    if robot.scene.contacts:
        does = "and touch: the logs' robot did not go through itself"
    text = f"in {share:.0%} {what} {abbreviate(pairs)} lie inside each other {does}"
    level = "warning" if robot.scene.contacts and logged else "note"
    return Finding(level, "contacts", text, values={"pairs": pairs, "share": share})


def _steps(
    robot: RobotSpec, models: dict[float, mujoco.MjModel], postures: Array
) -> Iterator[Finding]:
    """Find small motions that grow under gains, inertias and physics step; friction, which hides
    them, is left out.
    """
    thin = [robot.qpos_home, *postures[:: max(1, len(postures) // MAX_POSTURES)][:MAX_POSTURES]]
    cases = []
    worst = _Growth(0.0, 0, False)
    mass = 0.0  # with which it grows
    for payload, model in models.items():
        for posture in thin:
            cases.append((model, posture))
            found = _growth(model, posture)
            if found.factor > worst.factor:
                worst = found
                mass = payload
    growth, joint, oscillates = worst
    name = robot.joint_names[joint]
    if growth <= 1 + MAX_GROWTH:
        yield Finding(
            "ok", "step", "gains, inertias and physics step go together", values={"growth": growth}
        )
    elif not oscillates:
        load = f" with {mass:g} kg" if mass else ""
        text = (
            f"{name}: kp {robot.servo.kp[joint]:g} is too little to hold it up{load}: it falls "
            "away from its target; check kp in robot.toml"
        )
        yield Finding("warning", "step", text, (name,), {"growth": growth})
    else:
        yield _unstable_step(robot, cases, joint, growth)


def _unstable_step(
    robot: RobotSpec, cases: list[tuple[mujoco.MjModel, Array]], joint: int, growth: float
) -> Finding:
    """Return the finding about a joint that is unstable in the robot's physics steps, with what
    would cure it.
    """

    def is_stable(timestep: float, armature: float) -> bool:
        most = 1 + MAX_GROWTH
        return all(_growth(model, q, timestep, armature).factor <= most for model, q in cases)

    step = None
    for halvings in range(1, 7):
        shorter = robot.timestep / 2**halvings
        if is_stable(shorter, 0.0):
            step = shorter
            break
    armature = None
    for doublings in range(14):
        larger = 1e-4 * 2**doublings
        if is_stable(robot.timestep, larger):
            armature = larger
            break
    cures = []
    if step:
        cures.append(f"timestep = {step:g} in robot.toml")
    if armature:
        cures.append(f"armature = {armature:g} in robot.xml where it is less")
    cures.append("a smaller kp")
    name = robot.joint_names[joint]
    text = (
        f"{name}: kp {robot.servo.kp[joint]:g} and kd {robot.servo.kd[joint]:g} on so little "
        f"inertia are unstable in physics steps of {robot.timestep * 1e3:g} ms: write "
        f"{' or '.join(cures)}"
    )
    values = {"growth": growth, "timestep": step, "armature": armature}
    return Finding("error", "step", text, (name,), values)


def _growth(
    model: mujoco.MjModel, q: Array, timestep: float | None = None, armature: float = 0.0
) -> _Growth:
    """Return the growth of the worst small motion about a posture that targets hold against
    gravity.
    """
    model = copy(model)
    model.opt.timestep = timestep or model.opt.timestep
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    model.actuator_forcelimited[:] = False
    model.dof_armature[:] = np.maximum(model.dof_armature, armature)
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    kp = model.actuator_gainprm[:, 0]
    data.ctrl[:] = q + np.divide(data.qfrc_bias, kp, out=np.zeros_like(kp), where=kp > 0)
    slopes = np.zeros((2 * model.nv, 2 * model.nv))
    mujoco.mjd_transitionFD(model, data, 1e-6, True, slopes, None, None, None)
    if not np.isfinite(slopes).all():
        return _Growth(np.inf, 0, True)
    values, vectors = np.linalg.eig(slopes)
    k = int(np.abs(values).argmax())
    joint = int(np.abs(vectors[: model.nv, k]).argmax())
    return _Growth(
        float(np.abs(values[k])), joint, bool(abs(np.angle(values[k])) > MIN_OSCILLATION_RAD)
    )


class _Hold(NamedTuple):
    """A hold at home at every payload, (payloads, n) each."""

    speed: Array  # greatest in the last ten seconds, rad/s
    saturated: Array  # whether the motor gave all it can then
    creep: Array  # in the second half, rad
    sag: Array  # at the end, rad


class _HoldLimit(NamedTuple):
    """A limit of an amount in a hold, and what to say where it is exceeded."""

    what: str
    amount: Array  # (payloads, n)
    most: float
    level: str
    cure: str


def _held(robot: RobotSpec, payloads: tuple[float, ...]) -> _Hold:
    """Hold home for HOLD_S at every payload."""
    sim = BatchSim(robot, [Condition(mass, "both", robot.dt) for mass in payloads], nthread=1)
    home = np.tile(robot.qpos_home, (len(payloads), 1))
    low, high = robot.qpos_range.T
    start = np.clip(home + HOLD_START_RAD, low, high)
    sim.reset(slice(None), start, np.zeros_like(home), past=home[:, None])
    rows = round(HOLD_S / robot.dt)
    speed = np.zeros_like(home)
    saturated = np.zeros(home.shape, bool)
    middle = home
    for t in range(rows):
        sim.step(home)
        if t >= rows * 5 // 6:
            speed = np.fmax(speed, np.abs(sim.qvel))
            saturated |= np.abs(sim.torque) > 0.999 * robot.servo.effort_limit
        if t == rows // 2:
            middle = sim.qpos.copy()
    return _Hold(speed, saturated, np.abs(sim.qpos - middle), np.abs(sim.qpos - home))


def _hold_limits(hold: _Hold) -> list[_HoldLimit]:
    """Return the limits of a hold, the worst first."""
    swings = "check kp and kd; write more damping in robot.xml"
    if (hold.saturated & (hold.speed > MAX_REST_SPEED)).any():
        swings = (
            "its motor gives all it can, one way and the other, and MuJoCo's motors brake no more "
            "then: write kd as damping in robot.xml and kd = 0 in robot.toml, a shorter timestep, "
            "or armature"
        )
    creeps = (
        "friction gives way where its armature is small: write armature = 0.003 or more in "
        "robot.xml"
    )
    return [
        _HoldLimit(
            "does not come to rest: {:.2g} rad/s after a minute",
            hold.speed,
            MAX_REST_SPEED,
            "error",
            swings,
        ),
        _HoldLimit(
            "creeps {:.2g} rad in half a minute of a hold",
            hold.creep,
            MAX_CREEP_RAD,
            "warning",
            creeps,
        ),
        _HoldLimit(
            "hangs {:.2g} rad from its target",
            hold.sag,
            MAX_SAG_RAD,
            "note",
            "check kp and effort_limit against masses",
        ),
    ]


def _hold(robot: RobotSpec, payloads: tuple[float, ...]) -> Iterator[Finding]:
    """Hold home for a minute at every payload; find motion, else creep, else sag."""
    for limit in _hold_limits(_held(robot, payloads)):
        wrong = np.argwhere(~(limit.amount <= limit.most))
        if len(wrong):
            yield _hold_finding(robot, payloads, limit, wrong)
            return
    masses = ", ".join(f"{mass:g}" for mass in payloads)
    yield Finding(
        "ok",
        "hold",
        f"home is held for {HOLD_S:g} s with {masses} kg without creeping or swinging",
    )


def _hold_finding(
    robot: RobotSpec, payloads: tuple[float, ...], limit: _HoldLimit, wrong: Array
) -> Finding:
    """Return the finding about a limit that is exceeded at `wrong`, rows of payload and joint, (k,
    2).
    """
    amount = np.nan_to_num(limit.amount, nan=np.inf)
    payload, joint = max(wrong, key=lambda place: float(amount[*place]))
    names = tuple(dict.fromkeys(robot.joint_names[i] for _, i in wrong))
    load = f" with {payloads[payload]:g} kg" if payloads[payload] else ""
    more = f" ({len(names) - 1} more joints do)" if len(names) > 1 else ""
    worst = limit.amount[payload, joint]
    what = limit.what.format(worst)
    text = f"{robot.joint_names[joint]} {what}{load}{more}: {limit.cure}"
    values = {"payload_mass": payloads[payload], "amount": float(worst)}
    return Finding(limit.level, "hold", text, names, values)
