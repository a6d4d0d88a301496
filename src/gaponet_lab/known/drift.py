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

from gaponet.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.errors import UsageError
from gaponet.eval.knowledge import Knowledge
from gaponet.robot import RobotSpec
from gaponet.sim.axes import OVER_KP
from gaponet.sim.joint_runs import SOFT
from gaponet_lab.known.evidence import PLAY, Evidence, evidence, inverted, spread_of

ALARM = 0.002  # of a robot that did not change: how often any of its numbers is said to have moved
AGAINST = 1e-4  # the same of a recording that is said to contradict the others
FELT = 0.15  # of what the model leaves anyway: a change that moves a joint by less is none that matters
MOST = 3  # numbers of a joint that are named
FEWEST, ROBUST = 6, 12  # recordings that speak for themselves; clusters that a scatter known from before counts as
WARM = ("damping", "frictionloss", "stribeck")
ELSE = 0.4  # of all joints: so many with kp or several numbers moved are another robot's

Verdict = str  # same, drifted, contradictory


@dataclass(frozen=True)
class Moved:
    """A number of a joint that is another one now.

    Attributes:
        field: Of the servo, or play (rad).
        by, error: Change on the axes of eval/knowledge.py and its standard error.
        moves: By how much that moves the joint along these recordings, RMS, rad.
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
    """What was found; the largest change of every joint with its standard deviations, whether it counts or not."""

    verdict: Verdict
    moved: tuple[Moved, ...]
    largest: Mapping[str, Moved]
    against: tuple[Against, ...]
    advice: str
    threshold: float
    seconds: float


def drift(robot: RobotSpec, known: Knowledge, sequences: ListOf[Sequence], nthread: int = 0) -> Drift:
    """Compare recordings with what is known of a robot.

    Args:
        robot: Of the folder that keeps the knowledge.
        sequences: Of the robot that is said to be the same.

    Raises:
        UsageError: The recordings are too short, or move no joint.
    """
    says = evidence(robot, sequences, known.fields, nthread=nthread)
    if not says.rows.any():
        raise UsageError("no recording moves an operated joint away from what it may touch; record gaponet excite's")
    fields, joints = (*known.fields, PLAY), robot.operated
    grouped = says.by_recording() if len(says.names) >= FEWEST else says
    clusters = grouped.pulls.shape[1]
    scatter = np.stack([known.array(j, "scatter") for j in joints])
    free = ROBUST + clusters - 1
    tests = len(joints) * len(fields)
    threshold = float(student.isf(ALARM / tests / 2, free))
    normal, spread = grouped.normals.sum(axis=1), spread_of(grouped.pulls)
    expected = widened(normal, np.maximum(scatter, 1.0))
    spread = (ROBUST * expected + (clusters - 1) * spread) / free
    moved: list[Moved] = []
    largest: dict[str, Moved] = {}
    for i, joint in enumerate(joints):
        step, about = known.array(joint, "step"), known.array(joint, "step_covariance")
        pull = -grouped.pulls[i].sum(axis=0) - normal[i] @ step
        variance = spread[i] + normal[i] @ about @ normal[i]
        felt = FELT * known.joints[joint].left
        way = directions(known, joint)
        length = SOFT * np.sqrt(np.maximum(np.diag(way.T @ normal[i] @ way), 0.0) / max(int(says.rows[i]), 1))
        found, first = _explained(joint, fields, normal[i] @ way, length, pull, variance, threshold, felt)
        moved += found
        if first is not None:
            largest[joint] = first
    against = _contradictions(says.by_recording(), scatter, known, joints, fields)
    verdict = "contradictory" if against else "drifted" if moved else "same"
    seconds = float(sum(s.duration for s in sequences))
    return Drift(verdict, tuple(moved), largest, against, _advice(verdict, moved, against, joints), threshold, seconds)


def widened(normal: Array, scatter: Array) -> Array:
    """Covariance of the sum of pulls, (n, Q, Q), that scatter so much farther than independent rows."""
    root = np.sqrt(scatter)
    return np.asarray(root[..., :, None] * normal * root[..., None, :])


def directions(known: Knowledge, joint: str) -> Array:
    """How the axes and play move when one number alone does, in SI: column by column, (Q, Q). A softer motor has the
    friction that it had, so over its gain it has more."""
    found = np.eye(len(known.fields) + 1)
    for i, (field, value) in enumerate(zip(known.fields, known.joints[joint].values, strict=True)):
        found[i, known.fields.index("kp")] -= value * (field in OVER_KP)
    return found


def _explained(
    joint: str, fields: ListOf[str], columns: Array, length: Array, pull: Array, variance: Array, threshold: float,
    felt: float,
) -> tuple[list[Moved], Moved | None]:  # fmt: skip
    """The numbers that moved, and the largest change of one alone; each is worth naming where it also is felt.

    columns: what a change of each number pulls, (Q, Q); length: by how much it moves the joint, RMS, (Q) rad.
    """
    size = np.sqrt(np.maximum(np.diag(variance), 1e-30))
    weight = np.linalg.inv(variance / np.outer(size, size) + 1e-9 * np.eye(len(size))) / np.outer(size, size)
    told: list[Moved] = []
    first: Moved | None = None
    while len(told) < MOST:
        chosen, best = [fields.index(m.field) for m in told], 0.0
        what: list[Moved] = []
        for k in range(len(fields)):
            if k in chosen or length[k] <= 0:
                continue
            by, error = _solved(columns[:, [*chosen, k]], weight, pull)
            if abs(by[-1]) / error[-1] > best:
                best = abs(by[-1]) / error[-1]
                what = [
                    Moved(joint, fields[i], float(b), float(e), float(abs(b) * length[i]))
                    for i, b, e in zip([*chosen, k], by, error, strict=True)
                ]
        if not what:
            break
        first = first or what[-1]
        if best < threshold or what[-1].moves < felt:
            break
        told = what
    return told, first


def _solved(columns: Array, weight: Array, pull: Array) -> tuple[Array, Array]:
    """Changes of some fields that explain pulls best, and their standard errors."""
    covariance = np.linalg.pinv(columns.T @ weight @ columns, hermitian=True)
    return covariance @ columns.T @ weight @ pull, np.sqrt(np.maximum(np.diag(covariance), 1e-300))


def _contradictions(
    says: Evidence, scatter: Array, known: Knowledge, joints: ListOf[str], fields: ListOf[str]
) -> tuple[Against, ...]:
    """Recordings that differ from the rest of them by more than recordings do, the farthest number of each."""
    count = len(says.names)
    if count < 2:
        return ()
    limit = float(student.isf(AGAINST / (count * len(joints) * len(fields)) / 2, ROBUST))
    found: list[Against] = []
    for r in range(count):
        worst: Against | None = None
        for i, joint in enumerate(joints):
            mine, all_of = says.normals[i, r], says.normals[i].sum(axis=0)
            rest = all_of - mine
            pull, others = -says.pulls[i, r], -(says.pulls[i].sum(axis=0) - says.pulls[i, r])
            root = np.sqrt(np.maximum(scatter[i], 1.0))
            inverse = inverted(rest[None])[0]
            carried = mine @ inverse
            left = pull - carried @ others
            variance = np.outer(root, root) * mine + carried @ (np.outer(root, root) * rest) @ carried.T
            for k in range(len(fields)):
                if mine[k, k] <= 0 or rest[k, k] < 0.5 * mine[k, k]:
                    continue
                by, error = _solved(mine[:, [k]], np.linalg.pinv(variance, rcond=1e-9, hermitian=True), left)
                sigmas = float(by[0] / error[0])
                felt = SOFT * abs(by[0]) * np.sqrt(mine[k, k] * count / max(float(says.rows[i]), 1))
                if abs(sigmas) > max(limit, abs(worst.sigmas) if worst else 0) and felt > known.joints[joint].left:
                    worst = Against(says.names[r], joint, fields[k], float(by[0]), sigmas)
        found += [worst] if worst else []
    return tuple(found)


def _advice(verdict: Verdict, moved: ListOf[Moved], against: ListOf[Against], joints: ListOf[str]) -> str:
    """What to do."""
    if verdict == "same":
        return "nothing to do"
    if verdict == "contradictory":
        names = ", ".join(dict.fromkeys(a.recording for a in against))
        return (
            f"these recordings contradict each other ({names}): another robot's are among them, or something changed "
            "on the way; check them apart, calibrate with none of this"
        )
    by = {j: [m for m in moved if m.joint == j] for j in joints}
    odd = [j for j, ms in by.items() if len(ms) > 1 or any(m.field == "kp" for m in ms)]
    if len(odd) > ELSE * len(joints) and len(odd) > 1:
        return (
            f"{len(odd)} of {len(joints)} joints have another stiffness or several other numbers: is this the same "
            "robot, with the same gains and payload? If so, identify again; a calibration is not enough"
        )
    play = sorted({m.joint for m in moved if m.field == PLAY and m.by > 0})
    if play:
        return f"look at the gearbox and the screws of {', '.join(play)}: play that was not there; then identify again"
    eased = [m for m in moved if m.field in WARM]
    ways = {np.sign(m.by) for m in eased}
    if len({m.joint for m in eased}) > len(joints) / 2 and len(ways) == 1:
        how = "more easily: warmer" if ways == {-1.0} else "harder: colder, or dry"
        return f"most joints turn {how}? Check again as warm as when it was identified, or calibrate for now"
    return "calibrate with these logs: gaponet calibrate ROBOT LOGS --out ROBOT_TODAY"
