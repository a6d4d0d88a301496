"""Separable CMA-ES (Ros & Hansen 2008) of several small problems that are tried out together.

One simulation tries a candidate of every problem at once: each joint's parameters are judged by the joint's own error.
Free runs with friction that sticks have a rough surface on which least squares ends early.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Array = np.ndarray

CANDIDATES = 16
SIGMA = 0.5  # of a parameter's scale: the first spread
FLAT = 1e-3  # of a parameter's scale: ends when every problem's spread is below


def evolve(
    start: Array,
    low: Array,
    high: Array,
    cost: Callable[[Array], Array],
    generations: int,
    progress: Callable[[int, Array], None] = lambda generation, best: None,
    seed: int = 0,
) -> Array:
    """The mean of the last generation, (n, P), clipped to the bounds.

    Args:
        start: n problems of P parameters, in units in which a change of one is a large one.
        low, high: Bounds, (P,) or (n, P); candidates are clipped.
        cost: Candidates (k, n, P) → costs (k, n).
        generations: At most.
        progress: Called with the generation and the least cost in it, (n,).
        seed: Of the candidates.
    """
    rng = np.random.default_rng(seed)
    n, size = start.shape
    mean, spread, variance = start.astype(float), np.full((n, 1), SIGMA), np.ones((n, size))
    parents = CANDIDATES // 2
    weight = np.log(parents + 0.5) - np.log(np.arange(1, parents + 1))
    weight /= weight.sum()
    mass = 1 / (weight**2).sum()
    c_step, c_path = (mass + 2) / (size + mass + 5), (4 + mass / size) / (size + 4 + 2 * mass / size)
    damping = 1 + 2 * max(0.0, np.sqrt((mass - 1) / (size + 1)) - 1) + c_step
    faster = (size + 2) / 3  # a diagonal is learned from fewer candidates than a matrix
    c_one = min(0.5, faster * 2 / ((size + 1.3) ** 2 + mass))
    c_rank = min(1 - c_one, faster * 2 * (mass - 2 + 1 / mass) / ((size + 2) ** 2 + mass))
    usual = np.sqrt(size) * (1 - 1 / (4 * size) + 1 / (21 * size**2))  # length of a normal vector
    step_path, path = np.zeros((n, size)), np.zeros((n, size))
    for generation in range(1, generations + 1):
        tried = np.clip(mean + spread * np.sqrt(variance) * rng.standard_normal((CANDIDATES, n, size)), low, high)
        costs = cost(tried)
        best = np.argsort(costs, axis=0)[:parents]
        moved = (np.take_along_axis(tried, best[:, :, None], axis=0) - mean) / spread
        mover = np.einsum("k,kij->ij", weight, moved)
        mean = mean + spread * mover
        step_path = (1 - c_step) * step_path + np.sqrt(c_step * (2 - c_step) * mass) * mover / np.sqrt(variance)
        length = np.linalg.norm(step_path, axis=1, keepdims=True)
        steady = length / np.sqrt(1 - (1 - c_step) ** (2 * generation)) < (1.4 + 2 / (size + 1)) * usual
        path = (1 - c_path) * path + steady * np.sqrt(c_path * (2 - c_path) * mass) * mover
        kept = 1 - c_one - c_rank + c_one * ~steady * c_path * (2 - c_path)
        variance = kept * variance + c_one * path**2 + c_rank * np.einsum("k,kij->ij", weight, moved**2)
        spread = spread * np.exp(np.minimum(1.0, c_step / damping * (length / usual - 1)))
        progress(generation, costs.min(axis=0))
        if (spread * np.sqrt(variance) < FLAT).all():
            break
    return np.clip(mean, low, high)
