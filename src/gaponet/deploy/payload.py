"""How heavy is what the robot holds? From the torque that holds the arms up, where nobody says it."""

from __future__ import annotations

import mujoco
import numpy as np

from gaponet.arrays import Array
from gaponet.robot import RobotSpec
from gaponet.sim.batch import BatchSim

MEMORY = 1.0  # s: time constant of forgetting
RATE = 1.0  # kg/s: a payload that appears at once is believed over this time, so that commands do not jump
STILL = 0.5  # rad/s: a sample counts half at this speed, less when faster
CERTAIN = 4.0  # (N·m/kg)²: leverage below which the present guess is kept


class PayloadEstimate:
    """Least squares with forgetting on gravity: τ = τ_0(q) + m dτ(q), in which the mass m per hand is linear.

    Friction hides ± a few N·m, so this is good to some hundred grams on an arm of 40 N·m, and slow on purpose.
    """

    def __init__(self, sim: BatchSim, at: Array, robot: RobotSpec, masses: int, dt: float) -> None:
        """
        Args:
            sim: Its last `masses` rows carry payloads from 0 to the largest; the first and last of those are used.
            at: Operated joints among the simulation's.
            dt: Control period, s.
        """
        self.sim, self.at, self.dt = sim, at, dt
        self.rows = np.array([sim.num_envs - masses, sim.num_envs - 1])
        self.kp, self.kd = robot.kp[robot.operated_index], robot.kd[robot.operated_index]
        self.heaviest = float(sorted(c[0] for c in sim.models)[-1])
        self.bias: Array = sim.batch.bind("qfrc_bias")
        self.home = robot.qpos_home[robot.index(sim.joint_names)]

    def reset(self, num: int) -> None:
        """Nothing in the hands of num robots."""
        self.mass, self.top, self.weight = np.zeros(num), np.zeros(num), np.zeros(num)

    def update(self, qpos: Array, qvel: Array, sent: Array, tau: Array | None, seen: Array) -> Array:
        """Take in one control period; all (num, n operated). Returns kg per robot, (num,).

        Args:
            qpos, qvel: Measured, rad, rad/s.
            sent: Command in force, rad.
            tau: Measured torque, N·m; None for the servo law's.
            seen: Robots (num,) whose state is one; of the others nothing is learned.
        """
        torque = self.kp * (sent - qpos) - self.kd * qvel if tau is None else tau
        keep = np.exp(-self.dt / MEMORY)
        for i in np.flatnonzero(seen):
            empty, full = self._gravity(qpos[i])
            per_kg = (full - empty) / self.heaviest
            share = 1.0 / (1.0 + (np.abs(qvel[i]).max() / STILL) ** 2)
            self.top[i] = keep * self.top[i] + share * float(per_kg @ (torque[i] - empty)) * self.dt
            self.weight[i] = keep * self.weight[i] + share * float(per_kg @ per_kg) * self.dt
        guess = np.clip(self.top / np.maximum(self.weight, 1e-9), 0.0, self.heaviest)
        guess = np.where(self.weight > CERTAIN * MEMORY * 0.1, guess, self.mass)
        self.mass = self.mass + np.clip(guess - self.mass, -RATE * self.dt, RATE * self.dt)
        return self.mass

    def _gravity(self, qpos: Array) -> Array:
        """Torque that holds a posture, empty and with the largest payload, (2, n) N·m."""
        self.sim.qpos[self.rows], self.sim.qvel[self.rows] = self.home, 0.0
        self.sim.qpos[self.rows[:, None], self.at] = qpos
        self.sim.batch.forward(self.rows, stage=mujoco.mjtStage.mjSTAGE_VEL.value)
        return self.bias[self.rows][:, self.at]
