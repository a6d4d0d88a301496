"""Identification: the fit to positions (fit.py), and what competes with it on validation motions: the ramps of servos
that move their targets themselves (target_speed.py), and recorded torque (torque.py)."""

from __future__ import annotations

from collections.abc import Sequence as ListOf

from gaponet.data.sequence import Sequence
from gaponet.robot.spec import RobotSpec
from gaponet.sysid.fit import DEFAULT_TERMS, WINDOWS, Identified, Progress, fit_robot
from gaponet.sysid.target_speed import with_ramps
from gaponet.sysid.torque import rival


def identify(
    sequences: ListOf[Sequence],
    robot: RobotSpec,
    validation: ListOf[Sequence] = (),
    windows: int = WINDOWS,
    terms: tuple[str, ...] = DEFAULT_TERMS,
    table: bool = True,
    shared: bool = False,
    nthread: int = 0,
    progress: Progress = lambda done, total, note: None,
    budget: float | None = None,
    stops: bool = False,
) -> Identified:
    """Fit the parameters of all operated joints.

    Args:
        sequences: Recordings to fit on; validation and test motions stay out.
        robot: Where to start from; its payloads' masses are taken as true, its gains where recordings state them.
        validation: Recordings that judge; without them the fitted windows do.
        windows: Free runs of 8 s, taken evenly from the recordings.
        terms: Which terms of the servo's law, from TERMS, in the order in which they are tried.
        table: Look for a table under the robot's tips.
        shared: In the end give joints with one type of servo (robot.servos) one law.
        nthread: Threads, 0 for all cores.
        progress: Called in each iteration.
        budget: s that the searches may take, the table's apart; without one results are the same on every machine.
        stops: Give joints that stayed behind several commands a stop there.
    """
    options = (validation, windows, terms, table, shared, nthread, progress, stops)

    def fit(one: RobotSpec, seconds: float | None) -> Identified:
        made = fit_robot(sequences, one, *options, seconds)
        return rival(made, sequences, validation, one, nthread) if validation else made

    return with_ramps(fit, sequences, robot, validation, budget) if validation else fit(robot, budget)
