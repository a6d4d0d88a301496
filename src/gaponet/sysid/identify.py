"""Identification: the servo parameters with which rollouts of the simulator follow the recordings
best.

Per operated joint these are kp, total damping, dry friction, armature, zero offset and command
delay, then what validation motions accept: terms of the servo model (sim/servo.py) and, on request,
links. `identify` goes this way:

1. Fit the classic fields, every joint by itself and then all together where that helps
   (steps/classic.py).
2. Propose one step after the other: terms (steps/servo_term.py), links (steps/link_masses.py). Each
   is fitted to the same recordings; motions that were not fitted accept or reject it (`Judge`).
3. Estimate standard errors (standard_errors.py), and fit the table under the tips
   (table_contact.py).
4. Compare with a fit that begins with recorded torque (steps/recorded_torque.py), and with
   speed-limited targets (steps/speed_limits.py).

Where few motions validate, all of this is done for folds of a cross-validation side by side, and
for all recordings.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from functools import partial

from gaponet.base.progress import Progress, no_progress
from gaponet.data.sequence import Sequence
from gaponet.robot.servo_fields import Term
from gaponet.robot.spec import RobotSpec
from gaponet.sim.metrics import Comparison
from gaponet.sim.temperature import temperature_findings
from gaponet.sysid.acceptance import HeldOut, Identified, Judge, Split, cross_validation
from gaponet.sysid.axes import Bounds, Values, with_values
from gaponet.sysid.joint_rollouts import JointRollouts
from gaponet.sysid.motion_limits import default_terms, stop_questions, with_stops
from gaponet.sysid.options import IdentifyOptions
from gaponet.sysid.problem import JointFit, fitted_fields
from gaponet.sysid.robot_rollouts import cut
from gaponet.sysid.search_progress import SearchProgress
from gaponet.sysid.servo_types import far_from_servo_type
from gaponet.sysid.standard_errors import (
    StandardErrors,
    contradicted_gains,
    standard_errors,
)
from gaponet.sysid.steps import backlash
from gaponet.sysid.steps.classic import fit_classic
from gaponet.sysid.steps.link_masses import LinkMasses
from gaponet.sysid.steps.recorded_torque import with_torque
from gaponet.sysid.steps.servo_term import Backlash, ServoTerm
from gaponet.sysid.steps.speed_limits import better_of, seen_speed_limits
from gaponet.sysid.steps.step import Fits, FitState, Step
from gaponet.sysid.table_contact import (
    TableFit,
    contact_height,
    fit_table,
    low_windows,
    tip_heights,
)

NO_TERMS: tuple[Term, ...] = ()


@dataclass(frozen=True)
class Recordings:
    """Recordings of an identification.

    Attributes:
        fitted: Recordings to fit.
        validation: Recordings that choose among candidates.
        splits: Folds, or the one split into fitted and validation.
    """

    fitted: list[Sequence]
    validation: list[Sequence]
    splits: list[Split]

    @property
    def fitted_sets(self) -> list[list[Sequence]]:
        """What is fitted: the recordings of each fold, and all of them last if there are several
        folds.
        """
        sets = [split.fitted for split in self.splits]
        if len(self.splits) > 1:
            sets.append([*self.fitted, *self.validation])
        return sets


def identify(
    sequences: ListOf[Sequence],
    robot: RobotSpec,
    validation: ListOf[Sequence] = (),
    options: IdentifyOptions | None = None,
    progress: Progress = no_progress,
) -> Identified:
    """Fit the parameters of all operated joints.

    Where fewer than three motions validate a set of joints, all recordings are fitted in the end,
    and cross-validation over their motions chooses among candidates.

    Args:
        sequences: Recordings to fit; validation and test motions stay out.
        robot: Start of the fit; its payload masses are taken as true, its gains where recordings
            state them.
        validation: Recordings that choose among candidates; without them the fitted windows do.
        options: Default: IdentifyOptions().
        progress: Called with iterations done, in all, and what is fitted.
    """
    options = options or IdentifyOptions()
    if options.terms is None:
        options = replace(options, terms=default_terms(sequences, robot))
    splits = cross_validation(sequences, validation, options.folds)
    recordings = Recordings(list(sequences), list(validation), splits)
    limits = seen_speed_limits(sequences, robot) if validation else {}
    if not limits:
        return _identify(recordings, robot, options, progress)
    if options.seconds is not None:
        options = replace(options, seconds=options.seconds / 2)
    plain = _identify(recordings, robot, options, progress)
    limited = _identify(recordings, robot.with_identified(limits), options, progress)
    return better_of(plain, limited, limits)


def _identify(
    recordings: Recordings,
    robot: RobotSpec,
    options: IdentifyOptions,
    progress: Progress,
) -> Identified:
    """Fit to positions, and then from recorded torque, with the speed limits that the robot's
    servos have.
    """
    began = time.monotonic()
    fitted = _fit_positions(recordings, robot, options, progress)
    if not recordings.validation:
        return fitted
    if options.seconds is not None and time.monotonic() - began > options.seconds:
        return fitted
    return with_torque(fitted, recordings.splits, robot, options.nthread)


def _fit_positions(
    recordings: Recordings,
    given: RobotSpec,
    options: IdentifyOptions,
    progress: Progress,
) -> Identified:
    """Fit to positions."""
    # Stops that nobody confirmed are taken back in the end, by `_fitted`.
    robot = with_stops(given, recordings.fitted)
    heights = tip_heights(recordings.fitted, robot)
    contact = contact_height(robot, heights)
    makers = _makers_of_steps(options)
    fits = _fits(recordings, robot, given, options, progress, contact, steps=len(makers))
    classic = fit_classic(fits, joints_alone=options.joints_alone)
    steps = [make(fits) for make in makers]
    state, comparisons, untried = with_steps(steps, fits, classic)
    errors = _standard_errors(state)
    robots = _robots(fits, state)
    without_table = robots[-1]  # of the last set of recordings, as all that is returned
    if state.chosen == "given":
        without_table = robot  # which has the stops, unlike robots[-1]
    table = None
    if options.table and robot.scene.tips:
        windows = low_windows(recordings.fitted, heights, contact)
        lowest = min(float(height.min()) for height in heights)
        table = _fit_table(fits, windows, without_table, lowest, recordings.validation)
    fitted = _fitted(given, without_table, state, table, keep_stops=options.stops)
    warnings = _warnings_of_steps(steps, state, untried)
    warnings += _warnings_of_values(fits, state, errors)
    warnings += stop_questions(given, robot)
    warnings += far_from_servo_type(fitted)
    warnings += errors.sentences
    fits.progress.show("validation motions, with the fitted robot and from recorded torque")
    given_values = [joints.bounds.first for joints in fits.joints]
    return Identified(
        robot=fitted,
        before=float(fits.judge.errors(given_values).mean()),
        after=float(fits.judge.errors(state.values, state.links).mean()),
        chosen=state.chosen,
        warnings=tuple(warnings),
        std=errors.std,
        comparisons=comparisons,
        table_fit=table,
        by_joint=_errors_by_joint(fits, given_values, state),
        covariance=errors.covariance,
        undetermined=errors.undetermined,
        held_out=tuple(_held_out(recordings, fitted, robots)),
        findings=_findings(recordings, state, fitted, errors),
        links=state.link_fit[1] if state.link_fit else None,
        without_terms=_without_terms(fits, classic, fitted),
    )


def _fits(
    recordings: Recordings,
    robot: RobotSpec,
    given: RobotSpec,
    options: IdentifyOptions,
    progress: Progress,
    contact: float,
    *,
    steps: int,
) -> Fits:
    """Return the fits of all sets, and their judge.

    Args:
        robot: Start of the fits: `given` with the stops that recordings show.
        contact: Height under which a tip may touch, m.
        steps: Number of steps after the classic fit, among which the time is divided.
    """
    sets = recordings.fitted_sets
    shown = SearchProgress(options.seconds, steps, len(sets), progress)
    joints = []
    for recordings_of_set in sets:
        windows = cut(recordings_of_set, options.windows)
        rollouts = JointRollouts(windows, robot, contact, options.nthread)
        joints.append(JointFit(rollouts, robot, Bounds(robot, recordings_of_set)))
    fitted_windows = joints[0].rollouts.parts
    judging = [split.held_out or fitted_windows for split in recordings.splits]
    judge = Judge(judging, robot, contact, options.nthread)
    return Fits(sets, given, joints, judge, shown, options.nthread)


def _makers_of_steps(options: IdentifyOptions) -> list[Callable[[Fits], Step]]:
    """Return what makes the steps after the classic fit, in their order."""
    makers: list[Callable[[Fits], Step]] = []
    for term in options.terms or NO_TERMS:
        if term == "backlash":
            makers.append(Backlash)
        else:
            makers.append(partial(ServoTerm, term))
    if options.masses:
        makers.append(LinkMasses)
    return makers


def with_steps(
    steps: ListOf[Step],
    fits: Fits,
    state: FitState,
) -> tuple[FitState, tuple[Comparison, ...], list[str]]:
    """Return the state with the steps that the judge accepts, its comparisons, and names of steps
    without time.
    """
    comparisons: list[Comparison] = []
    untried: list[str] = []
    for step in steps:
        if fits.progress.all_is_over():
            untried.append(step.name)
            continue
        if not step.applies(state):
            continue
        proposed = step.propose(state)
        comparison = fits.judge.compare(step.name, state, proposed)
        comparisons.append(comparison)
        state = state.after(proposed, accepted=comparison.accepted)
    is_any_accepted = any(comparison.accepted for comparison in comparisons)
    if state.chosen == "given" and is_any_accepted:
        state = replace(state, chosen="whole")
    return _with_servo_slopes(state), tuple(comparisons), untried


def _with_servo_slopes(state: FitState) -> FitState:
    """Return the state with how the servos follow its links, if it has some."""
    if state.link_fit is None:
        return state
    fit, result = state.link_fit
    slopes = fit.servo_slopes(result)
    return replace(state, link_fit=(fit, replace(result, servo_slopes=slopes)))


def _standard_errors(state: FitState) -> StandardErrors:
    """Return the standard errors of the last set's values, in the simulator of the whole robot."""
    whole = state.robots[-1]
    if state.links:
        whole.rollouts.robot = replace(whole.rollouts.robot, links=state.links[-1])
    return standard_errors(whole, state.values[-1])


def _fit_table(
    fits: Fits,
    windows: list[Sequence],
    robot: RobotSpec,
    lowest: float,
    validation: ListOf[Sequence],
) -> TableFit:
    """Fit the table under a robot with fitted servos, in the time that is left.

    Args:
        windows: Those in which a tip is low.
        lowest: Least height of a tip, m.
    """
    fits.progress.begin_table()
    report = fits.progress.report_table
    return fit_table(windows, robot, lowest, fits.nthread, report, validation)


def _warnings_of_steps(
    steps: ListOf[Step],
    state: FitState,
    untried: ListOf[str],
) -> list[str]:
    """Return what the user has to know about steps; `untried` are the names of those without
    time.
    """
    warnings = []
    if untried:
        names = ", ".join(untried)
        warnings.append(f"the time was over before {names}: give more, or no limit, to try them")
    for step in steps:
        warnings += step.warnings(state)
    return warnings


def _warnings_of_values(
    fits: Fits,
    state: FitState,
    errors: StandardErrors,
) -> list[str]:
    """Return sentences about fitted values at a bound, and values that contradict the file."""
    bounds = fits.joints[-1].bounds
    values = state.values[-1]
    at_bound = bounds.warnings(values, fitted_fields(values))
    return [*at_bound, *contradicted_gains(bounds, values, errors.std)]


def _robots(fits: Fits, state: FitState) -> list[RobotSpec]:
    """Return the robot of each set."""
    robots = []
    for i, values in enumerate(state.values):
        robot = fits.given
        if state.chosen != "given":
            robot = with_values(fits.joints[i].robot, values)
        if state.links:
            robot = replace(robot, links=state.links[i])
        robots.append(robot)
    return robots


def _fitted(
    given: RobotSpec,
    without_table: RobotSpec,
    state: FitState,
    table: TableFit | None,
    *,
    keep_stops: bool,
) -> RobotSpec:
    """Return the robot with the table, and with the given stops unless the fitted ones are kept."""
    fitted = without_table
    has_table = False
    if table is not None:
        fitted = table.robot
        has_table = table.accepted
    if keep_stops:
        return fitted
    if state.chosen == "given" and not has_table:
        return given
    return fitted.with_servo(stop_low=given.servo.stop_low, stop_high=given.servo.stop_high)


def _without_terms(
    fits: Fits,
    classic: FitState,
    fitted: RobotSpec,
) -> RobotSpec | None:
    """Return the classic fit with the table, zeros and stops of `fitted`, which has terms of the
    servo model.
    """
    given = fits.given
    if given.servo.has_terms or not fitted.servo.has_terms:
        return None
    if fitted.links != given.links:
        return None
    plain = with_values(fits.joints[-1].robot, classic.base[-1]).with_table(fitted.scene.table)
    return plain.with_servo(
        zero=fitted.servo.zero,
        stop_low=fitted.servo.stop_low,
        stop_high=fitted.servo.stop_high,
    )


def _held_out(
    recordings: Recordings,
    fitted: RobotSpec,
    robots: ListOf[RobotSpec],
) -> list[HeldOut]:
    """Return the recordings that judge, and the robot that was fitted without them."""
    if not recordings.validation:
        return []
    if len(recordings.splits) == 1:
        return [HeldOut(recordings.validation, fitted)]
    folds = []
    for i, split in enumerate(recordings.splits):
        with_table = robots[i].with_table(fitted.scene.table)
        own = with_table.with_servo(
            stop_low=fitted.servo.stop_low, stop_high=fitted.servo.stop_high
        )
        folds.append(HeldOut(split.held_out, own))
    return folds


def _errors_by_joint(
    fits: Fits,
    given_values: list[Values],
    state: FitState,
) -> dict[str, tuple[float, float]]:
    """Return joint → mean |error| on motions that judge, of the given robot and of the fitted one,
    rad.
    """
    before = fits.judge.errors_by_joint(given_values).tolist()
    after = fits.judge.errors_by_joint(state.values, state.links).tolist()
    return {joint: (before[i], after[i]) for i, joint in enumerate(fits.given.operated)}


def _findings(
    recordings: Recordings,
    state: FitState,
    fitted: RobotSpec,
    errors: StandardErrors,
) -> tuple[str, ...]:
    """Return sentences about temperature, backlash and links."""
    findings = [*temperature_findings(recordings.fitted, fitted, errors.std)]
    if state.gaps is not None:
        findings += backlash.findings(fitted.operated, *state.gaps, errors.std)
    if state.link_fit is not None:
        findings += state.link_fit[1].sentences()
    return tuple(findings)
