"""A rehearsal on a real robot: everything is read, judged and computed, and nothing is sent."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.hw.control.driver import Driver, Fault, State
from gaponet.hw.control.recording import Recording


class DryRun:
    """A `Driver` around another one that only reads.

    Its states are the robot's, moved on by what the commands would have moved, as if the robot followed at once: else
    the first motion would count as a joint that does not follow.
    """

    def __init__(self, driver: Driver) -> None:
        """
        Args:
            driver: The robot; one that publishes nothing when it connects.
        """
        self.driver = driver
        self.address = driver.address  # under the same lock: a serial bus has one speaker, who only reads too
        self.joint_names, self.commanded = driver.joint_names, driver.commanded
        self.noisy, self.at_end, self.at_stop = driver.noisy, driver.at_end, driver.at_stop
        self.reads_back = True  # of what was not sent nothing can be read
        self._adopt()
        self._at = np.array([driver.joint_names.index(name) for name in driver.commanded])
        self._base: Array | None = None  # where the joints were at the first command
        self._moved: Array | float = 0.0

    def connect(self) -> None:
        self.driver.connect()
        self._adopt()

    def _adopt(self) -> None:
        inner = self.driver
        self.virtual, self.kp, self.kd, self.qpos_range = inner.virtual, inner.kp, inner.kd, inner.qpos_range
        self.facts: dict[str, Any] = inner.facts | {"dry_run": True}

    def read(self) -> State:
        """What the robot says, moved on."""
        self._real = self.driver.read()
        return replace(self._real, qpos=self._real.qpos + self._moved)

    def write(self, ctrl: Array, weight: float = 1.0) -> None:
        self._base = self._real.qpos if self._base is None else self._base
        moved = np.zeros_like(self._base)
        moved[self._at] = (ctrl - self._base)[self._at]
        self._moved = moved

    def verify(self) -> Fault | None:
        return self.driver.verify()

    def damp(self, weight: float = 1.0, share: float = 0.0) -> None:
        """Send nothing."""

    def confirm(self) -> str:
        return "nothing was sent"

    def close(self, hold: bool = False) -> None:
        """Leave the bus; nothing was sent."""
        self.driver.close(hold=True)

    def watchdog(self) -> dict[str, object] | None:
        """Nothing is commanded, so nothing must be damped."""
        return None


def would_send(recording: Recording, limits: Any) -> dict[str, dict[str, float]]:
    """What would be sent, by joint: least and greatest command (rad), the fastest (rad/s), the largest torque (N·m).

    Args:
        limits: safety.Limits of its commanded joints.
    """
    table = recording.rows.table()
    rows = table[~np.isnan(table["ctrl"]).all(axis=1)]
    if not len(rows):
        return {}
    at = [recording.joint_names.index(name) for name in recording.commanded]
    ctrl, qpos, qvel = (rows[name][:, at] for name in ("ctrl", "qpos", "qvel"))
    speed = np.abs(np.diff(ctrl, axis=0, prepend=ctrl[:1])).max(axis=0) / recording.dt
    torque = np.abs(limits.kp * (ctrl - qpos) - limits.kd * qvel).max(axis=0)
    table = np.stack([ctrl.min(axis=0), ctrl.max(axis=0), speed, torque], axis=1).tolist()
    names = ("lowest_rad", "highest_rad", "fastest_rad_s", "torque_nm")
    return {joint: dict(zip(names, row, strict=True)) for joint, row in zip(recording.commanded, table, strict=True)}
