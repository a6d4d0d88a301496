"""How the numbers of what was played are put together: by method, over seeds, against a base."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from collections.abc import Sequence as ListOf
from typing import Any, Protocol, TypeVar

import numpy as np

from gaponet.base.result_table import MeanStd
from gaponet.report.figures.colours import colour
from gaponet.report.methods import title

LEFT_OUT = ("identified feedforward",)  # of pictures of single motions; it stands in bars and tables
RIVALS = ("mlp", "shared_mlp")  # of the operator


class Measured(Protocol):
    """Anything that was measured of a method, once or for each seed, with one payload."""

    @property
    def method(self) -> str:
        """Its key of plot.methods."""

    @property
    def seed(self) -> int | None:
        """None where nothing was trained."""

    @property
    def payload(self) -> float:
        """kg per hand."""


M = TypeVar("M", bound=Measured)


def methods(found: Iterable[Measured]) -> list[str]:
    """Methods in the order in which they were measured."""
    return list(dict.fromkeys(m.method for m in found))


def payloads(found: Iterable[Measured]) -> list[float]:
    """Payloads from light to heavy, kg."""
    return sorted({m.payload for m in found})


def of(found: Iterable[M], method: str | None = None, payload: float | None = None) -> list[M]:
    """Measurements of a method, of a payload, or of both."""
    return [m for m in found if method in (None, m.method) and payload in (None, m.payload)]


def over_seeds(found: ListOf[M], value: Callable[[M], Any], scale: float = 1.0, middle: Any = np.mean) -> MeanStd:
    """The mean (or another middle) of each seed, over seeds; a method without seeds gives one number."""
    by_seed: dict[int | None, list[float]] = {}
    for m in found:
        by_seed.setdefault(m.seed, []).append(value(m))
    finite = [[v for v in values if v == v] for values in by_seed.values()]
    return MeanStd.from_values([float(middle(values)) for values in finite if values], scale)


def series(found: ListOf[M], groups: ListOf[Any], value: Callable[[str, Any], MeanStd]) -> dict[str, Any]:
    """Bars of every method, one for each group."""
    return {title(m): (colour(m), [value(m, group) for group in groups]) for m in methods(found)}


def cut(value: float, base: float) -> float:
    """How many per cent value is below base."""
    return 100 * (1 - value / base) if base else float("nan")


def percent(change: float) -> str:
    """A cut in words."""
    return f"{change:.0f} % less" if change >= 0 else f"{-change:.0f} % MORE"


def duels(error: Mapping[float, Mapping[str, float]], names: ListOf[str]) -> list[str]:
    """Whether GAPONet beats each MLP that was played, from {payload kg: {method: error}}."""
    return [_duel(error, rival) for rival in RIVALS if "gaponet" in names and rival in names]


def _duel(error: Mapping[float, Mapping[str, float]], rival: str) -> str:
    lost = [f"{p:g} kg" for p, of in error.items() if of["gaponet"] >= of[rival]]
    if lost:
        return f"GAPONet does NOT beat '{title(rival)}' at {', '.join(lost)}"
    return f"GAPONet beats '{title(rival)}'" + (" at every payload" if len(error) > 1 else "")
