"""Random draws of VIRTUAL robots and of their motions. This module imports nothing of gaponet."""

from __future__ import annotations

from typing import Any

import numpy as np


def log_uniform(
    rng: np.random.Generator,
    low: float,
    high: float,
    size: int | tuple[int, ...] | None = None,
) -> Any:
    """Draw numbers whose logarithm is uniform: a float without a size, else an array."""
    return np.exp(rng.uniform(np.log(low), np.log(high), size))


def minimum_jerk(progress: np.ndarray) -> np.ndarray:
    """Return the share of a way from rest to rest that is done, for times from 0 to 1."""
    share: np.ndarray = 10 * progress**3 - 15 * progress**4 + 6 * progress**5
    return share
