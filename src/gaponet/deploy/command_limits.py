"""Limits of the commands that a compensator gives."""

from __future__ import annotations

import numpy as np

from gaponet.base.arrays import Array, within


class CommandLimits:
    """Keeps commands near their targets and within the joint range.

    After a start, the difference between command and target blends in.

    Attributes:
        command: The last one, (num, n) rad.
        saturation: +1 where it is at its upper limit, −1 at its lower one, else 0, (num, n).
        periods: Control periods since the start.
        limited_periods: Those of them in which a joint could not do what was asked of it, (num, n).
    """

    def __init__(
        self, limit: float, blend: float, dt: float, low: Array, high: Array, num: int
    ) -> None:
        """
        Args:
            limit: Largest |command − target|, rad.
            blend: Time in which the difference increases from nothing to all of it, s.
            dt: Control period, s.
            low, high: Limits of the joints, (n,) rad.
            num: Number of robots.
        """
        self.command = np.zeros((num, len(low)))
        self.saturation = np.zeros_like(self.command)
        self.periods = 0
        self.limited_periods = np.zeros(self.command.shape, int)
        self._limit = limit
        self._blend = blend
        self._dt = dt
        self._low = low
        self._high = high

    def reset(self, target: Array) -> None:
        """Start at targets, (num, n) rad."""
        self.command = target
        self.saturation = np.zeros_like(target)
        self.periods = 0
        self.limited_periods[:] = 0

    def apply(self, target: Array, wanted: Array, exhausted: Array) -> Array:
        """Return the commands of the coming control period. Call this once per period.

        Args:
            target: Targets of the robots, (num, n) rad.
            wanted: Commands without limits, (num, n) rad.
            exhausted: Joints that cannot do what is asked of them for another reason, (num, n).
        """
        share = 1.0
        if self._blend:
            share = min(1.0, self.periods * self._dt / self._blend)
        unlimited = target + share * (wanted - target)
        near = within(unlimited, target - self._limit, target + self._limit)
        self.command = within(near, self._low, self._high)
        self.saturation = np.sign(unlimited - self.command)
        self.limited_periods += (self.saturation != 0) | exhausted
        self.periods += 1
        return self.command

    @property
    def limited_shares(self) -> Array:
        """Share of the periods in which a joint was limited, mean of all robots, (n,)."""
        shares: Array = self.limited_periods.mean(axis=0) / max(self.periods, 1)
        return shares
