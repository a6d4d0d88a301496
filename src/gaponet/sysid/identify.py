"""Identification: the servo parameters with which rollouts of the simulator follow the recordings best.

Per operated joint these are kp, total damping, dry friction, armature, zero offset and command delay, then the terms of
the servo model (sim/servo.py) that validation motions accept. Steps:

1. Fit every joint by itself beside the recording, from several starts (joint_rollouts.py).
2. Fit all joints together in the simulator of the robot, from there and from the robot's file (robot_rollouts.py). The
   first iterations say whether that helps; if not, this step ends there.
3. Choose among the given robot, a delay and an offset by joint, and these fits by motions that were not fitted
   (acceptance.py); add terms of the servo model one by one. Where few motions validate, cross-validation chooses.
4. On request, fit masses and inertias of the links with the servos, judged as a term is (link_fit.py).
5. Fit the table under the tips (table_contact.py).
6. Compare with a fit that begins with recorded torque (torque.py), and with speed-limited targets (motion_limits.py).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.robot.servo_fields import SERVO_FIELDS, TERMS, Term
from gaponet.robot.spec import RobotSpec
from gaponet.sim.links import LinkResult
from gaponet.sim.metrics import Comparison
from gaponet.sim.temperature import temperature_findings
from gaponet.sysid import backlash
from gaponet.sysid.acceptance import (
    MIN_JUDGES,
    HeldOut,
    Identified,
    Judge,
    Links,
    Split,
    cross_validation,
)
from gaponet.sysid.axes import CLASSIC, Bounds, Values, with_values
from gaponet.sysid.joint_rollouts import ERROR_SCALE_RAD, JointRollouts
from gaponet.sysid.link_fit import LinkFit
from gaponet.sysid.motion_limits import default_terms, stop_questions, with_speed_limits, with_stops
from gaponet.sysid.problem import (
    CHAIN_ITERATIONS,
    SEARCH_ITERATIONS,
    JointFit,
    RobotFit,
    fitted_fields,
    robot_fields,
    standard_errors,
)
from gaponet.sysid.robot_rollouts import cut
from gaponet.sysid.servo_types import far_from_servo_type
from gaponet.sysid.table_contact import contact_height, fit_table, low_windows, tip_heights
from gaponet.sysid.torque import TorqueFit, with_torque

ONE_PAYLOAD = (
    "masses and gains are known up to a common factor: record two payloads before you trust a third"
)
# In the judge's order: the given robot, then the default, which others replace only where they are clearly better.
CANDIDATES = ("given", "limbs", "joints", "whole", "delay and offset")
FOLDS = 3  # of the cross-validation
WINDOWS = 40  # of joints by themselves
ROBOT_ITERATIONS = (2, 3)  # of the whole robot: from both starts, from the better one
POLISH_ITERATIONS = 2  # of the whole robot with a term of the servo model
JOINTS_TIME_SHARE, ROBOT_TIME_SHARE, TERMS_TIME_SHARE = 0.3, 0.4, 0.3  # of a time budget

Progress = Callable[
    [float, float, str], None
]  # iterations done, in all, what is fitted and its error


class _SearchProgress:
    """Progress of the searches; and the time that each may take, where the time is limited."""

    def __init__(self, seconds: float | None, terms: int, fits: int, progress: Progress) -> None:
        """Begin the time of the searches of so many terms in so many fits, s; None for no limit."""
        joints = sum(SEARCH_ITERATIONS)
        robot = sum(ROBOT_ITERATIONS) + CHAIN_ITERATIONS
        each = [joints] * fits + [robot * fits] + [joints + POLISH_ITERATIONS] * (fits * terms)
        term = TERMS_TIME_SHARE / (terms + 1)
        shares = [JOINTS_TIME_SHARE] * fits + [ROBOT_TIME_SHARE * fits] + [term] * (fits * terms)
        self._began, self._seconds, self._progress = time.monotonic(), seconds, progress
        self._last_of = np.cumsum(each).tolist()  # number of each search's last iteration
        # Of the time that is left when a search begins: as much as of one more term stays.
        self._shares = [share / (sum(shares[i:]) + fits * term) for i, share in enumerate(shares)]
        self._total, self._done, self._end, self._search = self._last_of[-1], 0, np.inf, 0
        self.untried: tuple[Term, ...] = ()  # terms for which no time was left
        self.tell(0, "inertias along the recordings")

    def tell(self, done: float, what: str) -> None:
        """Report iterations done, inf after the last search, and what comes next."""
        self._progress(min(done, self._total), self._total, what)

    def begin(self) -> None:
        """Begin the next search, which may take its share of the time that is left."""
        elapsed = time.monotonic() - self._began
        left = np.inf if self._seconds is None else max(self._seconds - elapsed, 0.0)
        self._end = elapsed + self._shares[self._search] * left
        self._done = self._last_of[self._search - 1] if self._search else 0
        self._search += 1

    def expired(self) -> bool:
        """Return whether the time of the present search is over."""
        return time.monotonic() - self._began > self._end

    def over(self) -> bool:
        """Return whether the time of all searches is over."""
        return self._seconds is not None and time.monotonic() - self._began > self._seconds

    def report(self, what: str, joints: tuple[str, ...], rows: Array) -> Callable[[Array], bool]:
        """Return a function of the costs (n,) of problems of so many rows (n,), which says whether to end the search.

        It is called in each iteration.
        """

        def tell(cost: Array) -> bool:
            each = 1e3 * ERROR_SCALE_RAD * np.sqrt(2 * cost / np.maximum(rows, 1))
            self._done += 1
            self.tell(
                self._done,
                f"{what}: {each.mean():.2f} mrad, {joints[int(each.argmax())]} {each.max():.2f}",
            )
            return self.expired()

        return tell


def identify(
    sequences: ListOf[Sequence],
    robot: RobotSpec,
    validation: ListOf[Sequence] = (),
    windows: int = WINDOWS,
    terms: tuple[Term, ...] | None = None,
    table: bool = True,
    nthread: int = 0,
    progress: Progress = lambda done, total, note: None,
    budget: float | None = None,
    stops: bool = False,
    folds: int = FOLDS,
    masses: bool = False,
    joints_alone: bool = False,
) -> Identified:
    """Fit the parameters of all operated joints.

    Where fewer than three motions validate a set of joints, all recordings are fitted in the end, and cross-validation
    over their motions chooses among candidates.

    Args:
        sequences: Recordings to fit; validation and test motions stay out.
        robot: Start of the fit; its payload masses are taken as true, its gains where recordings state them.
        validation: Recordings that choose among candidates; without them the fitted windows do.
        windows: Number of rollouts of 8 s, taken evenly from the recordings.
        terms: Terms of the servo model, from TERMS, in the order in which they are fitted;
            default: motion_limits.default_terms.
        table: Fit a table under the robot's tips.
        budget: Time of the searches, s, without the table's. A search that has begun ends, and no further term is
            tried. Results are the same on every machine only without it.
        stops: Give joints that stayed behind several commands a stop there.
        folds: Folds of the cross-validation, at most; 1 for none.
        masses: Fit masses, centres of mass and inertias of the links too.
        joints_alone: Fit each joint by itself, and skip the fit of the whole robot, which takes longest.
    """
    terms = default_terms(sequences, robot) if terms is None else terms
    splits = cross_validation(sequences, validation, folds)
    options = (
        splits,
        validation,
        windows,
        terms,
        table,
        nthread,
        progress,
        stops,
        masses,
        joints_alone,
    )

    def fit(one: RobotSpec, seconds: float | None) -> Identified:
        fitted = _fit_robot(sequences, one, *options, seconds)
        return with_torque(fitted, splits, one, nthread) if validation else fitted

    return with_speed_limits(fit, sequences, robot, budget) if validation else fit(robot, budget)


def _fit_robot(
    sequences: ListOf[Sequence], robot: RobotSpec, splits: ListOf[Split], validation: ListOf[Sequence], windows: int,
    terms: tuple[Term, ...], table: bool, nthread: int, progress: Progress, stops: bool,
    masses: bool, joints_alone: bool, budget: float | None,
) -> Identified:  # fmt: skip
    """Fit to positions, with the speed limits that the robot's servos have; arguments as of `identify`."""
    given, robot = (
        robot,
        with_stops(robot, sequences),
    )  # stops that nobody confirmed are taken back in the end
    heights = tip_heights(sequences, robot)
    contact = contact_height(robot, heights)
    fitted_sets = [train for train, _ in splits] + [[*sequences, *validation]] * (len(splits) > 1)
    fits = [
        JointFit(
            JointRollouts(cut(train, windows), robot, contact, nthread), robot, Bounds(robot, train)
        )
        for train in fitted_sets
    ]
    judge = Judge(
        [held_out or fits[0].rollouts.parts for _, held_out in splits], robot, contact, nthread
    )
    searches = _SearchProgress(budget, len(terms) + masses, len(fits), progress)
    classic = _fit_classic(fits, judge, given, nthread, searches, joints_alone)
    wholes = classic.wholes
    chosen = classic.chosen
    comparisons, values, gaps = _with_terms(
        fits,
        wholes if classic.together else [],
        judge,
        terms,
        classic.values,
        classic.base,
        searches,
    )
    linked, links = None, list[Links]()
    if masses:
        start = values if any(c.accepted for c in comparisons) else classic.base
        gains = [
            {j: (g.kp, g.error) for j, g in TorqueFit(one, robot).known.items()}
            for one in fitted_sets
        ]
        comparison, linked, links, values = _with_links(
            wholes, judge, start, values, gains, searches
        )
        comparisons = *comparisons, comparison
    chosen = "whole" if chosen == "given" and any(c.accepted for c in comparisons) else chosen
    joints, whole, first = fits[-1], wholes[-1], [one.bounds.first for one in fits]
    whole.rollouts.robot = replace(robot, links=links[-1]) if links else robot
    errors = standard_errors(whole, values[-1])
    robots = [with_values(robot, v) if chosen != "given" else given for v in values]
    if links:
        robots = [replace(one, links=own) for one, own in zip(robots, links, strict=True)]
    fitted, table_fit = robots[-1] if chosen != "given" else robot, None
    if table and robot.tips:
        low, lowest = low_windows(sequences, heights, contact), min(h.min() for h in heights)
        tell = lambda error: searches.tell(np.inf, f"table {error * 1e3:.2f} mrad")  # noqa: E731
        table_fit = fit_table(low, fitted, lowest, nthread, tell, validation)
        fitted = table_fit.robot
    if not stops:
        fitted = replace(fitted, stop_low=given.stop_low, stop_high=given.stop_high)
        fitted = given if chosen == "given" and not (table_fit and table_fit.accepted) else fitted
    held_out = [HeldOut(list(validation), fitted)] if validation else []
    if len(splits) > 1:
        held_out = [
            HeldOut(
                part,
                replace(
                    one, table=fitted.table, stop_low=fitted.stop_low, stop_high=fitted.stop_high
                ),
            )
            for (_, part), one in zip(splits, robots, strict=False)
        ]
    one_payload = bool(links and robot.payload_mounts and not gains[-1])
    one_payload = one_payload and len({s.meta.payload_mass for s in sequences}) == 1
    untried = f"the time was over before {', '.join(searches.untried)}: give more, or no limit, to try more terms"
    warnings = (
        *[untried] * bool(searches.untried), *[ONE_PAYLOAD] * one_payload,
        *joints.bounds.warnings(values[-1], fitted_fields(values[-1])),
        *stop_questions(given, robot), *far_from_servo_type(fitted), *errors.sentences,
    )  # fmt: skip
    pairs = (first, ()), (values, links)
    before, after = (float(judge.errors(*pair).mean()) for pair in pairs)
    by_joint = zip(*(judge.errors_by_joint(*pair).tolist() for pair in pairs), strict=True)
    searches.tell(np.inf, "the fitted robot, and recorded torque")
    findings = temperature_findings(sequences, fitted, errors.std)
    findings += backlash.findings(robot.operated, *gaps, errors.std) if gaps else ()
    return Identified(
        fitted, before, after, chosen, warnings, errors.std, comparisons, table_fit,
        dict(zip(robot.operated, by_joint, strict=True)), errors.covariance,
        errors.undetermined, tuple(held_out), (*findings, *(linked.sentences() if linked else ())), linked,
    )  # fmt: skip


@dataclass(frozen=True)
class _Classic:
    """Fit of the classic fields. Lists have an item for each set of fitted recordings.

    Attributes:
        wholes: Fits in the simulator of the whole robot, for later steps.
        together: All joints were fitted together, because that helps.
        chosen: Best candidate.
        values: Its values, (n,) each.
        base: Values from which terms of the servo model are fitted.
    """

    wholes: list[RobotFit]
    together: bool
    chosen: str
    values: list[Values]
    base: list[Values]


def _fit_classic(
    fits: ListOf[JointFit],
    judge: Judge,
    given: RobotSpec,
    nthread: int,
    searches: _SearchProgress,
    joints_alone: bool,
) -> _Classic:
    """Fit the classic fields, joints by themselves and then together, and choose among the candidates."""
    each = [_joint_candidates(joints, searches) for joints in fits]
    wholes = [joints.robot_fit(nthread) for joints in fits]
    candidates = {name: [one[name] for one in each] for name in each[0]}
    searches.begin()
    together: dict[str, list[Values]] = {}
    if not joints_alone:
        together = _robot_candidates(wholes, judge, candidates["joints"], searches)
    candidates |= together
    candidates = {name: candidates[name] for name in CANDIDATES if name in candidates}
    if given.nominal is not None:
        chosen, values = judge.best_by_joint(candidates)
        return _Classic(wholes, bool(together), chosen, values, values)
    chosen, values = judge.best(candidates)
    base = values
    if chosen == "given":
        base = candidates["limbs"] if together else candidates["joints"]
    return _Classic(wholes, bool(together), chosen, values, base)


def _joint_candidates(joints: JointFit, searches: _SearchProgress) -> dict[str, Values]:
    """Fit each joint by itself; return the given values, a delay and an offset, and the classic fields."""
    bounds, names, residual = joints.bounds, joints.robot.operated, joints.prior.residual
    given = {f: bounds.first[f] for f in bounds.start}  # without terms that the robot does not have
    searches.begin()
    report = searches.report("joints, each on its own", names, joints.rollouts.rows)
    late = joints.search(
        ("offset", "delay"), given, only=True, report=lambda cost: searches.expired()
    )
    joints.prior.residual = residual  # of other fields' searches
    alone = joints.search(CLASSIC, bounds.start, joints.regressed(), report=report)
    joints.prior.update_correlation_time(joints.rollouts, alone)
    return {"given": given, "joints": alone, "delay and offset": late}


def _robot_candidates(
    wholes: ListOf[RobotFit], judge: Judge, alone: list[Values], searches: _SearchProgress
) -> dict[str, list[Values]]:
    """Fit all joints together, from their own fits and from the robot's file; return nothing if that does not help.

    The first iterations decide by the motions that were not fitted, if there are enough of them. Few windows are fitted
    together, so that later iterations follow these closer and others less: on the real SO-101, the whole search ends
    0.2 mrad worse.
    """
    names = wholes[0].robot.operated

    def together(iterations: tuple[int, ...]) -> list[Values]:
        fitted = []
        for whole, own in zip(wholes, alone, strict=True):
            report = searches.report("whole robot", names, whole.rollouts.rows)
            starts = (own, whole.bounds.start)
            fitted.append(whole.descend(CLASSIC, starts[1], starts, iterations, report=report))
        return fitted

    if len(set(judge.names.tolist())) >= MIN_JUDGES:
        first = together(ROBOT_ITERATIONS[:1])
        if judge.errors(first).mean() >= judge.errors(alone).mean():
            return {}
    whole_robot = together(ROBOT_ITERATIONS)
    if searches.expired():
        return {"whole": whole_robot, "limbs": whole_robot}
    chains = []
    for whole, values in zip(wholes, whole_robot, strict=True):
        chains.append(
            whole.descend_chains(
                values, lambda joints, rows: searches.report("kinematic chains", joints, rows)
            )
        )
    return {"whole": whole_robot, "limbs": chains}


def _with_terms(
    fits: ListOf[JointFit], wholes: ListOf[RobotFit], judge: Judge, terms: tuple[Term, ...], values: list[Values],
    base: list[Values], searches: _SearchProgress,
) -> tuple[tuple[Comparison, ...], list[Values], tuple[Array, Array] | None]:  # fmt: skip
    """Fit terms of the servo model one by one, each from `base`; add a term to the values if it is accepted.

    With `wholes`, each term is also polished in the simulator of the whole robot, where that helps.

    Backlash that the robot lacks is fitted if it is worth a search. Its widths, rad, and probabilities are returned,
    (n,).
    """
    comparisons, gaps = list[Comparison](), None
    for i, term in enumerate(terms):
        first = TERMS[term][0]
        if searches.over():
            searches.untried = terms[i:]
            break
        if term == "backlash" and (
            "backlash" in base[-1] or not backlash.worth_a_search(fits[-1], base[-1])
        ):
            continue
        alone = [_fit_term(term, *one, searches) for one in zip(fits, base, strict=True)]
        richer = alone
        if wholes and not any(SERVO_FIELDS[f].single_joint for f in TERMS[term]):
            polished = [_polish(term, *one, searches) for one in zip(wholes, alone, strict=True)]
            if judge.errors(polished).mean() < judge.errors(alone).mean():
                richer = polished
        richer = [
            v | {first: fit.bounds.visible(first, v)} for fit, v in zip(fits, richer, strict=True)
        ]
        if term == "backlash":
            without = fits[-1].search((), base[-1], report=lambda cost: searches.expired())
            chance = backlash.probability(fits[-1], without, alone[-1])
            gaps = richer[-1]["backlash"], chance
            richer = backlash.only_probable(values, richer, chance)
        comparisons.append(judge.compare(term, values, richer))
        if comparisons[
            -1
        ].accepted:  # a term that is zero in every joint only gave the others more iterations
            used = any(v[first].any() for v in richer)
            values = base = [
                {f: x for f, x in v.items() if f not in TERMS[term] or used} for v in richer
            ]
    return tuple(comparisons), values, gaps


def _with_links(
    wholes: ListOf[RobotFit],
    judge: Judge,
    start: list[Values],
    values: list[Values],
    gains: list[dict[str, tuple[float, float]]],
    searches: _SearchProgress,
) -> tuple[Comparison, LinkResult | None, list[Links], list[Values]]:
    """Fit the links with the servos from `start`; return them and the servos' values if they are better."""
    results, fits = (
        list[LinkResult](),
        [LinkFit(*one) for one in zip(wholes, start, gains, strict=True)],
    )
    for fit in fits:
        searches.begin()
        report = searches.report(
            "masses", ("all joints",), fit.whole.rollouts.rows.sum(keepdims=True)
        )
        results.append(fit.descend(report))
    links, servos = [r.axes.links(r.x) for r in results], [r.values for r in results]
    before = judge.errors(values)
    comparison = Comparison(
        "masses", before, judge.errors(servos, links) if results[-1].x.any() else before
    )
    slopes = fits[-1].servo_slopes(results[-1]) if comparison.accepted else {}
    accepted = comparison, replace(results[-1], servo_slopes=slopes), links, servos
    return accepted if comparison.accepted else (comparison, None, [], values)


def _fit_term(term: Term, joints: JointFit, values: Values, searches: _SearchProgress) -> Values:
    """Fit a term from values (n,), each joint by itself."""
    searches.begin()
    report = searches.report(term, joints.robot.operated, joints.rollouts.rows)
    start = values | {f: joints.bounds.guess[f] for f in TERMS[term]}
    return joints.search(TERMS[term], start, report=report)


def _polish(term: Term, whole: RobotFit, values: Values, searches: _SearchProgress) -> Values:
    """Fit values (n,) with a term once more, all joints together."""
    names = whole.robot.operated
    report = searches.report(f"{term}, whole robot", names, whole.rollouts.rows)
    fields = robot_fields(values)
    return whole.descend(fields, values, (values,), (POLISH_ITERATIONS,), report=report)
