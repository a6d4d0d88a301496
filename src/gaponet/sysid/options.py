"""Options of an identification, for Python and for the command line."""

from __future__ import annotations

from dataclasses import dataclass

from gaponet.robot.servo_fields import Term


@dataclass(frozen=True)
class IdentifyOptions:
    """Options of `sysid.identify.identify`."""

    windows: int = 40
    """Number of rollouts of 8 s of single joints, taken evenly from the recordings."""

    terms: tuple[Term, ...] | None = None
    """Terms of the servo model, in the order in which they are fitted; default:
    motion_limits.default_terms."""

    table: bool = True
    """Fit a table under the robot's tips."""

    stops: bool = False
    """Give joints that stayed behind several commands a stop there."""

    masses: bool = False
    """Fit masses, centres of mass and inertias of the links too."""

    joints_alone: bool = False
    """Fit each joint by itself, and skip the fit of the whole robot, which takes longest."""

    folds: int = 3
    """Folds of the cross-validation, at most; 1 for none."""

    seconds: float | None = None
    """Time for the searches. A search that has begun ends, and what does not fit into the time is
    left out. Results are the same on every machine only without a limit."""

    nthread: int = 0
    """Threads; 0 for all cores."""
