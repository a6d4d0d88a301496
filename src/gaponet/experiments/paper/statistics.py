"""Reductions of an error, with the uncertainty over training seeds and over motions."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import dataclass

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.result_table import format_cell


@dataclass(frozen=True)
class Reduction:
    """Reduction of an error by a method, %.

    Attributes:
        mean: Over all seeds and motions: 100 (1 − Σ error / Σ error of the baseline).
        seed_error: Standard error over training seeds; 0 for one seed, which tells nothing of it.
        motion_error: Standard error over motions; NaN for one motion, which tells nothing of it.
        seeds, motions: How many there are.
    """

    mean: float
    seed_error: float
    motion_error: float
    seeds: int
    motions: int

    @property
    def error(self) -> float:
        """Standard error over seeds and motions; NaN for one motion."""
        return float(np.hypot(self.seed_error, self.motion_error))

    def verdict(self, claim: float) -> str:
        """Say if a reduction of `claim` % is reached, by two standard errors; one motion decides
        nothing.
        """
        if self.mean - 2 * self.error >= claim:
            return "reached"
        if self.mean + 2 * self.error < claim:
            return "not reached"
        return "not decided"

    def __str__(self) -> str:
        mean = format_cell(self.mean, 0)
        return f"{mean} ± {format_cell(self.error, 0)}" if self.error > 0 else mean


def reduction(errors: ListOf[Array], baselines: ListOf[Array], motions: ListOf[str]) -> Reduction:
    """Return the reduction of an error.

    Errors are paired: entry i of every array is of recording i, and seeds are compared with equal
    seeds. The standard error over motions is
    that of a delete-one-motion jackknife (Efron & Stein 1981): each motion in turn is left out of
    the error and of the baseline. A motion that is hard for both then adds no uncertainty, because
    the reduction is a ratio of sums over the same motions.

    Args:
        errors: Error of each recording, (recordings,), one array for each training seed; of a
            method that is not trained, one array. In any unit, that of the baseline.
        baselines: Error of each recording by the baseline, (recordings,): one array, or for a
            trained baseline one for each seed.
        motions: Motion of each recording: recordings of one motion are not independent.
    """
    if len(baselines) == 1:
        baselines = [baselines[0]] * len(errors)
    pairs = zip(errors, baselines, strict=True)
    by_seed = np.array([_percent_less(error, baseline) for error, baseline in pairs])  # (seeds,) %
    mean_error = np.mean(errors, axis=0)  # (recordings,)
    mean_baseline = np.mean(baselines, axis=0)  # (recordings,)
    names = list(dict.fromkeys(motions))
    motion_of = np.array(motions)  # (recordings,)
    left_out = []  # reduction without each motion, %
    for name in names:
        kept = motion_of != name
        left_out.append(_percent_less(mean_error[kept], mean_baseline[kept]))
    count = len(names)
    motion_error = np.nan
    if count > 1:
        motion_error = float(np.sqrt((count - 1) * np.var(left_out)))
    seed_error = 0.0
    if len(by_seed) > 1:
        seed_error = float(by_seed.std(ddof=1) / np.sqrt(len(by_seed)))
    return Reduction(float(by_seed.mean()), seed_error, motion_error, len(by_seed), count)


def _percent_less(error: Array, baseline: Array) -> float:
    """Return the reduction of the sum, %; 0 where there is no error to reduce."""
    total = float(baseline.sum())
    if total == 0.0:
        return 0.0
    return 100 * (1 - float(error.sum()) / total)
