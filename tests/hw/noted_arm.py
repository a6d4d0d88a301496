"""A virtual two-joint arm in simulated time that notes all it is sent, and a watchdog without a process."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from arm import commands

from gaponet.hw.control.clock import SimulatedClock
from gaponet.hw.control.phases import ControlConfig
from gaponet.robot.spec import RobotSpec
from gaponet.sysid.motion.motion import Motion
from gaponet.testing.fleet import load_fleet
from gaponet.testing.virtual_driver import VirtualDriver

DT = 0.02
QUICK = ControlConfig(blend=0.3, blend_speed=4.0, settle=0.1, damp=0.1)
MOTION = Motion("sway", "whole_body", DT, commands(40, seed=1))


class NotedArm(VirtualDriver):
    """Notes commands (None: damping), weights, and how it is closed."""

    def __init__(self, robot: RobotSpec, clock: SimulatedClock | None = None) -> None:
        unit = load_fleet("easy", robot).unit("virtual-1")
        super().__init__(robot, unit, clock or SimulatedClock(), period=0.01)
        self.sent: list[tuple[float, np.ndarray | None]] = []
        self.weights: list[tuple[float, float]] = []
        self.shares: list[float] = []
        self.closed: list[bool] = []

    @property
    def damped(self) -> float:
        """Time of the first damping message, s."""
        return next(time for time, ctrl in self.sent if ctrl is None)

    @property
    def commands(self) -> list[tuple[float, np.ndarray]]:
        """Times and position commands."""
        return [(time, ctrl) for time, ctrl in self.sent if ctrl is not None]

    def write(self, ctrl: np.ndarray, weight: float = 1.0) -> None:
        self.sent.append((self.clock.now(), ctrl.copy()))
        self.weights.append((self.clock.now(), weight))
        super().write(ctrl, weight)

    def damp(self, weight: float = 1.0, share: float = 0.0) -> None:
        self.sent.append((self.clock.now(), None))
        self.weights.append((self.clock.now(), weight))
        self.shares.append(share)
        super().damp(weight, share)

    def close(self, hold: bool = False) -> None:
        self.closed.append(hold)


def fake_watchdog(**changes: object) -> SimpleNamespace:
    """A watchdog that is always well, but for the changes."""
    well = {"problem": str, "fired": bool, "beat": lambda weight: True, "wait_ready": lambda: None}
    return SimpleNamespace(**well | {"release": lambda unconfirmed: None} | changes)
