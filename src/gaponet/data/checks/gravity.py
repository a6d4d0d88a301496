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
from itertools import combinations
from typing import NamedTuple

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.checks.survey import Survey
from gaponet.data.offsets import Gravity
from gaponet.robot.finding import Finding, Mend
from gaponet.robot.spec import RobotSpec

Payload = tuple[float, str]  # payload_mass, kg, and payload_side
Loads = dict[Payload, tuple[Array, Array]]  # angles and torques, (k, n) each

TURNS_RAD = (0.3, 0.6, 1.0, 1.5708, 2.3, 3.1416)  # of a zero, tried in both directions
# Hypotheses of one joint: sign of its angle, turn of its zero, sign of its torque.
JOINT_FAULTS = [
    (-1, 0.0, -1),
    (-1, 0.0, 1),
    (1, 0.0, -1),
    *((1, turn, 1) for turn in TURNS_RAD),
    *((1, -turn, 1) for turn in TURNS_RAD),
]
MAX_ROWS = 120  # gravity is evaluated some fifteen times for each joint
MIN_ROWS = 20
# sum over joints of ln(unexplained as logged / unexplained otherwise); correct recordings: < 0.1
MIN_EVIDENCE = 0.4
# mean share of the torque's square
MIN_EXPLAINED = 0.5
MIN_IMPROVEMENT = 0.03
MIN_LOAD = 0.01  # of the torque limit: a joint that gravity loads less shows nothing


class _Hypothesis(NamedTuple):
    """One way in which the logs may be wrong: the angles are sign · logged[order] + turn.

    words: Description. joints: Indices. mend: Its correction in logs.toml.
    """

    words: str
    joints: tuple[int, ...]
    mend: Mend
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
        yield Finding(
            "ok",
            "gravity",
            "too few torques and rests: zeros and signs cannot be told from gravity",
        )
        return
    best = max(results, key=lambda b: b.evidence)
    improvement = best.otherwise - best.as_logged
    significant = (
        best.evidence > MIN_EVIDENCE
        and best.otherwise > MIN_EXPLAINED
        and improvement > MIN_IMPROVEMENT
    )
    if best.hypothesis is not None and significant:
        joints = tuple(robot.joint_names[j] for j in best.hypothesis.joints)
        text = (
            f"with {best.hypothesis.words} the torques fit the weight of the arm better "
            f"({best.otherwise:.0%}) than as logged ({best.as_logged:.0%}): wrong in command and "
            "state alike, where neither shows it; check it against the model"
        )
        yield Finding(
            "warning", "gravity", text, joints, {"evidence": best.evidence}, best.hypothesis.mend
        )
        return
    shares = " and ".join(f"{b.as_logged:.0%}" for b in results)
    text = f"no other zero, sign or order fits gravity better; it explains {shares} of the torques"
    yield Finding("ok", "gravity", text)


def _best(loads: Loads, robot: RobotSpec, model: Gravity, centred: bool) -> _Best:
    """Return the hypothesis that explains the torques best; `centred` ignores a constant of each
    joint.
    """
    loads = _thinned(loads, max(1, _count_rows(loads) // MAX_ROWS))
    as_logged = {key: model(qpos, *key) for key, (qpos, _) in loads.items()}
    rms = np.sqrt(np.mean(np.concatenate(list(as_logged.values())) ** 2, axis=0))  # (n) N·m
    loaded = np.flatnonzero(rms > MIN_LOAD * robot.servo.effort_limit)
    unexplained = _unexplained(as_logged, loads, loaded, centred)
    best = _Best(0.0, None, 1 - float(unexplained.mean()) if len(unexplained) else 0.0, 0.0)
    for hypothesis in [*_joint_faults(robot, loaded), *_order_faults(robot)]:
        torques = {key: hypothesis.torque(model, qpos, key) for key, (qpos, _) in loads.items()}
        otherwise = _unexplained(torques, loads, loaded, centred)
        evidence = float(np.log(unexplained / otherwise).sum())
        if evidence > best.evidence:
            best = _Best(evidence, hypothesis, best.as_logged, 1 - float(otherwise.mean()))
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
        for sign, turn, torque_sign in JOINT_FAULTS:
            words = "its torque negated"
            mend: Mend = {}
            if sign < 0:
                words = "its angle mirrored"
                mend = {"signs": {name: sign}}
            elif turn:
                words = f"its zero turned by {turn:+.2f} rad"
                mend = {"offsets": {name: turn}}
            factors = (1 + (sign - 1) * one, turn * one, 1 + (torque_sign - 1) * one)
            yield _Hypothesis(f"{words} at {name}", (j,), mend, np.arange(len(one)), *factors)


def _order_faults(robot: RobotSpec) -> Iterator[_Hypothesis]:
    """Yield hypotheses with two operated joints swapped, or all of them moved by one place, or
    reversed.
    """
    op = robot.operated_index
    for a, b in combinations(op.tolist(), 2):
        words = f"{robot.joint_names[a]} and {robot.joint_names[b]} in each other's place"
        yield _order_fault(robot, (a, b), [b, a], words)
    for words, moved in (
        ("one place on", np.roll(op, 1)),
        ("one place back", np.roll(op, -1)),
        ("backwards", op[::-1]),
    ):
        words = f"the order of joints {words}"
        yield _order_fault(robot, tuple(op.tolist()), moved.tolist(), words)


def _order_fault(
    robot: RobotSpec, joints: tuple[int, ...], replaced: list[int], words: str
) -> _Hypothesis:
    """Return the hypothesis that the columns `replaced` belong to these joints."""
    order = np.arange(len(robot.joint_names))
    order[list(joints)] = replaced
    names = {robot.joint_names[o]: robot.joint_names[i] for i, o in enumerate(order) if i != o}
    return _Hypothesis(words, joints, {"names": names}, order)


def _recorded_torques(surveys: list[Survey]) -> Loads:
    """Return recorded torques in slow rows; none if they are unsigned."""
    if not any((survey.torque.low < 0).any() for survey in surveys if survey.torque):
        return {}
    samples = []
    for survey in surveys:
        if survey.samples.gravity is not None:
            qpos, torque = survey.samples.gravity
            samples.append((survey, qpos, torque))
    return _by_payload(samples)


def _servo_torques(surveys: list[Survey], robot: RobotSpec) -> Loads:
    """Return the torques of the servos at rest, from their distance to the command."""
    samples = []
    for survey in surveys:
        kp = robot.with_gains(*survey.entry.meta.recorded_gains).servo.kp
        poses = survey.samples.static_poses
        samples.append((survey, poses.qpos, kp * (poses.ctrl - poses.qpos)))
    return _by_payload(samples)


def _by_payload(samples: Iterable[tuple[Survey, Array, Array]]) -> Loads:
    parts: dict[Payload, list[tuple[Array, Array]]] = defaultdict(list)
    for survey, qpos, torque in samples:
        parts[survey.entry.meta.payload_mass, survey.entry.meta.payload_side].append((qpos, torque))
    loads = {}
    for payload, pairs in parts.items():
        qpos_of_parts, torque_of_parts = zip(*pairs, strict=True)
        loads[payload] = (np.concatenate(qpos_of_parts), np.concatenate(torque_of_parts))
    return loads


def _unexplained(
    gravity: dict[Payload, Array], loads: Loads, loaded: Array, centred: bool
) -> Array:
    """Return the share of the torques' square that gravity, times a scale ≥ 0 per joint, does not
    explain, (loaded).
    """
    x = np.concatenate([gravity[key][:, loaded] for key in loads])
    y = np.concatenate([torque[:, loaded] for _, torque in loads.values()])
    if centred:
        x = x - x.mean(axis=0)
        y = y - y.mean(axis=0)
    power = (x**2).sum(axis=0) * (y**2).sum(axis=0)
    explained = np.maximum((x * y).sum(axis=0), 0) ** 2 / np.where(power > 0, power, np.inf)
    return np.asarray(1 - explained + 1e-4)
