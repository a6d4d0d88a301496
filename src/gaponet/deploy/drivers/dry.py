"""A rehearsal on a real robot: everything is read, judged and computed, and nothing is sent."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from gaponet.arrays import Array
from gaponet.deploy.driver import Driver, State
from gaponet.deploy.recording import Recording


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
        self.address = f"{driver.address}, dry run"
        self.joint_names, self.commanded = driver.joint_names, driver.commanded
        self.noisy, self.at_end = driver.noisy, driver.at_end
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

    def damp(self, weight: float = 1.0) -> None:
        """Send nothing."""

    def close(self, hold: bool = False) -> None:
        """Leave the bus; nothing was sent."""
        self.driver.close(hold=True)

    def guard(self) -> dict[str, object] | None:
        """Nothing is commanded, so nothing must be damped."""
        return None


def would_send(recording: Recording, limits: Any) -> dict[str, dict[str, float]]:
    """What would be sent, by joint: least and greatest command (rad), the fastest (rad/s), the largest torque (N·m).

    Args:
        limits: safety.Limits of its commanded joints.
    """
    rows = [row for row in recording.rows if row.ctrl is not None]
    if not rows:
        return {}
    at = [recording.joint_names.index(name) for name in recording.commanded]
    ctrl = np.array([row.ctrl for row in rows])[:, at]
    qpos, qvel = (np.array([getattr(row.state, name) for row in rows])[:, at] for name in ("qpos", "qvel"))
    speed = np.abs(np.diff(ctrl, axis=0, prepend=ctrl[:1])).max(axis=0) / recording.dt
    torque = np.abs(limits.kp * (ctrl - qpos) - limits.kd * qvel).max(axis=0)
    table = np.stack([ctrl.min(axis=0), ctrl.max(axis=0), speed, torque], axis=1).tolist()
    names = ("lowest_rad", "highest_rad", "fastest_rad_s", "torque_nm")
    return {joint: dict(zip(names, row, strict=True)) for joint, row in zip(recording.commanded, table, strict=True)}
