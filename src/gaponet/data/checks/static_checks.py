"""Checks of static poses against gravity and the stated gains: offsets, scales, gains, payload
labels, mixed robots.

At rest, a servo's distance from its command is qpos − ctrl = offset + (scale − 1)·ctrl −
softness·G(qpos)/kp − stiction·approach. G is the gravity torque of the nominal model with the
labelled payload. The four coefficients of a joint are fitted to all poses, and also without some of
the sequences: for standard errors (jackknife), and to judge a sequence by the others.

A PD controller's torque is kp (command − position) at rest; with a feed-forward torque it is that
and a share of the weight, and the joint sags less than kp says. Recorded torque at rest is fitted
to both. Behind backlash, or in a sensor behind the gears, the torque seems to be the weight alone,
but the joint sags as kp says.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations
from typing import NamedTuple

import numpy as np

from gaponet.base.arrays import Array, joined
from gaponet.data.checks.completeness import unsigned_torque
from gaponet.data.checks.survey import Survey, with_torque
from gaponet.data.offsets import Gravity
from gaponet.robot.finding import Finding, abbreviate
from gaponet.robot.servo_parameters import NO_LIMIT
from gaponet.robot.spec import RobotSpec

MIN_POSES = 12  # of a joint
MAX_FOLDS = 20  # of the sequences
SIGNIFICANCE = 4.0  # standard errors
MIN_OFFSET_RAD = 0.015  # that is a note
FAR_OFFSET_RAD = 0.05  # that is a warning
MIN_SCALE_ERROR = 0.1
SOFTNESS_BOUNDS = (0.5, 1.8)
MIN_SAG_RAD = 0.01  # rms of the nominal sag, below which softness is unknown
MIN_UNIT_DISTANCE_RAD = 0.03  # between sequences of one robot
MIN_MASS_ERROR = 0.25  # of a label, as a share of the heaviest label, or kg if all are 0
MIN_MASS_SHARE = 0.5  # of the misfit that another mass must explain
MIN_LOAD_CHANGE_RAD = 1e-3  # by which a joint rests elsewhere with another label
MIN_EVIDENCE = 10.0  # for other labels: poses times the logarithm by which their scatter falls
MIN_GROUP_DISTANCE_RAD = 0.006  # between two groups of recordings
MIN_GROUP_SCATTERS = 6.0  # the same, over the scatter within the groups
# Coefficients of a joint by their index, with the values of a motor as stated and the standard
# deviations that are expected about these.
OFFSET = 0  # rad
SCALE_ERROR = 1  # scale − 1
SOFTNESS = 2
STICTION = 3  # rad
PRIOR = np.array([0.0, 0.0, 1.0, 0.0])
PRIOR_STD = np.array([0.5, 0.5, 1.0, 0.1])
MIN_SCATTER_RAD = 5e-4  # of the robust fit
MAX_ITERATIONS = 12  # of the same
MAX_ODD_SEQUENCES = 10  # that are reported
# Of a torque that is fed forward:
MIN_RECORDINGS = 3
MIN_LOAD = 0.01  # of the torque limit, by which the weight on a joint changes
MIN_KP = 1e-9  # N·m/rad, by which torques are divided where kp is 0
MIN_SHARE = 0.3  # of the weight that the command does not hold
MIN_UNEXPLAINED = 0.02  # share of the torque that PD does not explain
MIN_IMPROVEMENT = 8.0  # PD leaves so many times as much unexplained as PD and a share of the weight
# Of the sag that kp and the weight give, at most this at a share of 1, and more per share below.
MAX_SAG = 0.25
MAX_SAG_PER_SHARE = 2.5
MIN_JOINTS_SHARE = 1 / 3  # of the joints that are judged


@dataclass(frozen=True)
class _Poses:
    """Distinct static poses of single joints (k), ordered by sequence."""

    sequence: Array  # indices, (k)
    joint: Array  # indices, (k)
    error: Array  # qpos − ctrl, (k) rad
    columns: Array  # regressors of the four coefficients, (k, 4)
    per_kg: Array  # change of the softness regressor with 1 kg more payload, (k) rad

    def only(self, keep: Array | slice) -> _Poses:
        """Return some of the poses."""
        return _Poses(*(values[keep] for values in vars(self).values()))

    def of_joint(self, joint: int) -> _Poses:
        """Return the poses of a joint."""
        return self.only(self.joint == joint)

    def rows_of(self, number: int) -> slice:
        """Return the rows of the sequence with this number."""
        start, stop = np.searchsorted(self.sequence, [number, number + 1])
        return slice(start, stop)

    def __len__(self) -> int:
        return len(self.error)


@dataclass(frozen=True)
class _Fit:
    """Coefficients of one joint, fitted to its poses."""

    coefficients: Array  # (4)
    std: Array  # their standard errors, (4)
    scatter: float  # of the poses about the fit, rad
    without: dict[int, Array]  # number of a sequence → coefficients without its poses, (4)

    @property
    def significant(self) -> Array:
        """Which coefficients are not those of a motor as stated, (4) bool."""
        away = np.abs(self.coefficients - PRIOR)
        return np.asarray(away > SIGNIFICANCE * self.std)


def static_checks(surveys: list[Survey], robot: RobotSpec, model: Gravity) -> Iterator[Finding]:
    """Do offsets, scales, gains and payload labels agree with the static poses?"""
    poses = _collect_poses(surveys, robot, model)
    judged = [j for j in robot.operated_index.tolist() if (poses.joint == j).sum() >= MIN_POSES]
    if not judged:
        text = "too few rests: offsets, scales, gains and payloads cannot be told; add holds"
        yield Finding("ok", "rests", text)
        return
    findings = _swapped_labels(surveys, poses, judged) or _two_units(surveys, robot, poses, judged)
    if findings:  # they would spoil every fit to all recordings
        yield from findings
        return
    findings, poses = _odd_sequences(surveys, robot, poses, judged)
    findings = findings or _two_units(surveys, robot, poses, judged, min_size=1, min_joints=3)
    findings += _odd_motors(robot, poses, judged)
    if not findings:
        text = "rests agree with gravity, gains and payload labels"
        findings.append(Finding("ok", "rests", text))
    yield from findings


def _odd_motors(robot: RobotSpec, poses: _Poses, judged: list[int]) -> Iterator[Finding]:
    """Find joints with an offset, another scale, or other gains than stated."""
    softness: dict[str, float] = {}
    for j in judged:
        own = poses.of_joint(j)
        if len(own) < MIN_POSES:
            continue
        name = robot.joint_names[j]
        fit = _fit(own)
        yield from _offset_and_scale(name, fit)
        soft = _odd_softness(own, fit)
        if soft is not None:
            softness[name] = soft
    if softness:
        yield _wrong_gains(softness)


def _odd_softness(poses: _Poses, fit: _Fit) -> float | None:
    """Return how many times as far a joint sags as kp says, if that is odd and known."""
    sag = float(np.sqrt(np.mean(poses.columns[:, SOFTNESS] ** 2)))
    soft = float(fit.coefficients[SOFTNESS])
    low, high = SOFTNESS_BOUNDS
    if low < soft < high:
        return None
    known = sag > MIN_SAG_RAD and fit.significant[SOFTNESS] and soft > -low
    return soft if known else None


def _wrong_gains(softness: dict[str, float]) -> Finding:
    """Report joints that do not sag as kp says. softness: joint → sag over that of kp."""
    median = max(float(np.median(list(softness.values()))), 0.0)
    fed = ""
    if median <= 1:
        fed = ", or was a torque fed forward (feedforward_torque in logs.toml)"
    text = (
        f"{abbreviate(list(softness))} sag {median:.2f} times as far as the stated kp says: "
        f"were these logs made at other gains, or with another payload than their label{fed}? "
        "Import again with --kp or --payload-mass"
    )
    return Finding("warning", "gains", text, tuple(softness), {"softness": softness})


def _collect_poses(surveys: list[Survey], robot: RobotSpec, model: Gravity) -> _Poses:
    """Return the poses of the operated joints of all sequences."""
    none = np.zeros(0, int)
    parts = [_Poses(none, none, np.zeros(0), np.zeros((0, 4)), np.zeros(0))]
    for number, survey in enumerate(surveys):
        if len(survey.samples.static_poses):
            parts.append(_poses_of(number, survey, robot, model))
    return joined(parts)


def _poses_of(number: int, survey: Survey, robot: RobotSpec, model: Gravity) -> _Poses:
    """Return the poses of the operated joints of one sequence, which has this number."""
    mass, side = survey.payload
    poses = survey.samples.static_poses
    kp = np.where(robot.servo.kp > 0, survey.kp(robot), np.inf)
    # weight over kp, and its change with 1 kg more; (poses, n) rad
    load = model(poses.qpos, mass, side) / kp
    heavier = np.zeros_like(load)
    if robot.payload_mounts:
        heavier = model(poses.qpos, mass + 1.0, side) / kp - load
    judged = poses.distinct & (poses.approach != 0)  # (poses, n)
    nth, pose = np.nonzero(judged[:, robot.operated_index].T)
    joint = robot.operated_index[nth]
    at = (pose, joint)
    columns = np.zeros((len(joint), 4))
    columns[:, OFFSET] = 1.0
    columns[:, SCALE_ERROR] = poses.ctrl[at]
    columns[:, SOFTNESS] = -load[at]
    columns[:, STICTION] = -poses.approach[at]
    error = poses.qpos[at] - poses.ctrl[at]
    return _Poses(np.full(len(joint), number), joint, error, columns, -heavier[at])


def _fit(poses: _Poses) -> _Fit:
    """Fit the coefficients of the one joint of these poses."""
    coefficients, formal_std, scatter = _solve(poses.columns, poses.error)
    numbers, index = np.unique(poses.sequence, return_inverse=True)
    fold = index % MAX_FOLDS
    folds = []  # coefficients without the poses of each fold
    for number in range(min(len(numbers), MAX_FOLDS)):
        kept = fold != number
        without_fold, _, _ = _solve(poses.columns[kept], poses.error[kept])
        folds.append(without_fold)
    std = 3 * formal_std
    if len(folds) > 2:
        std = np.maximum(formal_std, _jackknife(np.array(folds)))
    without = {number: folds[i % MAX_FOLDS] for i, number in enumerate(numbers.tolist())}
    return _Fit(coefficients, std, scatter, without)


def _jackknife(folds: Array) -> Array:
    """Return the standard errors of coefficients from those without each fold, (folds, 4) → (4).

    The estimate of Tukey (1958) for folds of about equal size.
    """
    count = len(folds)
    squares = ((folds - folds.mean(axis=0)) ** 2).sum(axis=0)
    return np.asarray(np.sqrt((count - 1) / count * squares))


def _solve(
    columns: Array, error: Array, expected: Array = PRIOR, expected_std: Array = PRIOR_STD
) -> tuple[Array, Array, float]:
    """Return robust least-squares coefficients, their formal standard errors, and the scatter of
    the residuals.

    Iteratively reweighted: residuals beyond three scatters count less (Huber's weights), and the
    scatter is 1.48 times the median residual, which is the standard deviation of a normal
    distribution.

    Args:
        columns: Regressors, (k, c).
        error: What they explain, (k) rad.
        expected, expected_std: Normal prior of the coefficients, (c).
    """
    coefficients = expected
    scatter = 0.01
    weight = np.ones(len(error))
    prior = np.diag(1 / expected_std)
    rows = prior
    for _ in range(MAX_ITERATIONS):
        rows = np.concatenate([columns * (weight / scatter)[:, None], prior])
        values = np.concatenate([error * weight / scatter, prior @ expected])
        coefficients = np.linalg.lstsq(rows, values, rcond=None)[0]
        residual = np.abs(error - columns @ coefficients)
        if len(residual):
            scatter = max(1.48 * float(np.median(residual)), MIN_SCATTER_RAD)
        weight = np.sqrt(1 / np.maximum(1, residual / (3 * scatter)))
    return coefficients, np.sqrt(np.diag(np.linalg.inv(rows.T @ rows))), scatter


def _offset_and_scale(name: str, fit: _Fit) -> Iterator[Finding]:
    offset = float(fit.coefficients[OFFSET])
    scale = float(1 + fit.coefficients[SCALE_ERROR])
    if fit.significant[SCALE_ERROR] and abs(scale - 1) > MIN_SCALE_ERROR:
        text = (
            f"{name} goes {scale:.2f} rad where its command goes 1 rad, sag taken off: another "
            "gear ratio, range or ticks a turn in one of them; import again with the right scale"
        )
        yield Finding("warning", "scale", text, (name,), {"scale": scale})
    elif fit.significant[OFFSET] and abs(offset) > MIN_OFFSET_RAD:
        level = "note"
        verdict = "as assembly leaves it"
        if abs(offset) > FAR_OFFSET_RAD:
            level = "warning"
            verdict = "more than assembly leaves: a wrong zero or a missed homing"
        text = (
            f"{name} rests {offset * 1e3:+.0f} ± {fit.std[OFFSET] * 1e3:.0f} mrad off its command, "
            f"sag and stiction taken off: a constant offset, {verdict}; gaponet identify finds it, "
            "or take it off at import"
        )
        yield Finding(level, "offset", text, (name,), {"offset": offset})


def _swapped_labels(surveys: list[Survey], poses: _Poses, judged: list[int]) -> list[Finding]:
    """Would the labels' masses in another order explain the poses better?"""
    mass = np.array([survey.meta.payload_mass for survey in surveys])[poses.sequence]
    labels = sorted(set(mass.tolist()))
    if not 1 < len(labels) <= 3:
        return []
    best_evidence = 0.0
    rests_as = labels
    for order in list(permutations(labels))[1:]:
        other_mass = np.array(order)[np.searchsorted(labels, mass)]
        evidence = _evidence_for_masses(poses, judged, other_mass - mass)
        if evidence > best_evidence:
            best_evidence = evidence
            rests_as = list(order)
    loaded = np.abs(poses.per_kg) * (labels[-1] - labels[0]) > MIN_LOAD_CHANGE_RAD
    if best_evidence < max(MIN_EVIDENCE, 0.1 * loaded.sum()):
        return []
    swaps = []
    for label, other in zip(labels, rests_as, strict=True):
        if label != other:
            swaps.append(f"{label:g} kg rests as {other:g} kg")
    text = (
        f"what is labelled {', '.join(swaps)}: payload labels in each other's place? Import again "
        "with the right --payload-mass"
    )
    return [Finding("warning", "payload", text, (), {"labels": labels, "rests_as": rests_as})]


def _evidence_for_masses(poses: _Poses, judged: list[int], more: Array) -> float:
    """Return how much better the poses are explained with more payload, (k) kg, than as labelled:
    the logarithm by which the scatter falls, over all poses.
    """
    columns = poses.columns.copy()
    columns[:, SOFTNESS] += more * poses.per_kg
    evidence = 0.0
    for j in judged:
        own = poses.joint == j
        _, _, as_labelled = _solve(poses.columns[own], poses.error[own])
        _, _, otherwise = _solve(columns[own], poses.error[own])
        evidence += float(own.sum() * np.log(as_labelled / otherwise))
    return evidence


def _two_units(
    surveys: list[Survey],
    robot: RobotSpec,
    poses: _Poses,
    judged: list[int],
    min_size: int = 2,
    min_joints: int = 2,
) -> list[Finding]:
    """Do the recordings form two groups of `min_size` or more that rest apart in `min_joints` or
    more joints?
    """
    rests = _median_residuals(surveys, poses, judged)
    known = np.flatnonzero(np.isfinite(rests).all(axis=1))
    if len(known) <= 2:
        return []
    best = max(_groups(rests, known, min_size), key=lambda groups: groups.size, default=None)
    if best is None or best.apart.sum() < min_joints:
        return []
    names = [robot.joint_names[j] for j in np.array(judged)[best.apart].tolist()]
    members = [surveys[i].motion for i in known if i in best.members]
    others = [surveys[i].motion for i in known if i not in best.members]
    text = (
        f"{abbreviate(members)} rest up to {best.distance * 1e3:.0f} mrad from where "
        f"{abbreviate(others)} do ({abbreviate(names)}): two robots under one name, or "
        "zeros set in between? Import one part with another --unit-id"
    )
    values = {"apart": best.distance, "motions": members}
    return [Finding("warning", "unit_id", text, tuple(names), values)]


def _median_residuals(surveys: list[Survey], poses: _Poses, judged: list[int]) -> Array:
    """Return how far each sequence rests from the fit to all, (sequences, judged) rad; NaN where
    a joint has fewer than two poses.
    """
    medians = np.full((len(surveys), len(judged)), np.nan)
    for column, j in enumerate(judged):
        own = poses.of_joint(j)
        coefficients, _, _ = _solve(own.columns, own.error)
        residual = own.error - own.columns @ coefficients
        for number in set(own.sequence.tolist()):
            part = residual[own.rows_of(number)]
            if len(part) > 1:
                medians[number, column] = np.median(part)
    return medians


@dataclass(frozen=True)
class _Groups:
    """Two groups of sequences that rest apart."""

    members: Array  # sequences of the first group
    apart: Array  # judged joints in which they rest apart, (judged) bool
    distance: float  # in any joint, rad

    @property
    def size(self) -> tuple[int, float]:
        """Number of joints and distance: of several groups, the greatest is told."""
        return int(self.apart.sum()), self.distance


def _groups(rests: Array, known: Array, min_size: int) -> Iterator[_Groups]:
    """Yield every cut of the sequences, ordered by where one joint rests, into two groups.

    Args:
        rests: (sequences, judged) rad.
        known: Sequences that are cut.
        min_size: Of a group.
    """
    for column in range(rests.shape[1]):
        order = known[np.argsort(rests[known, column])]
        count = len(order)
        cuts = np.arange(min_size, count + 1 - min_size)  # sizes of the first group, (cuts)
        centred = rests[order] - rests[order].mean(axis=0)  # (N, judged)
        # Of the first group; that of the second is its negative. (cuts, judged)
        sums = centred.cumsum(axis=0)[cuts - 1]
        per = (1 / cuts + 1 / (count - cuts))[:, None]
        gaps = np.abs(sums) * per  # between the means of both groups, (cuts, judged) rad
        squares = (centred**2).sum(axis=0) - sums**2 * per  # within the groups
        within = np.sqrt(np.maximum(squares, 0) / (count - 2))  # pooled scatter, rad
        scatters = MIN_GROUP_SCATTERS * np.maximum(within, MIN_SCATTER_RAD)
        least = np.maximum(MIN_GROUP_DISTANCE_RAD, scatters)
        for cut, gap, apart in zip(cuts.tolist(), gaps, gaps > least, strict=True):
            yield _Groups(order[:cut], apart, float(gap.max()))


def _odd_sequences(
    surveys: list[Survey], robot: RobotSpec, poses: _Poses, judged: list[int]
) -> tuple[list[Finding], _Poses]:
    """Return findings of the sequences that rest elsewhere than the others, and the poses without
    these.
    """
    findings: list[Finding] = []
    while len(findings) < MAX_ODD_SEQUENCES:
        odd = _odd_sequence(surveys, robot, poses, judged)
        if odd is None:
            break
        number, finding = odd
        findings.append(finding)
        poses = poses.only(poses.sequence != number)
    return findings, poses


def _odd_sequence(
    surveys: list[Survey], robot: RobotSpec, poses: _Poses, judged: list[int]
) -> tuple[int, Finding] | None:
    """Return the sequence that rests furthest from where the others say, with its finding, if any
    is far.
    """
    by_joint = {j: poses.of_joint(j) for j in judged}
    fits = {j: _fit(own) for j, own in by_joint.items() if len(own) >= MIN_POSES}
    heaviest = max(survey.meta.payload_mass for survey in surveys) or 1.0
    furthest = 0.0  # mean square of its residuals
    odd: tuple[int, Finding] | None = None
    for number in sorted(set(poses.sequence.tolist())):
        rests = _rests_of(number, by_joint, fits, robot)
        if rests is None:
            continue
        finding = _judge_sequence(surveys[number], heaviest, rests)
        if finding is not None and (odd is None or rests.mean_square > furthest):
            furthest = rests.mean_square
            odd = (number, finding)
    return odd


@dataclass(frozen=True)
class _Rests:
    """Where one sequence rests, against what the others say, in k poses of any joints."""

    residuals: Array  # in scatters of the joint, (k)
    slopes: Array  # change of these with 1 kg more payload, (k)
    apart: dict[str, float]  # joint → distance, rad, of joints that rest far away

    @property
    def mean_square(self) -> float:
        """Of the residuals."""
        return float(self.residuals @ self.residuals) / len(self.residuals)


def _rests_of(
    number: int, by_joint: dict[int, _Poses], fits: dict[int, _Fit], robot: RobotSpec
) -> _Rests | None:
    """Compare the sequence of this number with the fits to the others; None with too few poses."""
    residuals = []
    slopes = []
    apart = {}
    for j, fit in fits.items():
        every = by_joint[j]
        own = every.only(every.rows_of(number))
        if len(own) < 3 or len(every) - len(own) < MIN_POSES:
            continue
        coefficients = fit.without[number]
        residual = own.error - own.columns @ coefficients
        residuals.append(residual / fit.scatter)
        slopes.append(coefficients[SOFTNESS] * own.per_kg / fit.scatter)
        middle = float(np.median(residual))
        scatter = max(fit.scatter, 1.48 * float(np.median(np.abs(residual - middle))))
        error = scatter / np.sqrt(len(residual))
        if abs(middle) > max(MIN_UNIT_DISTANCE_RAD, SIGNIFICANCE * error):
            apart[robot.joint_names[j]] = middle
    if not residuals:
        return None
    return _Rests(np.concatenate(residuals), np.concatenate(slopes), apart)


def _judge_sequence(survey: Survey, heaviest: float, rests: _Rests) -> Finding | None:
    """Return the finding of a sequence, if another mass or another unit explains where it rests.

    Args:
        heaviest: Of the labels, kg.
    """
    meta = survey.meta
    more = _mass_that_explains(rests)
    if abs(more) > MIN_MASS_ERROR * heaviest:
        text = (
            f"{meta.motion} rests as with {max(meta.payload_mass + more, 0.0):.2g} kg, its label "
            f"says {meta.payload_mass:g} kg: a wrong payload label? Import it again with "
            "--payload-mass"
        )
        mass = {"motion": meta.motion, "mass": meta.payload_mass + more}
        return Finding("warning", "payload", text, (), mass)
    if not rests.apart:
        return None
    worst = max(rests.apart.values(), key=abs)
    text = (
        f"{meta.motion} rests {worst * 1e3:+.0f} mrad from where the other recordings "
        f"of unit {meta.unit_id} say ({abbreviate(list(rests.apart))}): another robot, or zeros "
        "set in between? Import it with another --unit-id"
    )
    unit = {"motion": meta.motion, "apart": rests.apart}
    return Finding("warning", "unit_id", text, tuple(rests.apart), unit)


def _mass_that_explains(rests: _Rests) -> float:
    """Return by how much more payload than its label says a sequence rests, kg; 0 if that does not
    explain most of the misfit, or may be chance.
    """
    power = float(rests.slopes @ rests.slopes)
    if not power > 0:
        return 0.0
    more = float(rests.slopes @ rests.residuals) / power  # least squares
    explained = more**2 * power
    misfit = float(rests.residuals @ rests.residuals)
    unexplained = max(1.0, rests.mean_square - explained / len(rests.residuals))
    if explained > max(MIN_MASS_SHARE * misfit, SIGNIFICANCE**2 * unexplained):
        return more
    return 0.0


def feedforward(surveys: list[Survey], robot: RobotSpec, model: Gravity) -> Iterator[Finding]:
    """Is a torque fed forward beside the position command?"""
    recorded = with_torque(surveys)
    if not recorded or unsigned_torque(recorded, robot):
        return
    shares: dict[str, _FedForward] = {}
    for j, name in enumerate(robot.joint_names):
        of_joint = _fed_forward(_joint_holds(surveys, robot, model, j), robot, j)
        if of_joint is not None:
            shares[name] = of_joint
    if not shares:
        yield Finding("ok", "feed-forward", "too few rests with torque to tell")
        return
    fed = {name: of_joint for name, of_joint in shares.items() if of_joint.share > 0}
    if len(fed) < MIN_JOINTS_SHARE * len(shares):
        yield Finding("ok", "feed-forward", "no torque beside the commands is seen at rest")
        return
    share, alone, both = np.clip(np.median(list(fed.values()), axis=0), 0, 1)
    text = (
        f"at rest the commands of {abbreviate(list(fed))} hold only {1 - share:.0%} of the "
        f"weight: kp times their distance explains {alone:.0%} of the torque, with the rest of "
        f"the weight {both:.0%} (recordings not fitted). A torque is fed forward beside the "
        "command, such as gravity compensation, or an integral term holds the joint. Name its "
        "column in logs.toml (feedforward_torque); without it, gaponet identify takes the missing "
        "sag for stiffer motors, and a simulator needs the same torque"
    )
    values = {name: of_joint.share for name, of_joint in fed.items()}
    yield Finding("warning", "feed-forward", text, tuple(fed), values)


class _FedForward(NamedTuple):
    """What holds a joint at rest, as shares."""

    share: float  # of its weight that is fed forward; 0 if it may be none
    alone: float  # of its torque that PD alone explains
    both: float  # of its torque that PD and a share of the weight explain


@dataclass(frozen=True)
class _JointHolds:
    """Rests of one joint under constant commands, (k) each."""

    recording: Array  # number of the recording
    torque: Array  # over kp, rad
    weight: Array  # over kp, rad
    error: Array  # command − position, rad
    qpos: Array  # rad


def _fed_forward(holds: _JointHolds, robot: RobotSpec, joint: int) -> _FedForward | None:
    """Return what holds a joint; None with too few holds, or without a weight that changes."""
    numbers, index = np.unique(holds.recording, return_inverse=True)
    fold = index % MAX_FOLDS
    least = MIN_LOAD * np.abs(holds.weight).max(initial=0.0)
    limit = robot.servo.effort_limit[joint]
    if limit < NO_LIMIT:
        least = MIN_LOAD * limit / max(robot.servo.kp[joint], MIN_KP)
    few = len(holds.torque) < MIN_POSES or len(numbers) < MIN_RECORDINGS
    if few or np.std(holds.weight) < least:
        return None
    sag, _, _ = _explained(holds.error, fold, holds.weight)
    # qpos: command and state may differ in scale
    _, _, alone = _explained(holds.torque, fold, holds.error, holds.qpos)
    share, std, both = _explained(holds.torque, fold, holds.weight, holds.error, holds.qpos)
    max_sag = MAX_SAG + MAX_SAG_PER_SHARE * max(1 - share, 0.0)
    significant = share > max(MIN_SHARE, SIGNIFICANCE * std) and sag < max_sag
    better = 1 - alone > max(MIN_UNEXPLAINED, MIN_IMPROVEMENT * (1 - both))
    if not (significant and better):
        share = 0.0
    return _FedForward(share, alone, both)


def _joint_holds(
    surveys: list[Survey], robot: RobotSpec, model: Gravity, joint: int
) -> _JointHolds:
    """Return the holds of one joint in all recordings."""
    none = np.zeros(0)
    parts = [_JointHolds(none, none, none, none, none)]
    for number, survey in enumerate(surveys):
        holds = survey.samples.holds
        if holds is None:
            continue
        own = holds.joint == joint
        if not own.any():
            continue
        kp = max(float(survey.kp(robot)[joint]), MIN_KP)
        qpos = holds.qpos[own]
        weight = model(qpos, *survey.payload)[:, joint]
        part = _JointHolds(
            recording=np.full(len(qpos), number),
            torque=holds.torque[own] / kp,
            weight=weight / kp,
            error=holds.error[own],
            qpos=qpos[:, joint],
        )
        parts.append(part)
    return joined(parts)


def _explained(values: Array, fold: Array, *columns: Array) -> tuple[float, float, float]:
    """Return the robust coefficient of the first column, its standard error, and the share of the
    variance of the values that fits to the other folds explain.

    Args:
        values: What is explained, (k).
        fold: Of each value, (k).
        columns: Regressors, (k) each; a constant is added.
    """
    regressors = np.stack([*columns, np.ones_like(values)], axis=1)  # (k, c)
    start = np.zeros(regressors.shape[1])
    free = np.full(regressors.shape[1], 1e3)
    folds = np.unique(fold)
    without = []
    for number in folds:
        kept = fold != number
        coefficients, _, _ = _solve(regressors[kept], values[kept], start, free)
        without.append(coefficients)
    each = np.array(without)  # (folds, c)
    of_others = each[np.searchsorted(folds, fold)]  # (k, c)
    left = values - np.einsum("kc,kc->k", regressors, of_others)
    std = np.sqrt((len(each) - 1) * each[:, 0].var())
    share = 1 - float(np.mean(left**2)) / max(float(np.var(values)), 1e-12)
    coefficients, _, _ = _solve(regressors, values, start, free)
    return float(coefficients[0]), float(std), share
