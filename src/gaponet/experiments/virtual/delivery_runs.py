"""Execution of goal trajectories on a VIRTUAL unit, by every method: offsets, settling time, torque, heat."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from functools import partial

import numpy as np

from gaponet.base.arrays import Array
from gaponet.deploy.compensator import CompensatorConfig
from gaponet.experiments.virtual.goals import GoalPlanner, Plan
from gaponet.experiments.virtual.play import (
    Progress,
    Trajectories,
    compensations,
    play,
    stack_targets,
    step_name,
    with_payloads,
)
from gaponet.experiments.virtual.trained_models import TrainedModel
from gaponet.robot.spec import RobotSpec
from gaponet.testing.physics import Physics

AVERAGED_S = 1.0  # end of a hold over which offsets are averaged
SUCCESS_RADIUS_M = 0.01
MIN_RISE_M = 0.05  # of a move that counts as lifting or lowering
# Holding matters here: the integral is twice as fast as by default, its low-pass half as long.
HOLD = CompensatorConfig(dynamics=True, feedback=1.0, feedback_time=0.25)


@dataclass(frozen=True)
class HoldError:
    """Errors of one hand at one goal.

    Attributes:
        seed: None for a method without training.
        payload: kg per hand.
        offset: Mean |hand − goal| by axis at the end of the hold, (3,) m, of the true hand position.
        measured: The same of the hand position by the encoders.
        near, measured_near: True if the hand stayed within SUCCESS_RADIUS_M at the end of the hold.
        settle: s from the end of the move until the hand stays within SUCCESS_RADIUS_M; NaN if it does not.
        direction: Direction of the move: lift, lower or across.
        moving: Mean |hand − its target| by axis during the move, (3,) m.
    """

    method: str
    seed: int | None
    payload: float
    offset: Array
    measured: Array
    near: bool
    measured_near: bool
    settle: float
    direction: str
    moving: Array


@dataclass(frozen=True)
class Effort:
    """Effort of one trajectory over the operated joints: RMS motor torque in the holds, N·m; mean warming, K."""

    method: str
    seed: int | None
    payload: float
    torque: float
    warming: float


@dataclass(frozen=True)
class ExampleHand:
    """One hand on one trajectory: target and true positions by method, (T, 3) m; goals (G, 3) m, held from row arrive
    to row leave."""

    payload: float
    dt: float
    goals: Array
    arrive: Array
    leave: Array
    target: Array
    positions: dict[str, Array]


def deliver(
    robot: RobotSpec,
    unit: Physics,
    planner: GoalPlanner,
    plans: ListOf[Plan],
    payloads: tuple[float, ...],
    trained: ListOf[TrainedModel],
    progress: Progress = lambda step, share: None,
) -> tuple[list[HoldError], list[Effort], ExampleHand]:
    """Execute every trajectory with every payload (kg per hand), by every method."""
    pairs = with_payloads(plans, payloads)
    lengths, targets = np.array([len(p.ctrl) for p, _ in pairs]), stack_targets([p.ctrl for p, _ in pairs])
    mass = np.array([p for _, p in pairs])
    target_positions = {id(plan): planner.hand_positions(plan.ctrl) for plan in plans}
    shown = len(pairs) // 2 // len(payloads) * len(payloads) + len(payloads) - 1
    errors: list[HoldError] = []
    efforts: list[Effort] = []
    example: dict[str, Array] = {}
    for method, seed, compensation in compensations(robot, trained, HOLD):
        done = partial(progress, step_name(method, seed))
        played = play(robot, unit, targets, mass, lengths=lengths, compensation=compensation, progress=done)
        for i, (plan, payload) in enumerate(pairs):
            rows = slice(0, len(plan.ctrl))
            hands = planner.hand_positions(played.true[rows, i])
            measured = planner.hand_positions(played.qpos[rows, i])
            errors += [
                HoldError(method, seed, payload, *values)
                for values in _hold_errors(plan, hands, measured, target_positions[id(plan)], robot.dt)
            ]
            efforts.append(Effort(method, seed, payload, *_effort(plan, played, i, robot)))
            if i == shown and seed in (None, trained[0].seed):
                example[method] = hands[:, 0]
    plan, payload = pairs[shown]
    target = target_positions[id(plan)][:, 0]
    return errors, efforts, ExampleHand(payload, robot.dt, plan.goals[:, 0], plan.arrive, plan.leave, target, example)


def _hold_errors(
    plan: Plan, hands: Array, measured: Array, targets: Array, dt: float
) -> list[tuple[Array, Array, bool, bool, float, str, Array]]:
    """Return the fields of HoldError from offset on, for each goal and hand; positions are (T, hands, 3) m."""
    out = []
    last = round(AVERAGED_S / dt)
    for k, goals in enumerate(plan.goals):
        start, arrive, leave = plan.start[k], plan.arrive[k], plan.leave[k]
        end = slice(leave - last, leave)
        for h, goal in enumerate(goals):
            away = np.linalg.norm(hands[arrive:leave, h] - goal, axis=1) > SUCCESS_RADIUS_M
            by_encoders = measured[end, h] - goal
            settled = 0 if not away.any() else int(np.flatnonzero(away)[-1]) + 1
            rise = plan.rise[k, h]
            out.append((
                np.abs(hands[end, h] - goal).mean(axis=0),
                np.abs(by_encoders).mean(axis=0),
                not away[-last:].any(),
                bool((np.linalg.norm(by_encoders, axis=1) <= SUCCESS_RADIUS_M).all()),
                settled * dt if settled < len(away) else float("nan"),
                "lift" if rise > MIN_RISE_M else "lower" if rise < -MIN_RISE_M else "across",
                np.abs(hands[start:arrive, h] - targets[start:arrive, h]).mean(axis=0),
            ))  # fmt: skip
    return out


def _effort(plan: Plan, played: Trajectories, row: int, robot: RobotSpec) -> tuple[float, float]:
    op = robot.operated_index
    holds = np.concatenate([np.arange(a, b) for a, b in zip(plan.arrive, plan.leave, strict=True)])
    torque = played.tau[holds, row][:, op].astype(float)
    heat = played.temperature[[0, len(plan.ctrl) - 1], row][:, op].astype(float)
    return float(np.sqrt((torque**2).mean())), float((heat[1] - heat[0]).mean())
