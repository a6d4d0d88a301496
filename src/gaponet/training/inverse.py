"""Inverse labels: the smallest correction that makes the simulator follow the robot's recorded motion.

The position actuator's force is kp·(u + offset − q) − kd·q̇, so the target that produces a torque τ is
u* = q + (τ + kd·q̇)/kp − offset, sent ahead by the servo's delay where one is identified. τ comes from the inverse
dynamics of the payload-carrying model at low-pass filtered (q, q̇, q̈), plus dry friction. A joint that moves has all of
its friction against it; one that rests takes whatever friction is needed, up to the limit, so every target within that
band leads along the recording. The label is the one nearest to the command: where the simulator needs no help, it is 0.

The plant is stable about u*, so the label stays right when the simulated state has drifted from the recorded one: that
is what lets a network be fitted on the states that it visits itself.
"""

from __future__ import annotations

import numpy as np

from gaponet.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.data.signals import differentiate, lowpass
from gaponet.robot import RobotSpec
from gaponet.sim.dynamics import CUTOFF, inverse_dynamics
from gaponet.sim.model import build_model

FRICTION_SPEED = 0.02  # rad/s: below it, recorded motion is as good as rest


def inverse_targets(sequence: Sequence, robot: RobotSpec, cutoff: float = CUTOFF) -> tuple[Array, Array]:
    """The least and the greatest u*, (T, n) rad each: held over [t, t+1), they lead the simulator from row t to t+1."""
    robot = robot.with_gains(*sequence.meta.known_gains)
    model = build_model(robot, sequence.meta.payload_mass, sequence.meta.payload_side, sequence.dt)
    qpos = lowpass(sequence.qpos.astype(float), sequence.dt, cutoff)
    qvel = differentiate(qpos, sequence.dt)
    tau = inverse_dynamics(model, qpos, qvel, differentiate(qvel, sequence.dt))
    moving = np.tanh(np.abs(qvel) / FRICTION_SPEED)  # 0 at rest: friction is anything within ±limit; 1: all of it
    against = np.sign(qvel) * model.dof_frictionloss
    free = (1.0 - moving) * model.dof_frictionloss
    low, high = (_targets(tau + moving * against + part, qpos, qvel, robot, sequence.dt) for part in (-free, free))
    return low, high


def _targets(tau: Array, qpos: Array, qvel: Array, robot: RobotSpec, dt: float) -> Array:
    """Targets with which the servos produce these torques."""
    tau = np.clip(tau, -robot.effort_limit, robot.effort_limit)
    target = qpos + (tau + robot.kd * qvel) / robot.kp - robot.offset
    t = np.arange(len(target)) * dt
    for j in np.flatnonzero(robot.delay):
        target[:, j] = np.interp(t + robot.delay[j], t, target[:, j])
    return target.astype(np.float32)


def inverse_labels(sequence: Sequence, robot: RobotSpec, limit: float) -> Array:
    """The Δa* nearest to 0 with a + Δa* between these targets, operated joints, within ±limit rad, (T, n_operated)."""
    low, high = inverse_targets(sequence, robot)
    delta = np.clip(sequence.ctrl, low, high) - sequence.ctrl
    return np.clip(delta[:, robot.operated_index], -limit, limit).astype(np.float32)
