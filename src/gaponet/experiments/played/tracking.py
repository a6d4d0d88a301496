"""Zero-shot tracking on a VIRTUAL unit: how near is the aligned simulator to it, and how near it to what it is asked?

    alignment      Q_dis between a simulator and the robot under the same targets (the paper's Figure 3)
    compensation   Q_dis between the targets and the robot, which is given corrected targets

Q_dis = Δt Σ_t |e_t| per joint over the whole motion, rad·s. The robot is at rest under the first target, compensated or
not, when a motion begins. e_t compares the target of a moment with the joint at that moment.
"""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gaponet.base.result_table import MeanStd, ResultTable
from gaponet.experiments.played.measured import (
    LEFT_OUT,
    RIVALS,
    cut,
    duels,
    methods,
    of,
    over_seeds,
    payloads,
    percent,
    series,
)
from gaponet.experiments.played.play import PLANNED
from gaponet.experiments.played.session import Playing, Session, Tell
from gaponet.experiments.played.track import Score, ShownMotion, align, track
from gaponet.experiments.played.unseen import Unseen, from_files, generated, require_unseen
from gaponet.experiments.result import Result
from gaponet.report.candidate import choose
from gaponet.report.figures.charts import Course, against, draw_bars
from gaponet.report.figures.colours import colour
from gaponet.report.figures.style import figure, joint_label, legend, styled
from gaponet.report.methods import title
from gaponet.robot.spec import RobotSpec

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Joints = tuple[str, list[int]]  # how they are called, columns

QUICK_MOTIONS = 4
BASE = {"alignment": "nominal", "compensation": "raw"}
SOURCES = {"generated": "generated motions", "files": "motion files", "recorded": "recorded test motions"}
WHAT = {
    "alignment": "between simulator and robot under the same targets, free run",
    "compensation": "between targets and robot",
}
HEADS = {"alignment": "Alignment: simulator to robot", "compensation": "Compensation: robot to target"}


@dataclass(frozen=True)
class Tracking(Playing):
    """Figure 3 of the paper: Q_dis on motions never trained on, joint by joint and payload by payload.

    Alignment (simulator to robot) and compensation (robot to target) on a VIRTUAL unit; of real recordings, alignment
    on the test motions. About ten minutes on one core with models that are there; --quick in under five with training.
    """

    motions: Path | None = None
    """Folder of motion files (SAGE txt, csv, npz) to play too, reported apart."""
    count: int = 10
    """How many motions are made for the experiment."""

    def measured(self, session: Session, tell: Tell) -> Tracked:
        """Play the motions on the unit; recordings of a real robot allow alignment alone."""
        robot, trained = session.robot, session.trained
        if not any(e.meta.virtual for e in session.data.entries):
            entries, unseen = choose([t.run for t in trained], session.data)
            sequences = session.data.sequences(entries)
            scores = align(lambda: sequences, ["recorded"] * len(entries), robot, trained, tell)
            return Tracked(scores, None, [], {"test_motions": len({e.meta.motion for e in entries}), "unseen": unseen})
        who, physics, payloads = session.cast
        tell("motions", 0.0)
        motions = self._motions(session, max(payloads))
        scores, example = track(robot, physics, who, motions, payloads, trained, tell, session.parts)
        more: dict[str, Any] = {"unit_trained_on": True} if who in session.known_units else {}
        return Tracked(scores, example, motions, more | {"config": PLANNED})

    def play(self, session: Session, tell: Tell) -> Result:
        """Measure, and say what came out."""
        found = self.measured(session, tell)
        return result(session, found.scores, found.example, found.motions, **found.facts)

    def _motions(self, session: Session, heaviest: float) -> list[Unseen]:
        few = QUICK_MOTIONS if session.quick else None
        made = generated(session.robot, few or self.count, heaviest)
        made += from_files(session.robot, self.motions, heaviest)[:few] if self.motions else []
        return require_unseen(made, session.data, session.robot, session.trained, session.whole)


@dataclass(frozen=True)
class Tracked:
    """What was measured, and what it takes to repeat it. Recordings of a real robot give no example and no motions."""

    scores: list[Score]
    example: ShownMotion | None
    motions: list[Unseen]
    facts: dict[str, Any]


def result(
    session: Session, scores: ListOf[Score], example: ShownMotion | None, motions: ListOf[Unseen], **told: Any
) -> Result:
    """Everything, ready to be written; no example where recordings of a real robot are all there is."""
    robot, parts = session.robot, list(dict.fromkeys(s.part for s in scores))
    sets, tag = joint_sets(robot), "real robot" if example is None else "VIRTUAL robot"
    tables = [by_payload(scores, part, sets) for part in parts]
    tables += [by_joint(scores, part, robot) for part in parts]
    tables += [_motions(motions, robot)] if motions else []
    figures: dict[str, Figure] = {}
    for source, some in by_source(scores).items():
        figures["joints" if not figures else source] = draw_joints(some, robot, f"{SOURCES[source]}, {tag}")
    if example is not None:
        figures["example"] = draw_example(example, robot, tag)
    said = [s for part in parts for s in sentences(scores, part, sets[0])]
    zero_shot = example is not None and not told.get("unit_trained_on")
    who = ", unit never trained on" if zero_shot else ""
    heading = f"Zero-shot tracking of motions never trained on{who} ({tag})"
    name = "tracking" if example is not None else "tracking-real"
    told |= {"motions": len(motions)} if motions else {}
    return session.result(name, heading, tables, figures, said, **told)


def joint_sets(robot: RobotSpec) -> list[Joints]:
    """Without wrists, as the paper's figure; and all."""
    plain = [i for i, name in enumerate(robot.operated) if "wrist" not in name]
    every = list(range(len(robot.operated)))
    sets = [(f"{len(every)} joints", every)]
    return sets if len(plain) in (0, len(every)) else [(f"{len(plain)} joints", plain), *sets]


def by_source(scores: ListOf[Score]) -> dict[str, list[Score]]:
    """Generated motions, motion files and recordings apart."""
    return {source: [s for s in scores if s.source == source] for source in dict.fromkeys(s.source for s in scores)}


def by_payload(scores: ListOf[Score], part: str, sets: ListOf[Joints]) -> ResultTable:
    """Mean Q_dis over motions and joints; a row per source of motions, set of joints and payload."""
    of_part = [s for s in scores if s.part == part]
    names, masses = methods(of_part), payloads(of_part)
    learned = [m for m in (*RIVALS, "gaponet") if m in names]
    rows: list[tuple[Any, ...]] = []
    for source, some in by_source(of_part).items():
        for label, columns in sets:
            for payload in [*masses, None] if len(masses) > 1 else masses:
                values = {m: q_dis(of(some, payload=payload), m, columns) for m in names}
                cuts = (f"{cut(values[m].mean, values[BASE[part]].mean):.0f} %" for m in learned)
                where = f"{SOURCES[source]}, {label}, " + ("all payloads" if payload is None else f"{payload:g} kg")
                rows.append((where, *values.values(), *cuts))
    heads = (*(title(m) for m in names), *(f"{title(m)} cuts" for m in learned))
    caption = f"Mean Q_dis per joint, rad·s, {WHAT[part]}; ± is the spread of training seeds."
    return ResultTable(part, ("Q_dis, rad·s", *heads), tuple(rows), caption, digits=4)


def by_joint(scores: ListOf[Score], part: str, robot: RobotSpec) -> ResultTable:
    """The same joint by joint and payload by payload."""
    of_part = [s for s in scores if s.part == part]
    names = methods(of_part)
    rows = [
        (f"{SOURCES[source]}, {p:g} kg, {joint}", *(q_dis(of(some, payload=p), m, [i]) for m in names))
        for source, some in by_source(of_part).items()
        for p in payloads(of_part)
        for i, joint in enumerate(robot.operated)
    ]
    head = ("Q_dis, rad·s", *(title(m) for m in names))
    return ResultTable(f"{part}-joints", head, tuple(rows), f"Q_dis {WHAT[part]}, joint by joint.", digits=4)


def _motions(motions: ListOf[Unseen], robot: RobotSpec) -> ResultTable:
    rows = [(m.name, SOURCES[m.source], len(m.ctrl) * robot.dt, m.nearest[0], m.nearest[1] * 1e3) for m in motions]
    caption = (
        "None was trained or chosen on: the motion of training or validation that is most like it, and how far apart "
        "their targets are."
    )
    return ResultTable(
        "motions", ("motion", "from", "length, s", "nearest", "apart, mrad RMS"), tuple(rows), caption, 1
    )


def q_dis(scores: ListOf[Score], method: str, columns: list[int]) -> MeanStd:
    """Mean over motions and joints, over seeds."""
    return over_seeds(of(scores, method), lambda s: s.q_dis[columns].mean())


def sentences(scores: ListOf[Score], part: str, joints: Joints) -> list[str]:
    """What the numbers of one part say, for one set of joints."""
    label, columns = joints
    of_part = [s for s in scores if s.part == part]
    names, masses, said = methods(of_part), payloads(of_part), []
    for source, some in by_source(of_part).items():
        error = {p: {m: q_dis(of(some, payload=p), m, columns).mean for m in names} for p in (None, *masses)}
        cuts = []
        for m in names[1:]:
            all_of, heavy = (percent(cut(error[p][m], error[p][BASE[part]])) for p in (None, masses[-1]))
            cuts.append(f"{title(m)} {all_of}" + (f" ({heavy} at {masses[-1]:g} kg)" if len(masses) > 1 else ""))
        said.append(f"{part}, {SOURCES[source]}, {label}, Q_dis against {title(BASE[part])}: {'; '.join(cuts)}.")
        said += [f"{part}, {SOURCES[source]}: {d}." for d in duels({p: error[p] for p in masses}, names)]
    return said


def _pick(values: dict[str, list[MeanStd]], method: str, joint: int) -> MeanStd:
    return values[method][joint]


@styled
def draw_joints(scores: ListOf[Score], robot: RobotSpec, label: str) -> Figure:
    """Q_dis per joint, a row per payload, alignment beside compensation; standard error over motions."""
    parts, masses = list(dict.fromkeys(s.part for s in scores)), payloads(scores)
    wide = 0.52 * len(robot.operated) + 0.8
    fig = figure(max(6.0, wide * len(parts)), 1.55 * len(masses) + 1.5)
    axes = fig.subplots(len(masses), len(parts), sharex=True, sharey="col", squeeze=False)
    names, joints = [joint_label(n) for n in robot.operated], list(range(len(robot.operated)))
    for column, part in zip(axes.T, parts, strict=True):
        for ax, payload in zip(column, masses, strict=True):
            some = of([s for s in scores if s.part == part], payload=payload)
            values = {m: over_motions(of(some, m)) for m in methods(some)}
            draw_bars(ax, names, series(some, joints, partial(_pick, values)), 7)
            ax.annotate(f"{payload:g} kg", (0.995, 0.97), xycoords="axes fraction", ha="right", va="top",
                        fontweight="bold")  # fmt: skip
        column[0].set_title(HEADS[part])
    for ax in axes[:, 0]:
        ax.set_ylabel("Q_dis, rad·s")
    legend(fig, f"{robot.name}, {label}; mean and standard error over motions")
    return fig


def over_motions(scores: ListOf[Score]) -> list[MeanStd]:
    """Mean over motions and its standard error for each joint, seeds averaged first."""
    by_motion: dict[str, list[Any]] = {}
    for s in scores:
        by_motion.setdefault(s.motion, []).append(s.q_dis)
    values = np.array([np.mean(v, axis=0) for v in by_motion.values()])  # (motions, n)
    found = [MeanStd.from_values(column) for column in values.T]
    return [replace(f, std=f.standard_error) for f in found]


def draw_example(shown: ShownMotion, robot: RobotSpec, tag: str) -> Figure:
    """Targets and joints by method, and the error below: of joints that move the three with the largest raw error."""
    moves = np.ptp(shown.target, axis=0) > 0.1
    raw = np.abs(shown.qpos["raw"] - shown.target).mean(axis=0) * (moves if moves.sum() > 2 else 1)
    drawn = {m: qpos for m, qpos in shown.qpos.items() if m not in LEFT_OUT}
    joints = {
        joint_label(robot.operated[j], wrapped=False): Course(
            {m: q[:, j] for m, q in drawn.items()}, shown.target[:, j]
        )
        for j in sorted(np.argsort(-raw)[:3].tolist())
    }
    looks = {m: (title(m), colour(m)) for m in (*drawn, "target")}
    heading = f"{shown.motion}, {shown.payload:g} kg in each hand, {tag}"
    return against(np.arange(len(shown.target)) * shown.dt, joints, looks, "target", heading)
