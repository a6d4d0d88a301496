"""Tables of the errors of methods, for terminal and report."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from gaponet.base.result_table import ResultTable
from gaponet.evaluation.methods import title


def mrad(value: float | None) -> str:
    """Format an angle in rad as milliradian; a dash if there is none, such as the standard error over one motion."""
    return (
        "–" if value is None or value != value else f"{round(value * 1e3, 2) + 0.0:.2f}"
    )  # no −0.00


def mrad_with_error(value: float, standard_error: float) -> str:
    """Format an angle in rad with its standard error over independent motions, which is NaN if there is one."""
    one = standard_error != standard_error
    return (
        f"{mrad(value)} mrad (one motion)"
        if one
        else f"{mrad(value)} ± {mrad(standard_error)} mrad"
    )


def mrad_and_degrees(value: float) -> str:
    """Format an angle in rad as milliradian and degrees."""
    return f"{mrad(value)} ({np.degrees(value):.2f}°)"


def totals(
    methods: dict[str, Any],
    angle: Callable[[float], str] = mrad,
    simulators: Mapping[str, str] | None = None,
) -> ResultTable:
    """Return a row per method.

    Args:
        methods: Method → metrics (sim.metrics.summary).
        angle: Formats the MPJAE.
        simulators: Method → hash of its simulator, for a last column.
    """
    base = methods["nominal"]["mpjae"]
    columns = ("method", "mean |error|, mrad", "of nominal", "RMSE, mrad", "static, mrad", "dynamic, mrad",
               "Q_dis, rad·s", "≥ 0.05 rad", "≥ 0.1 rad", "correlation", *["simulator"] * bool(simulators))  # fmt: skip
    return ResultTable("totals", columns, tuple(
        (title(name), angle(m["mpjae"]), m["mpjae"] / base if base else "–", mrad(m["rmse"]), mrad(m["static"]),
         mrad(m["dynamic"]), f"{m['q_dis']:.3f}", f"{m['large_0.05'] * 100:.1f} %", f"{m['large_0.1'] * 100:.2f} %",
         f"{m['correlation']:.4f}", *([simulators[name]] if simulators else []))
        for name, m in methods.items()
    ))  # fmt: skip


def by_group(
    methods: dict[str, Any], group: str, angle: Callable[[float], str] = mrad
) -> ResultTable:
    """Return the MPJAE by joint, payload, unit, horizon or motion: a row for each, a column per method."""
    parts = [m[f"by_{group}"] for m in methods.values()]
    rows = tuple((key, *(angle(part[key]["mpjae"]) for part in parts)) for key in parts[0])
    return ResultTable(group, ("mean |error|, mrad", *map(title, methods)), rows)
