"""A virtual two-joint arm in simulated time that notes all it is sent, its controller, and a
watchdog in name only.
"""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
from arm import commands

from gaponet.hw.control.clock import SimulatedClock
from gaponet.hw.control.controller import Controller
from gaponet.hw.control.driver import State
from gaponet.hw.control.phases import ControlConfig
from gaponet.hw.control.recording import Recording
from gaponet.hw.targets.policy import Policy, motion_policy
from gaponet.motion.motion import Motion
from gaponet.robot.spec import RobotSpec
from gaponet.virtual.fleet import load_fleet
from gaponet.virtual.virtual_driver import VirtualDriver

DT = 0.02
QUICK = ControlConfig(blend=0.3, blend_speed=4.0, settle=0.1, damp=0.1)
MOTION = Motion("sway", "whole_body", DT, commands(40, seed=1))


class NotedArm(VirtualDriver):
    """Notes commands (None: damping), weights, and how it is closed; `change` may replace each
    state that is read.
    """

    def __init__(
        self,
        robot: RobotSpec,
        clock: SimulatedClock | None = None,
        change: Callable[[State], State] = lambda state: state,
    ) -> None:
        self.robot = robot.before_identification
        self.change = change
        unit = load_fleet("easy", robot).unit("virtual-1")
        super().__init__(robot, unit, clock or SimulatedClock(), period=0.01)
        self.sent: list[tuple[float, np.ndarray | None]] = []
        self.weights: list[tuple[float, float]] = []
        self.shares: list[float] = []
        self.closed: list[bool] = []

    @property
    def elapsed(self) -> float:
        """Time since the clock began, s."""
        return self.clock.now() - self.clock.start

    @property
    def damped(self) -> float:
        """Time of the first damping message, s."""
        return next(time for time, ctrl in self.sent if ctrl is None)

    @property
    def commands(self) -> list[tuple[float, np.ndarray]]:
        """Times and position commands."""
        return [(time, ctrl) for time, ctrl in self.sent if ctrl is not None]

    def read(self) -> State:
        return self.change(super().read())

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


def control(driver: NotedArm, **options: Any) -> Controller:
    """A controller of the arm, quick and in simulated time."""
    return Controller(
        driver, driver.robot, config=options.pop("config", QUICK), clock=driver.clock, **options
    )


def run(driver: NotedArm, motion: Motion = MOTION, **options: Any) -> Recording:
    """Play a motion."""
    return control(driver, **options).run(motion_policy(motion, DT))


def acting(act: Callable[[], object], period: int = 20) -> Policy:
    """A policy that plays MOTION and acts in one period of the run."""
    play = motion_policy(MOTION, DT)
    return lambda k, state: [act() if k == period else None, play(k, state)][1]


def phases(recording: Recording) -> list[str]:
    """Names of the phases in turn."""
    return [event.phase for event in recording.events]


def fake_watchdog(**changes: object) -> SimpleNamespace:
    """A watchdog that is always well, but for the changes."""
    well = {
        "problem": str,
        "fired": bool,
        "is_damping": bool,
        "can_damp": lambda: True,
        "beat": lambda weight: True,
        "wait_ready": lambda: None,
    }
    return SimpleNamespace(**well | {"release": lambda unconfirmed: None} | changes)
