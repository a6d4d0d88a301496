"""Sends the hands of a VIRTUAL unit to goals and holds them there, by every method: offsets, settling, torque, heat."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.deploy.compensator import CompensatorConfig
from gaponet.experiments.played.goals import Plan, Planner
from gaponet.experiments.played.kept import KeptParts, revived
from gaponet.experiments.played.play import Driven, Played, compensations, of_seed, play, stacked, with_payloads
from gaponet.experiments.played.session import Tell
from gaponet.experiments.played.trained import Trained
from gaponet.robot.spec import RobotSpec
from gaponet.sim.model import model_hash
from gaponet.testing.physics import Physics

LAST = 1.0  # s at the end of a hold in which offsets are averaged
NEAR = 0.01  # m: delivered
CLIMB = 0.05  # m: less of a rise is neither lifting nor lowering
# Holding is what counts: the integral is twice as quick as by default, its low-pass half as long.
HOLD = CompensatorConfig(dynamics=True, feedback=1.0, feedback_time=0.25)


@dataclass(frozen=True)
class Placed:
    """One hand at one goal.

    Attributes:
        method, seed: Seed None where nothing was trained.
        payload: kg per hand.
        offset: Mean |hand − goal| by axis in the last second, (3,) m; true place.
        measured: The same of the place that the encoders tell.
        near, measured_near: Whether it stayed within 1 cm of the goal for that second.
        settle: s from the end of the way until it stays within 1 cm; NaN where it does not.
        way: lift, lower or across: the direction of the way.
        moving: Mean |hand − its target| by axis on the way, (3,) m.
    """

    method: str
    seed: int | None
    payload: float
    offset: Array
    measured: Array
    near: bool
    measured_near: bool
    settle: float
    way: str
    moving: Array


@dataclass(frozen=True)
class Cost:
    """Cost of one trajectory: motor torque over the holds, RMS over operated joints, N·m; mean rise of windings, K."""

    method: str
    seed: int | None
    payload: float
    torque: float
    warming: float


@dataclass(frozen=True)
class ShownHand:
    """One hand on one trajectory: its target's place and its true place by method, (T, 3) m; goals (stops, 3) m,
    held from row arrive to row leave."""

    payload: float
    dt: float
    goals: Array
    arrive: Array
    leave: Array
    target: Array
    places: dict[str, Array]


def deliver(
    robot: RobotSpec,
    unit: Physics,
    planner: Planner,
    plans: ListOf[Plan],
    payloads: tuple[float, ...],
    trained: ListOf[Trained],
    tell: Tell = lambda what, share: None,
    folder: Path | None = None,
) -> tuple[list[Placed], list[Cost], ShownHand]:
    """Play every trajectory with every payload, by every method.

    Args:
        payloads: kg per hand.
        folder: Where each method's part is kept when it is done.
    """
    pairs = with_payloads(plans, payloads)
    lengths, targets = np.array([len(p.ctrl) for p, _ in pairs]), stacked([p.ctrl for p, _ in pairs])
    mass, seeds = np.array([p for _, p in pairs]), list(range(len(pairs)))
    asked = {id(plan): planner.places(plan.ctrl) for plan in plans}
    last, shown = round(LAST / robot.dt), len(pairs) // 2 // len(payloads) * len(payloads) + len(payloads) - 1
    kept = KeptParts(folder, "delivery", model_hash(robot), unit, plans, payloads)
    found: list[Placed] = []
    costs: list[Cost] = []
    places: dict[str, Array] = {}

    def work(method: str, seed: int | None, driven: Driven | None) -> Any:
        played = play(robot, unit, targets, mass, seeds, driven, lengths, partial(tell, of_seed(method, seed)))
        placed: list[Placed] = []
        hands = []
        for i, (plan, payload) in enumerate(pairs):
            rows = slice(0, len(plan.ctrl))
            hands.append(planner.places(played.true[rows, i]))
            told = planner.places(played.qpos[rows, i])
            placed += _placed(plan, hands[-1], told, asked[id(plan)], method, seed, payload, last, robot.dt)
        cost = [_cost(plan, played, i, method, seed, payload, robot) for i, (plan, payload) in enumerate(pairs)]
        return {"found": placed, "costs": cost, "place": hands[shown][:, 0]}

    for method, seed, way in compensations(robot, trained):
        driven = None if way is None else replace(way, config=HOLD)
        part = kept(method, seed, driven and driven.facts, make=partial(work, method, seed, driven))
        found += [revived(Placed, d) for d in part["found"]]
        costs += [revived(Cost, c) for c in part["costs"]]
        if seed in (None, trained[0].seed):
            places[method] = np.array(part["place"])
    plan, payload = pairs[shown]
    target = asked[id(plan)][:, 0]
    return found, costs, ShownHand(payload, robot.dt, plan.goals[:, 0], plan.arrive, plan.leave, target, places)


def _placed(
    plan: Plan, hand: Array, told: Array, asked: Array, method: str, seed: int | None, payload: float, last: int,
    dt: float,
) -> list[Placed]:  # fmt: skip
    out = []
    for k, goals in enumerate(plan.goals):
        start, arrive, leave = plan.start[k], plan.arrive[k], plan.leave[k]
        end = slice(leave - last, leave)
        for h, goal in enumerate(goals):
            off, seen = hand[arrive:leave, h] - goal, told[end, h] - goal
            away = np.linalg.norm(off, axis=1) > NEAR
            settled = 0 if not away.any() else int(np.flatnonzero(away)[-1]) + 1
            rise = plan.rise[k, h]
            out.append(Placed(
                method, seed, payload, np.abs(hand[end, h] - goal).mean(axis=0), np.abs(seen).mean(axis=0),
                not away[-last:].any(), bool((np.linalg.norm(seen, axis=1) <= NEAR).all()),
                settled * dt if settled < len(away) else np.nan,
                "lift" if rise > CLIMB else "lower" if rise < -CLIMB else "across",
                np.abs(hand[start:arrive, h] - asked[start:arrive, h]).mean(axis=0),
            ))  # fmt: skip
    return out


def _cost(
    plan: Plan, played: Played, row: int, method: str, seed: int | None, payload: float, robot: RobotSpec
) -> Cost:
    op = robot.operated_index
    holds = np.concatenate([np.arange(a, b) for a, b in zip(plan.arrive, plan.leave, strict=True)])
    torque = played.tau[holds, row][:, op].astype(float)
    heat = played.temperature[[0, len(plan.ctrl) - 1], row][:, op].astype(float)
    return Cost(method, seed, payload, float(np.sqrt((torque**2).mean())), float((heat[1] - heat[0]).mean()))
