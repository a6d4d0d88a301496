"""Classic fields: kp, damping, friction, armature, offset and delay of every joint."""

from __future__ import annotations

import time
from collections import defaultdict

from gaponet.sysid.acceptance import MIN_JUDGES
from gaponet.sysid.axes import CLASSIC, Values
from gaponet.sysid.least_squares import DAMPING_FACTORS
from gaponet.sysid.problem import JointFit, RobotFit, RobotSearch
from gaponet.sysid.search_progress import (
    FIRST_ROBOT_ITERATIONS,
    ROBOT_ITERATIONS,
    SearchProgress,
)
from gaponet.sysid.steps.step import Fits, FitState

MAX_LOSS_OF_FIRST_ITERATIONS = 0.05  # share of the error; see `robot_candidates`
# In the judge's order: the given robot, then the default, which others replace only where they are
# clearly better.
CANDIDATES = ("given", "limbs", "joints", "whole", "delay and offset")


def fit_classic(fits: Fits, *, joints_alone: bool) -> FitState:
    """Fit the classic fields, joints by themselves and then together, and choose among the
    candidates.
    """
    candidates: dict[str, list[Values]] = defaultdict(list)
    for joints in fits.joints:
        for name, values_of_set in _joint_candidates(joints, fits.progress).items():
            candidates[name].append(values_of_set)
    robots = [joints.robot_fit(fits.nthread) for joints in fits.joints]
    fits.progress.begin_search()
    together: dict[str, list[Values]] = {}
    if not joints_alone:
        together = robot_candidates(fits, robots, candidates["joints"])
    candidates |= together
    candidates = {name: candidates[name] for name in CANDIDATES if name in candidates}
    if fits.given.nominal is not None:
        chosen, values = fits.judge.best_by_joint(candidates)
        return FitState(chosen, values, values, robots, bool(together))
    chosen, values = fits.judge.best(candidates)
    base = values
    if chosen == "given":
        base = candidates["limbs"] if together else candidates["joints"]
    return FitState(chosen, values, base, robots, bool(together))


def _joint_candidates(joints: JointFit, progress: SearchProgress) -> dict[str, Values]:
    """Fit each joint by itself; return the given values, a delay and an offset, and the classic
    fields.
    """
    bounds = joints.bounds
    residual = joints.prior.residual
    given = {f: bounds.first[f] for f in bounds.start}  # without terms that the robot does not have
    progress.begin_search()
    late = joints.search_fields(
        ("offset", "delay"), given, report=lambda cost: progress.search_is_over()
    )
    joints.prior.residual = residual  # of other fields' searches
    report = progress.reporter("each joint alone", joints.robot.operated, joints.rollouts.rows)
    alone = joints.search(bounds.start, joints.regressed(), report=report)
    joints.prior.update_correlation_time(joints.rollouts, alone)
    return {"given": given, "joints": alone, "delay and offset": late}


def robot_candidates(
    fits: Fits, robots: list[RobotFit], alone: list[Values]
) -> dict[str, list[Values]]:
    """Fit all joints together, from their own fits and from the robot's file; return nothing if
    that does not help.

    The first iterations decide by the motions that were not fitted, if there are enough of them. On
    real robots they lose either up to 1 % of the error, which later iterations and the chains win
    back (G1, SO-101 on another day), or a third of it, which nothing wins back (SO-101).
    """
    judge = fits.judge
    if not _has_time_for_iterations(fits, robots, alone):
        return {}
    starts = zip(robots, alone, strict=True)
    searches = [r.search(CLASSIC, r.bounds.start, (own, r.bounds.start)) for r, own in starts]
    _iterate(fits, robots, searches, FIRST_ROBOT_ITERATIONS)
    if len(set(judge.names.tolist())) >= MIN_JUDGES:
        first = [search.values for search in searches]
        largest = (1 + MAX_LOSS_OF_FIRST_ITERATIONS) * judge.errors(alone).mean()
        if judge.errors(first).mean() > largest:
            return {}
    for search in searches:
        search.keep_better_starts()
    _iterate(fits, robots, searches, ROBOT_ITERATIONS)
    whole_robot = [search.values for search in searches]
    if fits.progress.search_is_over():
        return {"whole": whole_robot, "limbs": whole_robot}
    chains = []
    for robot, values in zip(robots, whole_robot, strict=True):
        chains.append(
            robot.descend_chains(
                values,
                lambda joints, rows: fits.progress.reporter("kinematic chains", joints, rows),
            )
        )
    return {"whole": whole_robot, "limbs": chains}


def _has_time_for_iterations(fits: Fits, robots: list[RobotFit], alone: list[Values]) -> bool:
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
    rows = sum(sum(map(len, robot.rollouts.parts)) for robot in robots)
    return fits.progress.has_time_for(seconds_per_row * rows * candidates * FIRST_ROBOT_ITERATIONS)


def _iterate(
    fits: Fits, robots: list[RobotFit], searches: list[RobotSearch], iterations: int
) -> None:
    """Go on with the searches for all joints together."""
    for robot, search in zip(robots, searches, strict=True):
        report = fits.progress.reporter("whole robot", robot.robot.operated, robot.rollouts.rows)
        search.iterate(iterations, report)
