"""Statistics of samples, of one recording and pooled over recordings."""

from __future__ import annotations

import numpy as np

from gaponet.base.arrays import Array

Statistics = dict[str, Array]  # min, max, mean, std (n) and count (1)


def statistics(values: Array) -> Statistics:
    """Return the statistics of one recording's samples, (T, n) or (T)."""
    samples = values.reshape(len(values), -1).astype(float)  # (T, n)
    return {
        "min": samples.min(axis=0),
        "max": samples.max(axis=0),
        "mean": samples.mean(axis=0),
        "std": samples.std(axis=0),
        "count": np.array([len(samples)]),
    }


def pool(parts: list[Statistics]) -> Statistics:
    """Return the statistics of all samples together, from those of the recordings."""
    least = np.stack([part["min"] for part in parts])  # (recordings, n), as the others
    greatest = np.stack([part["max"] for part in parts])
    means = np.stack([part["mean"] for part in parts])
    stds = np.stack([part["std"] for part in parts])
    counts = np.stack([part["count"] for part in parts])  # (recordings, 1)
    weight = counts / counts.sum()
    mean = (weight * means).sum(axis=0)
    variance = (weight * (stds**2 + (means - mean) ** 2)).sum(axis=0)
    return {
        "min": least.min(axis=0),
        "max": greatest.max(axis=0),
        "mean": mean,
        "std": np.sqrt(variance),
        "count": counts.sum(axis=0).astype(int),
    }
