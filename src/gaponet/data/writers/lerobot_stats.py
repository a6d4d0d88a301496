"""The statistics that a LeRobot set carries: of every feature in every episode, and pooled over all of them."""

from __future__ import annotations

from typing import Any

import numpy as np

from gaponet.base.arrays import Array

EpisodeStats = dict[str, dict[str, Any]]  # {feature: {min, max, mean, std (n), count (1)}}, arrays or lists


def episode_stats(columns: dict[str, Array]) -> EpisodeStats:
    """Statistics of one episode's columns, (T, n) or (T)."""
    stats = {}
    for name, values in columns.items():
        x = values.reshape(len(values), -1).astype(float)
        stats[name] = {
            "min": x.min(axis=0), "max": x.max(axis=0), "mean": x.mean(axis=0), "std": x.std(axis=0),
            "count": np.array([len(x)]),
        }  # fmt: skip
    return stats


def pool(episodes: list[EpisodeStats]) -> EpisodeStats:
    """Statistics of all frames together, from those of the episodes."""
    pooled = {}
    for name in episodes[0]:
        parts = {k: np.stack([e[name][k] for e in episodes]) for k in episodes[0][name]}
        weight = parts["count"] / parts["count"].sum()  # (episodes, 1)
        mean = (weight * parts["mean"]).sum(axis=0)
        variance = (weight * (parts["std"] ** 2 + (parts["mean"] - mean) ** 2)).sum(axis=0)
        pooled[name] = {
            "min": parts["min"].min(axis=0), "max": parts["max"].max(axis=0), "mean": mean, "std": np.sqrt(variance),
            "count": parts["count"].sum(axis=0).astype(int),
        }  # fmt: skip
    return pooled


def plain(stats: EpisodeStats) -> dict[str, dict[str, list[float]]]:
    """The same as lists, for JSON."""
    return {name: {k: v.tolist() for k, v in values.items()} for name, values in stats.items()}
