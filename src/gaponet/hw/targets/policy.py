"""What says a controller's targets, once a control period: a motion, a function of your own, or live ones."""

from __future__ import annotations

from collections.abc import Callable

from gaponet.base.arrays import Array
from gaponet.hw.control.driver import Fault, State
from gaponet.sysid.motion.motion import Motion

# Period since the start of the run, state → targets (n) rad; None: the end; a fault: the robot damps.
Policy = Callable[[int, State], "Array | Fault | None"]


class NotYet(Fault):
    """There is no first target yet; until there is one nothing is commanded. Later it is a fault as any other."""


def play(motion: Motion, dt: float) -> Policy:
    """A motion as a policy: row k in period k."""
    rows = motion.sample(dt)
    return lambda k, state: rows[k] if k < len(rows) else None
