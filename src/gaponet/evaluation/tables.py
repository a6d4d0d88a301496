"""Tables of the errors of methods, for terminal and report."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from gaponet.base.result_table import ResultTable
from gaponet.evaluation.methods import title


def mrad(value: float | None) -> str:
    """Format an angle in rad as milliradian.

    A dash stands for none, such as the standard error over one motion.
    """
    if value is None or np.isnan(value):
        return "–"
    no_minus_zero = round(value * 1e3, 2) + 0.0
    return f"{no_minus_zero:.2f}"


def mrad_with_error(value: float, standard_error: float) -> str:
    """Format an angle in rad with its standard error over independent motions, NaN if there is
    one.
    """
    if np.isnan(standard_error):
        return f"{mrad(value)} mrad (one motion)"
    return f"{mrad(value)} ± {mrad(standard_error)} mrad"


def mrad_and_degrees(value: float) -> str:
    """Format an angle in rad as milliradian and degrees."""
    return f"{mrad(value)} ({np.degrees(value):.2f}°)"


def totals(
    methods: dict[str, Any],
    angle: Callable[[float], str] = mrad,
    simulators: Mapping[str, str] | None = None,
) -> ResultTable:
    """Return a row per method.

    The terminal shows the first columns alone (cli/show.py). A metric that is shown here must also
    be a field of run_files.Scores, which refuses the stored evaluations that lack it.

    Args:
        methods: Method → metrics (sim.metrics.summary).
        angle: Formats the MPJAE.
        simulators: Method → hash of its simulator, for a last column.
    """
    columns = [
        "method",
        "mean |error|, mrad",
        "of nominal",
        "RMSE, mrad",
        "static, mrad",
        "dynamic, mrad",
        "Q_dis, rad·s",
        "≥ 0.05 rad",
        "≥ 0.1 rad",
        "correlation",
    ]
    if simulators:
        columns.append("simulator")
    nominal = methods["nominal"]["mpjae"]
    rows = []
    for name, errors in methods.items():
        row: list[Any] = [
            title(name),
            angle(errors["mpjae"]),
            errors["mpjae"] / nominal if nominal else "–",
            mrad(errors["rmse"]),
            mrad(errors["static"]),
            mrad(errors["dynamic"]),
            f"{errors['q_dis']:.3f}",
            f"{100 * errors['large_0.05']:.1f} %",
            f"{100 * errors['large_0.1']:.2f} %",
            f"{errors['correlation']:.4f}",
        ]
        if simulators:
            row.append(simulators[name])
        rows.append(tuple(row))
    return ResultTable("totals", tuple(columns), tuple(rows))


def by_group(
    methods: dict[str, Any], group: str, angle: Callable[[float], str] = mrad
) -> ResultTable:
    """Return the MPJAE by joint, payload, unit, horizon or motion: a row for each, a column per
    method.
    """
    parts = [errors[f"by_{group}"] for errors in methods.values()]
    rows = []
    for key in parts[0]:
        row = [key]
        for part in parts:
            row.append(angle(part[key]["mpjae"]))
        rows.append(tuple(row))
    return ResultTable(group, ("mean |error|, mrad", *map(title, methods)), tuple(rows))
