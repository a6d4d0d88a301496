"""Acceptance of candidates on validation motions, and the result of an identification."""

from __future__ import annotations

from collections.abc import Iterable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.data.split import hash_order
from gaponet.robot.spec import Link, RobotSpec
from gaponet.sim.links import LinkResult
from gaponet.sim.metrics import MIN_RELATIVE_GAIN, MIN_RELATIVE_GAIN_ONE_MOTION, Comparison
from gaponet.sim.replay import motion_errors
from gaponet.sysid.axes import Values, one_candidate
from gaponet.sysid.robot_rollouts import RobotRollouts
from gaponet.sysid.table_contact import TableFit, tip_heights

Std = dict[str, dict[str, float]]  # joint → field → standard error
Links = dict[str, Link]  # MJCF body → mass, centre of mass and inertia
# joint → fields (P), (P, P) on the axes of uncertainty.py
Covariance = dict[str, tuple[list[str], Array]]

# Motions: a fit to two of three says little about a fit to all.
MIN_CROSS_VALIDATED = 4
# Motions of each set of recorded joints; fewer cannot validate without cross-validation.
MIN_JUDGES = 3
# Error of a joint, on all recordings, over that with the values of a fold, from which the fit to
# all recordings counts as lost.
LOST_OVER_FOLD = 2.0


class HeldOut(NamedTuple):
    """Recordings, and a robot that was fitted without them."""

    sequences: list[Sequence]
    robot: RobotSpec


def held_out_errors(folds: Iterable[HeldOut]) -> Array:
    """Return the mean |error| of each motion in rollouts of the robot that was fitted without it,
    (motions,) rad.
    """
    return np.concatenate([motion_errors(sequences, robot) for sequences, robot in folds])


class Judged(Protocol):
    """A candidate for comparison: values and links of each fold."""

    @property
    def values(self) -> list[Values]: ...

    @property
    def links(self) -> list[Links]: ...


class Split(NamedTuple):
    """Recordings to fit, and recordings that judge the fit."""

    fitted: list[Sequence]
    held_out: list[Sequence]


def cross_validation(
    sequences: ListOf[Sequence],
    validation: ListOf[Sequence],
    folds: int,
) -> list[Split]:
    """Return folds by motion, or the given split if at least MIN_JUDGES motions validate each set
    of recorded joints.

    Motions of one set of joints are dealt out to the folds. A set with a single motion is fitted in
    every fold.
    """
    every = [*sequences, *validation]
    motions = _motions(every)
    most_motions = max(len(names) for names in motions.values())
    folds = min(folds, most_motions)
    if not validation or folds < 2 or not _needs_cross_validation(motions, _motions(validation)):
        return [Split(list(sequences), list(validation))]
    return [_split(every, motions, number, folds) for number in range(folds)]


# Joints that a recording does not hold → names of independent motions, in the order of their
# hashes.
_Motions = dict[tuple[str, ...], list[str]]


def _motions(sequences: ListOf[Sequence]) -> _Motions:
    """Return the motions of each set of joints."""
    names: _Motions = {}
    for s in sequences:
        names.setdefault(s.meta.unrecorded, []).append(s.meta.independent_motion)
    return {unrecorded: hash_order(motions) for unrecorded, motions in names.items()}


def _needs_cross_validation(motions: _Motions, judges: _Motions) -> bool:
    """Return whether there are enough motions for it, and too few in validation for some set of
    joints.
    """
    every = set[str]().union(*motions.values())
    if len(every) < MIN_CROSS_VALIDATED:
        return False
    judges_of_sets = []
    for unrecorded, names in motions.items():
        if len(names) > 1:
            judges_of_sets.append(len(judges.get(unrecorded, [])))
    return min(judges_of_sets, default=0) < MIN_JUDGES


def _split(
    sequences: ListOf[Sequence],
    motions: _Motions,
    number: int,
    folds: int,
) -> Split:
    """Return the recordings outside and inside one of some folds: each takes every so many motions
    of a set of joints, and none of a set with a single motion.
    """
    fitted: list[Sequence] = []
    held_out: list[Sequence] = []
    for s in sequences:
        names = motions[s.meta.unrecorded]
        place = names.index(s.meta.independent_motion)
        if len(names) > 1 and place % folds == number:
            held_out.append(s)
        else:
            fitted.append(s)
    return Split(fitted, held_out)


@dataclass(frozen=True)
class Identified:
    """Result of an identification.

    Attributes:
        robot: The robot with identified parameters; the given robot if no candidate was better.
        before, after: Mean |error| of the motions that judge, rad: of the given robot, of this one.
        chosen: Best candidate: given, joints (each by itself), whole (all together), limbs
            (kinematic chains), mixed, torque or ramp.
        warnings: Parameters at a bound, what to check, and what the recordings do not determine
            (last).
        std: Joint → field → standard error.
        comparisons: Terms of the servo model in the order in which they were fitted; then torque
            and speed limits.
        table_fit: Result for the table; None if no tip may touch anything.
        by_joint: Joint → mean |error| before and after, rad.
        covariance: Joint → fields and their covariance.
        undetermined: Joint → fields that the recordings do not determine; all of a joint that is
            never moved.
        held_out: Recordings that were not fitted and the robot that was fitted without them, one
            pair for each fold of a cross-validation; `robot` itself where nothing was fitted to
            them afterwards.
        findings: A sentence about each joint that may have backlash, and about each link that
            changed.
        links: Masses and inertias, if they were fitted and accepted.
        without_terms: The best fit without terms of the servo model, if the robot has some: what
            engines without such terms can play.
    """

    robot: RobotSpec
    before: float
    after: float
    chosen: str
    warnings: tuple[str, ...]
    std: Std
    comparisons: tuple[Comparison, ...]
    table_fit: TableFit | None
    by_joint: dict[str, tuple[float, float]] = field(default_factory=dict)
    covariance: Covariance = field(default_factory=dict)
    undetermined: dict[str, tuple[str, ...]] = field(default_factory=dict)
    held_out: tuple[HeldOut, ...] = ()
    findings: tuple[str, ...] = ()
    links: LinkResult | None = None
    without_terms: RobotSpec | None = None

    @property
    def improved(self) -> bool:
        """True if the result differs from the given robot."""
        return self.chosen != "given" or bool(self.table_fit and self.table_fit.accepted)

    def no_gain_message(self, robot: RobotSpec, given: Array, fitted: Array) -> str:
        """Explain why nothing is written, and what to record; errors of the given and the fitted
        robot, rad.
        """
        before = {joint: error for joint, (error, _) in self.by_joint.items()}
        worst = sorted(before, key=lambda joint: -before[joint])[:3]
        joints = ", ".join(f"{joint} {1e3 * before[joint]:.2f}" for joint in worst)
        why = f"; {self.warnings[0]}" if self.warnings else ""
        return (
            f"nothing is written: no fit follows the {len(given)} validation motion(s) better "
            f"than {robot.name} as it is ({1e3 * given.mean():.2f} mrad, best fit "
            f"{1e3 * fitted.mean():.2f}; worst {joints}). Record gaponet excite's motions, every "
            f"joint over its range, slow and fast, and look at gaponet doctor{why}"
        )


class Judge:
    """Errors of candidates on whole motions that they were not fitted to, in the simulator of the
    whole robot.

    A candidate is a list of values (n,): one for each fold, fitted without its motions; then
    perhaps one that was fitted to all recordings, which no motion judges. Repetitions of a motion
    count as one.
    """

    def __init__(
        self,
        folds: ListOf[ListOf[Sequence]],
        robot: RobotSpec,
        contact_height: float,
        nthread: int,
    ) -> None:
        """Take the recordings that judge, fold by fold; rows with a tip below `contact_height`, m,
        do not count.
        """
        self._folds: list[_Fold] = []
        self.rows = 0  # of all recordings
        names: list[str] = []
        for sequences in folds:
            touch = _contact_rows(sequences, robot, contact_height)
            fold = _Fold.of(sequences, RobotRollouts(list(sequences), robot, nthread, touch=touch))
            self._folds.append(fold)
            names += fold.motions
            self.rows += sum(map(len, sequences))
        self.names = np.array(names)  # of all motions, (motions,)
        self._simulated: dict[tuple[int, bytes], Array] = {}  # fold and candidate → its sums

    def _sums(self, candidate: ListOf[Values], links: ListOf[Links] = ()) -> tuple[Array, Array]:
        """Return the sums of |error| over counted rows, rad, and their numbers, by motion and
        joint, (motions, n).
        """
        totals = []
        counts = []
        for number, (fold, values) in enumerate(zip(self._folds, candidate, strict=False)):
            own_links = links[number : number + 1]
            key = (number, _as_bytes(values, own_links))
            if key not in self._simulated:
                self._simulated[key] = fold.sums(values, own_links)
            totals.append(self._simulated[key])
            counts.append(fold.counts())
        return np.concatenate(totals), np.concatenate(counts)

    def errors(self, candidate: ListOf[Values], links: ListOf[Links] = ()) -> Array:
        """Return the mean |error| of each motion, (motions,) rad; `links` of each fold, if they
        are not the robot's.
        """
        total, count = self._sums(candidate, links)
        return np.asarray(total.sum(axis=1) / np.maximum(count.sum(axis=1), 1))

    def errors_by_joint(self, candidate: ListOf[Values], links: ListOf[Links] = ()) -> Array:
        """Return the mean |error| of each joint, (n,) rad."""
        total, count = self._sums(candidate, links)
        of_motions = total / np.maximum(count, 1)  # (motions, n); 0 where a motion does not hold it
        holding = (count > 0).sum(axis=0)
        return np.asarray(of_motions.sum(axis=0) / np.maximum(holding, 1))

    def without_lost_joints(self, candidate: list[Values]) -> list[Values]:
        """Return the candidate, whose last values are those of a fold at joints that follow all
        recordings with half the error with that fold's values.

        No motion judges values that were fitted to all recordings. They should follow these best.
        Where values that were fitted to a part follow them far better, the search ended in a poor
        minimum: a joint whose friction holds it where each window begins, for example.
        """
        folds = len(self._folds)
        if len(candidate) == folds:
            return candidate
        of_values = [self.errors_by_joint([values] * folds) for values in candidate]
        errors = np.stack(of_values)  # (folds + 1, n) rad
        is_lost = errors[-1] > LOST_OVER_FOLD * errors.min(axis=0)
        winner = np.where(is_lost, errors.argmin(axis=0), folds)
        by_number = {str(number): [values] for number, values in enumerate(candidate)}
        return [*candidate[:-1], *_mixed(by_number, winner)]

    def compare(self, name: str, before: Judged, after: Judged) -> Comparison:
        """Compare a state of the fit with the one before it."""
        return Comparison(
            name,
            self.errors(before.values, before.links),
            self.errors(after.values, after.links),
        )

    def best_by_joint(self, candidates: dict[str, list[Values]]) -> tuple[str, list[Values]]:
        """Return name and values of the first candidate, with another one's values at joints whose
        motions accept them.

        Units and payloads of a motion count as one, since a robot that is identified already needs
        evidence to change.
        """
        names = list(candidates)
        of_candidates = [self._joint_errors(values) for values in candidates.values()]
        errors = np.stack(of_candidates)  # (candidates, motions, n) rad; the given robot first
        winner = np.zeros(errors.shape[-1], int)  # number of the candidate of each joint
        for i in range(len(winner)):
            is_held = ~np.isnan(errors[0, :, i])  # (motions,)
            if not is_held.any():
                continue
            of_others = np.nansum(errors[1:, :, i], axis=1)
            best = 1 + int(of_others.argmin())
            given = errors[0, is_held, i]
            if Comparison(names[best], given, errors[best, is_held, i]).accepted:
                winner[i] = best
        if not winner.any():
            return names[0], candidates[names[0]]
        return "mixed", _mixed(candidates, winner)

    def _joint_errors(self, candidate: ListOf[Values]) -> Array:
        """Return the mean |error| of each motion and joint, (motions, n) rad; NaN where a motion
        does not hold it.
        """
        total, count = self._sums(candidate)
        errors = []
        for name in dict.fromkeys(self.names):
            judges = self.names == name
            with np.errstate(invalid="ignore"):  # 0 / 0 where no judge holds a joint
                errors.append(total[judges].sum(axis=0) / count[judges].sum(axis=0))
        return np.stack(errors)

    def best(self, candidates: dict[str, list[Values]]) -> tuple[str, list[Values]]:
        """Return name and values of the best candidate.

        The order of the candidates counts. The second one is the default. Another one replaces it
        if it is accepted by `Comparison`, or better by 10 %. The best values joint by joint
        ("mixed") replace it only if they are accepted. The first candidate, the given robot, is
        returned if no fit is better by 1 %.
        """
        of_candidates = [self.errors_by_joint(values) for values in candidates.values()]
        winner = np.array(of_candidates).argmin(axis=0)  # number of the candidate of each joint
        if len(set(winner.tolist())) > 1:
            candidates = candidates | {"mixed": _mixed(candidates, winner)}
        errors = {name: self.errors(values) for name, values in candidates.items()}
        given, default, *others = candidates
        best = default
        for other in others:
            limit = (1 - MIN_RELATIVE_GAIN_ONE_MOTION) * errors[best].mean()
            is_much_better = other != "mixed" and errors[other].mean() < limit
            if is_much_better or Comparison(other, errors[best], errors[other]).accepted:
                best = other
        is_better = errors[best].mean() < (1 - MIN_RELATIVE_GAIN) * errors[given].mean()
        if not is_better:
            best = given
        return best, candidates[best]


class _JudgeKey(NamedTuple):
    """What recordings have in common that judge as one: repetitions of a motion, pieces of it, and
    the same with other gains.
    """

    motion: str
    unit_id: str
    payload_mass: float
    payload_side: str


def _judge(meta: SequenceMeta) -> _JudgeKey:
    """Return the judge that a recording belongs to."""
    return _JudgeKey(meta.independent_motion, meta.unit_id, meta.payload_mass, meta.payload_side)


@dataclass(frozen=True)
class _Fold:
    """Recordings that judge the candidate of one fold.

    Attributes:
        rollouts: Rollouts beside the recordings.
        motions: Name of each judge's motion.
        rows: Rows of each judge, (rows,) bool each.
    """

    rollouts: RobotRollouts
    motions: list[str]
    rows: list[Array]

    @classmethod
    def of(cls, sequences: ListOf[Sequence], rollouts: RobotRollouts) -> _Fold:
        """Return the judges that have rows."""
        judge_of_window = [_judge(s.meta) for s in sequences]
        motions = []
        rows = []
        for judge in dict.fromkeys(judge_of_window):
            has_window = np.array([other == judge for other in judge_of_window])
            has_row = has_window[rollouts.window]
            if has_row.any():
                motions.append(judge.motion)
                rows.append(has_row)
        return cls(rollouts, motions, rows)

    def sums(self, values: Values, links: ListOf[Links]) -> Array:
        """Return the sums of |error| over the rows of each judge, (judges, n) rad; values (n,)."""
        errors = self.rollouts.flat_errors(one_candidate(values), links)[0]  # (n, rows) rad
        size = np.abs(errors)
        return np.stack([size[:, rows].sum(axis=1) for rows in self.rows])

    def counts(self) -> Array:
        """Return the number of rows of each judge that hold a joint, (judges, n)."""
        return np.stack([self.rollouts.recorded[:, rows].sum(axis=1) for rows in self.rows])


def _as_bytes(values: Values, links: ListOf[Links]) -> bytes:
    """Return a candidate as bytes that no other candidate has."""
    of_fields = [field.encode() + values[field].tobytes() for field in sorted(values)]
    return b"".join(of_fields) + repr(links).encode()


def _mixed(candidates: dict[str, list[Values]], winner: Array) -> list[Values]:
    """Return the values (n,) of each fold, of candidate number winner[i] for joint i; fields that
    all candidates have.
    """
    joints = np.arange(len(winner))
    mixed = []
    for of_fold in zip(*candidates.values(), strict=True):
        values = {}
        for name in of_fold[0]:
            if all(name in candidate for candidate in of_fold):
                by_candidate = np.stack([candidate[name] for candidate in of_fold])
                values[name] = by_candidate[winner, joints]
        mixed.append(values)
    return mixed


def _contact_rows(
    sequences: ListOf[Sequence],
    robot: RobotSpec,
    contact_height: float,
) -> Array | None:
    """Return the rows in which a tip is below a height, (sequences, rows)."""
    if not robot.scene.tips:
        return None
    heights = tip_heights(sequences, robot)
    most_rows = max(len(height) for height in heights)
    touch = np.zeros((len(heights), most_rows), bool)
    for i, height in enumerate(heights):
        touch[i, : len(height)] = height < contact_height
    return touch
