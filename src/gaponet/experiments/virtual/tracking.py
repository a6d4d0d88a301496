"""Zero-shot tracking: how near is an aligned simulator to a VIRTUAL unit, and the compensated unit to its targets?

    alignment      Q_dis between a simulator and the robot under the same targets (Figure 3 of the paper)
    compensation   Q_dis between the targets and the robot, which receives corrected targets

Q_dis = Δt Σ_t |e_t| per joint over the whole motion, rad·s. The robot is at rest under the first target when a motion
begins. e_t compares the target of a moment with the joint at that moment.
"""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.result_table import MeanStd, ResultTable
from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.experiments.result import Result
from gaponet.experiments.virtual.play import PLANNED, Progress, TrainedModel, execute, with_payloads
from gaponet.experiments.virtual.session import Session, UnitExperiment
from gaponet.experiments.virtual.statistics import (
    RIVALS,
    Measured,
    methods,
    over_seeds,
    payloads,
    percent_text,
    reduction,
    select,
)
from gaponet.experiments.virtual.unseen_motions import UnseenMotion, generated, require_unseen
from gaponet.report.candidate import select_entries
from gaponet.report.figures.style import draw_bars, figure, joint_label, legend, styled
from gaponet.report.methods import colour, title
from gaponet.robot.spec import RobotSpec
from gaponet.sim.replay import replay
from gaponet.testing.physics import Physics

if TYPE_CHECKING:
    from matplotlib.figure import Figure


JointSet = tuple[str, list[int]]  # label, columns

BASELINE = {"alignment": "nominal", "compensation": "raw"}
MEANING = {
    "alignment": "between simulator and robot under the same targets, open-loop rollout",
    "compensation": "between targets and robot",
}
FIGURE_TITLES = {
    "alignment": "Alignment: simulator to robot",
    "compensation": "Compensation: robot to target",
}
REST_S = 2.0  # under the first target before a motion begins, for the compensator to blend in


@dataclass(frozen=True)
class Score(Measured):
    """Q_dis of one motion."""

    part: str  # alignment or compensation
    motion: str
    q_dis: Array  # Q_dis of each operated joint, (n,) rad·s


def track(
    robot: RobotSpec,
    unit: Physics,
    unit_id: str,
    motions: ListOf[UnseenMotion],
    payloads: tuple[float, ...],
    trained: ListOf[TrainedModel],
    progress: Progress = lambda step, share: None,
) -> list[Score]:
    """Execute every motion with every payload (kg per hand), raw and compensated, and in every simulator."""
    pairs, op, rest = (
        with_payloads(motions, payloads),
        robot.operated_index,
        round(REST_S / robot.dt),
    )
    ctrl = [np.concatenate([np.repeat(m.ctrl[:1], rest, axis=0), m.ctrl]) for m, _ in pairs]
    scores: list[Score] = []
    for method, seed, played in execute(
        robot, unit, ctrl, [p for _, p in pairs], trained, PLANNED, progress
    ):
        if method == "raw":
            recorded = []
            for i, (motion, payload) in enumerate(pairs):
                meta = SequenceMeta(robot.name, unit_id, motion.name, payload, virtual=True)
                states = (x[rest : len(ctrl[i]), i] for x in (played.qpos, played.qvel))
                recorded.append(Sequence(meta, robot.joint_names, robot.dt, motion.ctrl, *states))
            scores += align(recorded, robot, trained, progress)
        for i, (motion, payload) in enumerate(pairs):
            error = (played.qpos[rest : len(ctrl[i]), i] - motion.ctrl)[:, op]
            q_dis = np.abs(error.astype(float)).sum(axis=0) * robot.dt
            scores.append(Score(method, seed, payload, "compensation", motion.name, q_dis))
    return scores


def align(
    recorded: ListOf[Sequence],
    robot: RobotSpec,
    trained: ListOf[TrainedModel],
    progress: Progress = lambda step, share: None,
) -> list[Score]:
    """Compare open-loop rollouts of every simulator with the recordings, from their first state.

    The identified simulator is that of the models that correct it.
    """
    simulators: list[tuple[str, int | None, RobotSpec, TrainedModel | None]] = [
        ("nominal", None, robot, None)
    ]
    simulators += [
        ("identified", None, t.robot, None) for t in trained if t.robot.nominal is not None
    ][:1]
    simulators += [(t.method, t.seed, t.robot, t) for t in trained]
    scores: list[Score] = []
    for method, seed, simulator, model in simulators:
        corrector = None if model is None else model.model.corrector(simulator)

        def report(done: int, total: int, method: str = method) -> None:
            progress(f"{method} simulator", done / total)

        replays = replay(
            list(recorded), simulator, corrector, nthread=1, progress=report, lock_idle=True
        )
        for s, simulated in zip(recorded, replays, strict=True):
            error = (simulated.qpos - s.qpos)[1:, robot.operated_index]
            q_dis = np.abs(error.astype(float)).sum(axis=0) * s.dt
            scores.append(
                Score(method, seed, s.meta.payload_mass, "alignment", s.meta.motion, q_dis)
            )
    return scores


@dataclass(frozen=True)
class Tracking(UnitExperiment):
    """Figure 3 of the paper: Q_dis on motions never trained on, joint by joint and payload by payload.

    Alignment (simulator to robot) and compensation (robot to target) on a VIRTUAL unit; of real recordings, alignment
    on the test motions. About ten minutes on one core with trained models.
    """

    count: int = 10
    """How many motions are made for the experiment."""

    def quick(self) -> Tracking:
        """Return the experiment with few motions, for a quick run."""
        return replace(self, count=4)

    def measure(self, session: Session, progress: Progress) -> tuple[list[Score], dict[str, Any]]:
        """Execute the motions on the unit; recordings of a real robot allow alignment alone.

        Returns:
            Scores; further arguments of Session.result.
        """
        robot, trained = session.robot, session.trained
        if not any(e.meta.virtual for e in session.data.entries):
            entries, unseen = select_entries([t.run for t in trained], session.data)
            scores = align(session.data.sequences(entries), robot, trained, progress)
            return scores, {"test_motions": len({e.meta.motion for e in entries}), "unseen": unseen}
        name, physics = session.unit
        progress("motions", 0.0)
        motions = generated(robot, self.count, max(session.payloads))
        require_unseen(motions, session.data, robot, trained)
        facts = {"unit_trained_on": True} if name in session.trained_units else {}
        scores = track(robot, physics, name, motions, session.payloads, trained, progress)
        return scores, facts | {"motions": len(motions), "config": PLANNED}

    def run(self, session: Session, progress: Progress) -> Result:
        """Execute the motions and return tables, figures and sentences."""
        return result(session, *self.measure(session, progress))


def result(session: Session, scores: list[Score], facts: dict[str, Any]) -> Result:
    """Return tables, figures and sentences."""
    robot, parts = session.robot, list(dict.fromkeys(s.part for s in scores))
    virtual = "compensation" in parts
    sets, tag = joint_sets(robot), "VIRTUAL robot" if virtual else "real robot"
    tables = [by_payload(scores, part, sets) for part in parts]
    tables += [by_joint(scores, part, robot) for part in parts]
    zero_shot = virtual and not facts.get("unit_trained_on")
    heading = f"Zero-shot tracking of motions never trained on{', unit never trained on' * zero_shot} ({tag})"
    return session.result(
        "tracking" if virtual else "tracking-real", heading, tables, {"joints": draw_joints(scores, robot, tag)},
        [conclusion(scores, part, sets[0]) for part in parts], **facts,
    )  # fmt: skip


def joint_sets(robot: RobotSpec) -> list[JointSet]:
    """Return the operated joints without wrists, as in the paper's figure, and all operated joints."""
    plain = [i for i, name in enumerate(robot.operated) if "wrist" not in name]
    every = list(range(len(robot.operated)))
    sets = [(f"{len(every)} joints", every)]
    return sets if len(plain) in (0, len(every)) else [(f"{len(plain)} joints", plain), *sets]


def by_payload(scores: ListOf[Score], part: str, sets: ListOf[JointSet]) -> ResultTable:
    """Mean Q_dis over motions and joints; a row per set of joints and payload."""
    of_part = [s for s in scores if s.part == part]
    names, masses = methods(of_part), payloads(of_part)
    learned = [m for m in (*RIVALS, "gaponet") if m in names]
    rows: list[tuple[Any, ...]] = []
    for label, columns in sets:
        for payload in [*masses, None] if len(masses) > 1 else masses:
            values = {m: q_dis(select(of_part, payload=payload), m, columns) for m in names}
            cuts = (
                f"{reduction(values[m].mean, values[BASELINE[part]].mean):.0f} %" for m in learned
            )
            where = f"{label}, all payloads" if payload is None else f"{label}, {payload:g} kg"
            rows.append((where, *values.values(), *cuts))
    heads = (*(title(m) for m in names), *(f"{title(m)} cuts" for m in learned))
    caption = f"Mean Q_dis per joint, rad·s, {MEANING[part]}; ± is the standard deviation over training seeds."
    return ResultTable(part, ("Q_dis, rad·s", *heads), tuple(rows), caption, digits=4)


def by_joint(scores: ListOf[Score], part: str, robot: RobotSpec) -> ResultTable:
    """Mean Q_dis over motions; a row per payload and joint."""
    of_part = [s for s in scores if s.part == part]
    names = methods(of_part)
    rows = [
        (f"{p:g} kg, {joint}", *(q_dis(select(of_part, payload=p), m, [i]) for m in names))
        for p in payloads(of_part) for i, joint in enumerate(robot.operated)
    ]  # fmt: skip
    head = ("Q_dis, rad·s", *(title(m) for m in names))
    return ResultTable(
        f"{part}-joints", head, tuple(rows), f"Q_dis {MEANING[part]}, joint by joint.", digits=4
    )


def q_dis(scores: ListOf[Score], method: str, columns: list[int]) -> MeanStd:
    """Mean over motions and joints, then over seeds."""
    return over_seeds(select(scores, method), lambda s: s.q_dis[columns].mean())


def conclusion(scores: ListOf[Score], part: str, joints: JointSet) -> str:
    """Return a sentence about one part, for one set of joints: the reduction of the error by each method."""
    label, columns = joints
    of_part = [s for s in scores if s.part == part]
    names, masses, cuts = methods(of_part), payloads(of_part), list[str]()
    error = {
        p: {m: q_dis(select(of_part, payload=p), m, columns).mean for m in names}
        for p in (None, *masses)
    }
    for m in names[1:]:
        overall, heavy = (
            percent_text(reduction(error[p][m], error[p][BASELINE[part]]))
            for p in (None, masses[-1])
        )
        cuts.append(
            f"{title(m)} {overall}"
            + (f" ({heavy} at {masses[-1]:g} kg)" if len(masses) > 1 else "")
        )
    return f"{part}, {label}, Q_dis against {title(BASELINE[part])}: {'; '.join(cuts)}."


@styled
def draw_joints(scores: ListOf[Score], robot: RobotSpec, label: str) -> Figure:
    """Draw Q_dis per joint, a row per payload, alignment beside compensation; standard error over motions."""
    parts, masses = list(dict.fromkeys(s.part for s in scores)), payloads(scores)
    width = 0.52 * len(robot.operated) + 0.8
    fig = figure(max(6.0, width * len(parts)), 1.55 * len(masses) + 1.5)
    axes = fig.subplots(len(masses), len(parts), sharex=True, sharey="col", squeeze=False)
    names = [joint_label(n) for n in robot.operated]
    for column, part in zip(axes.T, parts, strict=True):
        for ax, payload in zip(column, masses, strict=True):
            shown = select([s for s in scores if s.part == part], payload=payload)
            bars = {title(m): (colour(m), over_motions(select(shown, m))) for m in methods(shown)}
            draw_bars(ax, names, bars, 7)
            ax.annotate(f"{payload:g} kg", (0.995, 0.97), xycoords="axes fraction", ha="right", va="top",
                        fontweight="bold")  # fmt: skip
        column[0].set_title(FIGURE_TITLES[part])
    for ax in axes[:, 0]:
        ax.set_ylabel("Q_dis, rad·s")
    legend(fig, f"{robot.name}, {label}; mean and standard error over motions")
    return fig


def over_motions(scores: ListOf[Score]) -> list[MeanStd]:
    """Mean over motions and its standard error for each joint; seeds are averaged first."""
    by_motion: dict[str, list[Array]] = {}
    for s in scores:
        by_motion.setdefault(s.motion, []).append(s.q_dis)
    values = np.array([np.mean(v, axis=0) for v in by_motion.values()])  # (motions, n)
    return [replace(s, std=s.standard_error) for s in map(MeanStd.from_values, values.T)]
