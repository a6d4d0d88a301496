"""Estimate of the payload mass from the torques that hold the arms, if nobody states the mass."""

from __future__ import annotations

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import Batch, BatchSim, differing_fields

FORGETTING_TIME_S = 1.0  # time constant
MAX_RATE_KG_S = 1.0  # of the estimate: a payload that appears at once must not make commands jump
HALF_WEIGHT_SPEED = 0.5  # rad/s; samples at this speed have half the weight, faster ones less
MIN_LEVERAGE = 0.4  # (N·m/kg)² s; below it, the estimate does not change
# Least share of the excess torque over the empty arm's that must look like the largest payload's.
# On a virtual H1-2, 3 kg give 0.57 to 0.97, and no payload with positions wrong by 0.12 rad up to
# 0.56. Friction lowers the share of smaller payloads.
MIN_SIMILARITY = 0.55


class PayloadFields:
    """Values of the model fields that depend on the payload, for each possible mass."""

    def __init__(self, batch: Batch, models: list[mujoco.MjModel]) -> None:
        """models: The batch's model with each of the masses."""
        self._values = differing_fields(models)  # (masses, …)
        self._fields = {name: batch.expand(name) for name in self._values}  # (simulations, …)

    def carry(self, simulations: Array, mass: Array) -> None:
        """Let simulations, (k,) indices, carry masses, (k,) indices."""
        for name, field in self._fields.items():
            field[simulations] = self._values[name][mass]


class PayloadEstimate:
    """Least squares with forgetting: τ = τ_0(q) + m dτ(q) is linear in the mass m per hand.

    Friction hides a few N·m, so the error is some hundred grams on an arm with 40 N·m. The estimate
    is slow on purpose. Torques that do not look like a payload's give the mass 0.

    Attributes:
        mass: Estimate of each robot, (num,) kg, with a limited rate.
        latest: Estimate without the limit, (num,) kg.
        certain: Robots with enough leverage, (num,).
    """

    def __init__(
        self, sim: BatchSim, operated: Array, robot: RobotSpec, num_masses: int, dt: float
    ) -> None:
        """
        Args:
            sim: Its last num_masses rows carry payloads from 0 to the largest. The first and last
                of them are used.
            operated: Operated joints among the simulation's, (n,).
            dt: Control period, s.
        """
        self.sim = sim
        self.operated = operated
        self.dt = dt
        self.rows = np.array([sim.num_envs - num_masses, sim.num_envs - 1])
        self.kp = robot.kp[robot.operated_index]
        self.kd = robot.kd[robot.operated_index]
        self.max_mass = float(sorted(c[0] for c in sim.models)[-1])
        self.bias: Array = sim.batch.bind("qfrc_bias")
        self.home = robot.qpos_home[robot.index(sim.joint_names)]
        self.mass, self._projection, self._leverage, self._energy, self.latest = np.zeros((5, 0))
        self.certain = np.zeros(0, bool)

    def reset(self, num: int) -> None:
        """Start with empty hands of num robots."""
        self.mass, self._projection, self._leverage, self._energy, self.latest = np.zeros((5, num))
        self.certain = np.zeros(num, bool)

    def update(
        self, qpos: Array, qvel: Array, command: Array, tau: Array | None, valid: Array
    ) -> Array:
        """Process one control period of all robots; return the mass per robot, (num,) kg.

        Args:
            qpos, qvel: Measured, (num, n operated) rad, rad/s.
            command: Command in force, (num, n operated) rad.
            tau: Measured torque, (num, n operated) N·m; None for the servo model's.
            valid: Robots with a finite state, (num,). The others are skipped.
        """
        torque = self.kp * (command - qpos) - self.kd * qvel if tau is None else tau
        keep = np.exp(-self.dt / FORGETTING_TIME_S)
        for i in np.flatnonzero(valid):
            empty, full = self.gravity(qpos[i])
            per_kg = (full - empty) / self.max_mass
            excess = torque[i] - empty
            weight = 1.0 / (1.0 + (np.abs(qvel[i]).max() / HALF_WEIGHT_SPEED) ** 2)
            self._projection[i] = (
                keep * self._projection[i] + weight * float(per_kg @ excess) * self.dt
            )
            self._energy[i] = keep * self._energy[i] + weight * float(np.sum(excess**2)) * self.dt
            self._leverage[i] = keep * self._leverage[i] + weight * float(per_kg @ per_kg) * self.dt
        estimate = np.clip(self._projection / np.maximum(self._leverage, 1e-9), 0.0, self.max_mass)
        explained = self._projection * np.abs(self._projection)
        similarity = explained / np.maximum(self._leverage * self._energy, 1e-9)
        estimate = np.where(
            similarity < MIN_SIMILARITY * (estimate / self.max_mass) ** 2, 0.0, estimate
        )
        self.certain = self._leverage > MIN_LEVERAGE
        self.latest = np.where(self.certain, estimate, self.mass)
        change = MAX_RATE_KG_S * self.dt
        self.mass = self.mass + np.clip(self.latest - self.mass, -change, change)
        return self.mass

    def contradiction(self, stated: float) -> str:
        """Return a message if torques are those of another payload than stated, kg; else "".

        They are the first robot's.
        """
        if not self.certain[0] or abs(self.latest[0] - stated) <= self.max_mass / 2:
            return ""
        estimate = f"{self.latest[0]:.1f} kg"
        return (
            f"{stated:g} kg were stated, but the torques are those of about {estimate}: what is "
            "in the hand?"
        )

    def gravity(self, qpos: Array) -> Array:
        """Return the torques that hold a posture, empty and with most payload, (2, n) N·m."""
        self.sim.qpos[self.rows] = self.home
        self.sim.qvel[self.rows] = 0.0
        self.sim.qpos[self.rows[:, None], self.operated] = qpos
        self.sim.batch.forward(self.rows, stage=mujoco.mjtStage.mjSTAGE_VEL.value)
        torques: Array = self.bias[self.rows][:, self.operated]
        return torques
