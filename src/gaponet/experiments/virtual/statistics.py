"""Statistics of measurements on the virtual unit: by method and payload, over seeds, against a baseline."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from gaponet.base.result_table import MeanStd

RIVALS = ("mlp", "shared_mlp")  # networks that GAPONet is compared with


@dataclass(frozen=True)
class Measured:
    """A measurement of a method with one payload.

    Attributes:
        method: Key of report.methods.METHODS.
        seed: Seed of the model; None for a method without training.
        payload: kg per hand.
    """

    method: str
    seed: int | None
    payload: float


M = TypeVar("M", bound=Measured)


def methods(measured: Iterable[Measured]) -> list[str]:
    """Return the methods in the order of measurement."""
    return list(dict.fromkeys(m.method for m in measured))


def payloads(measured: Iterable[Measured]) -> list[float]:
    """Return the payloads in ascending order, kg."""
    return sorted({m.payload for m in measured})


def select(
    measured: Iterable[M], method: str | None = None, payload: float | None = None
) -> list[M]:
    """Return the measurements of a method, of a payload, or of both."""
    return [m for m in measured if method in (None, m.method) and payload in (None, m.payload)]


def over_seeds(
    measured: ListOf[M], value: Callable[[M], Any], scale: float = 1.0, average: Any = np.mean
) -> MeanStd:
    """Mean and standard deviation over seeds of each seed's average; one number for a method without seeds."""
    by_seed: dict[int | None, list[float]] = {}
    for m in measured:
        by_seed.setdefault(m.seed, []).append(value(m))
    finite = [[v for v in values if v == v] for values in by_seed.values()]
    return MeanStd.from_values([float(average(values)) for values in finite if values], scale)


def reduction(value: float, base: float) -> float:
    """Reduction of base to value, per cent; NaN for a base of zero."""
    return 100 * (1 - value / base) if base else float("nan")


def percent_text(change: float) -> str:
    """Describe a reduction in per cent in words; an increase in capitals."""
    return f"{change:.0f} % less" if change >= 0 else f"{-change:.0f} % MORE"
