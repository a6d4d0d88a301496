"""Joints that turn on and on: readings that jump by a whole turn are continued."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.describe.plausibility import MAX_BEYOND_RAD, TURN_RAD
from gaponet.data.log import Channel, Log
from gaponet.robot.spec import RobotSpec

ROUNDING_RAD = 0.1  # by which angles of one turn may pass its ends
MAX_STEP_RAD = 1.0  # that a joint moves beside the jump, from one row to the next


def continued_turns(log: Log, robot: RobotSpec) -> Log:
    """Return the log with joints whose readings wrap at the end of a turn continued beyond it.

    A joint without a range whose state lies whole turns from its command is moved by these turns.
    The log notes both (notes, "turns").
    """
    positions = {name: np.array(log.channels[name].values, float) for name in ("ctrl", "qpos")}
    turned = {}
    for column, joint in enumerate(log.joint_names):
        low, high = robot.qpos_range[robot.joint_names.index(joint)]
        wraps = 0
        for values in positions.values():
            wraps += _continue(values[:, column])
        endless = not (np.isfinite(low) and np.isfinite(high))
        if not wraps and not endless:
            continue
        apart = np.median(positions["qpos"][:, column]) - np.median(positions["ctrl"][:, column])
        turns = round(float(apart) / TURN_RAD)
        positions["qpos"][:, column] -= TURN_RAD * turns
        if wraps or turns:
            turned[joint] = {"wraps": wraps, "turns": turns}
    return _with_positions(log, positions, turned) if turned else log


def within_range(log: Log, robot: RobotSpec) -> Log:
    """Return the log with angles from 0 to a turn brought into their joint's range.

    An arm that counts from 0° to 360° writes −10° as 350°. Where command or state of a joint then
    fits its range, the other one follows by whole turns. Radians that never jump by a turn are left
    alone: they may be degrees. The log notes it (notes, "turns").
    """
    positions = {name: np.array(log.channels[name].values, float) for name in ("ctrl", "qpos")}
    turned = {}
    for column, joint in enumerate(log.joint_names):
        low, high = robot.qpos_range[robot.joint_names.index(joint)]
        if not np.isfinite([low, high]).all():
            continue
        brought: dict[str, Array] = {}  # channel → its angles in the range, (k,)
        wraps = 0
        for name, values in positions.items():
            angles = _brought_into_range(values[:, column], low, high)
            if angles is not None:
                brought[name] = angles
                wraps += _count_wraps(values[:, column])
        if not brought:
            continue
        converted = joint in log.meta.get("converted_from", {})
        if not wraps and not converted:
            continue  # radians beyond the range may be degrees
        reference = next(iter(brought.values()))
        for name, values in positions.items():
            if name not in brought:
                brought[name] = _of_same_turn(values[:, column], reference)
            values[:, column] = brought[name]
        turned[joint] = {"wraps": wraps, "turns": 0}
    return _with_positions(log, positions, turned) if turned else log


def _count_wraps(values: Array) -> int:
    """Return how often angles (k,) jump by more than half a turn."""
    return int((np.abs(np.diff(values)) > TURN_RAD / 2).sum())


def _with_positions(log: Log, positions: dict[str, Array], turned: dict[str, Any]) -> Log:
    """Return the log with other positions, and a note of them by joint."""
    channels = {
        name: Channel(log.channels[name].time, values) for name, values in positions.items()
    }
    notes = dict(log.meta.get("notes", {}))
    notes["turns"] = notes.get("turns", {}) | turned
    return replace(log, channels=log.channels | channels, meta=log.meta | {"notes": notes})


def _brought_into_range(values: Array, low: float, high: float) -> Array | None:
    """Return one joint's angles (k,), written from 0 to a turn, moved by whole turns into its
    range; None if they are not written so, lie in the range already, or do not fit it anyhow.
    """
    if values.min() < -ROUNDING_RAD or values.max() > TURN_RAD + ROUNDING_RAD:
        return None
    if values.max() <= high + MAX_BEYOND_RAD or values.max() <= TURN_RAD / 2:
        return None
    continued = values.copy()
    _continue(continued)
    middle = (continued.min() + continued.max()) / 2
    continued -= TURN_RAD * round((middle - (low + high) / 2) / TURN_RAD)
    fits = continued.min() >= low - MAX_BEYOND_RAD and continued.max() <= high + MAX_BEYOND_RAD
    return continued if fits else None


def _of_same_turn(values: Array, reference: Array) -> Array:
    """Return one joint's angles (k,) moved by whole turns to those of its command or state."""
    apart = float(np.median(values) - np.median(reference))
    return np.asarray(values - TURN_RAD * round(apart / TURN_RAD))


def _continue(values: Array) -> int:
    """Continue one joint's readings (k,) in place; return the number of jumps by a turn."""
    steps = np.diff(values)
    whole = np.round(steps / TURN_RAD)
    jumps = (whole != 0) & (np.abs(steps - TURN_RAD * whole) < MAX_STEP_RAD)
    values[1:] -= TURN_RAD * np.cumsum(np.where(jumps, whole, 0.0))
    return int(jumps.sum())
