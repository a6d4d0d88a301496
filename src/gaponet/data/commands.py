"""Which motions are one: two names under which the robot was told the same must not stand on two sides of a split.

Of every recording's commands a sketch is kept: a sample of the distinct rows, which repeats, other payloads, other
rates and recordings cut short have in common where a file was played; and an outline, which commands have in common
that were computed anew each time, at moments that are not quite the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated

import numpy as np
from annotated_types import Interval, Len
from typing_extensions import TypedDict

from gaponet.base.arrays import Array

SAMPLE, MOMENTS = 32, 24  # rows and moments kept
STEP = 1e-5  # rad; rows nearer than this are one
SHARED = 0.3  # of the sampled rows, from which two commands are one; 0.5 where one is at twice the rate
SEVERAL = 2  # rows at the least: motions that stop at one place are not one
LIKE, LONG = 0.004, 0.01  # outlines differ by less than this share of their range, and durations by this share
LATE = 0.1  # moments by which one may have begun later
ODD = 2  # moments that may differ more: a step is a row early or late


class Sketch(TypedDict):
    """What is kept of commands: a sample of the distinct rows, hashed, without the one that they begin with, as many
    motions begin alike; s between first and last change; the outline."""

    rows: Annotated[list[Annotated[int, Interval(ge=0, lt=2**32)]], Len(1, SAMPLE)]
    seconds: Annotated[float, Interval(ge=0, le=1e8)]
    outline: Annotated[list[Annotated[float, Interval(ge=-1e6, le=1e6)]], Len(MOMENTS, MOMENTS)]


def sketch(ctrl: Array, dt: float) -> Sketch:
    """The sketch of commands (T, n), rad, a period of dt s apart."""
    steps = np.round(np.asarray(ctrl, float) / STEP).astype(np.int64)
    draw = np.random.default_rng(0)
    weights = draw.integers(1, 2**62, ctrl.shape[1], dtype=np.int64) | 1
    mixed = ((steps * weights).sum(axis=1).astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(32)
    moved = mixed[mixed != mixed[0]]
    changed = np.flatnonzero((steps[1:] != steps[:-1]).any(axis=1))
    first, last = (int(changed[0]), int(changed[-1]) + 1) if len(changed) else (0, len(ctrl) - 1)
    curve = np.asarray(ctrl, float) @ draw.normal(size=ctrl.shape[1])
    outline = np.interp(np.linspace(first, last, MOMENTS), np.arange(len(ctrl)), curve)
    return {
        "rows": np.unique(moved if len(moved) else mixed)[:SAMPLE].tolist(),
        "seconds": round(float(last - first) * dt, 4),
        "outline": [round(float(x), 5) for x in outline],
    }


def alike(sketches: Sequence[Sketch]) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, of sketches of one command."""
    found = set(_same_rows([set(s["rows"]) for s in sketches]))
    curves = np.array([s["outline"] for s in sketches])  # (N, MOMENTS)
    seconds = np.array([s["seconds"] for s in sketches])
    slopes, spans = np.gradient(curves, axis=1), np.ptp(curves, axis=1)
    for i in np.flatnonzero(spans > 0):
        others = i + 1 + np.flatnonzero(np.abs(seconds[i + 1 :] - seconds[i]) <= LONG * seconds[i])
        apart, slope = curves[others] - curves[i], slopes[i]
        begun = np.clip(apart @ slope / max(slope @ slope, 1e-12), -LATE, LATE)  # they began a little apart
        worst = np.partition(np.abs(apart - begun[:, None] * slope), -1 - ODD, axis=1)[:, -1 - ODD]
        found |= {(int(i), int(j)) for j in others[worst <= LIKE * spans[i]]}
    return sorted(found)


def _same_rows(samples: list[set[int]]) -> Iterator[tuple[int, int]]:
    """Pairs with a good share of the least rows of both in common."""
    from scipy.sparse import csr_matrix

    index = {row: k for k, row in enumerate(sorted(set().union(*samples)))}
    where = [(i, index[row]) for i, sample in enumerate(samples) for row in sample]
    there = csr_matrix((np.ones(len(where), np.int32), tuple(zip(*where, strict=True))), (len(samples), len(index)))
    common = (there @ there.T).tocoo()
    for i, j, n in zip(common.row.tolist(), common.col.tolist(), common.data.tolist(), strict=True):
        a, b = samples[i], samples[j]
        if i < j and (a == b or n >= max(SEVERAL, SHARED * min(len(a), len(b)))):
            least = set(sorted(a | b)[: min(len(a), len(b))])
            if len(a & b & least) >= SHARED * len(least):
                yield i, j
