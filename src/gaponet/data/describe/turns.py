"""Joints that turn on and on: readings that jump by a whole turn are continued."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.log import Channel, Log
from gaponet.robot.spec import RobotSpec

TURN_RAD = 2 * np.pi
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
    if not turned:
        return log
    channels = {
        name: Channel(log.channels[name].time, values) for name, values in positions.items()
    }
    notes = log.meta.get("notes", {}) | {"turns": turned}
    return replace(log, channels=log.channels | channels, meta=log.meta | {"notes": notes})


def _continue(values: Array) -> int:
    """Continue one joint's readings (k,) in place; return the number of jumps by a turn."""
    steps = np.diff(values)
    whole = np.round(steps / TURN_RAD)
    jumps = (whole != 0) & (np.abs(steps - TURN_RAD * whole) < MAX_STEP_RAD)
    values[1:] -= TURN_RAD * np.cumsum(np.where(jumps, whole, 0.0))
    return int(jumps.sum())
