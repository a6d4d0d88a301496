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

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.checks.completeness import unsigned_torque
from gaponet.data.checks.survey import Survey
from gaponet.data.offsets import Gravity
from gaponet.robot.finding import Finding, abbreviate
from gaponet.robot.spec import RobotSpec

MIN_POSES = 12  # of a joint
MAX_FOLDS = 20  # of the sequences
SIGNIFICANCE = 4.0  # standard errors
# a note, a warning
MIN_OFFSET_RAD = 0.015
FAR_OFFSET_RAD = 0.05
MIN_SCALE_ERROR = 0.1
SOFTNESS_BOUNDS = (0.5, 1.8)
MIN_SAG_RAD = 0.01  # rms of the nominal sag, below which softness is unknown
MIN_UNIT_DISTANCE_RAD = 0.03  # between sequences of one robot
# of the heaviest label (or kg); of the misfit that another mass must explain
MIN_MASS = 0.25
MIN_MASS_SHARE = 0.5
MIN_LOAD_CHANGE_RAD = 1e-3  # by which a joint rests elsewhere with another label
MIN_EVIDENCE = 10.0  # for other labels: poses times the logarithm by which their scatter falls
# between two groups of recordings
MIN_GROUP_DISTANCE_RAD = 0.006
MIN_GROUP_SCATTERS = 6.0
PRIOR = np.array([0.0, 0.0, 1.0, 0.0])  # offset, scale − 1, softness, stiction of a motor as stated
PRIOR_STD = np.array([0.5, 0.5, 1.0, 0.1])
# of the robust fit
MIN_SCATTER_RAD = 5e-4
MAX_ITERATIONS = 12
SOFTNESS = 2  # index of the coefficient
MAX_ODD_SEQUENCES = 10  # that are reported
# Of a torque that is fed forward:
MIN_RECORDINGS = 3
MIN_LOAD = 0.01  # of the torque limit, by which the weight on a joint changes
MIN_SHARE = 0.3  # of the weight that the command does not hold
# share of the torque that PD does not explain; times as much as with it
MIN_UNEXPLAINED = 0.02
MIN_IMPROVEMENT = 8.0
# of the sag that kp and the weight give: at a share of 1, and more per share below
MAX_SAG = 0.25
MAX_SAG_PER_SHARE = 2.5
MIN_JOINTS_SHARE = 1 / 3  # of the joints that are judged


@dataclass(frozen=True)
class _Poses:
    """Distinct static poses of single joints (k), ordered by sequence."""

    sequence: Array  # indices, (k)
    joint: Array
    error: Array  # qpos − ctrl, (k) rad
    columns: Array  # regressors of the four coefficients, (k, 4)
    per_kg: Array  # change of the softness regressor with 1 kg more payload, (k) rad

    def only(self, keep: Array | slice) -> _Poses:
        """Return some of the poses."""
        return _Poses(*(values[keep] for values in vars(self).values()))

    def of_joint(self, joint: int) -> _Poses:
        return self.only(self.joint == joint)

    def of_sequence(self, number: int) -> slice:
        return slice(*np.searchsorted(self.sequence, [number, number + 1]))

    def __len__(self) -> int:
        return len(self.error)


@dataclass(frozen=True)
class _Fit:
    """Coefficients of a joint (4), their standard errors, scatter (rad), and the coefficients
    without each sequence.
    """

    x: Array
    std: Array
    scatter: float
    without: dict[int, Array]

    @property
    def significant(self) -> Array:
        return np.asarray(np.abs(self.x - PRIOR) > SIGNIFICANCE * self.std)


def static_checks(surveys: list[Survey], robot: RobotSpec, model: Gravity) -> Iterator[Finding]:
    """Do offsets, scales, gains and payload labels agree with the static poses?"""
    poses = _collect(surveys, robot, model)
    judged = [j for j in robot.operated_index.tolist() if (poses.joint == j).sum() >= MIN_POSES]
    if not judged:
        yield Finding(
            "ok",
            "rests",
            "too few rests: offsets, scales, gains and payloads cannot be told; add holds",
        )
        return
    findings = _swapped_labels(surveys, poses, judged) or _two_units(surveys, robot, poses, judged)
    if findings:
        yield from findings
        return
    findings, poses = _odd_sequences(surveys, robot, poses, judged)
    findings = findings or _two_units(surveys, robot, poses, judged, min_size=1, min_joints=3)
    softness: dict[str, float] = {}
    for j in judged:
        own = poses.of_joint(j)
        if len(own) < MIN_POSES:
            continue
        name = robot.joint_names[j]
        fit = _fit(own)
        findings += _offset_and_scale(name, fit)
        soft = _odd_softness(own, fit)
        if soft is not None:
            softness[name] = soft
    if softness:
        findings.append(_wrong_gains(softness))
    yield from findings or [
        Finding("ok", "rests", "rests agree with gravity, gains and payload labels")
    ]


def _odd_softness(poses: _Poses, fit: _Fit) -> float | None:
    """Return how many times as far a joint sags as kp says, if that is odd and known."""
    sag = float(np.sqrt(np.mean(poses.columns[:, SOFTNESS] ** 2)))
    soft = float(fit.x[SOFTNESS])
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


def _collect(surveys: list[Survey], robot: RobotSpec, model: Gravity) -> _Poses:
    parts = [(np.zeros(0, int), np.zeros(0, int), np.zeros(0), np.zeros((0, 4)), np.zeros(0))]
    for number, survey in enumerate(surveys):
        meta = survey.entry.meta
        poses = survey.samples.static_poses
        if not len(poses):
            continue
        kp = np.where(robot.servo.kp > 0, robot.with_gains(*meta.recorded_gains).servo.kp, np.inf)
        load = model(poses.qpos, meta.payload_mass, meta.payload_side) / kp
        heavier = np.zeros_like(load)
        if robot.payload_mounts:
            heavier = model(poses.qpos, meta.payload_mass + 1.0, meta.payload_side) / kp - load
        judged = poses.distinct & (poses.approach != 0)  # (poses, n)
        nth, pose = np.nonzero(judged[:, robot.operated_index].T)
        joint = robot.operated_index[nth]
        at = (pose, joint)
        ones = np.ones(len(joint))
        columns = np.column_stack([ones, poses.ctrl[at], -load[at], -poses.approach[at]])
        error = poses.qpos[at] - poses.ctrl[at]
        parts.append((np.full(len(joint), number), joint, error, columns, -heavier[at]))
    return _Poses(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _fit(poses: _Poses) -> _Fit:
    """Fit the coefficients of the one joint of these poses."""
    x, formal_std, scatter = _solve(poses.columns, poses.error)
    numbers, index = np.unique(poses.sequence, return_inverse=True)
    fold = index % MAX_FOLDS
    folds = range(min(len(numbers), MAX_FOLDS))
    without = {}
    for f in folds:
        kept = fold != f
        without[f], _, _ = _solve(poses.columns[kept], poses.error[kept])
    every = np.array(list(without.values()))
    jackknife = np.sqrt(
        (len(every) - 1) / len(every) * ((every - every.mean(axis=0)) ** 2).sum(axis=0)
    )
    std = np.maximum(formal_std, jackknife) if len(every) > 2 else 3 * formal_std
    left_out = {number: without[i % MAX_FOLDS] for i, number in enumerate(numbers.tolist())}
    return _Fit(x, std, scatter, left_out)


def _solve(
    columns: Array, error: Array, expected: Array = PRIOR, expected_std: Array = PRIOR_STD
) -> tuple[Array, Array, float]:
    """Return robust least-squares coefficients, their formal standard errors, and the scatter of
    the residuals.
    """
    x = expected
    scatter = 0.01
    weight = np.ones(len(error))
    prior = np.diag(1 / expected_std)
    a = prior
    for _ in range(MAX_ITERATIONS):
        a = np.concatenate([columns * (weight / scatter)[:, None], prior])
        x = np.linalg.lstsq(
            a, np.concatenate([error * weight / scatter, prior @ expected]), rcond=None
        )[0]
        residual = np.abs(error - columns @ x)
        scatter = (
            max(1.48 * float(np.median(residual)), MIN_SCATTER_RAD) if len(residual) else scatter
        )
        weight = np.sqrt(1 / np.maximum(1, residual / (3 * scatter)))
    return x, np.sqrt(np.diag(np.linalg.inv(a.T @ a))), scatter


def _offset_and_scale(name: str, fit: _Fit) -> Iterator[Finding]:
    offset = float(fit.x[0])
    scale = float(1 + fit.x[1])
    if fit.significant[1] and abs(scale - 1) > MIN_SCALE_ERROR:
        text = (
            f"{name} goes {scale:.2f} rad where its command goes 1 rad, sag taken off: another "
            "gear ratio, range or ticks a turn in one of them; import again with the right scale"
        )
        yield Finding("warning", "scale", text, (name,), {"scale": scale})
    elif fit.significant[0] and abs(offset) > MIN_OFFSET_RAD:
        far = abs(offset) > FAR_OFFSET_RAD
        verdict = "as assembly leaves it"
        if far:
            verdict = "more than assembly leaves: a wrong zero or a missed homing"
        text = (
            f"{name} rests {offset * 1e3:+.0f} ± {fit.std[0] * 1e3:.0f} mrad off its command, sag "
            f"and stiction taken off: a constant offset, {verdict}; gaponet identify finds it, or "
            "take it off at import"
        )
        yield Finding("warning" if far else "note", "offset", text, (name,), {"offset": offset})


def _swapped_labels(surveys: list[Survey], poses: _Poses, judged: list[int]) -> list[Finding]:
    """Would the labels' masses in another order explain the poses better?"""
    mass = np.array([survey.entry.meta.payload_mass for survey in surveys])[poses.sequence]
    labels = sorted(set(mass.tolist()))
    if not 1 < len(labels) <= 3:
        return []
    best = (0.0, labels)
    for order in [list(p) for p in permutations(labels)][1:]:
        other = np.array(order)[np.searchsorted(labels, mass)]
        columns = poses.columns + np.outer((other - mass) * poses.per_kg, np.eye(4)[SOFTNESS])
        evidence = 0.0
        for j in judged:
            own = poses.joint == j
            scatters = [_solve(c[own], poses.error[own])[2] for c in (poses.columns, columns)]
            evidence += float(own.sum() * np.log(scatters[0] / scatters[1]))
        best = max(best, (evidence, order))
    loaded = np.abs(poses.per_kg) * (labels[-1] - labels[0]) > MIN_LOAD_CHANGE_RAD
    if best[0] < max(MIN_EVIDENCE, 0.1 * loaded.sum()):
        return []
    swaps = ", ".join(
        f"{a:g} kg rests as {b:g} kg" for a, b in zip(labels, best[1], strict=True) if a != b
    )
    text = (
        f"what is labelled {swaps}: payload labels in each other's place? Import again with the "
        "right --payload-mass"
    )
    return [Finding("warning", "payload", text, (), {"labels": labels, "rests_as": best[1]})]


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
    best = max(_groups(rests, known, min_size), key=lambda g: g.size, default=None)
    if best is None or best.size[0] < min_joints:
        return []
    names = [robot.joint_names[j] for j, apart in zip(judged, best.apart, strict=True) if apart]
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
        residual = own.error - own.columns @ _solve(own.columns, own.error)[0]
        for number in set(own.sequence.tolist()):
            part = residual[own.of_sequence(number)]
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
        cuts = np.arange(min_size, len(order) + 1 - min_size)
        centred = rests[order] - rests[order].mean(axis=0)  # their sum is zero, (N, judged)
        sums = centred.cumsum(axis=0)[cuts - 1]
        per = (1 / cuts + 1 / (len(order) - cuts))[:, None]
        within = np.sqrt(np.maximum((centred**2).sum(axis=0) - sums**2 * per, 0) / (len(order) - 2))
        gaps = np.abs(sums) * per
        least = np.maximum(
            MIN_GROUP_DISTANCE_RAD, MIN_GROUP_SCATTERS * np.maximum(within, MIN_SCATTER_RAD)
        )
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
    heaviest = max(survey.entry.meta.payload_mass for survey in surveys) or 1.0
    odd: tuple[float, int, Finding] | None = None
    for number in sorted(set(poses.sequence.tolist())):
        rests = _Rests.of(number, by_joint, fits, robot)
        judgement = _judge_sequence(surveys[number], heaviest, rests)
        if judgement is None:
            continue
        mean_square, finding = judgement
        if odd is None or mean_square > odd[0]:
            odd = (mean_square, number, finding)
    if odd is None:
        return None
    return odd[1], odd[2]


@dataclass(frozen=True)
class _Rests:
    """Where one sequence rests, against what the others say.

    Attributes:
        residuals: One array per joint, in scatters of the joint.
        slopes: Change of these with 1 kg more payload.
        apart: Joint → distance, rad, of joints that rest far away.
    """

    residuals: list[Array]
    slopes: list[Array]
    apart: dict[str, float]

    @classmethod
    def of(
        cls, number: int, by_joint: dict[int, _Poses], fits: dict[int, _Fit], robot: RobotSpec
    ) -> _Rests:
        """Compare the sequence of this number with the fits to the others."""
        rests = cls([], [], {})
        for j, fit in fits.items():
            every = by_joint[j]
            own = every.only(every.of_sequence(number))
            if len(own) < 3 or len(every) - len(own) < MIN_POSES:
                continue
            x = fit.without[number]
            residual = own.error - own.columns @ x
            rests.residuals.append(residual / fit.scatter)
            rests.slopes.append(x[SOFTNESS] * own.per_kg / fit.scatter)
            middle = float(np.median(residual))
            scatter = max(fit.scatter, 1.48 * float(np.median(np.abs(residual - middle))))
            error = scatter / np.sqrt(len(residual))
            if abs(middle) > max(MIN_UNIT_DISTANCE_RAD, SIGNIFICANCE * error):
                rests.apart[robot.joint_names[j]] = middle
        return rests


def _judge_sequence(survey: Survey, heaviest: float, rests: _Rests) -> tuple[float, Finding] | None:
    """Return the mean square of a sequence's residuals and its finding, if another mass or unit
    explains them.
    """
    if not rests.residuals:
        return None
    r = np.concatenate(rests.residuals)
    slope = np.concatenate(rests.slopes)
    apart = rests.apart
    meta = survey.entry.meta
    mean_square = float(r @ r) / len(r)
    power = float(slope @ slope)
    more = float(slope @ r) / power if power > 0 else 0.0  # kg
    explained = more**2 * power
    unexplained = max(1.0, mean_square - explained / len(r))
    significant = explained > max(MIN_MASS_SHARE * float(r @ r), SIGNIFICANCE**2 * unexplained)
    if significant and abs(more) > MIN_MASS * heaviest:
        text = (
            f"{meta.motion} rests as with {max(meta.payload_mass + more, 0.0):.2g} kg, its label "
            f"says {meta.payload_mass:g} kg: a wrong payload label? Import it again with "
            "--payload-mass"
        )
        values = {"motion": meta.motion, "mass": meta.payload_mass + more}
        return mean_square, Finding("warning", "payload", text, (), values)
    if apart:
        worst = max(apart, key=lambda name: abs(apart[name]))
        text = (
            f"{meta.motion} rests {apart[worst] * 1e3:+.0f} mrad from where the other recordings "
            f"of unit {meta.unit_id} say ({abbreviate(list(apart))}): another robot, or zeros set "
            "in between? Import it with another --unit-id"
        )
        return mean_square, Finding(
            "warning", "unit_id", text, tuple(apart), {"motion": meta.motion, "apart": apart}
        )
    return None


def feedforward(surveys: list[Survey], robot: RobotSpec, model: Gravity) -> Iterator[Finding]:
    """Is a torque fed forward beside the position command?"""
    recorded = [(survey, survey.torque) for survey in surveys if survey.torque is not None]
    if not recorded or unsigned_torque(recorded, robot):
        return
    shares: dict[str, tuple[float, float, float]] = {}
    for j, name in enumerate(robot.joint_names):
        of_joint = _shares(surveys, robot, model, j)
        if of_joint is not None:
            shares[name] = of_joint
    if not shares:
        yield Finding("ok", "feed-forward", "too few rests with torque to tell")
        return
    fed = {name: x for name, x in shares.items() if x[0] > 0}
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
    yield Finding(
        "warning", "feed-forward", text, tuple(fed), {name: x[0] for name, x in fed.items()}
    )


def _shares(
    surveys: list[Survey], robot: RobotSpec, model: Gravity, joint: int
) -> tuple[float, float, float] | None:
    """Return the share of a joint's weight that is fed forward (0 if it may be none), and the
    shares of its torque that PD alone and both explain; None with too few holds, or without a
    weight that changes.
    """
    # (k,); torques over kp, rad
    recording, torque, weight, error, qpos = _holds_of(surveys, robot, model, joint).T
    numbers, fold = np.unique(recording, return_inverse=True)
    least = MIN_LOAD * robot.servo.effort_limit[joint] / max(robot.servo.kp[joint], 1e-9)
    if len(torque) < MIN_POSES or len(numbers) < MIN_RECORDINGS or np.std(weight) < least:
        return None
    fold = fold % MAX_FOLDS
    sag, _, _ = _explained(error, fold, weight)
    # qpos: command and state may differ in scale
    _, _, alone = _explained(torque, fold, error, qpos)
    share, std, both = _explained(torque, fold, weight, error, qpos)
    max_sag = MAX_SAG + MAX_SAG_PER_SHARE * max(1 - share, 0.0)
    significant = share > max(MIN_SHARE, SIGNIFICANCE * std) and sag < max_sag
    better = 1 - alone > max(MIN_UNEXPLAINED, MIN_IMPROVEMENT * (1 - both))
    return (share if significant and better else 0.0), alone, both


def _holds_of(surveys: list[Survey], robot: RobotSpec, model: Gravity, joint: int) -> Array:
    """Return the holds of a joint: number of the recording, torque over kp, weight over kp, command
    − position, position, (k, 5) in rad.
    """
    parts = [np.zeros((0, 5))]
    for number, survey in enumerate(surveys):
        if survey.samples.holds is None:
            continue
        own = survey.samples.holds[survey.samples.holds[:, 0] == joint]
        if not len(own):
            continue
        meta = survey.entry.meta
        kp = max(float(robot.with_gains(*meta.recorded_gains).servo.kp[joint]), 1e-9)
        weight = model(own[:, 3:], meta.payload_mass, meta.payload_side)[:, joint]
        numbers = np.full(len(own), number)
        columns = (numbers, own[:, 2] / kp, weight / kp, own[:, 1], own[:, 3 + joint])
        parts.append(np.stack(columns, axis=1))
    return np.concatenate(parts)


def _explained(values: Array, fold: Array, *columns: Array) -> tuple[float, float, float]:
    """Return the robust coefficient of the first column, its standard error, and the share of the
    variance of the values that fits to the other folds explain.
    """
    x = np.stack([*columns, np.ones_like(values)], axis=1)
    start = np.zeros(x.shape[1])
    free = np.full(x.shape[1], 1e3)
    folds = np.unique(fold)
    without = []
    for f in folds:
        kept = fold != f
        coefficients, _, _ = _solve(x[kept], values[kept], start, free)
        without.append(coefficients)
    each = np.array(without)
    left = values - np.einsum("kc,kc->k", x, each[np.searchsorted(folds, fold)])
    std = np.sqrt((len(each) - 1) * each[:, 0].var())
    share = 1 - float(np.mean(left**2)) / max(float(np.var(values)), 1e-12)
    return float(_solve(x, values, start, free)[0][0]), float(std), share
