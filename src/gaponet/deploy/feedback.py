"""Feedback of the remaining position error.

It is slow. A loaded arm swings on its servo with little damping (3 kg on H1-2's shoulder yaw: 10
rad/s, damping ratio 0.1). There, an integrator alone is unstable above 2ζω, 2 1/s.
"""

from __future__ import annotations

import numpy as np

from gaponet.base.arrays import Array, within


class LowPass:
    """Low-pass of first order with a limited input.

    Attributes:
        value: Its output, (num, n).
        limit: Largest input and output.
    """

    def __init__(self, time: float, limit: float, dt: float, shape: tuple[int, int]) -> None:
        """
        Args:
            time: Time constant, s.
            limit: Largest input.
            dt: Control period, s.
            shape: Of the values, (num, n).
        """
        self.value = np.zeros(shape)
        self.limit = limit
        self._share = min(1.0, dt / max(time, dt))

    def reset(self) -> None:
        """Start at zero."""
        self.value = np.zeros_like(self.value)

    def update(self, values: Array, valid: Array) -> Array:
        """Return the output after values, (num, n); only the rows `valid`, (num,), count."""
        change = (within(values, -self.limit, self.limit) - self.value) * self._share
        self.value = np.where(valid[:, None], self.value + change, self.value)
        return self.value


class Feedback:
    """Integrator of the remaining position error, with a low-pass, limits and anti-windup.

    Attributes:
        integral: Correction of the command, (num, n) rad.
    """

    def __init__(self, gain: float, error: LowPass, dt: float) -> None:
        """
        Args:
            gain: 1/s; 0 for no feedback.
            error: Low-pass of position errors, rad; its limit is that of the integral too. A
                blocked joint has a large error, which must not take long to decrease.
            dt: Control period, s.
        """
        self.integral = np.zeros_like(error.value)
        self._gain = gain * dt
        self._error = error

    def reset(self) -> None:
        """Start without correction."""
        self.integral = np.zeros_like(self.integral)
        self._error.reset()

    def update(self, error: Array, valid: Array, saturation: Array) -> None:
        """Integrate position errors, (num, n) rad.

        Args:
            valid: Robots whose error is known, (num,).
            saturation: As of CommandLimits, (num, n). The integral does not grow into a limit.
        """
        filtered = self._error.update(error, valid)
        limit = self._error.limit
        winds_up = filtered * saturation > 0
        integral = self.integral + self._gain * np.where(winds_up, 0.0, filtered)
        self.integral = np.where(valid[:, None], within(integral, -limit, limit), self.integral)

    @property
    def exhausted(self) -> Array:
        """Joints whose integral is at its limit, (num, n)."""
        limit = self._error.limit
        return np.asarray((limit > 0) & (np.abs(self.integral) >= limit))
