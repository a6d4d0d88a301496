"""Goal-directed delivery on a VIRTUAL unit: hands go to goals with a load and hold there; how far off are they?

Goals are places in the frame of the robot's base, joint targets come from inverse kinematics. Offsets are those of the
hand's true place, which includes the zero errors of the encoders that no controller can know, and those of the place
that the encoders tell.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from gaponet.base.errors import UsageError
from gaponet.base.result_table import MeanStd, ResultTable
from gaponet.data.store import Dataset
from gaponet.experiments.paper import TABLE_1, TABLE_1_METHODS
from gaponet.experiments.played.deliver import HOLD, LAST, NEAR, Cost, Placed, ShownHand, deliver
from gaponet.experiments.played.goals import STOPS, Planner
from gaponet.experiments.played.measured import (
    LEFT_OUT,
    M,
    cut,
    duels,
    methods,
    of,
    over_seeds,
    payloads,
    percent,
    series,
)
from gaponet.experiments.played.session import Playing, Session, Tell
from gaponet.experiments.result import Result
from gaponet.report.figures.charts import draw_bars
from gaponet.report.figures.colours import colour
from gaponet.report.figures.style import DASHED, figure, legend, styled
from gaponet.report.methods import title

if TYPE_CHECKING:
    from matplotlib.figure import Figure

QUICK_PLANS = 5
AXES = ("X", "Y", "Z")
SIDES = ("forward", "left", "up")


@dataclass(frozen=True)
class Delivery(Playing):
    """Table 1 of the paper: hands at goals under load, X, Y and Z offsets, success, settling, torque and heat.

    A VIRTUAL unit, targets from inverse kinematics, sent raw and through the compensator. About fifteen minutes on one
    core with models that are there; --quick in under five with training.
    """

    goals: int = 100
    """Per payload, over the space that the hands reach and can hold the heaviest payload in."""
    hold: float = 3.0
    """At each goal, s."""
    front: float = 0.1
    """Goals lie at least so far in front of the robot's base, m."""
    goal_seed: int = 0
    """Seed of the goals."""

    def require(self, data: Dataset) -> None:
        """Refuse short holds, and recordings of real robots, of which no unit can be played."""
        if self.hold < LAST + 0.5:
            raise UsageError(f"--hold {self.hold:g}: offsets are those of the last second; hold for 1.5 s or more")
        if not any(e.meta.virtual for e in data.entries):
            raise UsageError(
                f"{data.path}: holds recordings of real robots; delivery plays a virtual unit, give its dataset"
            )

    def measured(self, session: Session, tell: Tell) -> Delivered:
        """Every goal with every payload by every method."""
        _, physics, payloads = session.cast
        tell("goals", 0.0)
        planner = Planner(session.robot, max(payloads), self.goal_seed, self.hold, self.front)
        each = STOPS * len(planner.arms)
        plans = planner.plans(QUICK_PLANS if session.quick else -(-self.goals // each))
        found = deliver(session.robot, physics, planner, plans, payloads, session.trained, tell, session.parts)
        return Delivered(*found, {"goals_per_payload": len(plans) * each, "hold_s": self.hold})

    def play(self, session: Session, tell: Tell) -> Result:
        """Measure, and say what came out."""
        found = self.measured(session, tell)
        return result(session, found.placed, found.costs, found.example, config=HOLD, **found.facts)


@dataclass(frozen=True)
class Delivered:
    """What was measured, and what it takes to repeat it."""

    placed: list[Placed]
    costs: list[Cost]
    example: ShownHand
    facts: dict[str, Any]


def result(session: Session, found: ListOf[Placed], costs: ListOf[Cost], example: ShownHand, **told: Any) -> Result:
    heading = "Goal-directed delivery: hands at goals under load (VIRTUAL robot)"
    figures = {"offsets": draw_offsets(found), "example": draw_example(example)}
    tables = [offsets(found), beside_paper(found), moving(found), spent(costs)]
    return session.result("delivery", heading, tables, figures, sentences(found), **told)


def by_method(
    name: str, found: ListOf[M], columns: Mapping[str, Callable[[list[M]], MeanStd]], caption: str
) -> ResultTable:
    """A row per payload and method."""
    rows = [
        (f"{p:g} kg, {title(m)}", *(value(of(found, m, p)) for value in columns.values()))
        for p in payloads(found)
        for m in methods(found)
    ]
    return ResultTable(name, ("payload per hand", *columns), tuple(rows), caption)


def offsets(found: ListOf[Placed]) -> ResultTable:
    """Offsets by axis, success, settling; by the true place and by the encoders'."""
    columns: dict[str, Any] = {f"{a}, cm": _along("offset", i) for i, a in enumerate(AXES)}
    columns["within 1 cm, %"] = lambda some: over_seeds(some, lambda d: d.near, 1e2)
    columns["settled in, s"] = lambda some: over_seeds(some, lambda d: d.settle, middle=np.median)
    columns |= {f"{a} by encoders, cm": _along("measured", i) for i, a in enumerate(AXES)}
    columns["within 1 cm by encoders, %"] = lambda some: over_seeds(some, lambda d: d.measured_near, 1e2)
    caption = (
        "Mean |hand − goal| by axis in the last second of a hold (X forward, Y left, Z up); ± is the spread of "
        "training seeds. Where the hand is, zero errors of the encoders included; and where the encoders say that it "
        "is. Within 1 cm: for all of that second. Settled: median of the goals at which it stays within 1 cm until "
        "the end."
    )
    return by_method("offsets", found, columns, caption)


def beside_paper(found: ListOf[Placed]) -> ResultTable:
    """Table 1 as the paper has it, its numbers below ours."""
    shown = [m for m in TABLE_1_METHODS if m in methods(found)]
    columns = ["payload per hand", *(f"{title(m)}: {a}, cm" for m in shown for a in AXES)]
    rows: list[tuple[Any, ...]] = []
    for p in payloads(found):
        rows.append((f"{p:g} kg", *(_along("offset", a)(of(found, m, p)) for m in shown for a in range(3))))
        if p in TABLE_1:
            printed = [TABLE_1[p][TABLE_1_METHODS[m]] for m in shown]
            rows.append((f"{p:g} kg, the paper", *(offset for axes in printed for offset in axes)))
    caption = (
        "Mean |hand − goal| by axis, as Table 1 of the paper, and its numbers: a real H1-2, goals and heights that are "
        "not known here. Its third column is the simulator's output, sent as it is: raw targets here."
    )
    return ResultTable("table1", tuple(columns), tuple(rows), caption)


def moving(found: ListOf[Placed]) -> ResultTable:
    """How far the hand is from its target while it lifts and lowers."""
    columns = {f"{way}ing, {a}, cm": _along("moving", i, way) for way in ("lift", "lower") for i, a in enumerate(AXES)}
    return by_method("moving", found, columns, "Mean |hand − its target| on ways that rise or fall by 5 cm or more.")


def spent(costs: ListOf[Cost]) -> ResultTable:
    """Torque and heat."""
    columns: dict[str, Any] = {
        "motor torque, N·m RMS": lambda some: over_seeds(some, lambda c: c.torque),
        "windings warm by, K": lambda some: over_seeds(some, lambda c: c.warming),
    }
    return by_method("cost", costs, columns, "Operated joints: torque while holding, warming over a trajectory.")


def _along(field: str, a: int, way: str | None = None) -> Callable[[list[Placed]], MeanStd]:
    """One axis of a field, cm; on ways that lift or lower alone where that is said."""
    return lambda some: over_seeds([d for d in some if way in (None, d.way)], lambda d: getattr(d, field)[a], 1e2)


def axis(found: ListOf[Placed], method: str, payload: float, a: int) -> float:
    """Mean offset along one axis, m."""
    return over_seeds(of(found, method, payload), lambda d: d.offset[a]).mean


def sentences(found: ListOf[Placed]) -> list[str]:
    """What the numbers say."""
    names, masses = methods(found), payloads(found)
    light, heavy, said = masses[0], masses[-1], []
    for m in names[1:]:
        parts = []
        for a, label in enumerate(AXES):
            value, raw = axis(found, m, heavy, a), axis(found, "raw", heavy, a)
            parts.append(f"{label} {percent(cut(value, raw))} ({raw * 1e2:.1f} → {value * 1e2:.1f} cm)")
        said.append(f"At {heavy:g} kg, {title(m)} against raw targets: {', '.join(parts)}.")
    for m in names[1:]:
        worse = [x for a, x in enumerate(AXES) if axis(found, m, light, a) > axis(found, "raw", light, a)]
        if worse:
            said.append(f"At {light:g} kg, {title(m)} is WORSE than raw targets along {', '.join(worse)}.")
    if not any("WORSE" in s for s in said):
        said.append(f"At {light:g} kg nothing is worse than raw targets along any axis.")
    length = lambda m, p: float(np.hypot.reduce([axis(found, m, p, a) for a in range(3)]))  # noqa: E731
    off = {p: {m: length(m, p) for m in names} for p in masses}
    return said + [f"{d} (length of the mean offsets)." for d in duels(off, names)]


@styled
def draw_offsets(found: ListOf[Placed]) -> Figure:
    """Mean |hand − goal| by axis, a group of bars per payload; standard error over goals."""
    fig, masses = figure(10.2, 3.5), payloads(found)
    for a, ax in enumerate(fig.subplots(1, 3)):

        def over_goals(method: str, payload: float, a: int = a) -> MeanStd:
            values = np.array([d.offset[a] for d in of(found, method, payload)]) * 1e2
            goals = max(len(values) // len({d.seed for d in of(found, method)}), 1)
            return MeanStd(float(values.mean()), float(values.std() / np.sqrt(goals)), goals)

        draw_bars(ax, [f"{p:g} kg" for p in masses], series(found, masses, over_goals))
        ax.axhline(NEAR * 1e2, color="#111111", lw=0.7, ls=DASHED)
        ax.set_title(f"{AXES[a]}, {SIDES[a]}")
    fig.axes[0].set_ylabel("|hand − goal|, cm")
    legend(fig, "Offset at the goal, VIRTUAL robot; mean and standard error over goals; dashed: 1 cm")
    return fig


@styled
def draw_example(shown: ShownHand) -> Figure:
    """The hand's true place over time, axis by axis, goals with 1 cm on both sides."""
    fig = figure(10.2, 3.4)
    time = np.arange(len(shown.target)) * shown.dt
    for a, ax in enumerate(fig.subplots(1, 3, sharex=True)):
        for m, place in shown.places.items():
            if m not in LEFT_OUT:
                ax.plot(time, place[:, a] * 1e2, color=colour(m), label=title(m))
        ax.plot(time, shown.target[:, a] * 1e2, color=colour("target"), ls=DASHED, lw=1.0, label=title("target"))
        for goal, arrive, leave in zip(shown.goals, shown.arrive, shown.leave, strict=True):
            low, high = (goal[a] - NEAR) * 1e2, (goal[a] + NEAR) * 1e2
            span = [arrive * shown.dt, leave * shown.dt]
            ax.fill_between(span, low, high, color=colour("target"), alpha=0.18, lw=0)
        ax.set_title(f"{AXES[a]}, {SIDES[a]}")
        ax.set_xlabel("time, s")
    fig.axes[0].set_ylabel("hand, cm")
    legend(fig, f"One hand, two goals, {shown.payload:g} kg in each hand, VIRTUAL robot; shaded: goal ± 1 cm")
    return fig
