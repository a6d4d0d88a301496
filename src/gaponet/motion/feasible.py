"""Whether a robot can follow a command, and the nearest command that it can.

Four limits: joint range, joint speed, free space between limbs, and torque by inverse dynamics of the nominal model at
every payload. For a given motion the torque is an affine function of the payload mass (up to the payload ball's own
radius), so the lightest and the heaviest payload bound all between.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from gaponet.arrays import Array
from gaponet.errors import UsageError
from gaponet.motion.collision import CLEARANCE, Collision
from gaponet.motion.motion import GRID, Motion
from gaponet.robot import RobotSpec
from gaponet.sim.dynamics import inverse_dynamics
from gaponet.sim.model import build_model

MAX_PAYLOAD = 3.0  # kg per hand: the heaviest of the SimLifter recipe, and the default
MAX_SPEED = 4.0  # rad/s: under half of the 9 of the slowest H1-2 arm joint (unitreerobotics/unitree_ros, h1_2.urdf)
RANGE_MARGIN = 0.02  # rad kept from a hard stop
COLLISION_ROWS = 0.04  # s between postures that are checked for collisions: 4 cm at 1 m/s
STILL_SHARE = 0.95  # of the usable torque that may go into standing still; beyond it no time is slow enough
TORQUE_SHARE = 0.85  # of the effort limit that a command may ask for; the rest is for feedback and heavier real links


@dataclass(frozen=True)
class Demand:
    """The worst that a command asks of any joint: 1.0 is the limit."""

    position: float
    speed: float
    torque: float
    gravity: float  # the part of torque that remains however slowly the motion is played
    worst_joint: str  # by torque
    clearance: float  # m between the nearest shells, wherever that is

    @property
    def met(self) -> bool:
        """Within all limits."""
        return max(self.position, self.speed, self.torque) <= 1.0 + 1e-9 and self.clearance >= CLEARANCE


class Feasibility:
    """Limits of one robot at payloads from zero to max_payload."""

    def __init__(self, robot: RobotSpec, max_payload: float = MAX_PAYLOAD) -> None:
        self.robot = robot
        self.low, self.high = robot.qpos_range[:, 0] + RANGE_MARGIN, robot.qpos_range[:, 1] - RANGE_MARGIN
        self.max_payload = max_payload if robot.payload_mounts else 0.0
        self.models: list[mujoco.MjModel] = [build_model(robot, p, dt=GRID) for p in sorted({0.0, self.max_payload})]
        self.limit = TORQUE_SHARE * robot.effort_limit
        self.collision = Collision(robot, self.models[0])

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
            clearance=float(self.collision.distance(ctrl[:: max(1, round(COLLISION_ROWS / dt))]).min()),
        )

    def fit(self, motion: Motion, tries: int = 40) -> Motion:
        """Slow the motion down, or bring it nearer to a posture that is fine, until it fits.

        It is slowed where speed or acceleration asks too much, and brought nearer where even standing still does or
        where limbs meet: to its own start if that is fine, else to the robot's home.

        Raises:
            UsageError: It does not fit after `tries` changes; the message says what it still asks for.
        """
        ctrl = np.clip(motion.ctrl, self.low, self.high)
        anchor = ctrl[0] if self.still(ctrl[0]) else np.clip(self.robot.qpos_home, self.low, self.high)
        for _ in range(tries):
            need = self.demand(ctrl, motion.dt)
            if need.met:
                return Motion(motion.name, motion.level, motion.dt, ctrl)
            if need.gravity > STILL_SHARE or need.clearance < CLEARANCE:
                ctrl = anchor + 0.93 * (ctrl - anchor)
            else:
                ctrl = stretch(ctrl, min(max(need.speed, need.torque**0.5, 1.03), 1.5))
            ctrl = np.clip(ctrl, self.low, self.high)
        raise UsageError(
            f"motion '{motion.name}' does not fit {self.robot.name} after {tries} changes: {need.worst_joint} needs "
            f"{need.torque:.2f} of its usable torque at {self.max_payload:g} kg, speed is {need.speed:.2f} of "
            f"{MAX_SPEED:g} rad/s, the nearest limbs are {need.clearance * 100:.1f} cm apart (at least "
            f"{CLEARANCE * 100:g}). Start it from a posture that is easier to hold, or collect with a lighter payload"
        )

    def still(self, posture: Array) -> bool:
        """Whether a posture (n,) rad can be held at every payload, clear of the body."""
        rows = np.repeat(posture[None], 2, axis=0)
        need = self.demand(rows, GRID)
        return need.gravity <= STILL_SHARE and need.clearance >= CLEARANCE


def stretch(ctrl: Array, factor: float) -> Array:
    """The same path (T, n), `factor` times slower, on the same grid."""
    from scipy.interpolate import CubicSpline

    rows = round((len(ctrl) - 1) * factor) + 1
    return CubicSpline(np.arange(len(ctrl)), ctrl)(np.linspace(0, len(ctrl) - 1, rows))
