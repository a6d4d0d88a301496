"""Names and colours of what tracking and delivery compare, and how their numbers are put together."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from collections.abc import Sequence as ListOf
from typing import Any, Protocol, TypeVar

import numpy as np
from matplotlib.colors import to_hex, to_rgb

from gaponet.plot.methods import COLOURS, NAMES
from gaponet.study.table import Spread

ALONE = {  # what the robot is driven by where no model is asked
    "raw": "raw targets",
    "feedforward": "nominal model's feed-forward alone",
    "identified feedforward": "identified model's feed-forward alone",
}
ALONE_COLOURS = {"raw": COLOURS["nominal"], "feedforward": "#c9b28f", "identified feedforward": COLOURS["identified"]}


class Measured(Protocol):
    """Anything that was measured of a method, once or for each seed."""

    @property
    def method(self) -> str:
        """Its key."""

    @property
    def seed(self) -> int | None:
        """None where nothing was trained."""


M = TypeVar("M", bound=Measured)


def title(method: str) -> str:
    """For people."""
    if method.startswith("identified+"):
        return f"identification + {NAMES.get(method.removeprefix('identified+'), method)}"
    return ALONE.get(method) or NAMES.get(method, method)


def colour(method: str) -> str:
    """A model's in every figure, darker from the identified simulator."""
    if method.startswith("identified+"):
        base = to_rgb(COLOURS.get(method.removeprefix("identified+"), "#777777"))
        return to_hex((0.6 * base[0], 0.6 * base[1], 0.6 * base[2]))
    return ALONE_COLOURS.get(method) or COLOURS.get(method, "#777777")


def methods(found: Iterable[Measured]) -> list[str]:
    """In the order in which they were measured."""
    return list(dict.fromkeys(m.method for m in found))


def over_seeds(found: ListOf[M], value: Callable[[M], Any], scale: float = 1.0) -> Spread:
    """The mean of each seed, over seeds; a method without seeds gives one number."""
    seeds = dict.fromkeys(m.seed for m in found)
    return Spread.of([float(np.mean([value(m) for m in found if m.seed == seed])) for seed in seeds], scale)


def cut(value: float, base: float) -> float:
    """By how many per cent value is below base."""
    return 100 * (1 - value / base) if base else float("nan")


def percent(change: float) -> str:
    """A cut in words."""
    return f"{change:.0f} % less" if change >= 0 else f"{-change:.0f} % MORE"
