"""Do the torques hold up the arm that the joint angles describe?

A zero or a sign that is wrong in command and state alike shows in neither. It shows in the torque: an arm holds its own
weight, and how much depends on where it is. The recorded torque, where it has a sign, and the servo's kp (ctrl − qpos)
at rest are compared with the gravity of the nominal model, at the angles as logged and with one joint turned or
mirrored. Not seen is a mirrored joint that weighs the same both ways.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from gaponet.arrays import Array
from gaponet.data.checks.finding import Finding
from gaponet.data.offsets import Carried, Gravity
from gaponet.data.survey import Survey
from gaponet.robot import RobotSpec

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
LOADED = 0.01  # of the torque limit: a joint that gravity loads less says nothing


class _Best(NamedTuple):
    """Evidence for a joint being wrong in this way, and the mean shares explained."""

    evidence: float
    joint: str
    how: tuple[int, float, int]
    as_logged: float
    otherwise: float


def gravity(surveys: list[Survey], robot: RobotSpec, model: Gravity) -> Iterator[Finding]:
    """Are zero and sign of each joint those of the model?"""
    found = [
        _best(loads, robot, model) for loads in (_torques(surveys), _rests(surveys, robot))
        if sum(len(qpos) for qpos, _ in loads.values()) >= FEW
    ]  # fmt: skip
    if not found:
        yield Finding("ok", "gravity", "too few torques and rests: zeros and signs cannot be told from gravity")
        return
    best = max(found, key=lambda b: b.evidence)
    if best.evidence > EVIDENCE and best.otherwise > ENOUGH:
        sign, turn, _ = best.how
        what = f"its zero turned by {turn:+.2f} rad" if turn else "its torque negated"
        what = "its angle mirrored" if sign < 0 else what
        text = (
            f"with {what} at {best.joint} the torques fit the weight of the arm better ({best.otherwise:.0%}) "
            f"than as logged ({best.as_logged:.0%}): a sign or zero may be wrong in command and state alike; check "
            "it against the model"
        )
        yield Finding("warning", "gravity", text, (best.joint,), {"evidence": best.evidence})
    else:
        shares = " and ".join(f"{b.as_logged:.0%}" for b in found)
        yield Finding(
            "ok", "gravity", f"no other zero or sign fits gravity better; it explains {shares} of the torques"
        )


def _best(loads: Loads, robot: RobotSpec, model: Gravity) -> _Best:
    """The joint and the way of being wrong that explain the torques best."""
    step = max(1, sum(len(qpos) for qpos, _ in loads.values()) // ROWS)
    loads = {key: (qpos[::step], torque[::step]) for key, (qpos, torque) in loads.items() if len(qpos)}
    as_logged = {key: model(qpos, *key) for key, (qpos, _) in loads.items()}
    weight = np.sqrt(np.mean(np.concatenate(list(as_logged.values())) ** 2, axis=0))  # (n) N·m
    loaded = np.flatnonzero(weight > LOADED * robot.effort_limit)
    left = _unexplained(as_logged, loads, loaded)
    best = _Best(0.0, "", (1, 0.0, 1), 1 - float(left.mean()) if len(left) else 0.0, 0.0)
    for j in loaded.tolist():
        for how in OTHERWISE:
            other = {key: _as_if(model, qpos, key, j, *how) for key, (qpos, _) in loads.items()}
            rest = _unexplained(other, loads, loaded)
            evidence = float(np.log(left / rest).sum())
            if evidence > best.evidence:
                best = _Best(evidence, robot.joint_names[j], how, best.as_logged, 1 - float(rest.mean()))
    return best


def _torques(surveys: list[Survey]) -> Loads:
    """Recorded torques in slow rows; none where they have no sign."""
    told = [s for s in surveys if s.loads is not None and s.torque is not None]
    if not any((s.torque.low < 0).any() for s in told if s.torque):
        return {}
    return _joined((s, s.loads) for s in told if s.loads)


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


def _as_if(model: Gravity, qpos: Array, key: Carried, j: int, sign: int, turn: float, torque_sign: int) -> Array:
    """Gravity torque in the log's own signs, were joint j mirrored, its zero elsewhere or its torque negated."""
    other = qpos.copy()
    other[:, j] = sign * other[:, j] + turn
    torque = model(other, *key).copy()
    torque[:, j] *= torque_sign
    return torque


def _unexplained(gravity: dict[Carried, Array], loads: Loads, loaded: Array) -> Array:
    """Share of the torques' square that gravity, times a scale ≥ 0 for each joint, leaves, (loaded)."""
    x = np.concatenate([gravity[key][:, loaded] for key in loads])
    y = np.concatenate([torque[:, loaded] for _, torque in loads.values()])
    power = (x**2).sum(axis=0) * (y**2).sum(axis=0)
    return 1 - np.maximum((x * y).sum(axis=0), 0) ** 2 / np.where(power > 0, power, np.inf) + 1e-4
