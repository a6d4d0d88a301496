"""How good a connection is: rate, age, jitter and losses of a robot's states."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from gaponet.hw.control.driver import Driver

POLL = 0.0005  # s


def measure(driver: Driver, seconds: float) -> dict[str, Any]:
    """Listen to a connected robot; nothing is sent.

    Returns:
        states; rate_hz; age_ms and interval_ms (p50, p99, max), of a state when it came and between two; lost: were due
        by the robot's own clock and never came; refused: had a wrong checksum.
    """
    received = getattr(driver, "received", None)  # a bus may bring several between two looks
    first = driver.read()
    measured, arrived = [first.time], [time.monotonic()]
    while arrived[-1] - arrived[0] < seconds and time.monotonic() - arrived[-1] < max(seconds, 1.0):
        state = driver.read()
        if state.time > measured[-1]:
            measured.append(state.time)
            arrived.append(time.monotonic())
        time.sleep(POLL)
    count = len(measured) if received is None else driver.received - received + 1  # type: ignore[attr-defined]
    span = max(measured[-1] - measured[0], 1e-9)
    steps = np.diff(measured) if len(measured) > 1 else np.array([np.inf])
    due = 1 + round(span / float(np.median(steps)))
    ages, intervals = np.subtract(arrived, measured)[1:], np.diff(arrived)
    return {
        "states": count,
        "rate_hz": (count - 1) / max(arrived[-1] - arrived[0], 1e-9),
        "age_ms": _quantiles(ages),
        "interval_ms": _quantiles(intervals),
        "lost": max(due - count, 0),
        "refused": state.refused - first.refused,
    }


def _quantiles(values: np.ndarray) -> list[float]:
    if not len(values):
        return [float("inf")] * 3
    return [round(float(q) * 1e3, 3) for q in np.quantile(values, (0.5, 0.99, 1.0))]
