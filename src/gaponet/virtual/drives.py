"""Servo drives of virtual robots: PD control whose gain and torque limit the hidden physics
changes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gaponet.base.arrays import Array
from gaponet.virtual import motor
from gaponet.virtual.physics import Physics


class Gains(NamedTuple):
    """Stiffness N·m/rad, damping N·m·s/rad and added torque N·m, (N, active) each."""

    kp: Array
    kd: Array
    added: Array

    def times(self, factor: Array) -> Gains:
        """Return all three times a factor, (N, active)."""
        return Gains(self.kp * factor, self.kd * factor, self.added * factor)

    def plus_torque(self, torque: Array) -> Gains:
        """Return the gains with more added torque, (N, active) N·m."""
        return Gains(self.kp, self.kd, self.added + torque)


class Drives:
    """Drives of all joints.

    Attributes:
        gains: As set, times kp_scale and kd_scale of the hidden physics.
        effort: Torque limits, (active,) N·m.
        supply: Voltage over the nominal one, (N, 1).
        chain_gain: Factor of the gain by the load of the kinematic chain, (N, active).
    """

    def __init__(
        self, physics: Physics, thermal: motor.Thermal, kp: Array, kd: Array, effort: Array
    ) -> None:
        """kp, kd, effort: Of the robot, (active,) N·m/rad, N·m·s/rad, N·m."""
        self._physics = physics
        self._thermal = thermal
        scaled_kp = kp * physics.kp_scale
        self.gains = Gains(scaled_kp, kd * physics.kd_scale, np.zeros_like(scaled_kp))
        self.effort = effort
        self.supply = np.ones((len(scaled_kp), 1))
        self.chain_gain = np.zeros_like(scaled_kp)

    def set_gains(self, kp: Array, kd: Array, effort: Array | None, torque: Array) -> None:
        """Set other gains than the robot's, (active,) or (N, active); effort None keeps it."""
        shape = self.gains.kp.shape
        self.gains = Gains(
            np.broadcast_to(kp * self._physics.kp_scale, shape),
            np.broadcast_to(kd * self._physics.kd_scale, shape),
            np.broadcast_to(torque, shape),
        )
        if effort is not None:
            self.effort = effort

    def torque(self, ctrl: Array, qpos: Array, qvel: Array) -> Array:
        """Return the torque that the drives set at the rated torque constant, (N, active) N·m."""
        kp, kd, added = self.gains
        torque = kp * (ctrl - qpos) - kd * qvel + added
        result: Array = np.clip(torque * self.gain_factor(), -self.effort, self.effort)
        return result

    def gain_factor(self) -> Array:
        """Return the factor of the gain by supply, temperature and chain, (N, active)."""
        supply = 1.0 + self._physics.supply_gain * (self.supply - 1.0)
        result: Array = supply * self.derating() * self.chain_gain
        return result

    def derating(self) -> Array:
        """Return the factor of the gain at the temperature of the winding, (N, active)."""
        return motor.derating_factor(self._physics, self._thermal.winding)

    def max_torque(self) -> Array:
        """Return the largest torque at the present temperature and voltage, (N, active) N·m."""
        result: Array = self.effort * self._thermal.kt() * np.minimum(self.supply, 1.0)
        return result


class Transmission:
    """From drive to link: the current loop delays the torque, and gear and link twist under it.

    Attributes:
        passed: Torque of the motor in the last physics step, (N, active) N·m.
        twist: Angle of the motor before that of the link, (N, active) rad.
        lags, twists: False where no unit has the effect: most fleets lack it.
    """

    def __init__(self, physics: Physics, effort: Array) -> None:
        self._physics = physics
        self.compliance = physics.windup / effort  # rad per N·m
        self.lags = bool((physics.current_time > 0).any())
        self.twists = bool((physics.windup > 0).any())
        self.passed = np.zeros_like(self.compliance)
        self.twist = np.zeros_like(self.compliance)

    def delayed(self, gains: Gains, period: float) -> Gains:
        """Return gains that give the torque behind the current loop after `period` s."""
        lag = np.exp(-period / np.maximum(self._physics.current_time, 1e-9))
        return gains.times(1.0 - lag).plus_torque(lag * self.passed)

    def load(self, torque: Array, friction: Array) -> None:
        """Note the torque of the motor and how much of it friction took, (N, active) N·m."""
        self.passed = torque
        self.twist = self.compliance * (torque - friction)
