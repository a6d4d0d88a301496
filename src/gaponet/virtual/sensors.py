"""Sensors of virtual robots: encoders, current sensors and thermometers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gaponet.base.arrays import Array
from gaponet.virtual import motor
from gaponet.virtual.noise import Noise
from gaponet.virtual.physics import Physics


@dataclass(frozen=True)
class Reading:
    """Readings of the sensors, (N, n) each.

    Attributes:
        qpos, qvel: rad, rad/s.
        tau: Current times the rated torque constant, N·m.
        temperature: Of the winding, °C.
    """

    qpos: Array
    qvel: Array
    tau: Array
    temperature: Array


class Sensors:
    """Sensors of N robots; locked joints have them too."""

    def __init__(self, physics: Physics, active: Array, home: Array, noise: Noise) -> None:
        """
        Args:
            physics: Of all joints.
            active: Joints that are not locked, (active,).
            home: Where locked joints are, (n) rad.
            noise: Of each period.
        """
        self._physics = physics
        self._active = active
        self._home = home
        self._noise = noise
        self._idle_temperature = np.zeros((len(physics.kp_scale), len(home)))  # °C

    def reset(self, temperature: Array) -> None:
        """Start with motors of a temperature, (N, 1) °C."""
        self._idle_temperature = np.repeat(temperature, len(self._home), axis=1)

    def read(self, motor_angle: Array, qvel: Array, torque: Array, winding: Array) -> Reading:
        """Return the readings of true values of the active joints, (N, active).

        A second reading within a period has the same noise.

        Args:
            motor_angle: rad; the encoder is on the motor's side.
            qvel: rad/s.
            torque: Of the motor, N·m.
            winding: Temperature, °C.
        """
        physics = self._physics
        noise = self._noise.sensors()
        encoder = self.all_joints(motor_angle, self._home) + physics.zero_offset
        qpos = motor.quantised(encoder + physics.encoder_noise * noise[:, 0], physics.encoder_step)
        measured_qvel = self.all_joints(qvel, 0.0) + physics.velocity_noise * noise[:, 1]
        current = self.all_joints(torque, 0.0) + physics.current_offset
        tau = current + physics.current_noise * noise[:, 2]
        temperature = self._idle_temperature.copy()
        temperature[:, self._active] = winding
        return Reading(qpos, measured_qvel, tau, temperature)

    def true_qpos(self, qpos: Array) -> Array:
        """Return the positions of all joints, (N, n) rad, for those of the active ones."""
        return self.all_joints(qpos, self._home)

    def all_joints(self, values: Array, rest: Array | float) -> Array:
        """Return values (N, active) with those of locked joints added, (N, n)."""
        out = np.empty((len(values), len(self._home)))
        out[:] = rest
        out[:, self._active] = values
        return out
