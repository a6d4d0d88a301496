"""Goal-directed delivery on a VIRTUAL unit: offsets of hands that move to goals with a load and hold there.

Goals are positions in the frame of the robot's base. Joint targets come from inverse kinematics. Two offsets are
measured: that of the true hand position, which includes the encoders' zero errors that no controller can know, and that
of the hand position by the encoders.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.base.result_table import MeanStd, ResultTable
from gaponet.data.store import Dataset
from gaponet.deploy.compensator import CompensatorConfig
from gaponet.experiments.result import Result
from gaponet.experiments.virtual.goals import GOALS_PER_TRAJECTORY, GoalPlanner, Plan
from gaponet.experiments.virtual.play import (
    Progress,
    TrainedModel,
    Trajectories,
    compensations,
    play,
    stack_targets,
    step_name,
    with_payloads,
)
from gaponet.experiments.virtual.session import Session, UnitExperiment
from gaponet.experiments.virtual.statistics import (
    NOT_IN_EXAMPLES,
    M,
    bar_series,
    compare_with_rivals,
    methods,
    over_seeds,
    payloads,
    percent_text,
    reduction,
    select,
)
from gaponet.report.figures.charts import draw_bars
from gaponet.report.figures.style import DASHED, figure, legend, styled
from gaponet.report.methods import colour, title
from gaponet.robot.spec import RobotSpec
from gaponet.testing.physics import Physics

if TYPE_CHECKING:
    from matplotlib.figure import Figure


AXES = ("X", "Y", "Z")
AXIS_NAMES = ("forward", "left", "up")
AVERAGED_S = 1.0  # end of a hold over which offsets are averaged
SUCCESS_RADIUS_M = 0.01
MIN_RISE_M = 0.05  # of a move that counts as lifting or lowering
# Holding matters here: the integral is twice as fast as by default, its low-pass half as long.
HOLD = CompensatorConfig(dynamics=True, feedback=1.0, feedback_time=0.25)

# Table 1 as printed: kg → mean |offset| along X, Y, Z, cm, of GAPONet, an MLP and the simulator's output as it is.
TABLE_1 = {
    0.0: ((0.3564, 0.6274, 0.4797), (0.4298, 0.6097, 1.7068), (0.6733, 0.6450, 1.9698)),
    1.0: ((0.3506, 0.7331, 0.4885), (0.4581, 0.5801, 1.7142), (0.5424, 0.7554, 1.9978)),
    2.0: ((0.3725, 0.7357, 0.5759), (0.4363, 0.7374, 1.8323), (0.8149, 1.2051, 2.1376)),
    3.0: ((0.4597, 0.7855, 0.6214), (0.4726, 0.7113, 2.1137), (1.1455, 1.2520, 1.9269)),
}
TABLE_1_METHODS = {"paper": 0, "gaponet": 0, "mlp": 1, "raw": 2}  # our method → column of TABLE_1


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


@dataclass(frozen=True)
class Delivery(UnitExperiment):
    """Table 1 of the paper: hands at goals under load, X, Y and Z offsets, success, settling, torque and heat.

    A VIRTUAL unit, targets from inverse kinematics, sent raw and through the compensator. About fifteen minutes on one
    core with trained models.
    """

    goals: int = 100
    """Per payload, over the space that the hands reach and can hold the heaviest payload in."""
    hold: float = 3.0
    """At each goal, s."""
    front: float = 0.1
    """Goals lie at least so far in front of the robot's base, m."""
    goal_seed: int = 0
    """Seed of the goals."""

    def quick(self) -> Delivery:
        """Return the experiment with few motions, for a quick run."""
        return replace(self, goals=10)

    def require(self, data: Dataset) -> None:
        """Refuse short holds, and recordings of real robots, which cannot be executed."""
        if self.hold < AVERAGED_S + 0.5:
            raise UsageError(f"--hold {self.hold:g}: offsets are those of the last second; hold for 1.5 s or more")
        if not any(e.meta.virtual for e in data.entries):
            raise UsageError(
                f"{data.path}: holds recordings of real robots; delivery plays a virtual unit, give its dataset"
            )

    def measure(self, session: Session, progress: Progress) -> DeliveryErrors:
        """Execute every goal with every payload by every method."""
        physics, masses = session.unit[1], session.payloads
        progress("goals", 0.0)
        planner = GoalPlanner(session.robot, max(masses), self.goal_seed, self.hold, self.front)
        per_plan = GOALS_PER_TRAJECTORY * len(planner.arms)
        plans = planner.plans(-(-self.goals // per_plan))
        measured = deliver(session.robot, physics, planner, plans, masses, session.trained, progress)
        facts = {"goals_per_payload": len(plans) * per_plan, "hold_s": self.hold, "config": HOLD}
        return DeliveryErrors(*measured, facts)

    def run(self, session: Session, progress: Progress) -> Result:
        """Execute every goal and return tables, figures and sentences."""
        return result(session, self.measure(session, progress))


@dataclass(frozen=True)
class DeliveryErrors:
    """Measurements of a delivery experiment, and the arguments of Session.result."""

    errors: list[HoldError]
    efforts: list[Effort]
    example: ExampleHand
    facts: dict[str, Any]


def result(session: Session, measured: DeliveryErrors) -> Result:
    """Return tables, figures and sentences."""
    errors = measured.errors
    heading = "Goal-directed delivery: hands at goals under load (VIRTUAL robot)"
    figures = {"offsets": draw_offsets(errors), "example": draw_example(measured.example)}
    tables = [offset_table(errors), paper_table(errors), moving_table(errors), effort_table(measured.efforts)]
    return session.result("delivery", heading, tables, figures, sentences(errors), **measured.facts)


def _by_method(
    name: str, measured: ListOf[M], columns: Mapping[str, Callable[[list[M]], MeanStd]], caption: str
) -> ResultTable:
    """A row per payload and method."""
    rows = [
        (f"{p:g} kg, {title(m)}", *(value(select(measured, m, p)) for value in columns.values()))
        for p in payloads(measured)
        for m in methods(measured)
    ]
    return ResultTable(name, ("payload per hand", *columns), tuple(rows), caption)


def offset_table(errors: ListOf[HoldError]) -> ResultTable:
    """Offsets by axis, success and settling time, by the true position and by the encoders."""
    columns: dict[str, Any] = {f"{a}, cm": _along("offset", i) for i, a in enumerate(AXES)}
    columns["within 1 cm, %"] = lambda chosen: over_seeds(chosen, lambda e: e.near, 1e2)
    columns["settled in, s"] = lambda chosen: over_seeds(chosen, lambda e: e.settle, average=np.median)
    columns |= {f"{a} by encoders, cm": _along("measured", i) for i, a in enumerate(AXES)}
    columns["within 1 cm by encoders, %"] = lambda chosen: over_seeds(chosen, lambda e: e.measured_near, 1e2)
    caption = (
        "Mean |hand − goal| by axis in the last second of a hold (X forward, Y left, Z up); ± is the standard "
        "deviation over training seeds. The true position of the hand includes zero errors of the encoders; the "
        "columns by encoders do not. Within 1 cm: for all of that second. Settled: median over the goals at which the "
        "hand stays within 1 cm until the end."
    )
    return _by_method("offsets", errors, columns, caption)


def paper_table(errors: ListOf[HoldError]) -> ResultTable:
    """Table 1 in the paper's layout, the printed numbers below ours."""
    shown = [m for m in TABLE_1_METHODS if m in methods(errors)]
    columns = ["payload per hand", *(f"{title(m)}: {a}, cm" for m in shown for a in AXES)]
    rows: list[tuple[Any, ...]] = []
    for p in payloads(errors):
        rows.append((f"{p:g} kg", *(_along("offset", a)(select(errors, m, p)) for m in shown for a in range(3))))
        if p in TABLE_1:
            printed = [TABLE_1[p][TABLE_1_METHODS[m]] for m in shown]
            rows.append((f"{p:g} kg, the paper", *(offset for axes in printed for offset in axes)))
    caption = (
        "Mean |hand − goal| by axis, as Table 1 of the paper, and its numbers: a real H1-2, goals and heights that are "
        "not known here. Its third column is the simulator's output, sent as it is: raw targets here."
    )
    return ResultTable("table1", tuple(columns), tuple(rows), caption)


def moving_table(errors: ListOf[HoldError]) -> ResultTable:
    """Distance between hand and target during lifting and lowering."""
    columns = {f"{way}ing, {a}, cm": _along("moving", i, way) for way in ("lift", "lower") for i, a in enumerate(AXES)}
    return _by_method("moving", errors, columns, "Mean |hand − its target| on ways that rise or fall by 5 cm or more.")


def effort_table(efforts: ListOf[Effort]) -> ResultTable:
    """Motor torque and warming."""
    columns: dict[str, Any] = {
        "motor torque, N·m RMS": lambda chosen: over_seeds(chosen, lambda e: e.torque),
        "windings warm by, K": lambda chosen: over_seeds(chosen, lambda e: e.warming),
    }
    return _by_method("cost", efforts, columns, "Operated joints: torque while holding, warming over a trajectory.")


def _along(field: str, axis: int, direction: str | None = None) -> Callable[[list[HoldError]], MeanStd]:
    """Return the average of a field along one axis, cm; with a direction, only of such moves."""
    return lambda errors: over_seeds(
        [e for e in errors if direction in (None, e.direction)], lambda e: getattr(e, field)[axis], 1e2
    )


def mean_offset(errors: ListOf[HoldError], method: str, payload: float, axis: int) -> float:
    """Mean offset along one axis, m."""
    return over_seeds(select(errors, method, payload), lambda e: e.offset[axis]).mean


def sentences(errors: ListOf[HoldError]) -> list[str]:
    """Return the conclusions."""
    names, masses = methods(errors), payloads(errors)
    light, heavy = masses[0], masses[-1]
    offset = {(m, p): [mean_offset(errors, m, p, a) for a in range(3)] for m in names for p in masses}
    texts = []
    for m in names[1:]:
        parts = [
            f"{label} {percent_text(reduction(value, raw))} ({raw * 1e2:.1f} → {value * 1e2:.1f} cm)"
            for label, value, raw in zip(AXES, offset[m, heavy], offset["raw", heavy], strict=True)
        ]
        texts.append(f"At {heavy:g} kg, {title(m)} against raw targets: {', '.join(parts)}.")
    for m in names[1:]:
        worse = [x for x, v, raw in zip(AXES, offset[m, light], offset["raw", light], strict=True) if v > raw]
        if worse:
            texts.append(f"At {light:g} kg, {title(m)} is WORSE than raw targets along {', '.join(worse)}.")
    if not any("WORSE" in s for s in texts):
        texts.append(f"At {light:g} kg nothing is worse than raw targets along any axis.")
    lengths = {p: {m: float(np.linalg.norm(offset[m, p])) for m in names} for p in masses}
    return texts + [f"{sentence} (length of the mean offsets)." for sentence in compare_with_rivals(lengths, names)]


@styled
def draw_offsets(errors: ListOf[HoldError]) -> Figure:
    """Draw mean |hand − goal| by axis, a group of bars per payload; standard error over goals."""
    fig, masses = figure(10.2, 3.5), payloads(errors)
    for a, ax in enumerate(fig.subplots(1, 3)):

        def over_goals(method: str, payload: float, a: int = a) -> MeanStd:
            chosen = select(errors, method, payload)
            values = np.array([e.offset[a] for e in chosen]) * 1e2
            goals = max(len(values) // len({e.seed for e in chosen}), 1)
            return MeanStd(float(values.mean()), float(values.std() / np.sqrt(goals)), goals)

        draw_bars(ax, [f"{p:g} kg" for p in masses], bar_series(errors, masses, over_goals))
        ax.axhline(SUCCESS_RADIUS_M * 1e2, color="#111111", lw=0.7, ls=DASHED)
        ax.set_title(f"{AXES[a]}, {AXIS_NAMES[a]}")
    fig.axes[0].set_ylabel("|hand − goal|, cm")
    legend(fig, "Offset at the goal, VIRTUAL robot; mean and standard error over goals; dashed: 1 cm")
    return fig


@styled
def draw_example(example: ExampleHand) -> Figure:
    """Draw the true position of the hand over time, axis by axis, and the goals ± 1 cm."""
    fig = figure(10.2, 3.4)
    time = np.arange(len(example.target)) * example.dt
    for a, ax in enumerate(fig.subplots(1, 3, sharex=True)):
        for m, position in example.positions.items():
            if m not in NOT_IN_EXAMPLES:
                ax.plot(time, position[:, a] * 1e2, color=colour(m), label=title(m))
        ax.plot(time, example.target[:, a] * 1e2, color=colour("target"), ls=DASHED, lw=1.0, label=title("target"))
        for goal, arrive, leave in zip(example.goals, example.arrive, example.leave, strict=True):
            low, high = (goal[a] - SUCCESS_RADIUS_M) * 1e2, (goal[a] + SUCCESS_RADIUS_M) * 1e2
            span = [arrive * example.dt, leave * example.dt]
            ax.fill_between(span, low, high, color=colour("target"), alpha=0.18, lw=0)
        ax.set_title(f"{AXES[a]}, {AXIS_NAMES[a]}")
        ax.set_xlabel("time, s")
    fig.axes[0].set_ylabel("hand, cm")
    legend(fig, f"One hand, two goals, {example.payload:g} kg in each hand, VIRTUAL robot; shaded: goal ± 1 cm")
    return fig
