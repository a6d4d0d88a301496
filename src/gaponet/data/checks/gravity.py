"""Do the torques hold up the arm that the joint angles describe?

A zero or a sign that is wrong in command and state alike shows in neither. It shows in the torque: an arm holds its own
weight, and how much depends on where it is. The recorded torque, where it has a sign, and the servo's kp (ctrl − qpos)
at rest are compared with the gravity of the nominal model, at the angles as logged and with one joint turned or
mirrored, or joints in another order. Not seen is a mirrored joint that weighs the same both ways.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import combinations
from typing import NamedTuple

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.offsets import Carried, Gravity
from gaponet.data.survey import Survey
from gaponet.robot.finding import Finding, Mend
from gaponet.robot.spec import RobotSpec

Loads = dict[Carried, tuple[Array, Array]]  # angles and torques, (k, n) each

TURNS = (0.3, 0.6, 1.0, 1.5708, 2.3, 3.1416)  # of a zero, rad, both ways
# How a joint may be wrong: sign and turn of its angle, sign of its torque.
OTHERWISE = [(-1, 0.0, -1), (-1, 0.0, 1), (1, 0.0, -1), *((1, t, 1) for t in TURNS), *((1, -t, 1) for t in TURNS)]
ROWS = 120  # in all: gravity is evaluated some fifteen times for each joint
EVIDENCE = (
    0.4  # sum over the joints of ln(unexplained as logged / unexplained otherwise); recordings that are right: < 0.1
)
FEW = 20  # torques or rests that say nothing
ENOUGH = 0.5  # mean share of the torque's square that must then be explained
BETTER = 0.03  # so much more of it than as logged
LOADED = 0.01  # of the torque limit: a joint that gravity loads less says nothing


class _Guess(NamedTuple):
    """A way in which the logs may be wrong, in words, at these joints; gravity's torque (k, n) if they are so; and what
    logs.toml would say then."""

    words: str
    joints: tuple[int, ...]
    torque: Callable[[Array, Carried], Array]
    mend: Mend


class _Best(NamedTuple):
    """Evidence for the logs being wrong in this way, and the mean shares explained."""

    evidence: float
    guess: _Guess | None
    as_logged: float
    otherwise: float


def gravity(surveys: list[Survey], robot: RobotSpec, model: Gravity) -> Iterator[Finding]:
    """Are zero, sign and order of the joints those of the model?"""
    found = [
        _best(loads, robot, model, level)
        for loads, level in ((_torques(surveys), False), (_rests(surveys, robot), True))
        if sum(len(qpos) for qpos, _ in loads.values()) >= FEW
    ]  # fmt: skip
    if not found:
        yield Finding("ok", "gravity", "too few torques and rests: zeros and signs cannot be told from gravity")
        return
    best = max(found, key=lambda b: b.evidence)
    better = best.otherwise - best.as_logged
    if best.guess is not None and best.evidence > EVIDENCE and best.otherwise > ENOUGH and better > BETTER:
        names = tuple(robot.joint_names[j] for j in best.guess.joints)
        text = (
            f"with {best.guess.words} the torques fit the weight of the arm better ({best.otherwise:.0%}) "
            f"than as logged ({best.as_logged:.0%}): wrong in command and state alike, where neither shows it; check "
            "it against the model"
        )
        yield Finding("warning", "gravity", text, names, {"evidence": best.evidence}, best.guess.mend)
        return
    shares = " and ".join(f"{b.as_logged:.0%}" for b in found)
    text = f"no other zero, sign or order fits gravity better; it explains {shares} of the torques"
    yield Finding("ok", "gravity", text)


def _best(loads: Loads, robot: RobotSpec, model: Gravity, level: bool) -> _Best:
    """The way of being wrong that explains the torques best; with `level`, but for a constant of each joint."""
    step = max(1, sum(len(qpos) for qpos, _ in loads.values()) // ROWS)
    loads = {k: (q[::step].astype(float), t[::step].astype(float)) for k, (q, t) in loads.items() if len(q)}
    as_logged = {key: model(qpos, *key) for key, (qpos, _) in loads.items()}
    weight = np.sqrt(np.mean(np.concatenate(list(as_logged.values())) ** 2, axis=0))  # (n) N·m
    loaded = np.flatnonzero(weight > LOADED * robot.effort_limit)
    left = _unexplained(as_logged, loads, loaded, level)
    best = _Best(0.0, None, 1 - float(left.mean()) if len(left) else 0.0, 0.0)
    for guess in [*_turned(robot, loaded, model), *_ordered(robot, model)]:
        other = {key: guess.torque(qpos, key) for key, (qpos, _) in loads.items()}
        rest = _unexplained(other, loads, loaded, level)
        evidence = float(np.log(left / rest).sum())
        if evidence > best.evidence:
            best = _Best(evidence, guess, best.as_logged, 1 - float(rest.mean()))
    return best


def _turned(robot: RobotSpec, loaded: Array, model: Gravity) -> Iterator[_Guess]:
    """One joint mirrored, its zero elsewhere, or its torque negated."""
    for j in loaded.tolist():
        for sign, turn, torque_sign in OTHERWISE:
            what = f"its zero turned by {turn:+.2f} rad" if turn else "its torque negated"
            what = "its angle mirrored" if sign < 0 else what

            def torque(
                qpos: Array, key: Carried, j: int = j, how: tuple[int, float, int] = (sign, turn, torque_sign)
            ) -> Array:
                other = qpos.copy()
                other[:, j] = how[0] * other[:, j] + how[1]
                found = model(other, *key).copy()
                found[:, j] *= how[2]
                return found

            name = robot.joint_names[j]
            mend: Mend = {"offsets": {name: turn}} if turn else {"signs": {name: sign}} if sign < 0 else {}
            yield _Guess(f"{what} at {name}", (j,), torque, mend)


def _ordered(robot: RobotSpec, model: Gravity) -> Iterator[_Guess]:
    """Two operated joints in each other's place, or all of them one on, one back, or backwards."""
    op = robot.operated_index
    orders = []
    for a, b in combinations(op.tolist(), 2):
        order = np.arange(len(robot.joint_names))
        order[[a, b]] = b, a
        words = f"{robot.joint_names[a]} and {robot.joint_names[b]} in each other's place"
        orders.append((words, (a, b), order))
    for way, words in ((np.roll(op, 1), "one place on"), (np.roll(op, -1), "one place back"), (op[::-1], "backwards")):
        order = np.arange(len(robot.joint_names))
        order[op] = way
        orders.append((f"the order of joints {words}", tuple(op.tolist()), order))
    for words, joints, order in orders:
        names = {robot.joint_names[o]: robot.joint_names[i] for i, o in enumerate(order) if i != o}
        yield _Guess(words, joints, partial(_as_if_ordered, model, order), {"names": names})


def _as_if_ordered(model: Gravity, order: Array, qpos: Array, key: Carried) -> Array:
    """Gravity torque in the log's own order, where column order[i] is of joint i."""
    torque = np.empty_like(qpos)
    torque[:, order] = model(qpos[:, order], *key)
    return torque


def _torques(surveys: list[Survey]) -> Loads:
    """Recorded torques in slow rows; none where they have no sign."""
    told = [s for s in surveys if s.loads is not None and s.torque is not None]
    if not any((s.torque.low < 0).any() for s in told if s.torque):
        return {}
    return _joined((s, (s.loads[0], s.loads[1])) for s in told if s.loads is not None)


def _rests(surveys: list[Survey], robot: RobotSpec) -> Loads:
    """What the servos must make at rest to hold the arm so far from its command."""
    kps = (robot.with_gains(*s.entry.meta.known_gains).kp for s in surveys)
    return _joined((s, (s.holds.qpos, kp * (s.holds.ctrl - s.holds.qpos))) for s, kp in zip(surveys, kps, strict=True))


def _joined(parts: Iterable[tuple[Survey, tuple[Array, Array]]]) -> Loads:
    found: dict[Carried, list[tuple[Array, Array]]] = defaultdict(list)
    for s, load in parts:
        found[s.entry.meta.payload_mass, s.entry.meta.payload_side].append(load)
    return {
        key: (np.concatenate([q for q, _ in all_]), np.concatenate([t for _, t in all_])) for key, all_ in found.items()
    }


def _unexplained(gravity: dict[Carried, Array], loads: Loads, loaded: Array, level: bool) -> Array:
    """Share of the torques' square that gravity, times a scale ≥ 0 for each joint, leaves, (loaded)."""
    x = np.concatenate([gravity[key][:, loaded] for key in loads])
    y = np.concatenate([torque[:, loaded] for _, torque in loads.values()])
    if level:
        x, y = x - x.mean(axis=0), y - y.mean(axis=0)
    power = (x**2).sum(axis=0) * (y**2).sum(axis=0)
    return 1 - np.maximum((x * y).sum(axis=0), 0) ** 2 / np.where(power > 0, power, np.inf) + 1e-4
