"""Inverse labels: the targets that would make the simulator follow the robot's recorded motion.

The position actuator's force is kp·(u + offset − q) − kd·q̇, so the target that produces a torque τ is
u* = q + (τ + kd·q̇)/kp − offset, sent ahead by the servo's delay where one is identified. τ comes from the inverse
dynamics of the payload-carrying model at low-pass filtered (q, q̇, q̈). The plant is stable about u*, so the label stays
right when the simulated state has drifted from the recorded one: that is what lets a network be fitted on the states
that it visits itself.
"""

from __future__ import annotations

import numpy as np

from gaponet.data.sequence import Sequence
from gaponet.data.signals import differentiate, lowpass
from gaponet.robot import RobotSpec
from gaponet.sim.dynamics import CUTOFF, inverse_dynamics
from gaponet.sim.model import build_model

Array = np.ndarray

FRICTION_SPEED = 0.02  # rad/s: friction torque is tanh(q̇ / this), since its sign at rest is noise


def inverse_targets(sequence: Sequence, robot: RobotSpec, cutoff: float = CUTOFF) -> Array:
    """u*, (T, n) rad: held over [t, t+1), it leads the simulator from the recorded state t to t+1."""
    model = build_model(robot, sequence.meta.payload_mass, sequence.meta.payload_side, sequence.dt)
    qpos = lowpass(sequence.qpos.astype(float), sequence.dt, cutoff)
    qvel = differentiate(qpos, sequence.dt)
    tau = inverse_dynamics(model, qpos, qvel, differentiate(qvel, sequence.dt))
    tau += model.dof_frictionloss * np.tanh(qvel / FRICTION_SPEED)
    tau = np.clip(tau, -robot.effort_limit, robot.effort_limit)
    target = qpos + (tau + robot.kd * qvel) / robot.kp - robot.offset
    t = np.arange(len(target)) * sequence.dt
    for j in np.flatnonzero(robot.delay):
        target[:, j] = np.interp(t + robot.delay[j], t, target[:, j])
    return target.astype(np.float32)


def inverse_labels(sequence: Sequence, robot: RobotSpec, limit: float) -> Array:
    """Δa* = u* − a of the operated joints, within ±limit rad, (T, n_operated)."""
    delta = (inverse_targets(sequence, robot) - sequence.ctrl)[:, robot.operated_index]
    return np.clip(delta, -limit, limit).astype(np.float32)
