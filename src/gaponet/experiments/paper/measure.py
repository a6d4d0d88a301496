"""What a method is measured on, and the measurement: the same for every method.

On a VIRTUAL fleet: ten motions that no network has seen, on a unit that no network has seen, with
every payload. Of a real robot: the test motions of the dataset; nothing can be commanded there.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.experiments.paper.commands import (
    NETWORK_WAYS,
    PLAIN_WAYS,
    ShareDone,
    make_compensator,
    play,
)
from gaponet.experiments.paper.goals import GOALS_PER_TRAJECTORY, GoalPlanner, Plan
from gaponet.experiments.paper.unseen_motions import UnseenMotion
from gaponet.nn.artifact import GapModel
from gaponet.robot.spec import RobotSpec
from gaponet.sim.replay import replay
from gaponet.virtual.physics import Physics

REST_S = 2.0  # under the first target before a motion begins, for a compensator to blend in
HOLD_S = 3.0  # at each goal
AVERAGED_S = 1.0  # end of a hold over which offsets are averaged
SUCCESS_RADIUS_M = 0.01
GOAL_SEED = 0
LARGE_GAPS_RAD = (0.1, 0.5)
LATENCY_CALLS = 2000


@dataclass(frozen=True)
class VirtualUnit:
    """The unit that no network has seen, and what it does in the experiment.

    Attributes:
        motions: Motions of Figure 3.
        payloads: kg in each hand, ascending.
        goal_count: Goals of Table 1, per payload.
        dt: Control period, s.
    """

    name: str
    physics: Physics
    robot: RobotSpec  # nominal
    motions: ListOf[UnseenMotion]
    payloads: tuple[float, ...]
    goal_count: int
    dt: float

    def motion_runs(self) -> list[tuple[UnseenMotion, float]]:
        """Return each motion with each payload, the longest motions first."""
        longest_first = sorted(self.motions, key=lambda motion: -len(motion.ctrl))
        return list(product(longest_first, self.payloads))

    def motion_targets(self) -> list[Array]:
        """Return the targets of `motion_runs`, (T, n) rad each, with the rest before them."""
        rest = round(REST_S / self.dt)
        targets = []
        for motion, _ in self.motion_runs():
            standing = np.repeat(motion.ctrl[:1], rest, axis=0)
            targets.append(np.concatenate([standing, motion.ctrl]))
        return targets


@dataclass(frozen=True)
class Recorded:
    """Recordings of a robot that no network has seen: what simulators are compared with."""

    sequences: list[Sequence]

    @property
    def motions(self) -> list[str]:
        """Motion of each recording; repetitions and copies of a motion have one name."""
        return [sequence.meta.independent_motion for sequence in self.sequences]

    @property
    def payloads(self) -> list[float]:
        """Payload of each recording, kg in each hand."""
        return [sequence.meta.payload_mass for sequence in self.sequences]

    @property
    def durations(self) -> list[float]:
        """Duration of each recording, s."""
        return [(len(sequence) - 1) * sequence.dt for sequence in self.sequences]


def _payloads(runs: ListOf[tuple[object, float]]) -> list[float]:
    """Return the payload of each run, kg."""
    return [payload for _, payload in runs]


def record_unit(unit: VirtualUnit, progress: ShareDone = lambda share: None) -> Recorded:
    """Play the motions of Figure 3 on the unit, targets as they are, and return the recordings."""
    rest = round(REST_S / unit.dt)
    targets = unit.motion_targets()
    runs = unit.motion_runs()
    payloads = _payloads(runs)
    played = play(unit.robot, unit.physics, targets, payloads, unit.dt, progress=progress)
    sequences = []
    for i, (motion, payload) in enumerate(runs):
        rows = slice(rest, len(targets[i]))
        meta = SequenceMeta(unit.robot.name, unit.name, motion.name, payload, virtual=True)
        sequences.append(
            Sequence(
                meta,
                unit.robot.joint_names,
                unit.dt,
                motion.ctrl,
                played.qpos[rows, i],
                played.qvel[rows, i],
            )
        )
    return Recorded(sequences)


def measure_alignment(
    recorded: Recorded, simulator: RobotSpec, model: GapModel | None
) -> dict[str, Any]:
    """Equation 5: roll the simulator out under a + Δa from the recorded start, and compare it with
    the recordings.

    Returns:
        q_dis: Q_dis = Σ |error| Δt of each recording and operated joint, (recordings, n) rad·s.
        large_gaps: Threshold, rad → share of rows and joints beyond it, of each recording.
    """
    corrector = None
    if model is not None:
        corrector = model.corrector(simulator)
    replays = replay(recorded.sequences, simulator, corrector, nthread=1, lock_idle=True)
    operated = simulator.operated_index
    q_dis = []
    large_gaps: dict[str, list[float]] = {str(threshold): [] for threshold in LARGE_GAPS_RAD}
    for sequence, simulated in zip(recorded.sequences, replays, strict=True):
        error = np.abs((simulated.qpos - sequence.qpos)[1:, operated].astype(float))
        q_dis.append((error.sum(axis=0) * sequence.dt).tolist())
        for threshold in LARGE_GAPS_RAD:
            large_gaps[str(threshold)].append(float((error > threshold).mean()))
    return {"q_dis": q_dis, "large_gaps": large_gaps}


def measure_commands(
    unit: VirtualUnit, model: GapModel | None, simulator: RobotSpec | None = None
) -> dict[str, Any]:
    """Send the motions of Figure 3 to the unit in every way; way → Q_dis between target and joint.

    Args:
        simulator: Simulator of the feed-forward without a network; default the nominal one.

    Returns:
        Way → (recordings, n) rad·s.
    """
    rest = round(REST_S / unit.dt)
    targets = unit.motion_targets()
    payloads = _payloads(unit.motion_runs())
    operated = unit.robot.operated_index
    ways = PLAIN_WAYS if model is None else NETWORK_WAYS
    measured = {}
    for way, config in ways.items():
        compensator = None
        if config is not None:
            robot = simulator or unit.robot
            compensator = make_compensator(robot, model, config, payloads, unit.dt)
        played = play(unit.robot, unit.physics, targets, payloads, unit.dt, compensator)
        q_dis = []
        for i, target in enumerate(targets):
            rows = slice(rest, len(target))
            error = (played.qpos[rows, i] - target[rest:])[:, operated].astype(float)
            q_dis.append((np.abs(error).sum(axis=0) * unit.dt).tolist())
        measured[way] = q_dis
    return measured


@dataclass(frozen=True)
class Delivery:
    """Trajectories of the hands to their goals, of one unit."""

    planner: GoalPlanner
    plans: list[Plan]

    @classmethod
    def plan(cls, unit: VirtualUnit) -> Delivery:
        """Plan trajectories over the space that the hands reach and can hold the heaviest payload
        in.
        """
        planner = GoalPlanner(unit.robot, max(unit.payloads), GOAL_SEED, HOLD_S, unit.dt)
        goals_per_plan = GOALS_PER_TRAJECTORY * len(planner.arms)
        plans = planner.plans(-(-unit.goal_count // goals_per_plan))
        return cls(planner, sorted(plans, key=lambda plan: -len(plan.ctrl)))


def measure_delivery(
    unit: VirtualUnit, delivery: Delivery, model: GapModel | None
) -> dict[str, Any]:
    """Send the hands to their goals in every way.

    Returns:
        Way → offset: mean |hand − goal| in the last second of each hold, (payloads, goals, 3) m
        along X, Y, Z;
        near: share of the goals at which the hand stays within SUCCESS_RADIUS_M then, (payloads,).
    """
    ways = PLAIN_WAYS if model is None else NETWORK_WAYS
    runs = list(product(delivery.plans, unit.payloads))
    targets = [plan.ctrl for plan, _ in runs]
    payloads = _payloads(runs)
    measured = {}
    for way, config in ways.items():
        compensator = None
        if config is not None:
            compensator = make_compensator(unit.robot, model, config, payloads, unit.dt)
        played = play(unit.robot, unit.physics, targets, payloads, unit.dt, compensator)
        held: dict[float, list[Array]] = defaultdict(list)  # payload → offsets of each hold
        for i, (plan, payload) in enumerate(runs):
            hands = delivery.planner.hand_positions(played.true_qpos[: len(plan.ctrl), i])
            held[payload] += held_offsets(hands, plan, unit.dt)
        offsets = []
        near = []
        for payload in unit.payloads:
            offsets.append(_mean_offsets(held[payload]))
            near.append(_near_share(held[payload]))
        measured[way] = {"offset": offsets, "near": near}
    return measured


def _mean_offsets(held: list[Array]) -> list[list[float]]:
    """Return mean |hand − goal| along X, Y, Z in each hold, (holds, 3) m; held (rows, 3) m each."""
    return [np.abs(away).mean(axis=0).tolist() for away in held]


def _near_share(held: list[Array]) -> float:
    """Return the share of holds within SUCCESS_RADIUS_M of the goal; held (rows, 3) m each."""
    near = [(np.linalg.norm(away, axis=1) <= SUCCESS_RADIUS_M).all() for away in held]
    return float(np.mean(near))


def held_offsets(hands: Array, plan: Plan, dt: float) -> list[Array]:
    """Return hand − goal in the last second of every hold, for each goal and hand.

    Args:
        hands: Positions, (T, hands, 3) m.

    Returns:
        (rows of AVERAGED_S, 3) m each.
    """
    last_rows = round(AVERAGED_S / dt)
    offsets = []
    for goals, leave in zip(plan.goals, plan.leave, strict=True):
        for hand, goal in enumerate(goals):
            offsets.append(hands[leave - last_rows : leave, hand] - goal)
    return offsets


def measure_latency(model: GapModel) -> dict[str, float]:
    """Return the time of one correction of one robot in its control loop, µs: median and 99 %
    quantile.
    """
    loop = model.loop(1)
    rng = np.random.default_rng(0)
    positions = 0.1 * rng.standard_normal((LATENCY_CALLS, len(model.card["joint_names"])))
    velocity = np.zeros(positions.shape[1])
    seconds = []
    for position in positions:
        began = time.perf_counter()
        loop.delta(position, velocity, position, 0.0)
        seconds.append(time.perf_counter() - began)
    median, slow = np.quantile(seconds, [0.5, 0.99])
    return {"p50_us": 1e6 * float(median), "p99_us": 1e6 * float(slow)}
