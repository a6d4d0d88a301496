"""Random numbers of virtual robots. Each row has its own stream, so its company does not matter."""

from __future__ import annotations

import numpy as np

from gaponet.base.arrays import Array

NOISE_PERIODS = 50  # control periods of noise that are sampled at a time


class Noise:
    """Standard normal numbers for the sensors, and chances of jitter and loss for the link."""

    def __init__(self, n: int) -> None:
        """n: Joints of a robot."""
        self._n = n
        self._streams: list[np.random.Generator] = []
        self._sensors = np.zeros(0)
        self._chances = np.zeros(0)
        self._period = NOISE_PERIODS  # the samples are used up

    def reset(self, seeds: list[int]) -> None:
        """Start the streams of all rows again."""
        self._streams = [np.random.default_rng(seed) for seed in seeds]
        self._period = NOISE_PERIODS

    def of_rest(self) -> Array:
        """Draw a standard normal number for each joint, (N, n)."""
        return np.stack([stream.standard_normal(self._n) for stream in self._streams])

    def sensors(self) -> Array:
        """Return this period's noise of position, speed and current, (N, 3, n), σ = 1."""
        self._sample_if_used_up()
        return self._sensors[:, self._period]

    def chances(self) -> Array:
        """Return this period's chances of jitter and loss, (N, 2), uniform in [0, 1)."""
        self._sample_if_used_up()
        return self._chances[:, self._period]

    def next_period(self) -> None:
        """Go to the next control period."""
        self._period += 1

    def _sample_if_used_up(self) -> None:
        if self._period < NOISE_PERIODS:
            return
        shape = (NOISE_PERIODS, 3, self._n)
        self._sensors = np.stack([stream.standard_normal(shape) for stream in self._streams])
        self._chances = np.stack([stream.random((NOISE_PERIODS, 2)) for stream in self._streams])
        self._period = 0
