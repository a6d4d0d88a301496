"""Do the torques carry the arm that the joint angles describe?

A zero or a sign that is wrong in command and state alike shows in neither of them. It shows in the
torque, because an arm carries its own weight, which depends on its pose. Recorded torques, where
they are signed, and the servo's torque at rest, kp (ctrl − qpos), are compared with the gravity of
the nominal model: at the angles as logged, and with one joint turned or mirrored, or with joints in
another order. A mirrored joint with equal weight on both sides is not seen.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.checks.exchanges import pairs, shifts
from gaponet.data.checks.survey import Survey
from gaponet.data.offsets import Gravity
from gaponet.robot.finding import Finding, Mend
from gaponet.robot.servo_parameters import NO_LIMIT
from gaponet.robot.spec import RobotSpec

Payload = tuple[float, str]  # payload_mass, kg, and payload_side
Loads = dict[Payload, tuple[Array, Array]]  # angles, rad, and torques, N·m; (k, n) each

MAX_ROWS = 120  # gravity is evaluated some fifteen times for each joint
MIN_ROWS = 20
# Evidence is the sum over joints of ln(unexplained as logged / unexplained otherwise). Correct
# recordings have less than 0.1.
MIN_EVIDENCE = 0.4
MIN_EXPLAINED = 0.5  # mean share of the torque's square, with the hypothesis
MIN_IMPROVEMENT = 0.03  # of this share
# Of the torque limit, or of the most loaded joint's load: a joint that gravity loads less shows
# nothing.
MIN_LOAD = 0.01
FEW_EXPLAINED = 0.01  # share of the torques' square: with less, gravity is not the model's
TIE = 0.01  # of evidence: the earlier hypothesis counts
FLOOR = 1e-4  # of a share that is unexplained


class JointFault(NamedTuple):
    """One way in which a joint may be logged wrong: as sign · angle + turn, rad."""

    sign: int = 1
    turn: float = 0.0
    torque_sign: int = 1


TURNS_RAD = (0.3, 0.6, 1.0, 1.5708, 2.3, 3.1416)  # of a zero, tried in both directions
JOINT_FAULTS = [
    JointFault(sign=-1, torque_sign=-1),
    JointFault(sign=-1),
    JointFault(torque_sign=-1),
    *(JointFault(turn=turn) for turn in TURNS_RAD),
    *(JointFault(turn=-turn) for turn in TURNS_RAD),
]


class _Hypothesis(NamedTuple):
    """One way in which the logs may be wrong: the angles are sign · logged[order] + turn."""

    words: str  # for a person
    joints: tuple[int, ...]  # indices of those that are wrong
    mend: Mend  # the correction in logs.toml
    order: Array  # column order[i] of the log belongs to joint i, (n)
    sign: Array | float = 1.0  # (n)
    turn: Array | float = 0.0  # (n) rad
    torque_sign: Array | float = 1.0  # (n)

    def torque(self, model: Gravity, qpos: Array, payload: Payload) -> Array:
        """Return gravity's torque (k, n) under the hypothesis, in the log's order."""
        torque = np.empty_like(qpos)
        angles = self.sign * qpos[:, self.order] + self.turn
        torque[:, self.order] = self.torque_sign * model(angles, *payload)
        return torque


class _Best(NamedTuple):
    """The best hypothesis, its evidence, and the mean shares of torque explained as logged and
    with it.
    """

    evidence: float
    hypothesis: _Hypothesis | None
    as_logged: float
    otherwise: float
    is_loaded: bool = True  # whether gravity loads any joint


def gravity(surveys: list[Survey], robot: RobotSpec, model: Gravity) -> Iterator[Finding]:
    """Are zero, sign and order of the joints those of the model?"""
    results = []
    recorded = _recorded_torques(surveys)
    if _count_rows(recorded) >= MIN_ROWS:
        results.append(_best(recorded, robot, model, centred=False))
    servos = _servo_torques(surveys, robot)
    if _count_rows(servos) >= MIN_ROWS:
        results.append(_best(servos, robot, model, centred=True))
    if not results:
        text = "too few torques and rests: zeros and signs cannot be told from gravity"
        yield Finding("ok", "gravity", text)
        return
    results = [result for result in results if result.is_loaded]
    if not results:
        text = "gravity loads no joint here: zeros and signs cannot be told from it"
        yield Finding("ok", "gravity", text)
        return
    best = max(results, key=lambda result: result.evidence)
    hypothesis = best.hypothesis
    if hypothesis is not None and _is_significant(best):
        joints = tuple(robot.joint_names[j] for j in hypothesis.joints)
        text = (
            f"with {hypothesis.words} the torques fit the weight of the arm better "
            f"({best.otherwise:.0%}) than as logged ({best.as_logged:.0%}): wrong in command and "
            "state alike, where neither shows it; check it against the model"
        )
        values = {"evidence": best.evidence}
        yield Finding("warning", "gravity", text, joints, values, hypothesis.mend)
        return
    shares = " and ".join(f"{result.as_logged:.0%}" for result in results)
    text = f"no other zero, sign or order fits gravity better; it explains {shares} of the torques"
    if max(result.as_logged for result in results) >= FEW_EXPLAINED:
        yield Finding("ok", "gravity", text)
        return
    text += (
        ". If the base is mounted otherwise than in the model, write <option gravity> in "
        "robot.xml; else check masses and gains"
    )
    yield Finding("note", "gravity", text)


def _is_significant(best: _Best) -> bool:
    """Return True if a hypothesis fits well, and clearly better than the logs as they are."""
    if best.evidence <= MIN_EVIDENCE or best.otherwise <= MIN_EXPLAINED:
        return False
    return best.otherwise - best.as_logged > MIN_IMPROVEMENT


def _best(loads: Loads, robot: RobotSpec, model: Gravity, centred: bool) -> _Best:
    """Return the hypothesis that explains the torques best; `centred` ignores a constant of each
    joint.
    """
    loads = _thinned(loads, max(1, _count_rows(loads) // MAX_ROWS))
    weight = {payload: model(qpos, *payload) for payload, (qpos, _) in loads.items()}  # N·m
    rms = np.sqrt(np.mean(np.concatenate(list(weight.values())) ** 2, axis=0))  # (n) N·m
    limit = robot.servo.effort_limit
    loaded = np.flatnonzero(rms > MIN_LOAD * np.where(limit < NO_LIMIT, limit, rms.max()))
    if not len(loaded):
        return _Best(0.0, None, 0.0, 0.0, is_loaded=False)
    unexplained = _unexplained(weight, loads, loaded, centred)
    as_logged = max(1 - float(unexplained.mean()), 0.0)
    best = _Best(0.0, None, as_logged, 0.0)
    for hypothesis in (_upside_down(robot), *_joint_faults(robot, loaded), *_order_faults(robot)):
        torques = {}
        for payload, (qpos, _) in loads.items():
            torques[payload] = hypothesis.torque(model, qpos, payload)
        otherwise = _unexplained(torques, loads, loaded, centred)
        evidence = float(np.log(unexplained / otherwise).sum())
        if evidence > best.evidence + TIE:
            best = _Best(evidence, hypothesis, as_logged, 1 - float(otherwise.mean()))
    return best


def _count_rows(loads: Loads) -> int:
    return sum(len(qpos) for qpos, _ in loads.values())


def _thinned(loads: Loads, step: int) -> Loads:
    """Return every `step`-th row of each payload that has any."""
    thinned = {}
    for payload, (qpos, torque) in loads.items():
        if len(qpos):
            thinned[payload] = (qpos[::step].astype(float), torque[::step].astype(float))
    return thinned


def _joint_faults(robot: RobotSpec, loaded: Array) -> Iterator[_Hypothesis]:
    """Yield hypotheses with one joint mirrored, its zero turned, or its torque negated."""
    for j in loaded.tolist():
        name = robot.joint_names[j]
        one = np.eye(len(robot.joint_names))[j]
        for fault in JOINT_FAULTS:
            words = "its torque negated"
            mend: Mend = {}
            if fault.sign < 0:
                words = "its angle mirrored"
                mend = {"signs": {name: fault.sign}}
            elif fault.turn:
                words = f"its zero turned by {fault.turn:+.2f} rad"
                mend = {"offsets": {name: fault.turn}}
            yield _Hypothesis(
                words=f"{words} at {name}",
                joints=(j,),
                mend=mend,
                order=np.arange(len(one)),
                sign=1 + (fault.sign - 1) * one,
                turn=fault.turn * one,
                torque_sign=1 + (fault.torque_sign - 1) * one,
            )


def _upside_down(robot: RobotSpec) -> _Hypothesis:
    """Return the hypothesis that gravity loads all joints the other way."""
    return _Hypothesis(
        words="all torques negated (they are logged so, or the base hangs upside down: write "
        '<option gravity="0 0 9.81"/> in robot.xml; or the first joint is half a turn off)',
        joints=tuple(robot.operated_index.tolist()),
        mend={},
        order=np.arange(len(robot.joint_names)),
        torque_sign=-1.0,
    )


def _order_faults(robot: RobotSpec) -> Iterator[_Hypothesis]:
    """Yield hypotheses with two operated joints swapped, or all of them moved by one place, or
    reversed.
    """
    joints = robot.operated_index.tolist()
    names = robot.joint_names
    for exchange in (*pairs(joints, names), *shifts(joints, names)):
        mend: Mend = {"names": exchange.names(names)}
        yield _Hypothesis(exchange.words, exchange.joints, mend, exchange.order)


def _recorded_torques(surveys: list[Survey]) -> Loads:
    """Return recorded torques in slow rows; none if they are unsigned."""
    if not any((survey.torque.low < 0).any() for survey in surveys if survey.torque):
        return {}
    samples = []
    for survey in surveys:
        rows = survey.samples.slow_rows
        if rows is not None:
            samples.append((survey, rows.qpos, rows.torque))
    return _by_payload(samples)


def _servo_torques(surveys: list[Survey], robot: RobotSpec) -> Loads:
    """Return the torques of the servos at rest, from their distance to the command."""
    samples = []
    for survey in surveys:
        poses = survey.samples.static_poses
        torque = survey.kp(robot) * (poses.ctrl - poses.qpos)
        samples.append((survey, poses.qpos, torque))
    return _by_payload(samples)


def _by_payload(samples: Iterable[tuple[Survey, Array, Array]]) -> Loads:
    """Join the angles and torques, (k, n) each, of recordings with equal payloads."""
    parts: dict[Payload, list[tuple[Array, Array]]] = defaultdict(list)
    for survey, qpos, torque in samples:
        parts[survey.payload].append((qpos, torque))
    loads = {}
    for payload, of_payload in parts.items():
        qpos_of_parts, torque_of_parts = zip(*of_payload, strict=True)
        loads[payload] = (np.concatenate(qpos_of_parts), np.concatenate(torque_of_parts))
    return loads


def _unexplained(
    expected: dict[Payload, Array], loads: Loads, loaded: Array, centred: bool
) -> Array:
    """Return the share of the torques' square that the expected ones, times a scale ≥ 0 per joint,
    do not explain, (loaded).

    Args:
        expected: Payload → torques of gravity, (k, n) N·m.
        loaded: Indices of the joints that are judged.
        centred: A constant of each joint is ignored.
    """
    weight = np.concatenate([expected[payload][:, loaded] for payload in loads])
    torque = np.concatenate([of_payload[:, loaded] for _, of_payload in loads.values()])
    if centred:
        weight = weight - weight.mean(axis=0)
        torque = torque - torque.mean(axis=0)
    power = (weight**2).sum(axis=0) * (torque**2).sum(axis=0)
    agreement = np.maximum((weight * torque).sum(axis=0), 0)
    explained = agreement**2 / np.where(power > 0, power, np.inf)
    return np.asarray(1 - explained + FLOOR)
