"""Check: do the joints stand under their own names, in command and state alike?

Columns that are exchanged in both agree with each other, so that only physics can tell: the torques
that the model needs for the recorded motion, and the ranges of its joints. The torque of each
joint, recorded or from the servo's distance to its command, is fitted by the model's inverse
dynamics beside an offset, damping, friction and armature of any size. What is left speaks of
gravity and of the other joints' accelerations, which other names would change.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gaponet.base.arrays import Array, joined
from gaponet.data.checks.exchanges import Exchange, exchange, mirrored_joints, pairs, shifts
from gaponet.data.checks.gravity import JOINT_FAULTS, Payload
from gaponet.data.checks.survey import Movement, Survey
from gaponet.data.offsets import Dynamics
from gaponet.robot.finding import Finding, abbreviate, masked_names
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
# Share of the model torque's square that offset, damping, friction and armature do not imitate; a
# joint with less shows nothing.
MIN_OWN_SHARE = 1e-4
FRICTION_RAD_S = 0.05  # speed at which friction is nearly Coulomb's
MAX_BEYOND_RAD = 0.1  # of a range, by which a zero may be off
MAX_INSIDE_RAD = 0.02  # beyond a range, with the exchange


class _Motion:
    """Rows of motion of all recordings, and how much of their torque the model explains.

    Attributes:
        rows: Smoothed motion, (k, n).
        payloads: Of each row, (k).
        effort: Torque in any unit, (k, n): recorded, or the distance of the servo from its command.
        judged: Indices of joints that move.
        imitations: Of each joint, as in _imitation.
    """

    def __init__(self, surveys: list[Survey], robot: RobotSpec, model: Dynamics) -> None:
        parts: list[Movement] = []
        payloads: list[Payload] = []
        for survey in surveys:
            movement = survey.samples.movement
            if movement is not None:
                parts.append(movement)
                payloads += [survey.payload] * len(movement.qpos)
        step = -(-len(payloads) // MAX_ROWS)  # rounded up
        self.rows = joined(parts).in_double().at(slice(None, None, step))
        self.payloads = payloads[::step]
        self.model = model
        torque = self.rows.torque
        recorded = bool(np.isfinite(torque).all() and (torque < 0).any())
        self.effort = torque if recorded else self.rows.error
        moves = np.ptp(self.rows.qpos, axis=0) > MIN_MOTION_RAD
        self.judged = [int(j) for j in robot.operated_index if moves[j]]
        self.imitations = [self._imitation(j, recorded) for j in range(len(moves))]

    def _imitation(self, joint: int, recorded: bool) -> Array:
        """Return an orthonormal basis of what imitates the model's torque of one joint: offset,
        damping, friction and armature, (k, 4 or 6).

        Beside the distance to the command (no torque was recorded) these are also velocity and
        acceleration of the command, which a lag that is not quite known adds.
        """
        rows = self.rows
        speed = rows.qvel[:, joint]
        friction = np.tanh(speed / FRICTION_RAD_S)
        terms = [np.ones_like(speed), speed, friction, rows.qacc[:, joint]]
        if not recorded:
            terms += [rows.command_velocity[:, joint], rows.command_acceleration[:, joint]]
        return np.linalg.qr(np.stack(terms, axis=1))[0]

    def torque(self, order: Array, sign: Array | float = 1.0, turn: Array | float = 0.0) -> Array:
        """Return the model's torques in the log's columns, (k, n) N·m.

        Args:
            order: Column order[i] of the log belongs to joint i.
            sign, turn: Of the angles of each joint, (n).
        """
        columns: Array = np.empty_like(self.rows.qpos)
        for payload in dict.fromkeys(self.payloads):
            chosen = np.array([other == payload for other in self.payloads])
            rows = self.rows.at(chosen)
            qpos = sign * rows.qpos[:, order] + turn
            qvel = sign * rows.qvel[:, order]
            qacc = sign * rows.qacc[:, order]
            torque = np.empty_like(qpos)
            torque[:, order] = sign * self.model(qpos, qvel, qacc, *payload)
            columns[chosen] = torque
        return columns

    def with_order(self, order: Array) -> Array:
        """Return what the model does not explain if the columns have this order, (judged)."""
        return self.unexplained(self.torque(order))

    def unexplained(self, torque: Array) -> Array:
        """Return the share of the square of each judged column's torque that the model does not
        explain, (judged).
        """
        shares = []
        for j in self.judged:
            basis = self.imitations[j]
            expected = torque[:, j]
            measured = self.effort[:, j]
            # what offset, damping, friction and armature do not imitate of both
            own_expected = expected - basis @ (basis.T @ expected)
            own_measured = measured - basis @ (basis.T @ measured)
            explained = 0.0
            power = float(own_expected @ own_expected) * float(own_measured @ own_measured)
            shown = own_expected @ own_expected >= MIN_OWN_SHARE * (expected @ expected)
            if shown and power > 0:
                explained = max(float(own_expected @ own_measured), 0.0) ** 2 / power
            shares.append(1 - explained + FLOOR)
        return np.array(shares)


def arrangement(surveys: list[Survey], robot: RobotSpec, model: Dynamics) -> Iterator[Finding]:
    """Would the joints fit the model better under other names?"""
    by_range = _by_range(surveys, robot)
    movements = [survey.samples.movement for survey in surveys]
    if sum(len(movement.qpos) for movement in movements if movement is not None) < MIN_ROWS:
        yield from by_range
        return
    motion = _Motion(surveys, robot, model)
    as_logged = motion.with_order(np.arange(len(robot.joint_names)))
    first = []
    for one in _exchanges(motion.judged, robot):
        first.append((one, motion.with_order(one.order)))
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
    yield _finding(text, found, robot, {"evidence": evidence})


def _evidence(as_logged: Array, otherwise: Array) -> float:
    """Return how much better an exchange explains the torques.

    Both: unexplained shares of the joints.
    """
    return float(np.log(as_logged / otherwise).sum())


def _not_told(as_logged: Array, exchanges: list[tuple[Exchange, Array]]) -> Finding:
    """Say which exchanges would not be noticed. exchanges: each with what it leaves unexplained."""
    alike = []
    for one, unexplained in exchanges:
        if _evidence(as_logged, unexplained) > -MIN_STEP:
            alike.append(one.words)
    if not alike:
        return Finding("ok", "order", "the torques of motion fit no other order of the joints")
    text = (
        "gravity and inertia do not tell whether these are exchanged in command and state alike: "
        f"{abbreviate(alike)}. Be sure of the order of the columns"
    )
    return Finding("note", "order", text)


def _search(
    motion: _Motion, robot: RobotSpec, as_logged: Array, first: list[tuple[Exchange, Array]]
) -> tuple[Exchange, Array]:
    """Return the best exchange, found step by step, and what it leaves unexplained.

    Args:
        first: Single exchanges, each with what it leaves unexplained.
    """
    best = Exchange("", (), np.arange(len(robot.joint_names)))
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
        candidates = []
        for step, _ in first:
            both = _one_after_the_other(best, step)
            candidates.append((both, motion.with_order(both.order)))
    return best, unexplained


def _one_after_the_other(first: Exchange, then: Exchange) -> Exchange:
    """Return two exchanges as one."""
    words = f"{first.words}, and {then.words}"
    return Exchange(words, first.joints + then.joints, first.order[then.order])


def _exchanges(judged: list[int], robot: RobotSpec) -> Iterator[Exchange]:
    """Yield left and right, front and rear exchanged; pairs; all moved by one place, or
    reversed.
    """
    names = robot.joint_names
    for words, partners in mirrored_joints(names).items():
        both_judged = [j for j, partner in partners.items() if {j, partner} <= set(judged)]
        columns = [partners[j] for j in both_judged]
        if both_judged:
            yield exchange(len(names), both_judged, columns, f"{words} in each other's place")
    yield from pairs(judged, names)
    if len(judged) >= 3:
        yield from shifts(judged, names)


def _one_joint_explains(
    motion: _Motion, robot: RobotSpec, as_logged: Array, evidence: float
) -> bool:
    """Return True if one mirrored joint, or one turned zero, explains the torques as well."""
    same = np.arange(len(robot.joint_names))
    for j in motion.judged:
        one = np.eye(len(same))[j]
        for fault in JOINT_FAULTS:
            torque = motion.torque(same, 1 + (fault.sign - 1) * one, fault.turn * one)
            if _evidence(as_logged, motion.unexplained(torque)) > evidence:
                return True
    return False


def _by_range(surveys: list[Survey], robot: RobotSpec) -> list[Finding]:
    """Find exchanges that bring positions far outside of their joints' ranges inside."""
    low = np.min([survey.qpos_limits[:, 0] for survey in surveys], axis=0)
    high = np.max([survey.qpos_limits[:, 1] for survey in surveys], axis=0)
    judged = [int(j) for j in robot.operated_index if high[j] - low[j] > MIN_MOTION_RAD]
    beyond = _beyond(low, high, np.arange(len(low)), robot)
    if beyond.max(initial=0.0) < MAX_BEYOND_RAD:
        return []
    fitting = []
    for one in _exchanges(judged, robot):
        if _beyond(low, high, one.order, robot).max() < MAX_INSIDE_RAD:
            fitting.append(one)
    if not fitting:
        return []
    outside = list(masked_names(robot, beyond > MAX_INSIDE_RAD))
    text = (
        f"{abbreviate(outside)} is up to {beyond.max():.2f} rad outside of its range, and with "
        f"{fitting[0].words} no joint is"
    )
    if len(fitting) > 1:
        text += f" (nor with {len(fitting) - 1} other exchanges)"
    text += (
        ": are names of joints exchanged in command and state alike? Check the order of the columns"
    )
    return [_finding(text, fitting[0], robot, {"beyond_rad": float(beyond.max())})]


def _beyond(low: Array, high: Array, order: Array, robot: RobotSpec) -> Array:
    """Return by how much positions lie outside of the ranges of the joints that they would belong
    to, (n) rad.
    """
    ranges = robot.qpos_range
    beyond = np.maximum(ranges[:, 0] - low[order], high[order] - ranges[:, 1])
    return np.asarray(beyond.clip(0.0))


def _finding(text: str, found: Exchange, robot: RobotSpec, values: dict[str, float]) -> Finding:
    names = found.names(robot.joint_names)
    return Finding("warning", "order", text, tuple(names.values()), values, {"names": names})
