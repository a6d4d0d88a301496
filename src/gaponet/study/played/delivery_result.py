"""Delivery as tables, sentences and figures."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as ListOf
from typing import Any

import numpy as np

from gaponet.study.played.delivery import Cost, Delivery, Example
from gaponet.study.played.methods import cut, methods, over_seeds, percent, title
from gaponet.study.result import Result
from gaponet.study.table import Spread, Table

AXES = ("X", "Y", "Z")


def result(
    found: ListOf[Delivery], costs: ListOf[Cost], example: Example, virtual: str, facts: Mapping[str, Any]
) -> Result:
    """Everything, ready to be written."""
    from gaponet.study.played import draw_delivery as draw

    tables = (offsets(found), moving(found), spent(costs))
    figures = {"offsets": draw.offsets(found), "example": draw.example(example)}
    name = "Goal-directed delivery: hands at goals under load (VIRTUAL robot)"
    return Result("delivery", name, virtual, facts, tables, figures, tuple(sentences(found)))


def offsets(found: ListOf[Delivery]) -> Table:
    """Per payload and method: offsets by axis, success, settling; by the true place and by the encoders'."""
    rows: list[tuple[Any, ...]] = []
    for payload in sorted({d.payload for d in found}):
        for m in methods(found):
            some = [d for d in found if d.payload == payload and d.method == m]
            true = [_along(some, "offset", a) for a in range(3)]
            seen = [_along(some, "measured", a) for a in range(3)]
            rows.append((
                f"{payload:g} kg, {title(m)}", *true, over_seeds(some, lambda d: d.near, 1e2), _settle(some), *seen,
                over_seeds(some, lambda d: d.measured_near, 1e2),
            ))  # fmt: skip
    columns = (
        "payload per hand", *(f"{a}, cm" for a in AXES), "within 1 cm, %", "settled in, s",
        *(f"{a} by encoders, cm" for a in AXES), "within 1 cm by encoders, %",
    )  # fmt: skip
    caption = (
        "Mean |hand − goal| by axis in the last second of a hold (X forward, Y left, Z up); ± is the spread of "
        "training seeds. Where the hand is, zero errors of the encoders included; and where the encoders say that it "
        "is. Within 1 cm: for all of that second. Settled: median of the goals at which it stays within 1 cm until "
        "the end."
    )
    return Table("offsets", columns, tuple(rows), caption)


def moving(found: ListOf[Delivery]) -> Table:
    """Per payload and method: how far the hand is from its target while it lifts and lowers."""
    rows: list[tuple[Any, ...]] = []
    for payload in sorted({d.payload for d in found}):
        for m in methods(found):
            some = [d for d in found if d.payload == payload and d.method == m]
            values: list[Spread] = []
            for way in ("lift", "lower"):
                part = [d for d in some if d.way == way]
                values += [_along(part, "moving", a) for a in range(3)]
            rows.append((f"{payload:g} kg, {title(m)}", *values))
    columns = ("payload per hand", *(f"{way}, {a}, cm" for way in ("lifting", "lowering") for a in AXES))
    return Table("moving", columns, tuple(rows), "Mean |hand − its target| on ways that rise or fall by 5 cm or more.")


def spent(costs: ListOf[Cost]) -> Table:
    """Torque and heat."""
    rows: list[tuple[Any, ...]] = []
    for payload in sorted({c.payload for c in costs}):
        for m in methods(costs):
            some = [c for c in costs if c.payload == payload and c.method == m]
            torque, warming = over_seeds(some, lambda c: c.torque), over_seeds(some, lambda c: c.warming)
            rows.append((f"{payload:g} kg, {title(m)}", torque, warming))
    columns = ("payload per hand", "motor torque, N·m RMS", "windings warm by, K")
    return Table("cost", columns, tuple(rows), "Operated joints: torque while holding, warming over a trajectory.")


def _along(some: ListOf[Delivery], field: str, a: int) -> Spread:
    """One axis of a field, cm."""
    return over_seeds(some, lambda d: getattr(d, field)[a], 1e2)


def _settle(some: ListOf[Delivery]) -> Spread:
    """Median of each seed, over seeds; NaN where none settles."""
    seeds = dict.fromkeys(d.seed for d in some)
    times = [[d.settle for d in some if d.seed == s and np.isfinite(d.settle)] for s in seeds]
    return Spread.of([float(np.median(t)) for t in times if t])


def axis(found: ListOf[Delivery], method: str, payload: float, a: int) -> float:
    """Mean offset along one axis, m."""
    return over_seeds([d for d in found if d.method == method and d.payload == payload], lambda d: d.offset[a]).mean


def sentences(found: ListOf[Delivery]) -> list[str]:
    """What the numbers say."""
    names, payloads = methods(found), sorted({d.payload for d in found})
    light, heavy, said = payloads[0], payloads[-1], []
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
    if {"mlp", "gaponet"} <= set(names):
        lost = []
        for p in payloads:
            off = {m: np.hypot.reduce([axis(found, m, p, a) for a in range(3)]) for m in ("mlp", "gaponet")}
            if off["gaponet"] >= off["mlp"]:
                lost.append(f"{p:g} kg")
        said.append(
            f"GAPONet does NOT beat the MLP at {', '.join(lost)} (length of the mean offsets)." if lost
            else "GAPONet beats the MLP at every payload (length of the mean offsets)."
        )  # fmt: skip
    return said
