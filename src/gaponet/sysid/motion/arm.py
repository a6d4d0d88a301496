"""Arms of a robot, and inverse kinematics of their hands.

An arm is found by joint names, `<side>_shoulder_pitch…`, `…shoulder_roll…`, `…shoulder_yaw…`, `…elbow…` and
`…wrist_roll…`, with a payload mount of the same side as its hand. A robot without such names has no arms here, and no
coordinated arm motions.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.robot.spec import RobotSpec
from gaponet.sysid.motion.feasible import Feasibility

ROLES = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow", "wrist_roll")


@dataclass(frozen=True)
class Arm:
    """One arm.

    Attributes:
        side: left or right.
        sign: +1 left, −1 right: multiplies every sideways (y) quantity.
        columns: Positions of ROLES in robot.joint_names, (5,).
        hand: MuJoCo body at the palm.
    """

    side: str
    sign: float
    columns: Array
    hand: str


def arms(robot: RobotSpec) -> dict[str, Arm]:
    """The robot's arms by side; empty for a robot that is not built like that."""
    found = {}
    for mount in robot.payload_mounts:
        names = [[n for n in robot.joint_names if n.startswith(f"{mount.side}_{role}")] for role in ROLES]
        if all(len(n) == 1 for n in names):
            sign = -1.0 if mount.side == "right" else 1.0
            columns = robot.index([n[0] for n in names])
            found[mount.side] = Arm(mount.side, sign, columns, f"payload_{mount.side}")
    return found


class HandIK:
    """Damped least squares on the five joints of one arm; what the hand leaves open is pulled towards the start."""

    def __init__(self, limits: Feasibility, arm: Arm) -> None:
        self.model = limits.models[0]
        self.data = mujoco.MjData(self.model)
        self.arm = arm
        self.body = self.model.body(arm.hand).id
        self.low, self.high = limits.low[arm.columns], limits.high[arm.columns]

    def position(self, qpos: Array) -> Array:
        """Palm centre in the world at a posture (n,), (3,) m."""
        self.data.qpos = qpos
        mujoco.mj_kinematics(self.model, self.data)
        return self.data.xpos[self.body].copy()

    def solve(self, qpos: Array, target: Array, iterations: int = 80) -> Array:
        """Joint positions (n,) that bring the palm as near to target (3,) m as limits allow, starting from qpos."""
        q = np.array(qpos, float)
        rest = q[self.arm.columns].copy()
        jac = np.zeros((3, self.model.nv))
        for _ in range(iterations):
            error = target - self.position(q)
            if np.linalg.norm(error) < 1e-4:
                break
            mujoco.mj_comPos(self.model, self.data)
            mujoco.mj_jacBody(self.model, self.data, jac, None, self.body)
            J = jac[:, self.arm.columns]
            inverse = J.T @ np.linalg.inv(J @ J.T + 1e-3 * np.eye(3))
            pull = (np.eye(len(rest)) - inverse @ J) @ (rest - q[self.arm.columns])
            step = inverse @ error + 0.1 * pull
            q[self.arm.columns] = np.clip(q[self.arm.columns] + np.clip(step, -0.3, 0.3), self.low, self.high)
        return q

    def path(self, qpos: Array, targets: Array) -> Array:
        """One posture per target (k, 3), each from the one before: (k, n)."""
        rows = []
        for target in targets:
            qpos = self.solve(qpos, target)
            rows.append(qpos)
        return np.array(rows)
