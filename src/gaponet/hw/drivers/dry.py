"""Dry run on a real robot: everything is read, checked and computed, and nothing is sent."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.hw.control.driver import Driver, Fault, State
from gaponet.hw.control.recording import Recording
from gaponet.hw.control.safety import Limits


class DryRun:
    """A `Driver` around another one, of which only the readings are used.

    Its states are the robot's, moved on by the way of the commands, as if the robot followed at
    once. Without this the first motion would count as a joint that does not follow.
    """

    reads_back = True  # what was not sent cannot be checked

    def __init__(self, driver: Driver) -> None:
        """Take the driver of the robot, which must publish nothing when it connects."""
        self.driver = driver
        # The same lock: a serial bus has one master, also one that only reads.
        self.address = driver.address
        self.joint_names = driver.joint_names
        self.commanded = driver.commanded
        self.noisy = driver.noisy
        self.at_end = driver.at_end
        self.at_stop = driver.at_stop
        self._at = np.array([driver.joint_names.index(name) for name in driver.commanded])
        self._measured: Array | None = None  # qpos of the last state, rad
        self._start: Array | None = None  # qpos at the first command, rad
        self._moved: Array | float = 0.0  # way of the commands since then, rad

    @property
    def virtual(self) -> bool:
        """As of the robot's driver, also what follows."""
        return self.driver.virtual

    @property
    def kp(self) -> Array:
        return self.driver.kp

    @property
    def kd(self) -> Array:
        return self.driver.kd

    @property
    def qpos_range(self) -> Array | None:
        return self.driver.qpos_range

    @property
    def facts(self) -> dict[str, Any]:
        return self.driver.facts | {"dry_run": True}

    def connect(self) -> None:
        """Connect the robot's driver."""
        self.driver.connect()

    def read(self) -> State:
        """Return the robot's state, moved on."""
        state = self.driver.read()
        self._measured = state.qpos
        return replace(state, qpos=state.qpos + self._moved)

    def write(self, ctrl: Array, weight: float = 1.0) -> None:
        """Move the states on; send nothing."""
        assert self._measured is not None
        self._start = self._measured if self._start is None else self._start
        moved = np.zeros_like(self._start)
        moved[self._at] = (ctrl - self._start)[self._at]
        self._moved = moved

    def verify(self) -> Fault | None:
        """Read back what the robot's driver can."""
        return self.driver.verify()

    def damp(self, weight: float = 1.0, share: float = 0.0) -> None:
        """Send nothing."""

    def confirm(self) -> str:
        """Return that nothing was sent."""
        return "nothing was sent"

    def close(self, hold: bool = False) -> None:
        """Leave the bus; nothing is sent."""
        self.driver.close(hold=True)

    def watchdog(self) -> dict[str, object] | None:
        """Return None: nothing is commanded, so nothing must be damped."""
        return None


def summarize_commands(recording: Recording, limits: Limits) -> dict[str, dict[str, float]]:
    """Return by joint the range of the commands (rad), the fastest one (rad/s) and the largest
    torque (N·m).
    """
    table = recording.rows.table()
    rows = table[~np.isnan(table["ctrl"]).all(axis=1)]
    if not len(rows):
        return {}
    at = [recording.joint_names.index(name) for name in recording.commanded]
    ctrl = rows["ctrl"][:, at]
    qpos = rows["qpos"][:, at]
    qvel = rows["qvel"][:, at]
    speed = np.abs(np.diff(ctrl, axis=0, prepend=ctrl[:1])).max(axis=0) / recording.dt
    torque = np.abs(limits.kp * (ctrl - qpos) - limits.kd * qvel).max(axis=0)
    summary = {}
    for i, joint in enumerate(recording.commanded):
        summary[joint] = {
            "lowest_rad": float(ctrl[:, i].min()),
            "highest_rad": float(ctrl[:, i].max()),
            "fastest_rad_s": float(speed[i]),
            "torque_nm": float(torque[i]),
        }
    return summary
