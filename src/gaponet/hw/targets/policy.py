"""Policies: functions that give a controller's target of each period, from a motion, a user's
code, or live targets.
"""

from __future__ import annotations

from collections.abc import Callable

from gaponet.base.arrays import Array
from gaponet.hw.control.driver import Fault, State
from gaponet.motion.motion import Motion

# Period since the start of the run, state → targets (n) rad; None: the end; a fault: the robot
# damps.
Policy = Callable[[int, State], "Array | Fault | None"]


class NotYet(Fault):
    """There is no first target yet: nothing is commanded until there is one.

    After the first target it is a fault.
    """


def motion_policy(motion: Motion, dt: float) -> Policy:
    """Return a policy that plays a motion: row k in period k of dt s."""
    rows = motion.sample(dt)
    return lambda k, state: rows[k] if k < len(rows) else None
