"""Inverse labels: the targets that would make the simulator follow the robot's recorded motion.

The position actuator's force is kp·(u − q) − kd·q̇, so the target that produces a torque τ is u* = q + (τ + kd·q̇)/kp,
with τ from the inverse dynamics of the payload-carrying model at low-pass filtered (q, q̇, q̈). The plant is stable about
u*, so the label stays right when the simulated state has drifted from the recorded one: that is what lets a network be
fitted on the states that it visits itself.
"""

from __future__ import annotations

import mujoco
import numpy as np

from gaponet.data.sequence import Sequence
from gaponet.data.signals import differentiate, lowpass
from gaponet.robot import RobotSpec
from gaponet.sim.model import build_model

Array = np.ndarray

CUTOFF = 6.0  # Hz: above the joints' bandwidth (lag 80–160 ms), below encoder steps at 50 Hz
FRICTION_SPEED = 0.02  # rad/s: friction torque is tanh(q̇ / this), since its sign at rest is noise


def equivalent_torque(sequence: Sequence, robot: RobotSpec, cutoff: float = CUTOFF) -> tuple[Array, Array, Array]:
    """Inverse dynamics of the nominal, payload-carrying model along a recording.

    Returns:
        tau_eq (T, n) N·m, friction and damping included, and the filtered qpos, qvel it belongs to.
    """
    model = build_model(robot, sequence.meta.payload_mass, sequence.meta.payload_side, sequence.dt)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data = mujoco.MjData(model)
    qpos = lowpass(sequence.qpos.astype(float), sequence.dt, cutoff)
    qvel = differentiate(qpos, sequence.dt)
    qacc = differentiate(qvel, sequence.dt)
    tau = np.empty_like(qpos)
    for t in range(len(qpos)):
        data.qpos[:], data.qvel[:], data.qacc[:] = qpos[t], qvel[t], qacc[t]
        mujoco.mj_inverse(model, data)
        tau[t] = data.qfrc_inverse
    return tau + model.dof_frictionloss * np.tanh(qvel / FRICTION_SPEED), qpos, qvel


def inverse_targets(sequence: Sequence, robot: RobotSpec, cutoff: float = CUTOFF) -> Array:
    """u*, (T, n) rad: held over [t, t+1), it leads the simulator from the recorded state t to t+1."""
    tau, qpos, qvel = equivalent_torque(sequence, robot, cutoff)
    tau = np.clip(tau, -robot.effort_limit, robot.effort_limit)
    return (qpos + (tau + robot.kd * qvel) / robot.kp).astype(np.float32)
