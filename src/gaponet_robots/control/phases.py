"""Phases of a run on a robot, which may follow which, and how long they take."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from gaponet.errors import UsageError


class Phase(StrEnum):
    """Where a controller is."""

    IDLE = "idle"
    BLEND_IN = "blend_in"
    RUN = "run"
    BLEND_OUT = "blend_out"
    RELEASE = "release"
    DAMP = "damp"
    STOPPED = "stopped"


NEXT = {
    Phase.IDLE: (Phase.BLEND_IN, Phase.STOPPED),
    Phase.BLEND_IN: (Phase.RUN, Phase.RELEASE, Phase.DAMP, Phase.STOPPED),
    Phase.RUN: (Phase.BLEND_OUT, Phase.RELEASE, Phase.DAMP, Phase.STOPPED),
    Phase.BLEND_OUT: (Phase.RELEASE, Phase.DAMP, Phase.STOPPED),
    Phase.RELEASE: (Phase.DAMP, Phase.STOPPED),
    Phase.DAMP: (Phase.STOPPED,),
    Phase.STOPPED: (),
}
COMMANDING = (Phase.BLEND_IN, Phase.RUN, Phase.BLEND_OUT, Phase.RELEASE)


@dataclass(frozen=True)
class ControlConfig:
    """Timing of a controller."""

    rate: float = 50.0
    """Control periods per second."""
    blend: float = 2.0
    """Least duration of the moves to the first target and back, s."""
    blend_speed: float = 0.5
    """Fastest joint in those moves, rad/s."""
    settle: float = 0.5
    """Standing still at the first target before the run, s."""
    blend_out: bool = True
    """Go back to where the robot was found; a fault never waits for this."""
    damp: float = 2.0
    """Damping after a fault, or handing the arms back after a run, before the robot is let go, s."""

    def __post_init__(self) -> None:
        if not 1 <= self.rate <= 1000:
            raise UsageError(f"rate is {self.rate} Hz; give 1 to 1000")
        for name in ("blend", "blend_speed", "damp"):
            if not getattr(self, name) > 0:
                raise UsageError(f"{name} is {getattr(self, name)}; give a positive number")
