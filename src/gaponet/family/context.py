"""Which simulator is this? Told by its numbers, or found by asking it: a few numbers per joint, constant in a run.

Parameters: kp, damping, friction, armature and mass as factors of the nominal simulator's, the delay, the payload.
Fingerprint: the simulator's own answers in a posture that loads the arms, one joint at a time, at rest and moving.
"""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from itertools import product
from typing import Literal

import numpy as np

from gaponet.arrays import Array
from gaponet.family.draw import OF_JOINTS, Family, Members, scale
from gaponet.robot import RobotSpec
from gaponet.sim.batch import BatchSim, Condition
from gaponet.sim.dynamics import static_torque
from gaponet.sim.model import build_model, idle_joints

Kind = Literal["parameters", "fingerprint"]
STEPS = (-0.4, -0.1, -0.02, 0.02, 0.1, 0.4)  # rad from where the joint is
SPEEDS = (0.0, 0.5, -0.5)  # rad/s
POSTURES = 256  # tried, for the one that loads the arms most
INSIDE = 0.2  # of a joint's range, kept free on either side
TOLERANCE = 0.01  # of a factor; 0.1 ms of a delay


def context(
    kind: Kind,
    reference: RobotSpec,
    robot: RobotSpec,
    conditions: ListOf[Condition],
    members: Members | None = None,
    nthread: int = 0,
) -> Array:
    """What a network is told of simulators, (num, n operated · k) float32, joint by joint.

    Args:
        kind: Parameters, k = 7, or fingerprint, k = 36.
        reference: The nominal simulator of the family.
        robot: The simulator; with members, the one around which they are drawn.
        conditions: What the robots carry, and the control period.
        members: One for each condition.
    """
    if members is not None:
        conditions = members.conditions(conditions)
        if kind == "fingerprint":
            return fingerprint(robot, conditions, loaded_posture(reference), members, nthread)
        factors = {name: getattr(members, name) for name in (*OF_JOINTS, "mass")}
        return _stacked(factors, members.delay + robot.delay.max(), conditions)
    unique = list(dict.fromkeys(conditions))
    if kind == "fingerprint":
        out = fingerprint(robot, unique, loaded_posture(reference), nthread=nthread)
    else:
        parts = [factors_of(reference, robot.with_gains(c.kp, c.kd)) for c in unique]
        both = {name: np.stack([p[name] for p in parts]) for name in parts[0]}
        delay = np.full(len(unique), robot.delay.max())
        out = _stacked(both, delay, unique)
    return out[[unique.index(c) for c in conditions]]


def factors_of(reference: RobotSpec, robot: RobotSpec) -> dict[str, Array]:
    """The numbers of a simulator's operated joints as factors of the reference's, (n,); of its mass, ()."""
    own, nominal = _numbers(robot), _numbers(reference)
    with np.errstate(divide="ignore", invalid="ignore"):
        return {k: np.where(own[k] == nominal[k], 1.0, own[k] / nominal[k]) for k in own}


def outside(family: Family, reference: RobotSpec, robot: RobotSpec) -> str:
    """Why a simulator is none of the family's; "" where it is one."""
    if robot.has_law and not reference.has_law:
        return "its servos have a law of friction or torque that the family's have not"
    for name, factors in factors_of(reference, robot).items():
        low, high = getattr(family, name)
        for joint, x in zip(robot.operated, np.broadcast_to(factors, len(robot.operated)), strict=True):
            if not low - TOLERANCE * low <= x <= high * (1 + TOLERANCE):
                return f"joint '{joint}': {name} is {x:.3g} of the nominal one's, the family has {low:g} to {high:g}"
    later, (least, most) = float(robot.delay.max() - reference.delay.max()), family.delay
    if not least - 1e-4 <= later <= most + 1e-4:
        return f"its servos are {later * 1e3:.1f} ms later, the family's {least * 1e3:g} to {most * 1e3:g} ms"
    return ""


def fingerprint(
    robot: RobotSpec,
    conditions: ListOf[Condition],
    posture: Array,
    members: Members | None = None,
    nthread: int = 0,
) -> Array:
    """Own Δq and Δt·Δq̇ of every joint, over a control period, to steps of its target; (num, n · 36) float32, rad."""
    locked = idle_joints(robot, robot.operated)
    sim = BatchSim(robot if members is None else members.robot(robot), list(conditions), nthread, locked)
    if members is not None:
        members.put(sim, robot)
    op = [sim.joint_names.index(name) for name in robot.operated]
    stand = np.tile(posture[robot.index(sim.joint_names)], (sim.num_envs, 1))
    dt = sim.nstep * sim.timestep
    out = np.empty((sim.num_envs, len(op), len(SPEEDS) * len(STEPS), 2), np.float32)
    for k, j in enumerate(op):
        for i, (speed, step) in enumerate(product(SPEEDS, STEPS)):
            target, moving = stand.copy(), np.zeros_like(stand)
            target[:, j] += step
            moving[:, j] = speed
            sim.reset(slice(None), stand, moving, past=stand[:, None])
            sim.step(target)
            out[:, k, i, 0] = sim.qpos[:, j] - stand[:, j]
            out[:, k, i, 1] = dt * (sim.qvel[:, j] - speed)
    return out.reshape(len(out), -1)


def loaded_posture(robot: RobotSpec) -> Array:
    """A posture in which gravity pulls hard at the operated joints, all others at home, (n,) rad."""
    rng, op = np.random.default_rng(0), robot.operated_index
    low, high = np.clip(robot.qpos_range[op].T, -np.pi, np.pi)
    tried = np.tile(robot.qpos_home, (POSTURES, 1))
    tried[:, op] = low + (high - low) * rng.uniform(INSIDE, 1 - INSIDE, (POSTURES, len(op)))
    pull = np.abs(static_torque(build_model(robot), tried)[:, op]) / robot.kp[op]
    return np.array(tried[pull.mean(axis=1).argmax()])


def _numbers(robot: RobotSpec) -> dict[str, Array]:
    model, op = build_model(robot), robot.operated_index
    out = {name: getattr(model, f"dof_{name}")[op] for name in ("damping", "frictionloss", "armature")}
    out |= {"kp": robot.kp[op], "damping": out["damping"] + robot.kd[op]}
    return {name: out[name] for name in OF_JOINTS} | {"mass": np.array(model.body_mass.sum())}


def _stacked(factors: dict[str, Array], delay: Array, conditions: ListOf[Condition]) -> Array:
    shape = factors["kp"].shape
    columns = [scale(x if x.ndim > 1 else x[:, None]) for x in factors.values()]
    columns += [delay[:, None], np.array([c.payload_mass for c in conditions])[:, None]]
    each = np.stack([np.broadcast_to(x, shape) for x in columns], axis=2)
    return each.reshape(len(each), -1).astype(np.float32)
