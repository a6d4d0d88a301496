"""Quality of a connection: rate, age, jitter and losses of a robot's states."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.hw.control.driver import Driver

POLL_S = 0.0005
QUANTILES = (0.5, 0.99, 1.0)


def measure_link(driver: Driver, seconds: float) -> dict[str, Any]:
    """Listen to a connected robot; nothing is sent.

    Returns:
        states; rate_hz; age_ms of a state when it arrives and interval_ms between two (p50, p99,
        max); lost: states that were due by the robot's own clock and never came; refused: states
        with a wrong checksum.
    """
    received = getattr(driver, "received", None)  # a bus may bring several states between two reads
    first = driver.read()
    measured = [first.time]
    arrived = [time.monotonic()]
    while arrived[-1] - arrived[0] < seconds and time.monotonic() - arrived[-1] < max(seconds, 1.0):
        state = driver.read()
        if state.time > measured[-1]:
            measured.append(state.time)
            arrived.append(time.monotonic())
        time.sleep(POLL_S)
    count = len(measured)
    if received is not None:
        count = driver.received - received + 1  # type: ignore[attr-defined]
    span = max(measured[-1] - measured[0], 1e-9)
    steps = np.diff(measured) if len(measured) > 1 else np.array([np.inf])
    due = 1 + round(span / float(np.median(steps)))
    ages = np.subtract(arrived, measured)[1:]
    intervals = np.diff(arrived)
    return {
        "states": count,
        "rate_hz": (count - 1) / max(arrived[-1] - arrived[0], 1e-9),
        "age_ms": _quantiles_ms(ages),
        "interval_ms": _quantiles_ms(intervals),
        "lost": max(due - count, 0),
        "refused": state.refused - first.refused,
    }


def _quantiles_ms(seconds: Array) -> list[float]:
    if not len(seconds):
        return [float("inf")] * 3
    return [round(float(q) * 1e3, 3) for q in np.quantile(seconds, QUANTILES)]
