"""Whether later recordings are still of the robot that was identified: by joint, which number moved, and by how much.

At the robot's own values every cluster of the recordings pulls at the parameters. On the day of the identification
these pulls all but balanced; what they lack of it now, beyond what recordings scatter, is a change. It is put down to
as few numbers as explain it, the one that explains most first: to a joint's fields, or to play that was not there.
"""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as ListOf
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.data.sequence import Sequence
from gaponet.robot.spec import RobotSpec
from gaponet.sysid.axes import OVER_KP
from gaponet.sysid.evidence import PLAY, Evidence, evidence, inverted, spread_of
from gaponet.sysid.joint_rollouts import SOFT
from gaponet.sysid.uncertainty import ParameterUncertainty

ALARM = 0.003  # of a robot that did not change: how often any of its numbers is said to have moved
AGAINST = 1e-4  # the same of a recording that is said to contradict the others
FELT = 0.15  # of what the model leaves anyway: a change that moves a joint by less is none that matters
MOST = 3  # numbers of a joint that are named
TRUSTED = 40  # the most clusters that what was known counts as
MINORITY = 0.4  # of the recordings: so many that say something else are set aside, more contradict the others
SHARED = ("delay",)  # of one bus: all joints' move together
EVERY = "every joint"
WARM = ("damping", "frictionloss", "stribeck")
FAR = 2.5  # times what the model left when it was identified, in half of the windows: no longer this robot
ELSE = 0.4  # of all joints: so many with kp or several numbers moved are another robot's

Verdict = str  # same, drifted, contradictory


@dataclass(frozen=True)
class Moved:
    """A number of a joint that is another one now.

    Attributes:
        field: The servo's field, or play (rad).
        by, error: Change on the axes of sysid/uncertainty.py and its standard error.
        moves: How far that moves the joint along these recordings, RMS, rad.
    """

    joint: str
    field: str
    by: float
    error: float
    moves: float

    @property
    def sigmas(self) -> float:
        """Standard deviations: noise, the model's errors and how far recordings scatter together."""
        return self.by / self.error


@dataclass(frozen=True)
class Against:
    """A recording that says something else than the others: joint, field, by how much, in standard deviations."""

    recording: str
    joint: str
    field: str
    by: float
    sigmas: float


@dataclass(frozen=True)
class Drift:
    """What was found; the largest change of every joint, whether it counts or not; recordings that were set aside since
    they differ from the others; joints that are FAR from the model, and how many times what it left."""

    verdict: Verdict
    moved: tuple[Moved, ...]
    largest: Mapping[str, Moved]
    against: tuple[Against, ...]
    advice: str
    threshold: float
    seconds: float
    far: Mapping[str, float]


def drift(robot: RobotSpec, known: ParameterUncertainty, sequences: ListOf[Sequence], nthread: int = 0) -> Drift:
    """Compare recordings with what is known of a robot.

    Args:
        robot: The robot of the folder that keeps the knowledge.
        sequences: Recordings of the robot that is said to be the same.

    Raises:
        UsageError: The recordings are too short, or move no joint.
    """
    says = evidence(robot, sequences, known.fields, nthread=nthread)
    if not says.rows.any():
        raise UsageError("no recording moves an operated joint away from what it may touch; record gaponet excite's")
    fields, joints = (*known.fields, PLAY), robot.operated
    times = {
        j: float(np.median(e)) / max(known.joints[j].residual_rms, 1e-9) for j, e in zip(joints, says.left, strict=True)
    }
    far = {j: by for j, by in times.items() if by > FAR}
    scatter = np.stack([np.maximum(known.array(j, "overdispersion"), 1.0) for j in joints])
    against = _contradictions(says.by_recording(), scatter, known, joints, fields)
    aside = {a.recording for a in against}
    contradictory = len(aside) > MINORITY * len(says.names)
    says = says if contradictory else says.without(aside)
    grouped = says.by_recording() if len(says.names) > 1 else says
    clusters, trusted = grouped.pulls.shape[1], min(known.clusters, TRUSTED)
    tests = len(joints) * len(fields) + len(SHARED)
    threshold = float(student.isf(ALARM / tests / 2, trusted + clusters - 1))
    normal = grouped.normals.sum(axis=1)
    spread = trusted * widened(normal, scatter) + (clusters - 1) * spread_of(grouped.pulls)
    each = [
        _Joint.of(j, fields, known, normal[i], grouped.pulls[i].sum(axis=0), spread[i] / (trusted + clusters - 1),
                  int(says.rows[i]))
        for i, j in enumerate(joints)
    ]  # fmt: skip
    moved = [m for f in SHARED if len(joints) > 1 and (m := _together(each, fields.index(f), threshold))]
    largest: dict[str, Moved] = {m.joint: m for m in moved}
    for one in each:
        found, first = one.explained(threshold)
        moved += found
        largest |= {one.name: first} if first else {}
    verdict = "contradictory" if contradictory else "drifted" if moved or far else "same"
    seconds = float(sum(s.duration for s in sequences))
    return Drift(
        verdict, tuple(moved), largest, against, _advice(verdict, moved, against, joints, far), threshold, seconds, far
    )


def widened(normal: Array, scatter: Array) -> Array:
    """Covariance of the sum of pulls, (n, Q, Q), that scatter so much farther than independent rows."""
    root = np.sqrt(scatter)
    return np.asarray(root[..., :, None] * normal * root[..., None, :])


def directions(known: ParameterUncertainty, joint: str) -> Array:
    """How the axes and play move when one number alone does, in SI: column by column, (Q, Q). A softer motor has the
    friction that it had, so over its gain it has more."""
    found = np.eye(len(known.fields) + 1)
    for i, (field, value) in enumerate(zip(known.fields, known.joints[joint].values, strict=True)):
        found[i, known.fields.index("kp")] -= value * (field in OVER_KP)
    return found


@dataclass
class _Joint:
    """One joint's pull (Q), what a change of each number pulls (Q, Q), the inverse of the pull's covariance (Q, Q), by
    how much a change of one moves the joint, RMS (Q) rad, and what is felt, rad."""

    name: str
    fields: tuple[str, ...]
    pull: Array
    columns: Array
    weight: Array
    length: Array
    felt: float

    @classmethod
    def of(
        cls,
        joint: str,
        fields: tuple[str, ...],
        known: ParameterUncertainty,
        normal: Array,
        pulls: Array,
        spread: Array,
        rows: int,
    ) -> _Joint:
        """What is left of the pulls that the robot had when it was identified."""
        step, about, way = (
            known.array(joint, "gauss_newton_step"),
            known.array(joint, "gauss_newton_covariance"),
            directions(known, joint),
        )
        variance = spread + normal @ about @ normal
        size = np.sqrt(np.maximum(np.diag(variance), 1e-30))
        weight = np.linalg.inv(variance / np.outer(size, size) + 1e-9 * np.eye(len(size))) / np.outer(size, size)
        length = SOFT * np.sqrt(np.maximum(np.diag(way.T @ normal @ way), 0.0) / max(rows, 1))
        felt = FELT * known.joints[joint].residual_rms
        return cls(joint, fields, -pulls - normal @ step, normal @ way, weight, length, felt)

    def explained(self, threshold: float) -> tuple[list[Moved], Moved | None]:
        """The numbers that moved, and the largest change of one alone; each is worth naming where it also is felt."""
        told: list[Moved] = []
        first: Moved | None = None
        while len(told) < MOST:
            chosen, what = [self.fields.index(m.field) for m in told], list[Moved]()
            for k in np.flatnonzero(self.length > 0).tolist():
                if k not in chosen:
                    tried = self._moved([*chosen, k])
                    what = tried if not what or abs(tried[-1].sigmas) > abs(what[-1].sigmas) else what
            first = first or (what[-1] if what else None)
            if not what or abs(what[-1].sigmas) < threshold or what[-1].moves < self.felt:
                break
            told = what
        return told, first

    def _moved(self, numbers: list[int]) -> list[Moved]:
        by, error = _solved(self.columns[:, numbers], self.weight, self.pull)
        return [
            Moved(self.name, self.fields[i], float(b), float(e), float(abs(b) * self.length[i]))
            for i, b, e in zip(numbers, by, error, strict=True)
        ]


def _together(joints: ListOf[_Joint], number: int, threshold: float) -> Moved | None:
    """A number that moved in every joint by the same, if that says more than the joints do alone; it is taken out."""
    known = np.array([j.columns[:, number] @ j.weight @ j.columns[:, number] for j in joints])
    says = np.array([j.columns[:, number] @ j.weight @ j.pull for j in joints])
    by, error = float(says.sum() / max(known.sum(), 1e-300)), float(max(known.sum(), 1e-300) ** -0.5)
    moves = float(np.sqrt(np.mean([(by * j.length[number]) ** 2 for j in joints])))
    found = Moved(EVERY, joints[0].fields[number], by, error, moves)
    alone = max((abs(m.sigmas) for j in joints if (m := j.explained(np.inf)[1])), default=0.0)
    if abs(found.sigmas) < max(threshold, alone) or moves < np.mean([j.felt for j in joints]):
        return None
    for j in joints:
        j.pull = j.pull - by * j.columns[:, number]
    return found


def _solved(columns: Array, weight: Array, pull: Array) -> tuple[Array, Array]:
    """Changes of some fields that explain pulls best, and their standard errors."""
    covariance = np.linalg.pinv(columns.T @ weight @ columns, hermitian=True)
    return covariance @ columns.T @ weight @ pull, np.sqrt(np.maximum(np.diag(covariance), 1e-300))


def _contradictions(
    says: Evidence, scatter: Array, known: ParameterUncertainty, joints: ListOf[str], fields: ListOf[str]
) -> tuple[Against, ...]:
    """Recordings that differ from the rest of them by more than recordings do, the farthest first, which is then left
    out of the rest; of each its farthest number."""
    found: list[Against] = []
    while len(says.names) > 1 and (worst := _farthest(says, scatter, known, joints, fields)):
        found.append(worst)
        says = says.without({worst.recording})
    return tuple(found)


def _farthest(
    says: Evidence, scatter: Array, known: ParameterUncertainty, joints: ListOf[str], fields: ListOf[str]
) -> Against | None:
    count, worst = len(says.names), None
    limit = float(student.isf(AGAINST / (count * len(joints) * len(fields)) / 2, min(known.clusters, TRUSTED)))
    for i, joint in enumerate(joints):
        total, pulls = says.normals[i].sum(axis=0), says.pulls[i].sum(axis=0)
        for r in range(count):
            mine, rest = says.normals[i, r], total - says.normals[i, r]
            carried = mine @ inverted(rest[None])[0]
            left = carried @ (pulls - says.pulls[i, r]) - says.pulls[i, r]
            variance = widened(mine, scatter[i]) + carried @ widened(rest, scatter[i]) @ carried.T
            weight = np.linalg.pinv(variance, rcond=1e-9, hermitian=True)
            for k in range(len(fields)):
                if mine[k, k] <= 0 or rest[k, k] < 0.5 * mine[k, k]:
                    continue
                by, error = _solved(mine[:, [k]], weight, left)
                sigmas = float(by[0] / error[0])
                felt = SOFT * abs(by[0]) * np.sqrt(mine[k, k] * count / max(float(says.rows[i]), 1))
                if (
                    abs(sigmas) > max(limit, abs(worst.sigmas) if worst else 0)
                    and felt > known.joints[joint].residual_rms
                ):
                    worst = Against(says.names[r], joint, fields[k], float(by[0]), sigmas)
    return worst


def _advice(
    verdict: Verdict, moved: ListOf[Moved], against: ListOf[Against], joints: ListOf[str], far: Mapping[str, float]
) -> str:
    """What to do."""
    if verdict == "same":
        return "nothing to do"
    if verdict == "contradictory":
        names = ", ".join(dict.fromkeys(a.recording for a in against))
        return (
            f"these recordings contradict each other ({names}): another robot's are among them, or something changed "
            "on the way; check them apart, adapt with none of this"
        )
    if not moved:
        told = ", ".join(f"{j} {by:.1f} times" for j, by in far.items())
        return (
            f"no number explains how far these logs are from the model ({told} what it left): another robot, payload "
            "or controller, or a part that gives way; look at it, then identify again"
        )
    by = {j: [m for m in moved if m.joint == j] for j in joints}
    odd = [j for j, ms in by.items() if len(ms) > 1 or any(m.field == "kp" for m in ms)]
    if len(odd) > ELSE * len(joints) and len(odd) > 1:
        return (
            f"{len(odd)} of {len(joints)} joints have another stiffness or several other numbers: is this the same "
            "robot, with the same gains and payload? If so, identify again; an adaptation is not enough"
        )
    play = sorted({m.joint for m in moved if m.field == PLAY and m.by > 0})
    if play:
        return f"look at the gearbox and the screws of {', '.join(play)}: play that was not there; then identify again"
    eased = [m for m in moved if m.field in WARM]
    ways = {np.sign(m.by) for m in eased}
    if len({m.joint for m in eased}) > len(joints) / 2 and len(ways) == 1:
        how = "more easily: warmer" if ways == {-1.0} else "harder: colder, or dry"
        return f"most joints turn {how}? Check again as warm as when it was identified, or adapt for now"
    return "adapt with these logs: gaponet adapt ROBOT LOGS --out ROBOT_TODAY"
