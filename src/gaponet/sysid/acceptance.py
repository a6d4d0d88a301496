"""Acceptance of candidates on validation motions, and the result of an identification."""

from __future__ import annotations

from collections.abc import Iterable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.data.split import hash_order
from gaponet.robot.spec import Link, RobotSpec
from gaponet.sim.links import LinkResult
from gaponet.sim.metrics import MIN_RELATIVE_GAIN, MIN_RELATIVE_GAIN_ONE_MOTION, Comparison
from gaponet.sim.replay import motion_errors
from gaponet.sysid.axes import Values
from gaponet.sysid.robot_rollouts import RobotRollouts
from gaponet.sysid.table_contact import TableFit, tip_heights

Std = dict[str, dict[str, float]]  # joint → field → standard error
Links = dict[str, Link]  # MJCF body → mass, centre of mass and inertia
# joint → fields (P), (P, P) on the axes of uncertainty.py
Covariance = dict[str, tuple[list[str], Array]]

MIN_CROSS_VALIDATED = 4  # motions; a fit to two of three says little about a fit to all
# motions of each set of recorded joints; fewer are too few to validate without cross-validation
MIN_JUDGES = 3


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


Split = tuple[list[Sequence], list[Sequence]]  # recordings to fit, recordings that judge


def cross_validation(
    sequences: ListOf[Sequence], validation: ListOf[Sequence], folds: int
) -> list[Split]:
    """Return folds by motion, or the given split if at least MIN_JUDGES motions validate each set
    of recorded joints.

    Motions of one set of joints are dealt out to the folds. A set with a single motion is fitted in
    every fold.
    """
    every = [*sequences, *validation]
    motions = _motions(every)
    judges = _motions(validation)
    several = [joints for joints, names in motions.items() if len(names) > 1]
    enough = min((len(judges.get(joints, ())) for joints in several), default=0)
    count = min(folds, max(map(len, motions.values())))
    few = len({s.meta.independent_motion for s in every}) < MIN_CROSS_VALIDATED
    if not validation or enough >= MIN_JUDGES or count < 2 or few:
        return [(list(sequences), list(validation))]
    fold = {}
    for joints in several:
        for i, name in enumerate(motions[joints]):
            fold[joints, name] = i % count
    return [_split(every, fold, i) for i in range(count)]


def _split(
    sequences: ListOf[Sequence], fold: dict[tuple[tuple[str, ...], str], int], number: int
) -> Split:
    """Return the recordings outside and inside a fold; `fold` has its number by unrecorded joints
    and motion.
    """
    fitted: list[Sequence] = []
    held_out: list[Sequence] = []
    for s in sequences:
        own = fold.get((s.meta.unrecorded, s.meta.independent_motion))
        (held_out if own == number else fitted).append(s)
    return fitted, held_out


def _motions(sequences: ListOf[Sequence]) -> dict[tuple[str, ...], list[str]]:
    """Return joints that recordings do not hold → names of their independent motions, in the order
    of their hashes.
    """
    names: dict[tuple[str, ...], list[str]] = {}
    for s in sequences:
        names.setdefault(s.meta.unrecorded, []).append(s.meta.independent_motion)
    return {joints: hash_order(motions) for joints, motions in names.items()}


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
        worst = sorted(self.by_joint, key=lambda joint: -self.by_joint[joint][0])[:3]
        joints = ", ".join(f"{joint} {1e3 * self.by_joint[joint][0]:.2f}" for joint in worst)
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
        self, folds: ListOf[ListOf[Sequence]], robot: RobotSpec, contact_height: float, nthread: int
    ) -> None:
        """Take the recordings that judge, fold by fold; rows with a tip below `contact_height`, m,
        do not count.
        """
        # rollouts, and the rows of each motion
        self._folds: list[tuple[RobotRollouts, list[Array]]] = []
        names = []
        for sequences in folds:
            touch = _contact_rows(sequences, robot, contact_height)
            rollouts = RobotRollouts(list(sequences), robot, nthread, touch=touch)
            # Repetitions, pieces and gains of what one unit plays with one payload are one judge.
            metas = [s.meta for s in sequences]
            keys = [
                (m.independent_motion, m.unit_id, m.payload_mass, m.payload_side) for m in metas
            ]
            rows = {
                one: np.array([key == one for key in keys])[rollouts.window]
                for one in dict.fromkeys(keys)
            }
            rows = {key: counted for key, counted in rows.items() if counted.any()}
            self._folds.append((rollouts, list(rows.values())))
            names += [motion for motion, *_ in rows]
        self.names = np.array(names)  # of all motions, (motions,)
        self.rows = sum(len(s) for sequences in folds for s in sequences)  # of all recordings
        self._sums_of: dict[tuple[int, bytes], Array] = {}

    def _sums(self, candidate: ListOf[Values], links: ListOf[Links] = ()) -> tuple[Array, Array]:
        """Return the sums of |error| over counted rows, rad, and their numbers, by motion and
        joint, (motions, n).
        """
        totals = []
        counts = []
        for k, ((rollouts, motions), values) in enumerate(
            zip(self._folds, candidate, strict=False)
        ):
            own = links[k : k + 1]
            key = (
                k,
                b"".join(f.encode() + values[f].tobytes() for f in sorted(values))
                + repr(own).encode(),
            )
            if key not in self._sums_of:
                size = np.abs(rollouts.flat_errors({f: v[None] for f, v in values.items()}, own))[0]
                self._sums_of[key] = np.stack([size[:, rows].sum(axis=1) for rows in motions])
            totals.append(self._sums_of[key])
            counts += [rollouts.recorded[:, rows].sum(axis=1) for rows in motions]
        return np.concatenate(totals), np.stack(counts)

    def errors(self, candidate: ListOf[Values], links: ListOf[Links] = ()) -> Array:
        """Return the mean |error| of each motion, (motions,) rad; `links` of each fold, if they
        are not the robot's.
        """
        total, count = self._sums(candidate, links)
        return np.asarray(total.sum(axis=1) / np.maximum(count.sum(axis=1), 1))

    def errors_by_joint(self, candidate: ListOf[Values], links: ListOf[Links] = ()) -> Array:
        """Return the mean |error| of each joint, (n,) rad."""
        total, count = self._sums(candidate, links)
        return np.asarray(
            (total / np.maximum(count, 1)).sum(axis=0) / np.maximum((count > 0).sum(axis=0), 1)
        )

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
        # (motions, n), NaN: not held
        errors = {name: self._joint_errors(v) for name, v in candidates.items()}
        given, *others = errors
        winner = np.zeros(errors[given].shape[1], int)
        for i in range(len(winner)):
            held = ~np.isnan(errors[given][:, i])
            name = min(others, key=lambda other: float(np.nansum(errors[other][:, i])))
            if (
                held.any()
                and Comparison(name, errors[given][held, i], errors[name][held, i]).accepted
            ):
                winner[i] = list(errors).index(name)
        mixed = [_by_joint(each, winner) for each in zip(*candidates.values(), strict=True)]
        return ("mixed", mixed) if winner.any() else (given, candidates[given])

    def _joint_errors(self, candidate: ListOf[Values]) -> Array:
        """Return the mean |error| of each motion and joint, (motions, n) rad; NaN where a motion
        does not hold it.
        """
        total, count = self._sums(candidate)
        with np.errstate(invalid="ignore"):
            same = [self.names == name for name in dict.fromkeys(self.names)]
            return np.stack([total[rows].sum(axis=0) / count[rows].sum(axis=0) for rows in same])

    def best(self, candidates: dict[str, list[Values]]) -> tuple[str, list[Values]]:
        """Return name and values of the best candidate.

        The second candidate is the default. Another one replaces it if it is accepted by
        `Comparison`, or better by 10 %. The best values joint by joint ("mixed") replace it only if
        they are accepted. The first candidate, the given robot, is returned if no fit is better by
        1 %.
        """
        given, default, *others = candidates
        joints = np.array([self.errors_by_joint(v) for v in candidates.values()])
        winner = joints.argmin(axis=0)
        if len(set(winner.tolist())) > 1:
            mixed = [_by_joint(each, winner) for each in zip(*candidates.values(), strict=True)]
            candidates = candidates | {"mixed": mixed}
        errors = {name: self.errors(v) for name, v in candidates.items()}
        name = default
        for other in (*others, *(candidates.keys() & {"mixed"})):
            limit = (1 - MIN_RELATIVE_GAIN_ONE_MOTION) * errors[name].mean()
            much_better = other != "mixed" and errors[other].mean() < limit
            name = (
                other
                if much_better or Comparison(other, errors[name], errors[other]).accepted
                else name
            )
        name = (
            name if errors[name].mean() < (1 - MIN_RELATIVE_GAIN) * errors[given].mean() else given
        )
        return name, candidates[name]


def _by_joint(candidates: ListOf[Values], winner: Array) -> Values:
    """Return the values (n,) of candidate winner[i] for joint i."""
    fields = set.intersection(*map(set, candidates))
    return {f: np.stack([v[f] for v in candidates])[winner, np.arange(len(winner))] for f in fields}


def _contact_rows(
    sequences: ListOf[Sequence], robot: RobotSpec, contact_height: float
) -> Array | None:
    """Return the rows in which a tip is below a height, (sequences, rows)."""
    if not robot.tips:
        return None
    heights = tip_heights(sequences, robot)
    rows = max(map(len, heights))
    return np.array([np.r_[h < contact_height, np.zeros(rows - len(h), bool)] for h in heights])
