"""Statistics of samples, of one recording and pooled over recordings."""

from __future__ import annotations

import numpy as np

from gaponet.base.arrays import Array

Statistics = dict[str, Array]  # min, max, mean, std (n) and count (1)


def statistics(values: Array) -> Statistics:
    """Return the statistics of one recording's samples, (T, n) or (T)."""
    x = values.reshape(len(values), -1).astype(float)
    return {
        "min": x.min(axis=0),
        "max": x.max(axis=0),
        "mean": x.mean(axis=0),
        "std": x.std(axis=0),
        "count": np.array([len(x)]),
    }


def pool(parts: list[Statistics]) -> Statistics:
    """Return the statistics of all samples together, from those of the recordings."""
    s = {k: np.stack([part[k] for part in parts]) for k in parts[0]}
    weight = s["count"] / s["count"].sum()  # (recordings, 1)
    mean = (weight * s["mean"]).sum(axis=0)
    variance = (weight * (s["std"] ** 2 + (s["mean"] - mean) ** 2)).sum(axis=0)
    return {
        "min": s["min"].min(axis=0),
        "max": s["max"].max(axis=0),
        "mean": mean,
        "std": np.sqrt(variance),
        "count": s["count"].sum(axis=0).astype(int),
    }
