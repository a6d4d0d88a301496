"""Classic fields: kp, damping, friction, armature, offset and delay of every joint."""

from __future__ import annotations

import time

from gaponet.base.arrays import Array
from gaponet.sysid.acceptance import MIN_JUDGES, Judge
from gaponet.sysid.axes import CLASSIC, Values
from gaponet.sysid.least_squares import DAMPING_FACTORS, Progress
from gaponet.sysid.problem import JointFit, RobotFit, RobotSearch
from gaponet.sysid.search_progress import (
    FIRST_ROBOT_ITERATIONS,
    ROBOT_ITERATIONS,
    SearchProgress,
)
from gaponet.sysid.steps.step import Fits, FitState

MAX_LOSS_OF_FIRST_ITERATIONS = 0.05  # share of the error; see `_loses_much`
# In the judge's order: the given robot, then the default, which others replace only where they are
# clearly better.
CANDIDATES = ("given", "limbs", "joints", "whole", "delay and offset")


def fit_classic(fits: Fits, *, joints_alone: bool) -> FitState:
    """Fit the classic fields, joints by themselves and then together, and choose among the
    candidates.
    """
    of_joints = _fits_of_joints(fits)
    robots = [joints.robot_fit(fits.nthread) for joints in fits.joints]
    fits.progress.begin_search()
    of_robots: dict[str, list[Values]] = {}
    if not joints_alone:
        of_robots = robot_candidates(fits, robots, of_joints["joints"])
    every = of_joints | of_robots
    candidates = {name: every[name] for name in CANDIDATES if name in every}
    is_together = bool(of_robots)
    if fits.given.is_identified:
        chosen, values = fits.judge.best_by_joint(candidates)
        values = fits.judge.without_lost_joints(values)
        return FitState(chosen, values, values, robots, is_together)
    chosen, values = fits.judge.best(candidates)
    best_fit = values
    if chosen == "given":
        best_fit = candidates["limbs" if is_together else "joints"]
    base = fits.judge.without_lost_joints(best_fit)
    if chosen != "given":
        values = base
    return FitState(chosen, values, base, robots, is_together)


def _fits_of_joints(fits: Fits) -> dict[str, list[Values]]:
    """Return the candidates by name, with the values (n,) of each set of recordings."""
    candidates: dict[str, list[Values]] = {}
    for joints in fits.joints:
        for name, values in _joint_candidates(joints, fits.progress).items():
            candidates.setdefault(name, []).append(values)
    return candidates


def _joint_candidates(joints: JointFit, progress: SearchProgress) -> dict[str, Values]:
    """Fit each joint by itself; return the given values, a delay and an offset, and the classic
    fields.
    """
    bounds = joints.bounds
    # Without terms that the robot does not have.
    given = {field: bounds.first[field] for field in bounds.start}
    residual_before = joints.prior.residual
    progress.begin_search()
    delay_and_offset = joints.search_fields(
        ("offset", "delay"), given, report=lambda cost: progress.search_is_over()
    )
    joints.prior.residual = residual_before  # that of two fields is not that of all
    report = progress.reporter("each joint alone", joints.robot.operated, joints.rollouts.rows)
    alone = joints.search(bounds.start, joints.regressed(), report=report)
    joints.prior.update_correlation_time(joints.rollouts, alone)
    return {"given": given, "joints": alone, "delay and offset": delay_and_offset}


def robot_candidates(
    fits: Fits,
    robots: list[RobotFit],
    alone: list[Values],
) -> dict[str, list[Values]]:
    """Fit all joints together, from their own fits and from the robot's file; return nothing if
    that does not help.
    """
    if not _has_time_for_iterations(fits, robots, alone):
        return {}
    searches = []
    for robot, values in zip(robots, alone, strict=True):
        of_file = robot.bounds.start
        searches.append(robot.search(CLASSIC, of_file, (values, of_file)))
    _iterate(fits, robots, searches, FIRST_ROBOT_ITERATIONS)
    if _loses_much(fits.judge, alone, [search.values for search in searches]):
        return {}
    for search in searches:
        search.keep_better_starts()
    _iterate(fits, robots, searches, ROBOT_ITERATIONS)
    together = [search.values for search in searches]
    if fits.progress.search_is_over():
        return {"whole": together, "limbs": together}
    return {"whole": together, "limbs": _chain_fits(fits, robots, together)}


def _loses_much(judge: Judge, alone: list[Values], together: list[Values]) -> bool:
    """Return whether the first iterations of all joints together lose too much to go on, on the
    motions that were not fitted; never where these are too few to tell.

    On real robots they lose either up to 1 % of the error, which later iterations and the chains
    win back (G1, SO-101 on another day), or a third of it, which nothing wins back (SO-101).
    """
    motions = set(judge.names.tolist())
    if len(motions) < MIN_JUDGES:
        return False
    largest = (1 + MAX_LOSS_OF_FIRST_ITERATIONS) * judge.errors(alone).mean()
    return bool(judge.errors(together).mean() > largest)


def _chain_fits(
    fits: Fits,
    robots: list[RobotFit],
    together: list[Values],
) -> list[Values]:
    """Return fits of the kinematic chains that begin with values of all joints together."""

    def reporter(joints: tuple[str, ...], rows: Array) -> Progress:
        return fits.progress.reporter("kinematic chains", joints, rows)

    chains = []
    for robot, values in zip(robots, together, strict=True):
        chains.append(robot.descend_chains(values, reporter))
    return chains


def _has_time_for_iterations(
    fits: Fits,
    robots: list[RobotFit],
    alone: list[Values],
) -> bool:
    """Return whether the time is enough for the first iterations of all joints together.

    What they take follows from the time that the judge's motions take, which are simulated once in
    any case.
    """
    if not fits.progress.is_limited:
        return True
    began = time.monotonic()
    fits.judge.errors(alone)
    seconds_per_row = (time.monotonic() - began) / fits.judge.rows
    starts = 2
    candidates = starts * (len(CLASSIC) + 1 + len(DAMPING_FACTORS))
    rows = 0
    for robot in robots:
        rows += sum(len(part) for part in robot.rollouts.parts)
    seconds_per_candidate = seconds_per_row * rows
    return fits.progress.has_time_for(seconds_per_candidate * candidates * FIRST_ROBOT_ITERATIONS)


def _iterate(
    fits: Fits,
    robots: list[RobotFit],
    searches: list[RobotSearch],
    iterations: int,
) -> None:
    """Go on with the searches for all joints together."""
    for robot, search in zip(robots, searches, strict=True):
        report = fits.progress.reporter("whole robot", robot.robot.operated, robot.rollouts.rows)
        search.iterate(iterations, report)
