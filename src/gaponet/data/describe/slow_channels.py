"""Channels that were sampled more slowly than their table has rows: empty cells between their
samples.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import LogError
from gaponet.data.log import COMMANDS, REQUIRED, Channel

MIN_EMPTY_SHARE = 0.2  # of a joint's rows; fewer empty cells are bad rows


def sampled_channels(
    channels: dict[str, Channel], joints: tuple[str, ...], where: str
) -> tuple[dict[str, Channel], dict[str, Array], dict[str, Any]]:
    """Return channels with the rows in which they were sampled, the numbers of these rows, and
    notes of what was empty.

    Empty cells are NaN. A command that stands in every fifth row is held until the next one.
    Torque, velocity or temperature that is empty in all rows is left out.

    Raises:
        LogError: Command or position of a joint is empty in all rows.
    """
    sampled: dict[str, Channel] = {}
    numbers: dict[str, Array] = {}
    slower: dict[str, Any] = {}
    absent: dict[str, Any] = {}
    for name, channel in channels.items():
        present = np.isfinite(channel.values)
        empty = []
        for joint, in_any_row in zip(joints, present.any(axis=0), strict=True):
            if not in_any_row:
                empty.append(joint)
        if empty and name in REQUIRED:
            names = ", ".join(f'"{joint}"' for joint in empty)
            raise LogError(
                f"{where}: {name} of {', '.join(empty)} is empty in all rows; leave out what was "
                f"not recorded: ignore = [{names}] in logs.toml"
            )
        if empty:
            absent[name] = empty
            continue
        sampled[name], numbers[name] = _sampled(name, channel, present)
        if len(sampled[name].time) < len(channel.time):
            slower[name] = {"rows": len(sampled[name].time), "of": len(channel.time)}
        if name in COMMANDS:
            held = _held_to_the_end(sampled[name], numbers[name], channel.time)
            sampled[name], numbers[name] = held
    notes = {"slower": slower, "absent": absent}
    return sampled, numbers, {key: value for key, value in notes.items() if value}


def _sampled(name: str, channel: Channel, present: Array) -> tuple[Channel, Array]:
    """Return the rows with samples, and their numbers. present: where a cell holds one, (k, n)
    bool.
    """
    if (~present).mean(axis=0).max() < MIN_EMPTY_SHARE:
        return channel, np.arange(len(channel.time))
    some = present.any(axis=1)
    time = channel.time[some]
    values = channel.values[some]
    partly = some & ~present.all(axis=1)
    if partly.mean() < MIN_EMPTY_SHARE:
        return Channel(time, values), np.flatnonzero(some)
    columns = []
    for column, is_present in zip(values.T, present[some].T, strict=True):
        columns.append(_between_samples(name, time, column, is_present))
    joined = np.stack(columns, axis=1)
    known = np.isfinite(joined).all(axis=1)
    return Channel(time[known], joined[known]), np.flatnonzero(some)[known]


def _held_to_the_end(sampled: Channel, numbers: Array, time: Array) -> tuple[Channel, Array]:
    """Return commands, and the numbers of their rows, with the last one held to the last row.

    Args:
        time: Of all rows, s.
    """
    last = len(time) - 1
    if numbers[-1] == last:
        return sampled, numbers
    times = np.append(sampled.time, time[last])
    values = np.concatenate([sampled.values, sampled.values[-1:]])
    return Channel(times, values), np.append(numbers, last)


def _between_samples(name: str, time: Array, values: Array, present: Array) -> Array:
    """Return one joint's values in all rows: commands held, states interpolated; NaN before the
    first sample.
    """
    samples = np.flatnonzero(present)
    if name in COMMANDS:
        last = np.searchsorted(samples, np.arange(len(values)), side="right") - 1
        return np.where(last >= 0, values[samples[np.maximum(last, 0)]], np.nan)
    between = np.interp(time, time[samples], values[samples], left=np.nan, right=np.nan)
    return np.asarray(between)
