"""How heavy is what the robot holds? From the torque that holds the arms up, where nobody says it."""

from __future__ import annotations

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import BatchSim

MEMORY = 1.0  # s: time constant of forgetting
RATE = 1.0  # kg/s: a payload that appears at once is believed over this time, so that commands do not jump
STILL = 0.5  # rad/s: a sample counts half at this speed, less when faster
CERTAIN = 4.0  # (N·m/kg)²: leverage below which the present guess is kept
# Share of the torques beyond the empty arm's that is as the largest payload's (virtual H1-2, 3 kg held: 0.57 to 0.97,
# nothing held and positions read 0.12 rad wrong: up to 0.56); friction leaves less of it to a smaller one.
ALIKE = 0.55


class PayloadEstimate:
    """Least squares with forgetting on gravity: τ = τ_0(q) + m dτ(q), in which the mass m per hand is linear.

    Friction hides ± a few N·m, so this is good to some hundred grams on an arm of 40 N·m, and slow on purpose. Torques
    that are not alike a payload's, the less the heavier it would be, are believed to be none.
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
        self.mass, self.top, self.weight, self.energy = (np.zeros(num) for _ in range(4))
        self.guess, self.certain = np.zeros(num), np.zeros(num, bool)

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
            self.energy[i] = keep * self.energy[i] + share * float(np.sum((torque[i] - empty) ** 2)) * self.dt
            self.weight[i] = keep * self.weight[i] + share * float(per_kg @ per_kg) * self.dt
        guess = self.top / np.maximum(self.weight, 1e-9)
        alike = self.top * np.abs(self.top) / np.maximum(self.weight * self.energy, 1e-9)
        guess = np.clip(guess, 0.0, self.heaviest)
        guess = np.where(alike < ALIKE * (guess / self.heaviest) ** 2, 0.0, guess)
        self.certain = self.weight > CERTAIN * MEMORY * 0.1
        self.guess = np.where(self.certain, guess, self.mass)
        self.mass = self.mass + np.clip(self.guess - self.mass, -RATE * self.dt, RATE * self.dt)
        return self.mass

    def contradicts(self, told: float) -> str:
        """What the first robot's torques say, if that is another payload than was told, kg; else nothing."""
        if not self.certain[0] or abs(self.guess[0] - told) <= self.heaviest / 2:
            return ""
        return f"{told:g} kg were told, and the torques are those of about {self.guess[0]:.1f} kg: what is in the hand?"

    def _gravity(self, qpos: Array) -> Array:
        """Torque that holds a posture, empty and with the largest payload, (2, n) N·m."""
        self.sim.qpos[self.rows], self.sim.qvel[self.rows] = self.home, 0.0
        self.sim.qpos[self.rows[:, None], self.at] = qpos
        self.sim.batch.forward(self.rows, stage=mujoco.mjtStage.mjSTAGE_VEL.value)
        return self.bias[self.rows][:, self.at]
