"""Columns that run like clocks: which there are, and whether two of them contradict each other."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from gaponet.base.errors import LogError
from gaponet.data.describe.joints import ignored

CLOCK_WORDS = {
    "t",
    "ts",
    "time",
    "timestamp",
    "timestamps",
    "stamp",
    "clock",
    "elapsed",
    "uptime",
    "epoch",
    "wall",
    "tick",
    "s",
    "sec",
    "secs",
    "second",
    "seconds",
    "ms",
    "msec",
    "millis",
    "us",
    "usec",
    "micros",
    "ns",
    "nsec",
    "nanos",
}
CLOCK_ENDS = ("time", "stamp", "clock")  # of words such as realtime
ROWS = 4000  # that are looked at
MIN_ROWS = 20
MIN_LINEARITY = 0.99  # correlation of a clock with the number of its row
MAX_RATE_DIFFERENCE = (
    0.05  # by which two clocks may differ, apart from a factor of thousands between their units
)


def clock_periods(
    signals: Mapping[str, Sequence[str]], load: Callable[[list[str]], dict[str, Any]]
) -> dict[str, float]:
    """Return the columns that run like clocks → mean distance of their rows, in the column's own
    unit.

    Args:
        signals, load: Of a RawRecording.
    """
    periods = {}
    for name, labels in signals.items():
        if labels or not named_like_a_clock(name):
            continue
        try:
            values = load([name])[name].values[:ROWS]
        except LogError:  # text
            continue
        if len(values) >= MIN_ROWS and np.isfinite(values).all() and _runs(values):
            periods[name] = float(values[-1] - values[0]) / (len(values) - 1)
    return periods


def named_like_a_clock(name: str) -> bool:
    """Return True for timestamp, t_ms, header.stamp, realTime."""
    apart = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower()
    words = [word for word in re.split(r"[^a-z]+", apart) if word]
    return any(word in CLOCK_WORDS or word.endswith(CLOCK_ENDS) for word in words)


def _runs(values: np.ndarray) -> bool:
    """Return True if values grow like a clock: never back, and in proportion to their number."""
    steps = np.diff(values)
    if (steps < 0).any() or not (steps > 0).any():
        return False
    linearity = np.corrcoef(values, np.arange(len(values)))[0, 1]
    return bool(linearity > MIN_LINEARITY)


def rate_ratio(period: float, other: float) -> float:
    """Return how many times as long the other period is, without a factor of thousands: 0.004 and
    8 → 2.
    """
    ratio = other / period
    thousands = np.round(np.log10(ratio) / 3)
    return float(ratio / 1000.0**thousands)


def require_one_rate(
    periods: dict[str, float], clock: str, used: Sequence[str], ignore: Sequence[str], where: str
) -> None:
    """Refuse a clock that another column contradicts.

    Args:
        periods: Of clock_periods.
        clock: The column that is taken.
        used: Clocks that logs.toml names for single channels.
        ignore: Patterns of columns that logs.toml leaves out.
        where: File, for the error.

    Raises:
        LogError: Another column runs like a clock, at another rate.
    """
    if clock not in periods:
        return
    for other, period in periods.items():
        if other == clock or other in used or ignored(other, ignore):
            continue
        ratio = rate_ratio(periods[clock], period)
        if abs(ratio - 1) > MAX_RATE_DIFFERENCE:
            raise LogError(
                f"{where}: two columns run like clocks and contradict each other: "
                f"{clock}, {periods[clock]:.4g} a row, and {other}, {period:.4g} a row, "
                f"{ratio:.3g} times as much. A lag measured with the wrong one is wrong by this "
                "factor. Say which is right in logs.toml: "
                f'time = "{clock}" and ignore = ["{other}"], or time = "{other}" and ignore = '
                f'["{clock}"]'
            )
