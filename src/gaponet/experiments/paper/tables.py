"""Tables 1 and 2 of the paper, and the tables that answer its questions: commands, large gaps,
sensors, latency.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.result_table import MeanStd, ResultTable
from gaponet.experiments.paper.commands import (
    NETWORK_WAYS,
    PLAIN_TITLES,
    PLAIN_WAYS,
    REFERENCE_WAY,
    WAY_TITLES,
)
from gaponet.experiments.paper.measure import LARGE_GAPS_RAD
from gaponet.experiments.paper.options import Block
from gaponet.experiments.paper.printed import AXES, TABLE_1, TABLE_2, PrintedRow
from gaponet.experiments.paper.results import Results
from gaponet.experiments.paper.trainings import METHOD_BLOCKS, TABLE_2_CHANGES

CONVERGED_SHARE = 0.5  # of the nominal error; above it a row of Table 2 is not converged
# Row of Table 2 here → row of the paper. The paper does not say what is held for an action
# duration.
PRINTED_ROW = {
    "payload out": "payload out",
    "payload in": "payload in",
    "100 Hz": "100 Hz",
    "history 2": "history 2",
    "history 6": "history 6",
    "history 8": "history 8",
    "correction held 3": "action duration 3",
    "correction held 5": "action duration 5",
    "sensors held 3": "action duration 3",
    "sensors held 5": "action duration 5",
    "predict S(t+1)": "predict S(t+1)",
}
OWN_LABEL = "the paper's own: payload out, 50 Hz, history 4, S(t+1) − S(t)"


def table_1(results: Results, block: Block) -> ResultTable:
    """Table 1: offsets of the hands from their goals, all payloads, axes and methods, beside the
    paper's.
    """
    rows: list[tuple[Any, ...]] = []
    for index, mass in enumerate(results.masses):
        label = f"{mass:g} kg"
        for way in PLAIN_WAYS:
            offsets = results.plain_offsets(way)[index]
            cells = _offset_cells([offsets])
            rows.append((f"{label}, {PLAIN_TITLES[way]}", *cells))
        for name in results.networks(block):
            for way in NETWORK_WAYS:
                seeds = [seed[index] for seed in results.offsets(block, name, way)]
                cells = _offset_cells(seeds)
                rows.append((f"{label}, {name}: {WAY_TITLES[way]}", *cells))
        for method, printed in TABLE_1.items():
            if mass in printed:
                rows.append((f"{label}, the paper's {method}", *printed[mass]))
    caption = (
        "Mean |hand − goal| in the last second of a hold, cm, of a unit that no network has "
        f"seen; networks trained by {results.trained_by(block)}; ± is the standard deviation over "
        "training seeds. X is forward, Y left, Z up. The paper's robot is a real H1-2 with other "
        "goals; its third method sends the simulator's output as it is."
    )
    columns = ("payload in each hand, method", *(f"{axis}, cm" for axis in AXES))
    return ResultTable(f"table1_{block}", columns, tuple(rows), caption)


def _offset_cells(offsets: list[Array]) -> list[MeanStd]:
    """Return the mean offsets along X, Y and Z, cm.

    Args:
        offsets: (goals, 3) m for each training seed.
    """
    cells = []
    for axis in range(3):
        means = [of_seed[:, axis].mean() for of_seed in offsets]
        cells.append(MeanStd.from_values(means, scale=100))
    return cells


def commands_table(results: Results, block: Block) -> ResultTable:
    """Return the error of the robot by way of commanding it, and the gain over the same way
    without a network.
    """
    raw = results.mean_over_joints(results.plain_command_q_dis("raw"))
    rows: list[tuple[Any, ...]] = []

    def add_plain(title: str, q_dis: Array) -> None:
        error = results.mean_over_joints(q_dis)
        rows.append((title, 1e3 * error, _less(error, raw), None))

    for way in PLAIN_WAYS:
        add_plain(PLAIN_TITLES[way], results.plain_command_q_dis(way))
    identified = results.plain_command_q_dis("feedforward", "identified")
    add_plain(f"feed-forward, {results.simulators['identified']}", identified)

    for name in results.networks(block):
        for way in NETWORK_WAYS:
            without = results.mean_over_joints(results.plain_command_q_dis(REFERENCE_WAY[way]))
            errors = []  # rad·s, of each seed
            less_than_raw = []
            gains = []
            for q_dis in results.command_q_dis(block, name, way):
                error = results.mean_over_joints(q_dis)
                errors.append(error)
                less_than_raw.append(_less(error, raw))
                gains.append(_less(error, without))
            row = (
                f"{name}: {WAY_TITLES[way]}",
                MeanStd.from_values(errors, scale=1e3),
                MeanStd.from_values(less_than_raw),
                MeanStd.from_values(gains),
            )
            rows.append(row)
    caption = (
        "Q_dis between target and robot, mean over joints without wrists, motions and payloads; ± "
        "is the standard deviation over training seeds. The gain is over the same way without a "
        "network: over targets as they are for target − Δa, over the feed-forward for both, over "
        "feed-forward and integral with the integral."
    )
    columns = (
        "command",
        "Q_dis, mrad·s",
        "less than targets as they are, %",
        "gain of the network, %",
    )
    return ResultTable(f"commands_{block}", columns, tuple(rows), caption, digits=1)


def _less(error: float, reference: float) -> float:
    """Return by how much an error is below a reference, %."""
    return 100 * (1 - error / reference)


def large_gaps_table(results: Results, block: Block) -> ResultTable:
    """Return the share of rows and joints with a large gap, by payload: a later metric of the
    authors.
    """
    methods = results.networks(block)
    rows = []
    for threshold in LARGE_GAPS_RAD:
        key = str(threshold)
        for mass in results.masses:
            kept = results.payloads == mass
            cells: list[Any] = []
            for name in results.simulators:
                shares = np.array(results.baselines[name]["alignment"]["large_gaps"][key])
                cells.append(100 * float(shares[kept].mean()))
            for name in methods:
                seeds = []
                for run in results.runs(block, name):
                    shares = np.array(run["alignment"]["large_gaps"][key])
                    seeds.append(100 * float(shares[kept].mean()))
                cells.append(MeanStd.from_values(seeds))
            rows.append((f"above {threshold:g} rad, {mass:g} kg", *cells))
    caption = "Share of time and joints at which simulator and robot are further apart, %."
    columns = ("gap", *results.simulators.values(), *methods)
    return ResultTable(f"large_gaps_{block}", columns, tuple(rows), caption)


def table_2(results: Results) -> ResultTable:
    """Table 2: the paper's network with one setting changed in each row, MPJAE by payload."""
    rows: list[tuple[Any, ...]] = []
    for name in TABLE_2_CHANGES:
        runs = results.runs("table2", name)
        if not runs:
            continue
        baseline = "nominal"
        durations = results.durations
        payloads = results.payloads
        if name == "100 Hz":
            baseline = "nominal_fastest"
            durations = np.array(results.fastest.durations)
            payloads = np.array(results.fastest.payloads)
        nominal = results.over_joints(results.baseline_q_dis(baseline)) / durations
        errors = []  # MPJAE of each seed, which is Q_dis by the duration, (recordings,) rad
        ratios = []
        for q_dis in results.q_dis("table2", name):
            error = results.over_joints(q_dis) / durations
            errors.append(error)
            ratios.append(float(error.mean() / nominal.mean()))
        cells: list[MeanStd | None] = []
        for mass in results.masses:
            kept = payloads == mass
            if not kept.any():
                cells.append(None)
                continue
            means = [float(error[kept].mean()) for error in errors]
            cells.append(MeanStd.from_values(means, scale=1e3))
        ratio = MeanStd.from_values(ratios)
        note = "" if ratio.mean <= CONVERGED_SHARE else "not converged"
        label = OWN_LABEL if name == "payload out" else name
        printed = _printed(PRINTED_ROW.get(name))
        rows.append((label, runs[0]["obs_dim"], *cells, ratio, note, printed))
    masses = [f"{mass:g} kg" for mass in results.masses]
    caption = (
        "The literal network, joints without wrists, MPJAE in mrad on the motions and the unit of "
        "Figure 3; ± is the standard deviation over training seeds. A row above half of the "
        "nominal error is not converged, and its place in an order means nothing. The paper: Obs "
        "Dim, then mrad at 0, 1, 2 and 3 kg."
    )
    columns = ("setting", "Obs Dim", *masses, "of nominal", "", "the paper")
    return ResultTable("table2", columns, tuple(rows), caption)


def _printed(row: str | None) -> str:
    if row is None:
        return ""
    printed: PrintedRow = TABLE_2[row]
    errors = [f"{1e3 * error:.0f}" for error in printed.mpjae]
    return f"{printed.obs_dim}: {' '.join(errors)}"


def sensor_table(results: Results) -> ResultTable:
    """Return what the Sensor Predictor costs and saves, everything else equal."""
    rows = []
    for label, name in (
        ("predicted sensors (the paper's)", "payload out"),
        ("stepped probes: the simulator answers", "stepped probes"),
        ("without sensors: the branch sees the observation", "without sensors"),
    ):
        runs = results.runs("table2", name)
        if not runs:
            continue
        speeds = []  # steps per processor second
        errors = []  # rad
        for run in runs:
            errors.append(run["val_mpjae"]["model"])
            if run["cpu_s"] is not None:
                speeds.append(run["steps"] / run["cpu_s"])
        rows.append(
            (
                label,
                MeanStd.from_values(speeds),
                MeanStd.from_values(_seconds(runs)),
                MeanStd.from_values(errors, scale=1e3),
            )
        )
    caption = (
        "Processor seconds of one thread for one whole training of the literal network, "
        "validation included, labels aside, and control steps per such second; of trainings that "
        "were not interrupted."
    )
    columns = ("sensors", "steps per s", "processor seconds", "validation error, mrad")
    return ResultTable("sensors", columns, tuple(rows), caption, digits=1)


def _seconds(runs: list[dict[str, Any]]) -> list[float]:
    """Return the processor seconds of the trainings that were never interrupted."""
    return [run["cpu_s"] for run in runs if run["cpu_s"] is not None]


def _latency(runs: list[dict[str, Any]], percentile: str) -> MeanStd:
    """Return a percentile of the latency over trainings, µs."""
    return MeanStd.from_values([run["latency"][percentile] for run in runs])


def method_table(results: Results) -> ResultTable:
    """Return size, training time and latency of each method."""
    rows = []
    for block in METHOD_BLOCKS:
        for name in results.networks(block):
            runs = results.runs(block, name)
            rows.append(
                (
                    f"{name}, {results.trained_by(block)}",
                    runs[0]["parameters"],
                    runs[0]["steps"],
                    MeanStd.from_values(_seconds(runs)),
                    _latency(runs, "p50_us"),
                    _latency(runs, "p99_us"),
                )
            )
    caption = (
        "Equal recordings, payload input, labels, pre-training, control steps, selection and "
        "seeds. Latency is that of one correction for one robot, history and normalisation "
        "included."
    )
    columns = (
        "method",
        "weights",
        "control steps",
        "processor seconds",
        "latency p50, µs",
        "latency p99, µs",
    )
    return ResultTable("methods", columns, tuple(rows), caption, digits=1)
