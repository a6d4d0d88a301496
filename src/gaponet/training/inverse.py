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

from collections.abc import Sequence as ListOf

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
    moving = np.tanh(np.abs(qvel) / FRICTION_SPEED)  # 0 at rest: friction is anything within ±limit; 1: all
    tau, free = tau + moving * np.sign(qvel) * model.dof_frictionloss, (1.0 - moving) * model.dof_frictionloss
    low, high = (
        qpos
        + (np.clip(tau + band, -robot.effort_limit, robot.effort_limit) + robot.kd * qvel) / robot.kp
        - robot.offset
        for band in (-free, free)
    )
    t = np.arange(len(sequence)) * sequence.dt
    for j in np.flatnonzero(robot.delay):
        for target in (low, high):
            target[:, j] = np.interp(t + robot.delay[j], t, target[:, j])
    return low.astype(np.float32), high.astype(np.float32)


def inverse_labels(sequences: ListOf[Sequence], robot: RobotSpec, limit: float) -> Array:
    """The Δa* nearest to 0 with a + Δa* between these targets, operated joints, within ±limit rad, (rows of all
    recordings, n_operated)."""
    labels = []
    for s in sequences:
        low, high = inverse_targets(s, robot)
        labels.append((np.clip(s.ctrl, low, high) - s.ctrl)[:, robot.operated_index])
    return np.clip(np.concatenate(labels), -limit, limit).astype(np.float32)
