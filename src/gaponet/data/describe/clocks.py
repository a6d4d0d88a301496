"""Columns that run like clocks: which there are, and whether two of them contradict each other."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from gaponet.base.errors import LogError
from gaponet.data.describe.joints import ignored

COMMAND = "command:"  # before the names of signals that lie in a command_file
TIME = "time:"  # and in a time_file
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
WHOLE_SECONDS = re.compile(r"(.*?)secs?")
NANOSECONDS = ("nanosec", "nanosecs", "nsec", "nsecs")
MIN_ROWS = 20
MIN_LINEARITY = 0.99  # correlation of a clock with the number of its row
# By which two clocks may differ, apart from a factor of thousands between their units.
MAX_RATE_DIFFERENCE = 0.05
Load = Callable[[list[str]], dict[str, Any]]  # reads signals of these names


def clock_periods(signals: Mapping[str, Sequence[str]], load: Load) -> dict[str, float]:
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
            stamps = load([name])[name].values[:ROWS]
        except LogError:  # text
            continue
        if len(stamps) >= MIN_ROWS and np.isfinite(stamps).all() and _runs(stamps):
            periods[name] = float(stamps[-1] - stamps[0]) / (len(stamps) - 1)
    return periods


def with_whole_seconds(
    signals: dict[str, tuple[str, ...]], load: Load
) -> tuple[dict[str, tuple[str, ...]], Load]:
    """Return signals, and what reads them, with one clock for each pair of columns that hold
    seconds and the nanoseconds beyond them, as ROS writes stamps.
    """
    pairs = {}
    for stamp, columns in _stamps(signals).items():
        if _are_parts_of_a_stamp(load, columns):
            pairs[stamp] = columns
    if not pairs:
        return signals, load
    parts = set[str]().union(*pairs.values())
    joined: dict[str, tuple[str, ...]] = dict.fromkeys(pairs, ())
    for name, labels in signals.items():
        if name not in parts:
            joined[name] = labels
    return joined, partial(_load_stamps, load, pairs)


def _stamps(signals: Collection[str]) -> dict[str, tuple[str, str]]:
    """Return name of a stamp → columns of its seconds, and of the nanoseconds beyond them."""
    pairs: dict[str, tuple[str, str]] = {}
    for whole in signals:
        match = WHOLE_SECONDS.fullmatch(whole)
        if match is None:
            continue
        start = match[1]
        stamp = start.rstrip("._/ ") or "stamp"
        for ending in NANOSECONDS:
            if start + ending in signals:
                pairs[stamp] = (whole, start + ending)
    return pairs


def _are_parts_of_a_stamp(load: Load, parts: tuple[str, str]) -> bool:
    """Return False for two whole clocks: seconds with decimals, or more than a second of
    nanoseconds.
    """
    try:
        loaded = load(list(parts))
    except LogError:  # text
        return False
    seconds, nanoseconds = (loaded[part].values for part in parts)
    whole = np.array_equal(seconds, np.round(seconds), equal_nan=True)
    return bool(whole and np.nanmax(nanoseconds, initial=0.0) < 1e9)


def _load_stamps(load: Load, pairs: dict[str, tuple[str, str]], names: list[str]) -> dict[str, Any]:
    """Load signals, and stamps of pairs as seconds."""
    wanted = [name for name in names if name not in pairs]
    for name in names:
        wanted += pairs.get(name, ())
    loaded = load(wanted)
    for name in names:
        if name in pairs:
            whole, beyond = (loaded[part] for part in pairs[name])
            seconds = whole.values + 1e-9 * beyond.values
            loaded[name] = whole._replace(values=seconds, in_seconds=True)
    return {name: loaded[name] for name in names}


def named_like_a_clock(name: str) -> bool:
    """Return True for timestamp, t_ms, header.stamp, realTime."""
    apart = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name_in_file(name)).lower()
    words = [word for word in re.split(r"[^a-z]+", apart) if word]
    return any(word in CLOCK_WORDS or word.endswith(CLOCK_ENDS) for word in words)


def name_in_file(signal: str) -> str:
    """Return the name that a signal has in its own file."""
    return signal.removeprefix(COMMAND).removeprefix(TIME)


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
                f'time = "{name_in_file(clock)}" and ignore = ["{other}"], or time = '
                f'"{name_in_file(other)}" and ignore = ["{clock}"]'
            )
