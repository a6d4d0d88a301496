"""Inverse dynamics along a trajectory: which joint torques it takes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.robot.spec import RobotSpec, Tip
from gaponet.sim.model import build_model

CUTOFF_HZ = 6.0  # Hz: above the joints' bandwidth, below encoder steps at 50 Hz


def inverse_dynamics(model: mujoco.MjModel, qpos: Array, qvel: Array, qacc: Array) -> Array:
    """Return the torque of every joint by inertia, armature, Coriolis, gravity, damping and
    springs.

    Args:
        model: Nominal simulator with its payload (sim.model.build_model).
        qpos, qvel, qacc: (T, n), rad, rad/s, rad/s².

    Returns:
        (T, n), N·m, without limits, contacts and joint friction, which at rest is anything up to
        its limit. The motor that leads a joint without a motor carries both, and the other's
        torque is 0.
    """
    data = mujoco.MjData(model)
    flags = model.opt.disableflags
    model.opt.disableflags = flags | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    tau = np.empty(np.shape(qpos))
    # views, looked up once
    q = data.qpos
    v = data.qvel
    a = data.qacc
    out = data.qfrc_inverse
    for t in range(len(tau)):
        q[:] = qpos[t]
        v[:] = qvel[t]
        a[:] = qacc[t]
        mujoco.mj_inverse(model, data)
        tau[t] = out
    model.opt.disableflags = flags
    led = motion_of_followers(model)
    return tau if led is None else tau @ led


def motion_of_followers(model: mujoco.MjModel) -> Array | None:
    """Return how fast each joint moves if one motor turns at 1 rad/s, (n, n): [joint, motor].

    It is the identity but for joints that follow another one through an equality of the model;
    their columns are 0. None if no joint follows another.
    """
    is_coupling = model.eq_type == mujoco.mjtEq.mjEQ_JOINT
    coupled = np.flatnonzero(is_coupling & (model.eq_active0 != 0) & (model.eq_obj2id >= 0))
    if not len(coupled):
        return None
    followers = model.jnt_dofadr[model.eq_obj1id[coupled]]
    leaders = model.jnt_dofadr[model.eq_obj2id[coupled]]
    ratios = model.eq_data[coupled, 1]
    moves = np.eye(model.nv)
    for _ in coupled:  # a leader may follow another joint
        for follower, leader, ratio in zip(followers, leaders, ratios, strict=True):
            moves[:, leader] += ratio * moves[:, follower]
            moves[:, follower] = 0.0
    return moves


def static_torque(model: mujoco.MjModel, qpos: Array) -> Array:
    """Return the torque that holds each posture, (T, n), N·m."""
    zero = np.zeros_like(qpos)
    return inverse_dynamics(model, qpos, zero, zero)


def gravity_of(robot: RobotSpec) -> Callable[[Array, float, str], Array]:
    """Return the static torque by postures, payload mass and side (data/offsets.py); it can be
    pickled.
    """
    return partial(_gravity, dynamics_of(robot))


def dynamics_of(robot: RobotSpec) -> Callable[[Array, Array, Array, float, str], Array]:
    """Return the torque by motion, payload mass and side (data/offsets.py); it can be pickled."""
    return partial(_dynamics, robot, {})


def _gravity(
    dynamics: Callable[[Array, Array, Array, float, str], Array],
    qpos: Array,
    payload_mass: float,
    payload_side: str,
) -> Array:
    zero = np.zeros_like(qpos)
    return dynamics(qpos, zero, zero, payload_mass, payload_side)


def _dynamics(
    robot: RobotSpec,
    models: dict[tuple[float, str], mujoco.MjModel],
    qpos: Array,
    qvel: Array,
    qacc: Array,
    payload_mass: float,
    payload_side: str,
) -> Array:
    key = (payload_mass, payload_side)
    if key not in models:
        models[key] = build_model(robot, *key)
    return inverse_dynamics(models[key], qpos, qvel, qacc)


def tips_of(robot: RobotSpec) -> Callable[[Array], Array] | None:
    """Return the height of the lowest tip by postures (k, n), (k,) m; None if robot.toml names no
    tip.
    """
    if not robot.scene.tips:
        return None
    return partial(
        _lowest_tip, build_model(robot.with_table(None), physics_only=True), robot.scene.tips
    )


def _lowest_tip(model: mujoco.MjModel, tips: tuple[Tip, ...], postures: Array) -> Array:
    data = mujoco.MjData(model)
    height = np.full(len(postures), np.inf)
    at = [(model.body(tip.body).id, np.array(tip.pos), tip.radius) for tip in tips]
    # views, looked up once
    qpos = data.qpos
    xpos = data.xpos
    xmat = data.xmat
    for t, row in enumerate(postures):
        qpos[:] = row
        mujoco.mj_kinematics(model, data)
        height[t] = min(xpos[b, 2] + xmat[b, 6:] @ p - r for b, p, r in at)
    return height
