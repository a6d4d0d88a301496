"""The paper's experiment with motions and holds of fractions of a second."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from gaponet.experiments.paper import goals, measure, study

ROWS = 30  # of a motion


def shorten(set_attribute: Callable[[Any, str, Any], None] = setattr) -> None:
    """Shorten what is played in this process; workers of a pool of processes do not see it."""
    make_motions = study.make_unseen_motions

    def short_motions(*args: Any) -> list[Any]:
        return [replace(motion, ctrl=motion.ctrl[:ROWS]) for motion in make_motions(*args)]

    set_attribute(study, "make_unseen_motions", short_motions)
    set_attribute(measure, "REST_S", 0.1)
    set_attribute(measure, "HOLD_S", 0.2)
    set_attribute(measure, "AVERAGED_S", 0.1)
    set_attribute(goals, "REST_S", 0.1)
