"""Whether a robot can follow a command, and the nearest command that it can.

Three limits: joint range, joint speed, and torque by inverse dynamics of the nominal model at every payload. For a given
motion the torque is an affine function of the payload mass (up to the payload ball's own radius), so the lightest and the
heaviest payload bound all between.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from gaponet.errors import UsageError
from gaponet.motion.motion import GRID, Motion
from gaponet.robot import RobotSpec
from gaponet.sim.dynamics import inverse_dynamics
from gaponet.sim.model import build_model

Array = np.ndarray

MAX_PAYLOAD = 3.0  # kg per hand, the heaviest of the SimLifter recipe
MAX_SPEED = 4.0  # rad/s: below half of the 9 rad/s of the slowest H1-2 arm joint (h1_2.urdf, unitreerobotics/unitree_ros)
RANGE_MARGIN = 0.02  # rad kept from a hard stop
TORQUE_SHARE = 0.9  # of the effort limit that a command may ask for; the rest is for feedback


@dataclass(frozen=True)
class Demand:
    """The worst that a command asks of any joint: 1.0 is the limit."""

    position: float
    speed: float
    torque: float
    gravity: float  # the part of torque that remains however slowly the motion is played
    worst_joint: str  # by torque

    @property
    def met(self) -> bool:
        """Within all limits."""
        return max(self.position, self.speed, self.torque) <= 1.0 + 1e-9


class Feasibility:
    """Limits of one robot at payloads from zero to max_payload."""

    def __init__(self, robot: RobotSpec, max_payload: float = MAX_PAYLOAD) -> None:
        self.robot = robot
        self.low, self.high = robot.qpos_range[:, 0] + RANGE_MARGIN, robot.qpos_range[:, 1] - RANGE_MARGIN
        heaviest = max_payload if robot.payload_mounts else 0.0
        self.models: list[mujoco.MjModel] = [build_model(robot, p, dt=GRID) for p in sorted({0.0, heaviest})]
        self.limit = TORQUE_SHARE * robot.effort_limit

    def demand(self, ctrl: Array, dt: float) -> Demand:
        """What a command (T, n) rad at period dt asks for."""
        qvel = np.gradient(ctrl, dt, axis=0)
        qacc = np.gradient(qvel, dt, axis=0)
        zero = np.zeros_like(ctrl)
        share = np.max([np.abs(inverse_dynamics(m, ctrl, qvel, qacc)) for m in self.models], axis=0) / self.limit
        still = np.max([np.abs(inverse_dynamics(m, ctrl, zero, zero)) for m in self.models], axis=0) / self.limit
        centre, half = (self.low + self.high) / 2, (self.high - self.low) / 2
        with np.errstate(invalid="ignore"):
            position = np.nan_to_num(np.abs(ctrl - centre) / half, nan=0.0)  # unlimited joints: inf / inf
        return Demand(
            position=float(position.max()),
            speed=float(np.abs(qvel).max() / MAX_SPEED),
            torque=float(share.max()),
            gravity=float(still.max()),
            worst_joint=self.robot.joint_names[int(share.max(axis=0).argmax())],
        )

    def fit(self, motion: Motion, tries: int = 40) -> Motion:
        """Slow the motion down, or bring it nearer to its start where even holding still asks too much, until it fits.

        Raises:
            UsageError: It does not fit after `tries` changes; the message names the joint and its torque.
        """
        ctrl = np.clip(motion.ctrl, self.low, self.high)
        for _ in range(tries):
            need = self.demand(ctrl, motion.dt)
            if need.met:
                return Motion(motion.name, motion.level, motion.dt, ctrl)
            if need.gravity > 0.95:
                ctrl = ctrl[0] + 0.93 * (ctrl - ctrl[0])
            else:
                ctrl = stretch(ctrl, min(max(need.speed, need.torque**0.5, 1.03), 1.5))
        raise UsageError(
            f"motion '{motion.name}': {need.worst_joint} needs {need.torque:.2f} of its usable torque at "
            f"{MAX_PAYLOAD:g} kg after {tries} changes; start it from a posture that is easier to hold"
        )


def stretch(ctrl: Array, factor: float) -> Array:
    """The same path (T, n), `factor` times slower, on the same grid."""
    from scipy.interpolate import CubicSpline

    rows = round((len(ctrl) - 1) * factor) + 1
    return CubicSpline(np.arange(len(ctrl)), ctrl)(np.linspace(0, len(ctrl) - 1, rows))
