"""Tracking as tables, sentences and figures."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as ListOf
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from gaponet.robot import RobotSpec
from gaponet.study.played.methods import cut, methods, over_seeds, percent, title
from gaponet.study.played.tracking import Example, Score
from gaponet.study.played.unseen import Unseen
from gaponet.study.result import Result
from gaponet.study.table import Spread, Table

Joints = tuple[str, list[int]]  # how they are called, columns

BASE = {"alignment": "nominal", "compensation": "raw"}
SOURCES = {"generated": "generated motions", "files": "motion files", "recorded": "recorded test motions"}
WHAT = {
    "alignment": "between simulator and robot under the same targets, free run",
    "compensation": "between targets and robot",
}


def joint_sets(robot: RobotSpec) -> list[Joints]:
    """Without wrists, as the paper's figure; and all."""
    plain = [i for i, name in enumerate(robot.operated) if "wrist" not in name]
    every = list(range(len(robot.operated)))
    sets = [(f"{len(every)} joints", every)]
    return sets if len(plain) in (0, len(every)) else [(f"{len(plain)} joints", plain), *sets]


def result(
    robot: RobotSpec,
    scores: ListOf[Score],
    example: Example | None,
    motions: ListOf[Unseen],
    virtual: str,
    facts: Mapping[str, Any],
) -> Result:
    """Everything, ready to be written."""
    from gaponet.study.played import draw_tracking as draw

    parts = list(dict.fromkeys(s.part for s in scores))
    sets = joint_sets(robot)
    tables = [by_payload(scores, part, sets) for part in parts]
    tables += [by_joint(scores, part, robot) for part in parts]
    if motions:
        tables.append(_motions(motions, robot))
    figures: dict[str, Figure] = {}
    tag = "VIRTUAL robot" if "VIRTUAL" in virtual else "real robot"
    for source in dict.fromkeys(s.source for s in scores):
        some = [s for s in scores if s.source == source]
        figures["joints" if not figures else source] = draw.joints(some, robot, f"{SOURCES[source]}, {tag}")
    if example is not None:
        figures["example"] = draw.example(example, robot, tag)
    told = [s for part in parts for s in sentences(scores, part, sets[0])]
    who = "never trained on" if tag == "VIRTUAL robot" and not facts.get("unit_trained_on") else ""
    headline = f"Zero-shot tracking of motions never trained on{', unit ' + who if who else ''} ({tag})"
    name = "tracking" if tag == "VIRTUAL robot" else "tracking-real"
    return Result(name, headline, virtual, facts, tuple(tables), figures, tuple(told))


def by_payload(scores: ListOf[Score], part: str, sets: ListOf[Joints]) -> Table:
    """Mean Q_dis over motions and joints; a row per source of motions, set of joints and payload."""
    of_part = [s for s in scores if s.part == part]
    names = methods(of_part)
    rows: list[tuple[Any, ...]] = []
    for source in dict.fromkeys(s.source for s in of_part):
        for label, columns in sets:
            for payload in [*sorted({s.payload for s in of_part}), None]:
                chosen = [s for s in of_part if s.source == source and payload in (None, s.payload)]
                if payload is None and len({s.payload for s in of_part}) == 1:
                    continue
                values = {m: q_dis(chosen, m, columns) for m in names}
                base = values[BASE[part]].mean
                cuts = [cut(values[m].mean, base) for m in ("mlp", "gaponet") if m in values]
                where = f"{SOURCES[source]}, {label}, " + ("all payloads" if payload is None else f"{payload:g} kg")
                rows.append((where, *values.values(), *(f"{c:.0f} %" for c in cuts)))
    heads = [f"{title(m)} cuts" for m in ("mlp", "gaponet") if m in names]
    caption = f"Mean Q_dis per joint, rad·s, {WHAT[part]}; ± is the spread of training seeds."
    return Table(part, ("Q_dis, rad·s", *(title(m) for m in names), *heads), tuple(rows), caption, digits=4)


def by_joint(scores: ListOf[Score], part: str, robot: RobotSpec) -> Table:
    """The same joint by joint and payload by payload."""
    of_part = [s for s in scores if s.part == part]
    names = methods(of_part)
    rows: list[tuple[Any, ...]] = []
    for source in dict.fromkeys(s.source for s in of_part):
        for payload in sorted({s.payload for s in of_part}):
            chosen = [s for s in of_part if s.source == source and s.payload == payload]
            for i, joint in enumerate(robot.operated):
                rows.append((f"{SOURCES[source]}, {payload:g} kg, {joint}", *(q_dis(chosen, m, [i]) for m in names)))
    head = ("Q_dis, rad·s", *(title(m) for m in names))
    return Table(f"{part}-joints", head, tuple(rows), f"Q_dis {WHAT[part]}, joint by joint.", digits=4)


def _motions(motions: ListOf[Unseen], robot: RobotSpec) -> Table:
    rows = [
        (m.name, SOURCES[m.source], len(m.ctrl) * robot.dt, m.nearest[0], m.nearest[1] * 1e3) for m in motions
    ]  # fmt: skip
    caption = (
        "None was trained or chosen on: the motion of training or validation that is most like it, and how far apart "
        "their targets are."
    )
    return Table("motions", ("motion", "from", "length, s", "nearest", "apart, mrad RMS"), tuple(rows), caption, 1)


def q_dis(scores: ListOf[Score], method: str, columns: list[int]) -> Spread:
    """Mean over motions and joints, over seeds."""
    return over_seeds([s for s in scores if s.method == method], lambda s: s.q_dis[columns].mean())


def sentences(scores: ListOf[Score], part: str, joints: Joints) -> list[str]:
    """What the numbers of one part say, for one set of joints."""
    label, columns = joints
    of_part = [s for s in scores if s.part == part]
    names, payloads, said = methods(of_part), sorted({s.payload for s in of_part}), []
    for source in dict.fromkeys(s.source for s in of_part):
        some = [s for s in of_part if s.source == source]
        base = q_dis(some, BASE[part], columns).mean
        top = [s for s in some if s.payload == payloads[-1]]
        heavy = q_dis(top, BASE[part], columns).mean
        cuts = []
        for m in names[1:]:
            all_of = percent(cut(q_dis(some, m, columns).mean, base))
            at = percent(cut(q_dis(top, m, columns).mean, heavy))
            cuts.append(f"{title(m)} {all_of}" + (f" ({at} at {payloads[-1]:g} kg)" if len(payloads) > 1 else ""))
        said.append(f"{part}, {SOURCES[source]}, {label}, Q_dis against {title(BASE[part])}: {'; '.join(cuts)}.")
        if "gaponet" in names and "mlp" in names:
            said.append(_duel(some, part, source, columns, payloads))
    return said


def _duel(some: ListOf[Score], part: str, source: str, columns: list[int], payloads: ListOf[float]) -> str:
    lost = []
    for payload in payloads:
        at = [s for s in some if s.payload == payload]
        if q_dis(at, "gaponet", columns).mean >= q_dis(at, "mlp", columns).mean:
            lost.append(f"{payload:g} kg")
    where = f"{part}, {SOURCES[source]}: "
    if not lost:
        return where + ("GAPONet beats the MLP at every payload." if len(payloads) > 1 else "GAPONet beats the MLP.")
    return where + f"GAPONet does NOT beat the MLP at {', '.join(lost)}."


def standard_error(values: ListOf[float]) -> float:
    """Of a mean over motions or goals; 0 for one."""
    return float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else 0.0
