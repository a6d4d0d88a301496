"""Check: do the joints stand under their own names, in command and state alike?

Columns that are exchanged in both agree with each other, so that only physics can tell: the torques
that the model needs for the recorded motion, and the ranges of its joints. The torque of each
joint, recorded or from the servo's distance to its command, is fitted by the model's inverse
dynamics beside an offset, damping, friction and armature of any size. What is left speaks of
gravity and of the other joints' accelerations, which other names would change.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.checks.gravity import JOINT_FAULTS, Payload
from gaponet.data.checks.sides import mirrored_joints
from gaponet.data.checks.survey import Survey
from gaponet.data.offsets import Dynamics
from gaponet.robot.finding import Finding, abbreviate
from gaponet.robot.spec import RobotSpec

MAX_ROWS = 360  # of all recordings, for which inverse dynamics are computed some hundred times
MIN_ROWS = 50
MIN_MOTION_RAD = 0.05  # of a joint that is judged
MIN_STEP = 0.1  # of evidence, by which one more exchange must fit better
# Evidence is the sum over joints of ln(unexplained as logged / unexplained otherwise). Of eight
# real sets as they were logged, the model explains at most 0.21 of the torques where evidence is
# above 0.05 (G1: 2.2); of Go2's with left and right exchanged 0.51, with an evidence of 0.8.
MIN_EVIDENCE = 0.3
MIN_EXPLAINED = 0.3  # mean share of the torque's square, with the exchange
FLOOR = 0.01  # of a share that is unexplained: no model is better
MIN_OWN_SHARE = (
    1e-4  # of the model torque's square that offset, damping, friction and armature do not imitate
)
FRICTION_RAD_S = 0.05  # speed at which friction is nearly Coulomb's
MAX_BEYOND_RAD = 0.1  # of a range, by which a zero may be off
MAX_INSIDE_RAD = 0.02  # beyond a range, with the exchange


@dataclass(frozen=True)
class _Exchange:
    """One way in which names may be exchanged: column order[i] of the log belongs to joint i,
    (n).
    """

    words: str
    order: Array

    def after(self, other: _Exchange) -> _Exchange:
        """Return both exchanges in one, the other first."""
        words = f"{other.words}, and {self.words}" if other.words else self.words
        return _Exchange(words, other.order[self.order])


class _Motion:
    """Rows of motion of all recordings, and how much of their torque the model explains.

    Attributes:
        qpos, qvel, qacc: (k, n) rad, rad/s, rad/s².
        effort: Torque in any unit, (k, n).
        judged: Indices of joints that move.
    """

    def __init__(self, surveys: list[Survey], robot: RobotSpec, model: Dynamics) -> None:
        parts: list[Array] = []
        payloads: list[Payload] = []
        for survey in surveys:
            movement = survey.samples.movement
            if movement is not None:
                parts.append(movement)
                payload = (survey.entry.meta.payload_mass, survey.entry.meta.payload_side)
                payloads += [payload] * movement.shape[1]
        rows = np.concatenate(parts, axis=1).astype(float)
        step = -(-rows.shape[1] // MAX_ROWS)
        self.qpos, self.qvel, self.qacc, torque, error, *target = rows[:, ::step]
        recorded = bool(np.isfinite(torque).all() and (torque < 0).any())
        self.effort = torque if recorded else error
        further = [] if recorded else target
        self.payloads = payloads[::step]
        self.model = model
        moves = np.ptp(self.qpos, axis=0) > MIN_MOTION_RAD
        self.judged = [int(j) for j in robot.operated_index if moves[j]]
        self.imitations = [self._imitation(j, further) for j in range(rows.shape[2])]

    def _imitation(self, column: int, further: list[Array]) -> Array:
        """Return an orthonormal basis of offset, damping, friction and armature of one joint, (k,
        4 to 6).

        Args:
            further: Velocity and acceleration of the command, (k, n) each, which a lag that is not
                quite known adds.
        """
        speed = self.qvel[:, column]
        friction = np.tanh(speed / FRICTION_RAD_S)
        terms = [np.ones_like(speed), speed, friction, self.qacc[:, column]]
        terms += [channel[:, column] for channel in further]
        return np.linalg.qr(np.stack(terms, axis=1))[0]

    def torque(self, order: Array, sign: Array | float = 1.0, turn: Array | float = 0.0) -> Array:
        """Return the model's torques in the log's columns, (k, n) N·m.

        Args:
            order: Column order[i] of the log belongs to joint i.
            sign, turn: Of the angles of each joint, (n).
        """
        columns: Array = np.empty_like(self.qpos)
        for payload in dict.fromkeys(self.payloads):
            rows = np.array([p == payload for p in self.payloads])
            qpos = sign * self.qpos[rows][:, order] + turn
            qvel = sign * self.qvel[rows][:, order]
            qacc = sign * self.qacc[rows][:, order]
            torque = np.empty_like(qpos)
            torque[:, order] = sign * self.model(qpos, qvel, qacc, *payload)
            columns[rows] = torque
        return columns

    def unexplained(self, torque: Array) -> Array:
        """Return the share of the square of each judged column's torque that the model does not
        explain, (judged).
        """
        shares = []
        for j in self.judged:
            basis = self.imitations[j]
            own = torque[:, j] - basis @ (basis.T @ torque[:, j])
            measured = self.effort[:, j] - basis @ (basis.T @ self.effort[:, j])
            power = float(own @ own) * float(measured @ measured)
            agreement = max(float(own @ measured), 0.0)
            if own @ own < MIN_OWN_SHARE * (torque[:, j] @ torque[:, j]) or power == 0:
                agreement = 0.0
                power = 1.0
            shares.append(1 - agreement**2 / power + FLOOR)
        return np.array(shares)


def arrangement(surveys: list[Survey], robot: RobotSpec, model: Dynamics) -> Iterator[Finding]:
    """Would the joints fit the model better under other names?"""
    by_range = _by_range(surveys, robot)
    movements = [survey.samples.movement for survey in surveys]
    if sum(rows.shape[1] for rows in movements if rows is not None) < MIN_ROWS:
        yield from by_range
        return
    motion = _Motion(surveys, robot, model)
    as_logged = motion.unexplained(motion.torque(np.arange(len(robot.joint_names))))
    first = [
        (e, motion.unexplained(motion.torque(e.order))) for e in _exchanges(motion.judged, robot)
    ]
    found, unexplained = _search(motion, robot, as_logged, first)
    evidence = _evidence(as_logged, unexplained)
    explained = 1 - float(unexplained.mean()) if len(unexplained) else 0.0
    if evidence < MIN_EVIDENCE or explained < MIN_EXPLAINED:
        yield from by_range or [_not_told(as_logged, first)]
        return
    if _one_joint_explains(motion, robot, as_logged, evidence):
        return  # the gravity check names it
    text = (
        f"with {found.words} the motors' torques fit the model's motion better ({explained:.0%}) "
        f"than as logged ({1 - as_logged.mean():.0%}): names of joints are exchanged in command "
        "and state alike, where neither shows it; check the order of the columns"
    )
    yield _finding(text, found.order, robot, {"evidence": evidence})


def _evidence(as_logged: Array, otherwise: Array) -> float:
    """Return how much better an exchange explains the torques.

    Both: unexplained shares of the joints.
    """
    return float(np.log(as_logged / otherwise).sum())


def _not_told(as_logged: Array, exchanges: list[tuple[_Exchange, Array]]) -> Finding:
    """Say which exchanges would not be noticed. exchanges: each with what it leaves unexplained."""
    alike = [e.words for e, shares in exchanges if _evidence(as_logged, shares) > -MIN_STEP]
    if not alike:
        return Finding("ok", "order", "the torques of motion fit no other order of the joints")
    text = (
        "gravity and inertia do not tell whether these are exchanged in command and state alike: "
        f"{abbreviate(alike)}. Be sure of the order of the columns"
    )
    return Finding("note", "order", text)


def _search(
    motion: _Motion, robot: RobotSpec, as_logged: Array, first: list[tuple[_Exchange, Array]]
) -> tuple[_Exchange, Array]:
    """Return the best exchange, found step by step, and what it leaves unexplained.

    Args:
        first: Single exchanges, each with what it leaves unexplained.
    """
    best = _Exchange("", np.arange(len(robot.joint_names)))
    unexplained = as_logged
    candidates = first
    for _ in motion.judged:
        if not candidates:
            break
        following, left = max(candidates, key=lambda c: _evidence(unexplained, c[1]))
        if _evidence(unexplained, left) < MIN_STEP:
            break
        best = following
        unexplained = left
        steps = [step.after(best) for step, _ in first]
        candidates = [(e, motion.unexplained(motion.torque(e.order))) for e in steps]
    return best, unexplained


def _exchanges(judged: list[int], robot: RobotSpec) -> Iterator[_Exchange]:
    """Yield left and right, front and rear exchanged; pairs; all moved by one place, or
    reversed.
    """
    same = np.arange(len(robot.joint_names))
    for words, partners in mirrored_joints(robot.joint_names).items():
        order = same.copy()
        for joint, partner in partners.items():
            if joint in judged and partner in judged:
                order[joint] = partner
        if (order != same).any():
            yield _Exchange(f"{words} in each other's place", order)
    for a, b in combinations(judged, 2):
        order = same.copy()
        order[[a, b]] = [b, a]
        names = f"{robot.joint_names[a]} and {robot.joint_names[b]}"
        yield _Exchange(f"{names} in each other's place", order)
    if len(judged) < 3:
        return
    for words, moved in (
        ("one place on", np.roll(judged, 1)),
        ("one place back", np.roll(judged, -1)),
        ("backwards", judged[::-1]),
    ):
        order = same.copy()
        order[judged] = moved
        yield _Exchange(f"the order of joints {words}", order)


def _one_joint_explains(
    motion: _Motion, robot: RobotSpec, as_logged: Array, evidence: float
) -> bool:
    """Return True if one mirrored joint, or one turned zero, explains the torques as well."""
    same = np.arange(len(robot.joint_names))
    for j in motion.judged:
        one = np.eye(len(same))[j]
        for sign, turn, _ in JOINT_FAULTS:
            torque = motion.torque(same, 1 + (sign - 1) * one, turn * one)
            if _evidence(as_logged, motion.unexplained(torque)) > evidence:
                return True
    return False


def _by_range(surveys: list[Survey], robot: RobotSpec) -> list[Finding]:
    """Find exchanges that bring positions far outside of their joints' ranges inside."""
    low = np.min([survey.qpos_limits[:, 0] for survey in surveys], axis=0)
    high = np.max([survey.qpos_limits[:, 1] for survey in surveys], axis=0)
    judged = [int(j) for j in robot.operated_index if high[j] - low[j] > MIN_MOTION_RAD]
    same = np.arange(len(low))
    beyond = _beyond(low, high, same, robot)
    if beyond.max(initial=0.0) < MAX_BEYOND_RAD:
        return []
    fitting = []
    for exchange in _exchanges(judged, robot):
        if _beyond(low, high, exchange.order, robot).max() < MAX_INSIDE_RAD:
            fitting.append(exchange)
    if not fitting:
        return []
    outside = [
        name for name, x in zip(robot.joint_names, beyond, strict=True) if x > MAX_INSIDE_RAD
    ]
    text = (
        f"{abbreviate(outside)} is up to {beyond.max():.2f} rad outside of its range, and with "
        f"{fitting[0].words} no joint is"
    )
    if len(fitting) > 1:
        text += f" (nor with {len(fitting) - 1} other exchanges)"
    text += (
        ": are names of joints exchanged in command and state alike? Check the order of the columns"
    )
    return [_finding(text, fitting[0].order, robot, {"beyond_rad": float(beyond.max())})]


def _beyond(low: Array, high: Array, order: Array, robot: RobotSpec) -> Array:
    """Return by how much positions lie outside of the ranges of the joints that they would belong
    to, (n) rad.
    """
    ranges = robot.qpos_range
    beyond = np.maximum(ranges[:, 0] - low[order], high[order] - ranges[:, 1])
    return np.asarray(beyond.clip(0.0))


def _finding(text: str, order: Array, robot: RobotSpec, values: dict[str, float]) -> Finding:
    moved = np.flatnonzero(order != np.arange(len(order)))
    names = {robot.joint_names[order[i]]: robot.joint_names[i] for i in moved}
    return Finding("warning", "order", text, tuple(names.values()), values, {"names": names})
