"""Rows that a logger wrote twice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.log import Channel, Log

MIN_SHARE = 0.3  # of all rows; fewer short periods are those of an uneven clock
MAX_PERIOD_SHARE = 0.2  # of the usual period, after which a row can be a repetition


def without_repeated_rows(log: Log) -> Log:
    """Return the log without rows that repeat the one before within a small part of a period.

    Some drivers write each row twice, some tenths of a millisecond apart. The log then notes it
    (notes, "repeated"). A robot that rests repeats its numbers too, but at its usual period.
    """
    channels = dict(log.channels)
    rows = {}
    dropped = 0
    for name, channel in log.channels.items():
        keep = ~_repeated(channel.time, channel.values)
        dropped = max(dropped, int((~keep).sum()))
        channels[name] = Channel(channel.time[keep], channel.values[keep])
        rows[name] = log.row_numbers(name)[keep]
    if not dropped:
        return log
    notes = log.meta.get("notes", {}) | {"repeated": {"rows": dropped}}
    return replace(log, channels=channels, meta=log.meta | {"notes": notes, "rows": rows})


def repeats_row_before(channel: Channel) -> Array:
    """Return which rows repeat the one before at the same instant, (k,) bool."""
    again = np.diff(channel.time) == 0
    same = channel.values[1:] == channel.values[:-1]
    both_empty = np.isnan(channel.values[1:]) & np.isnan(channel.values[:-1])
    again &= (same | both_empty).all(axis=1)
    return np.concatenate([np.zeros(min(len(channel.time), 1), bool), again])


def _repeated(time: Array, values: Array) -> Array:
    """Return where a row repeats the one before, (k,); nowhere if few do."""
    nothing = np.zeros(len(time), bool)
    period = np.diff(time)
    if len(period) < 2:
        return nothing
    usual = np.quantile(period, 1 - MIN_SHARE / 2)
    short = period < MAX_PERIOD_SHARE * usual
    equal = (values[1:] == values[:-1]).all(axis=1)
    repeated = np.concatenate([[False], short & equal])
    if repeated.sum() < MIN_SHARE * len(time):
        return nothing
    return repeated
