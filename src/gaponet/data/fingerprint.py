"""Fingerprints of commands: recognise one command in recordings with different names, payloads,
rates or lengths.

Two motions with equal commands must not be on two sides of a split. A fingerprint holds hashes of a
sample of the distinct rows, which are equal where one file was played, and an outline, which is
similar where a command was computed again at slightly different times.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated

import numpy as np
from annotated_types import Interval, Len
from typing_extensions import TypedDict

from gaponet.base.arrays import Array

SAMPLED_ROWS = 32
OUTLINE_POINTS = 24
ROW_RESOLUTION_RAD = 1e-5  # rows that differ by less are equal
# of the sampled rows; one common resting place is not enough
MIN_SHARED_ROWS = 2
MIN_SHARED_SHARE = 0.3
MAX_OUTLINE_DIFFERENCE = 0.004  # of the outline's range
MAX_DURATION_DIFFERENCE = 0.01  # of the duration
MAX_START_SHIFT = 0.1  # outline points by which one command may begin later
HASH_FACTOR = np.uint64(0x9E3779B97F4A7C15)  # 2⁶⁴ over the golden ratio: spreads the upper bits
OUTLIERS = 2  # outline points that may differ by more: a step is a row early or late


class CommandFingerprint(TypedDict):
    """Fingerprint of the commands of one recording.

    rows: Least hashes of distinct rows, without the first row, which many motions share; seconds:
    time between the first and the last change; outline: projection of the commands at evenly spaced
    times between these.
    """

    rows: Annotated[list[Annotated[int, Interval(ge=0, lt=2**32)]], Len(1, SAMPLED_ROWS)]
    seconds: Annotated[float, Interval(ge=0, le=1e8)]
    outline: Annotated[
        list[Annotated[float, Interval(ge=-1e6, le=1e6)]], Len(OUTLINE_POINTS, OUTLINE_POINTS)
    ]


def fingerprint(ctrl: Array, dt: float) -> CommandFingerprint:
    """Return the fingerprint of commands (T, n), rad, with a period of dt s."""
    steps = np.round(np.asarray(ctrl, float) / ROW_RESOLUTION_RAD).astype(np.int64)
    rng = np.random.default_rng(0)
    weights = rng.integers(1, 2**62, ctrl.shape[1], dtype=np.int64) | 1
    sums = (steps * weights).sum(axis=1).astype(np.uint64)
    hashes = (sums * HASH_FACTOR) >> np.uint64(32)  # (T) 32 bits
    distinct = hashes[hashes != hashes[0]]
    changed = np.flatnonzero((steps[1:] != steps[:-1]).any(axis=1))
    first = 0
    last = len(ctrl) - 1
    if len(changed):
        first = int(changed[0])
        last = int(changed[-1]) + 1
    projection = np.asarray(ctrl, float) @ rng.normal(size=ctrl.shape[1])
    outline = np.interp(np.linspace(first, last, OUTLINE_POINTS), np.arange(len(ctrl)), projection)
    return {
        "rows": np.unique(distinct if len(distinct) else hashes)[:SAMPLED_ROWS].tolist(),
        "seconds": round(float(last - first) * dt, 4),
        "outline": [round(float(x), 5) for x in outline],
    }


def equal_commands(fingerprints: Sequence[CommandFingerprint]) -> list[tuple[int, int]]:
    """Return pairs (i, j), i < j, of fingerprints of one command."""
    pairs = set(_pairs_with_shared_rows([set(f["rows"]) for f in fingerprints]))
    outlines = np.array([f["outline"] for f in fingerprints])  # (N, OUTLINE_POINTS)
    seconds = np.array([f["seconds"] for f in fingerprints])
    slopes = np.gradient(outlines, axis=1)
    ranges = np.ptp(outlines, axis=1)
    for i in np.flatnonzero(ranges > 0):
        longer = np.abs(seconds[i + 1 :] - seconds[i])
        others = i + 1 + np.flatnonzero(longer <= MAX_DURATION_DIFFERENCE * seconds[i])
        difference = outlines[others] - outlines[i]  # (others, OUTLINE_POINTS)
        slope = slopes[i]
        fitted = difference @ slope / max(slope @ slope, 1e-12)  # least squares, points
        shift = np.clip(fitted, -MAX_START_SHIFT, MAX_START_SHIFT)
        residual = np.abs(difference - shift[:, None] * slope)
        worst = np.partition(residual, -1 - OUTLIERS, axis=1)[:, -1 - OUTLIERS]
        equal = others[worst <= MAX_OUTLINE_DIFFERENCE * ranges[i]]
        pairs.update((int(i), int(j)) for j in equal)
    return sorted(pairs)


def _pairs_with_shared_rows(samples: list[set[int]]) -> Iterator[tuple[int, int]]:
    """Yield pairs that share enough of the least row hashes of both."""
    from scipy.sparse import csr_matrix

    different = sorted(set().union(*samples))
    index = {row: k for k, row in enumerate(different)}
    owners: list[int] = []
    columns: list[int] = []
    for i, sample in enumerate(samples):
        owners += [i] * len(sample)
        columns += [index[row] for row in sample]
    ones = np.ones(len(columns), np.int32)
    contains = csr_matrix((ones, (owners, columns)), (len(samples), len(index)))
    common = (contains @ contains.T).tocoo()  # number of hashes that two samples share
    for i, j in zip(common.row.tolist(), common.col.tolist(), strict=True):
        if i < j and _share_enough(samples[i], samples[j]):
            yield i, j


def _share_enough(one: set[int], other: set[int]) -> bool:
    """Return True if two samples have many of their least hashes in common."""
    size = min(len(one), len(other))
    if one != other and len(one & other) < max(MIN_SHARED_ROWS, MIN_SHARED_SHARE * size):
        return False
    least = set(sorted(one | other)[:size])
    return len(one & other & least) >= MIN_SHARED_SHARE * len(least)
