"""Estimate of the payload mass from the torques that hold the arms, if nobody states the mass."""

from __future__ import annotations

import mujoco
import numpy as np

from gaponet.base.arrays import Array, within
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import BatchSim, Condition

FORGETTING_TIME_S = 1.0  # time constant
MAX_RATE_KG_S = 1.0  # of the estimate: a payload that appears at once must not make commands jump
HALF_WEIGHT_SPEED = 0.5  # rad/s; samples at this speed have half the weight, faster ones less
# Time between two samples of the torques: payloads change slowly, and control periods are short.
SAMPLE_TIME_S = 0.06
MIN_LEVERAGE = 0.4  # (N·m/kg)² s; below it, the estimate does not change
# Least share of the excess torque over the empty arm's that must look like the largest payload's.
# On a virtual H1-2, 3 kg give 0.57 to 0.97, and no payload with positions wrong by 0.12 rad up to
# 0.56. Friction lowers the share of smaller payloads.
MIN_SIMILARITY = 0.55


class GravityTorques:
    """Torques that hold a posture, with each of several payloads."""

    def __init__(self, robot: RobotSpec, loads: list[Condition], locked: tuple[str, ...]) -> None:
        """
        Args:
            loads: Conditions with the payloads.
            locked: Joints that are clamped at home; no operated one.
        """
        self._sim = BatchSim(robot, loads, 1, locked)
        self._operated = np.flatnonzero(np.isin(self._sim.joint_names, robot.operated))
        self._bias: Array = self._sim.batch.bind("qfrc_bias")
        self._sim.qpos[:] = robot.qpos_home[robot.index(self._sim.joint_names)]

    def __call__(self, qpos: Array) -> Array:
        """Return the torques at positions of the operated joints, (n,) rad, (loads, n) N·m."""
        self._sim.qpos[:, self._operated] = qpos
        self._sim.batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL.value)
        torques: Array = self._bias[:, self._operated]
        return torques


class PayloadEstimate:
    """Least squares with forgetting: τ = τ_0(q) + m dτ(q) is linear in the mass m per hand.

    Friction hides a few N·m, so the error is some hundred grams on an arm with 40 N·m. The estimate
    is slow on purpose. Torques that do not look like a payload's give the mass 0.

    Attributes:
        mass: Estimate of each robot, (num,) kg, with a limited rate.
    """

    def __init__(
        self, robot: RobotSpec, loads: list[Condition], num: int, locked: tuple[str, ...]
    ) -> None:
        """
        Args:
            loads: Control period, and payloads of the hands; the first is none, the last the
                largest.
            num: Number of robots.
            locked: Joints that are clamped at home; no operated one.
        """
        self.gravity = GravityTorques(robot, [loads[0], loads[-1]], locked)
        self.max_mass = loads[-1].payload_mass
        self.kp = robot.servo.kp[robot.operated_index]
        self.kd = robot.servo.kd[robot.operated_index]
        self.dt = loads[0].dt
        self.sample_periods = max(1, round(SAMPLE_TIME_S / self.dt))
        self.sample_time = self.dt * self.sample_periods  # s
        self.keep = np.exp(-self.sample_time / FORGETTING_TIME_S)  # share of the sums
        self.mass = np.zeros(num)
        self._period = 0
        # Of each robot: torque that looks like a payload's per kg, N²·m²·s/kg; leverage,
        # N²·m²·s/kg²; energy of the torque beyond the empty arm's, N²·m²·s. (3, num)
        self._sums = np.zeros((3, num))

    def reset(self) -> None:
        """Start with empty hands."""
        self.mass = np.zeros_like(self.mass)
        self._period = 0
        self._sums[:] = 0.0

    def observe(
        self, qpos: Array, qvel: Array, command: Array, tau: Array | None, valid: Array
    ) -> None:
        """Take the torques of one control period of all robots into account.

        Args:
            qpos, qvel: Measured, (num, n operated) rad, rad/s.
            command: Command in force, (num, n operated) rad.
            tau: Measured torque, (num, n operated) N·m; None for the servo model's.
            valid: Robots with a finite state, (num,). The others are skipped.
        """
        self._period += 1
        if self._period % self.sample_periods:
            return
        torque = self.kp * (command - qpos) - self.kd * qvel if tau is None else tau
        for i in valid.nonzero()[0]:
            empty, full = self.gravity(qpos[i])
            per_kg = (full - empty) / self.max_mass
            excess = torque[i] - empty
            speed = max(qvel[i].max(), -qvel[i].min())
            weight = self.sample_time / (1.0 + (speed / HALF_WEIGHT_SPEED) ** 2)
            self._sums[:, i] *= self.keep
            self._sums[:, i] += (
                weight * (per_kg @ excess),
                weight * (per_kg @ per_kg),
                weight * (excess @ excess),
            )

    def update(self) -> Array:
        """Return the estimate after the latest torques, (num,) kg. Call this once per period."""
        latest = np.where(self.certain, self.latest, self.mass)
        change = MAX_RATE_KG_S * self.dt
        self.mass = self.mass + within(latest - self.mass, -change, change)
        return self.mass

    @property
    def certain(self) -> Array:
        """Robots whose postures had enough leverage, (num,)."""
        _, leverage, _ = self._sums
        return np.asarray(leverage > MIN_LEVERAGE)

    @property
    def latest(self) -> Array:
        """Estimate without the limit of its rate, (num,) kg."""
        projection, leverage, energy = self._sums
        mass = within(projection / np.maximum(leverage, 1e-9), 0.0, self.max_mass)
        # Squared cosine between the excess torque and that of a payload, with the cosine's sign.
        explained = projection * np.abs(projection)
        similarity = explained / np.maximum(leverage * energy, 1e-9)
        similar = similarity >= MIN_SIMILARITY * (mass / self.max_mass) ** 2
        return np.where(similar, mass, 0.0)

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
