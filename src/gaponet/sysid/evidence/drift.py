"""Drift of a robot since its identification: which parameters changed, joint by joint, and by how
much.

At the robot's own values every cluster of the recordings has a gradient of the cost. On the day of
the identification these gradients balanced, but for the stored Gauss-Newton step. A remaining
gradient beyond the scatter of recordings is a change. As few parameters as possible explain it, the
one that explains most first: a joint's fields, or play.
"""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from scipy.stats import t as student

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.data.repeatability import repetition_difference
from gaponet.data.sequence import Sequence
from gaponet.robot.servo_fields import SERVO_FIELDS
from gaponet.robot.spec import RobotSpec
from gaponet.sysid.axes import identified_joints
from gaponet.sysid.evidence.evidence import (
    Evidence,
    evidence,
    gradient_covariance,
    inverted,
    widened,
)
from gaponet.sysid.joint_rollouts import ERROR_SCALE_RAD
from gaponet.sysid.uncertainty import PLAY, ParameterUncertainty

# Of a robot that did not change, for all its parameters together.
FALSE_ALARM_RATE = 0.003
FALSE_CONTRADICTION_RATE = 1e-4  # of recordings that agree
# Of a change's effect on the joint's path, over the residual.
MIN_EFFECT_RATIO = 0.15
MAX_CHANGES_PER_JOINT = 3
MAX_PRIOR_CLUSTERS = 40  # that the identification's overdispersion counts as
MAX_SET_ASIDE = 0.4  # of the recordings; more of them contradict the others
# Over that of the recording which is compared with them.
MIN_INFORMATION_OF_OTHERS = 0.5
COMMON_FIELDS = ("delay",)  # of one bus: those of all joints change together
EVERY_JOINT = "every joint"
FRICTION_FIELDS = ("damping", "frictionloss", "stribeck")
# Of the median error of a joint's windows to the residual of the identification: a larger one says
# that the robot is another one.
FAR_RATIO = 2.5
# Of all joints: if more have another kp or several changes, the robot is another one.
MAX_CHANGED_JOINTS = 0.4

Verdict = Literal["same", "drifted", "contradictory"]


@dataclass(frozen=True)
class ParameterChange:
    """Change of one parameter of a joint.

    Attributes:
        joint: Its name, or EVERY_JOINT.
        field: The servo's field, or play (rad).
        by, error: Change on the axes of sysid/uncertainty.py, and its standard error.
        moves: RMS effect on the joint's path in these recordings, rad.
    """

    joint: str
    field: str
    by: float
    error: float
    moves: float

    @property
    def sigmas(self) -> float:
        """Change over its standard error, which includes noise, model errors and the
        overdispersion of recordings.
        """
        return self.by / self.error


@dataclass(frozen=True)
class Contradiction:
    """Recording that contradicts the others: a joint's field, the difference on its axis, in
    standard errors.
    """

    recording: str
    joint: str
    field: str
    by: float
    sigmas: float


@dataclass(frozen=True)
class Drift:
    """Result of a drift check.

    Attributes:
        verdict: same, drifted or contradictory.
        moved: Significant changes.
        largest: Joint → its largest change, significant or not.
        min_effect: Joint → least effect on its path that counts, rad: a share of the model's error,
            and at least the RMS difference between two recordings of one command.
        against: Recordings that were set aside since they contradict the others.
        advice: What to do.
        threshold: Standard errors from which a change is significant.
        seconds: Duration of the recordings.
        far: Joint → error over the identification's residual, where it exceeds FAR_RATIO.
    """

    verdict: Verdict
    moved: tuple[ParameterChange, ...]
    largest: Mapping[str, ParameterChange]
    min_effect: Mapping[str, float]
    against: tuple[Contradiction, ...]
    advice: str
    threshold: float
    seconds: float
    far: Mapping[str, float]


def drift(
    robot: RobotSpec,
    uncertainty: ParameterUncertainty,
    sequences: ListOf[Sequence],
    nthread: int = 0,
) -> Drift:
    """Compare recordings of a robot that should be the same with the stored uncertainty of an
    identified robot.

    Raises:
        UsageError: The recordings are too short, or move no joint that was identified.
    """
    seen = evidence(robot, sequences, uncertainty.fields, nthread=nthread)
    if not seen.rows.any():
        raise UsageError(
            "no recording moves an operated joint away from what it may touch; record gaponet "
            "excite's"
        )
    joints = robot.operated
    _require_identified(robot, seen)
    repeatability = _repeatability(uncertainty, sequences, joints)
    far = _far_joints(uncertainty, seen, joints, repeatability)
    stored = [uncertainty.array(joint, "overdispersion") for joint in joints]
    overdispersion = np.maximum(np.stack(stored), 1.0)  # (n, Q)
    against = _contradictions(seen, overdispersion, uncertainty, joints)
    set_aside = {contradiction.recording for contradiction in against}
    is_contradictory = len(set_aside) > MAX_SET_ASIDE * len(seen.names)
    if not is_contradictory:
        seen = seen.without(set_aside)
    gradients, threshold = _gradients_to_explain(
        seen, overdispersion, uncertainty, joints, repeatability
    )
    moved, largest = _changes(gradients, threshold)
    verdict: Verdict = "same"
    if is_contradictory:
        verdict = "contradictory"
    elif moved or far:
        verdict = "drifted"
    return Drift(
        verdict=verdict,
        moved=tuple(moved),
        largest=largest,
        min_effect={joint.name: joint.min_effect for joint in gradients},
        against=tuple(against),
        advice=drift_advice(verdict, moved, against, joints, far),
        threshold=threshold,
        seconds=float(sum(s.duration for s in sequences)),
        far=far,
    )


def _require_identified(robot: RobotSpec, seen: Evidence) -> None:
    """Raise UsageError if no joint that the recordings hold was identified."""
    held = {j for j, rows in zip(robot.operated, seen.rows, strict=True) if rows}
    if not held & identified_joints(robot):
        raise UsageError(
            f"{robot.folder}: these recordings hold only joints that were never identified: "
            f"{', '.join(sorted(held))}. Identify these joints first"
        )


def _repeatability(
    uncertainty: ParameterUncertainty,
    sequences: ListOf[Sequence],
    joints: ListOf[str],
) -> dict[str, float]:
    """Return joint → RMS difference between two recordings of one command, rad: that of the
    identification.

    Where that had no repetitions, these recordings' own difference counts, which may itself have
    become worse.
    """
    today = repetition_difference(sequences, joints)
    differences = {}
    for joint, difference in zip(joints, today, strict=True):
        differences[joint] = uncertainty.joints[joint].repeatability or float(difference)
    return differences


def _far_joints(
    uncertainty: ParameterUncertainty,
    seen: Evidence,
    joints: ListOf[str],
    repeatability: Mapping[str, float],
) -> dict[str, float]:
    """Return joint → error over the identification's residual, where it exceeds FAR_RATIO."""
    far = {}
    for joint, errors in zip(joints, seen.window_rms, strict=True):
        usual = max(uncertainty.joints[joint].residual_rms, repeatability[joint], 1e-9)
        times = float(np.median(errors)) / usual
        if times > FAR_RATIO:
            far[joint] = times
    return far


def _contradictions(
    seen: Evidence,
    overdispersion: Array,
    uncertainty: ParameterUncertainty,
    joints: ListOf[str],
) -> list[Contradiction]:
    """Return the recordings that contradict the others, the farthest first; each is left out of
    the others.
    """
    against: list[Contradiction] = []
    rest = seen.by_recording()
    fields = (*uncertainty.fields, PLAY)
    while len(rest.names) > 1:
        worst = _farthest(rest, overdispersion, uncertainty, joints, fields)
        if worst is None:
            break
        against.append(worst)
        rest = rest.without({worst.recording})
    return against


def _gradients_to_explain(
    seen: Evidence,
    overdispersion: Array,
    uncertainty: ParameterUncertainty,
    joints: ListOf[str],
    repeatability: Mapping[str, float],
) -> tuple[list[_JointGradient], float]:
    """Return the gradients of the joints, and the number of standard errors from which a change is
    significant.

    The identification's overdispersion counts as that of MAX_PRIOR_CLUSTERS clusters at most,
    beside those of these recordings; Student's t has their degrees of freedom, and all parameters
    together raise FALSE_ALARM_RATE.
    """
    if len(seen.names) > 1:
        seen = seen.by_recording()
    clusters = seen.gradients.shape[1]
    trusted = min(uncertainty.clusters, MAX_PRIOR_CLUSTERS)
    freedom = trusted + clusters - 1
    tests = len(joints) * (len(uncertainty.fields) + 1) + len(COMMON_FIELDS)
    threshold = float(student.isf(FALSE_ALARM_RATE / tests / 2, freedom))
    information = seen.information.sum(axis=1)  # (n, Q, Q)
    expected = trusted * widened(information, overdispersion)
    scatter = expected + (clusters - 1) * gradient_covariance(seen.gradients)
    total = seen.gradients.sum(axis=1)  # (n, Q)
    gradients = []
    for i, joint in enumerate(joints):
        of_joint = _JointGradient(
            joint,
            uncertainty,
            information=information[i],
            gradient=total[i],
            scatter=scatter[i] / freedom,
            rows=int(seen.rows[i]),
            repeatability=repeatability[joint],
        )
        gradients.append(of_joint)
    return gradients, threshold


def _changes(
    joints: ListOf[_JointGradient], threshold: float
) -> tuple[list[ParameterChange], dict[str, ParameterChange]]:
    """Return the significant changes, and joint → its largest change: first those that all joints
    share.
    """
    moved: list[ParameterChange] = []
    if len(joints) > 1:
        for field in COMMON_FIELDS:
            number = joints[0].fields.index(field)
            together = _together(joints, number, threshold)
            if together is not None:
                moved.append(together)
    largest = {change.joint: change for change in moved}
    for joint in joints:
        changes, first = joint.explained(threshold)
        moved += changes
        if first is not None:
            largest[joint.name] = first
    return moved, largest


class _JointGradient:
    """Gradient of one joint that changes are to explain, beyond that of the identification.

    Attributes:
        fields: The fields of the axes, and play, (Q,).
        gradient: (Q,).
        columns: Gradient by a change of each parameter, (Q, Q).
        weight: Inverse of the gradient's covariance, (Q, Q).
        effect: RMS effect of a change of each parameter by one on the joint's path, (Q,) rad.
        min_effect: Least effect that counts, rad.
    """

    def __init__(
        self,
        name: str,
        uncertainty: ParameterUncertainty,
        information: Array,
        gradient: Array,
        scatter: Array,
        rows: int,
        repeatability: float,
    ) -> None:
        """
        Args:
            information, scatter: Of the recordings, and the covariance of their gradients, (Q, Q).
            gradient: Sum over the recordings, (Q,).
            rows: Number of rows that hold the joint.
            repeatability: RMS difference between two recordings of one command, rad.
        """
        self.name = name
        self.fields = (*uncertainty.fields, PLAY)
        # Change of the axes and play by a change of one parameter in SI units, column by column,
        # (Q, Q): a softer motor has the friction that it had, so its friction over kp is larger.
        by_field = np.eye(len(self.fields))
        over_kp = [SERVO_FIELDS[field].axis == "over kp" for field in uncertainty.fields]
        by_field[:-1, self.fields.index("kp")] -= uncertainty.array(name, "values") * over_kp
        step_covariance = uncertainty.array(name, "gauss_newton_covariance")
        variance = scatter + information @ step_covariance @ information
        size = np.sqrt(np.maximum(np.diag(variance), 1e-30))
        scale = np.outer(size, size)
        self.weight = np.linalg.inv(variance / scale + 1e-9 * np.eye(len(size))) / scale
        squares = np.maximum(np.diag(by_field.T @ information @ by_field), 0.0) / max(rows, 1)
        self.effect = ERROR_SCALE_RAD * np.sqrt(squares)
        self.min_effect = max(
            MIN_EFFECT_RATIO * uncertainty.joints[name].residual_rms, repeatability
        )
        self.gradient = -gradient - information @ uncertainty.array(name, "gauss_newton_step")
        self.columns = information @ by_field

    def explained(self, threshold: float) -> tuple[list[ParameterChange], ParameterChange | None]:
        """Return the significant changes with enough effect, and the largest change of one
        parameter alone.

        One parameter after the other is added, the one that is most significant beside those
        before.
        """
        changes: list[ParameterChange] = []
        first: ParameterChange | None = None
        while len(changes) < MAX_CHANGES_PER_JOINT:
            with_next = self._with_next(changes)
            if with_next is None:
                break
            newest = with_next[-1]
            if first is None:
                first = newest
            if abs(newest.sigmas) < threshold or newest.moves < self.min_effect:
                break
            changes = with_next
        return changes, first

    def _with_next(self, changes: list[ParameterChange]) -> list[ParameterChange] | None:
        """Return changes with the most significant further one, all fitted anew; None if there is
        no other parameter.
        """
        chosen = [self.fields.index(change.field) for change in changes]
        best: list[ParameterChange] | None = None
        for number in np.flatnonzero(self.effect > 0).tolist():
            if number in chosen:
                continue
            tried = self._fitted([*chosen, number])
            if best is None or abs(tried[-1].sigmas) > abs(best[-1].sigmas):
                best = tried
        return best

    def _fitted(self, numbers: list[int]) -> list[ParameterChange]:
        """Return the changes of parameters, by their numbers, that explain the gradient best."""
        by, errors = _solved(self.columns[:, numbers], self.weight, self.gradient)
        changes = []
        for number, change, error in zip(numbers, by, errors, strict=True):
            moves = float(abs(change) * self.effect[number])
            field = self.fields[number]
            changes.append(ParameterChange(self.name, field, float(change), float(error), moves))
        return changes


def _together(
    joints: ListOf[_JointGradient],
    number: int,
    threshold: float,
) -> ParameterChange | None:
    """Return a parameter that changed in every joint by the same, if that is more significant than
    the joints' own changes; it is then taken out of their gradients.
    """
    change = _common_change(joints, number)
    if change.moves < np.mean([joint.min_effect for joint in joints]):
        return None
    needed = threshold
    for joint in joints:
        _, largest = joint.explained(np.inf)
        if largest is not None:
            needed = max(needed, abs(largest.sigmas))
    if abs(change.sigmas) < needed:
        return None
    for joint in joints:
        joint.gradient = joint.gradient - change.by * joint.columns[:, number]
    return change


def _common_change(joints: ListOf[_JointGradient], number: int) -> ParameterChange:
    """Return the one change of a parameter in every joint that explains all gradients best."""
    information = []
    pulls = []
    for joint in joints:
        weighted = joint.columns[:, number] @ joint.weight
        information.append(weighted @ joint.columns[:, number])
        pulls.append(weighted @ joint.gradient)
    total = max(np.array(information).sum(), 1e-300)
    by = float(np.array(pulls).sum() / total)
    error = float(total**-0.5)
    squares = [(by * joint.effect[number]) ** 2 for joint in joints]
    moves = float(np.sqrt(np.mean(squares)))
    return ParameterChange(EVERY_JOINT, joints[0].fields[number], by, error, moves)


def _solved(columns: Array, weight: Array, pull: Array) -> tuple[Array, Array]:
    """Return the changes of some fields that explain a gradient best, and their standard errors."""
    covariance = np.linalg.pinv(columns.T @ weight @ columns, hermitian=True)
    changes = covariance @ columns.T @ weight @ pull
    return changes, np.sqrt(np.maximum(np.diag(covariance), 1e-300))


def _farthest(
    seen: Evidence,
    overdispersion: Array,
    uncertainty: ParameterUncertainty,
    joints: ListOf[str],
    fields: ListOf[str],
) -> Contradiction | None:
    """Return the recording that differs most from the others, by more than recordings scatter, and
    its field.
    """
    count = len(seen.names)
    rate = FALSE_CONTRADICTION_RATE / (count * len(joints) * len(fields))
    limit = float(student.isf(rate / 2, min(uncertainty.clusters, MAX_PRIOR_CLUSTERS)))
    worst = None
    for i, joint in enumerate(joints):
        residual = uncertainty.joints[joint].residual_rms
        for recording in range(count):
            for found in _differences(seen, i, recording, overdispersion[i]):
                if abs(found.sigmas) > limit and found.effect > residual:
                    limit = abs(found.sigmas)
                    name = seen.names[recording]
                    field = fields[found.number]
                    worst = Contradiction(name, joint, field, found.by, found.sigmas)
    return worst


class _Difference(NamedTuple):
    """Difference of one recording from all others together, in one parameter of a joint."""

    number: int  # of the parameter
    by: float  # on its axis
    sigmas: float  # the same in standard errors
    effect: float  # RMS on the joint's path, rad


def _differences(
    seen: Evidence,
    joint: int,
    recording: int,
    overdispersion: Array,
) -> list[_Difference]:
    """Return by how much a recording differs from all others together, for one joint; without
    parameters of which the others say too little.
    """
    mine = seen.information[joint, recording]  # (Q, Q)
    rest = seen.information[joint].sum(axis=0) - mine
    gradient = seen.gradients[joint, recording]  # (Q,)
    gradient_of_rest = seen.gradients[joint].sum(axis=0) - gradient
    # The others' Gauss-Newton step as a gradient of this recording.
    carried = mine @ inverted(rest[None])[0]
    difference = carried @ gradient_of_rest - gradient
    of_mine = widened(mine, overdispersion)
    of_rest = carried @ widened(rest, overdispersion) @ carried.T
    weight = np.linalg.pinv(of_mine + of_rest, rcond=1e-9, hermitian=True)
    recordings = len(seen.names)
    rows = max(float(seen.rows[joint]), 1)  # of all recordings
    differences = []
    for number in range(len(mine)):
        own_information = mine[number, number]
        if own_information <= 0:
            continue
        if rest[number, number] < MIN_INFORMATION_OF_OTHERS * own_information:
            continue
        by, error = _solved(mine[:, [number]], weight, difference)  # (1,) each
        sigmas = by[0] / error[0]
        effect = ERROR_SCALE_RAD * abs(by[0]) * np.sqrt(own_information * recordings / rows)
        found = _Difference(number, float(by[0]), float(sigmas), float(effect))
        differences.append(found)
    return differences


def drift_advice(
    verdict: Verdict,
    moved: ListOf[ParameterChange],
    against: ListOf[Contradiction],
    joints: ListOf[str],
    far: Mapping[str, float],
) -> str:
    """Return what to do after a comparison.

    Args:
        verdict: Of the comparison.
        moved: Parameters that changed.
        against: Recordings that contradict the others.
        joints: All joints that are operated.
        far: Joint → how many times the stored residual its error is, where that is too much.
    """
    if verdict == "same":
        return "nothing to do"
    if verdict == "contradictory":
        names = ", ".join(dict.fromkeys(a.recording for a in against))
        return (
            f"these recordings contradict each other ({names}): another robot's are among them, "
            "or something changed on the way; check them apart, adapt with none of this"
        )
    if not moved:
        times = ", ".join(f"{j} {by:.1f} times" for j, by in far.items())
        return (
            f"no number explains how far these logs are from the model ({times} the residual): "
            "another robot, payload or controller, or a part that gives way; look at it, then "
            "identify again"
        )
    return (
        _another_robot_advice(moved, joints)
        or _gearbox_advice(moved)
        or _friction_advice(moved, joints)
        or "adapt with these logs: gaponet adapt ROBOT LOGS --out ROBOT_TODAY"
    )


def _another_robot_advice(moved: ListOf[ParameterChange], joints: ListOf[str]) -> str:
    """Return what to do if many joints changed as another robot's would; else nothing."""
    odd = []
    for joint in joints:
        changes = [change for change in moved if change.joint == joint]
        if _is_odd(changes):
            odd.append(joint)
    if len(odd) <= MAX_CHANGED_JOINTS * len(joints) or len(odd) == 1:
        return ""
    return (
        f"{len(odd)} of {len(joints)} joints have another stiffness or several other numbers: is "
        "this the same robot, with the same gains and payload? If so, identify again; an "
        "adaptation is not enough"
    )


def _gearbox_advice(moved: ListOf[ParameterChange]) -> str:
    """Return what to do if joints have play that was not there; else nothing."""
    with_play = {change.joint for change in moved if change.field == PLAY and change.by > 0}
    if not with_play:
        return ""
    joints = ", ".join(sorted(with_play))
    return (
        f"look at the gearbox and the screws of {joints}: play that was not there; then "
        "identify again"
    )


def _is_odd(changes: ListOf[ParameterChange]) -> bool:
    """Return whether a joint's changes are rather another robot's: several, or one of its
    stiffness.
    """
    return len(changes) > 1 or any(change.field == "kp" for change in changes)


def _friction_advice(moved: ListOf[ParameterChange], joints: ListOf[str]) -> str:
    """Return what to do if most joints turn more easily, or harder; else nothing."""
    of_friction = [change for change in moved if change.field in FRICTION_FIELDS]
    changed_joints = {change.joint for change in of_friction}
    if len(changed_joints) <= len(joints) / 2:
        return ""
    if all(change.by < 0 for change in of_friction):
        how = "more easily: warmer"
    elif all(change.by > 0 for change in of_friction):
        how = "harder: colder, or dry"
    else:
        return ""
    return (
        f"most joints turn {how}? Check again as warm as when it was identified, or adapt for now"
    )
