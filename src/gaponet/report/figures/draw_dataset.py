"""Figures of a dataset: selection of recordings by fixed rules, and files."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from gaponet.base.arrays import Array
from gaponet.base.errors import DatasetError
from gaponet.base.files import lock_folder
from gaponet.base.progress import Progress, no_progress
from gaponet.data.repeatability import MIN_MOTION_RAD
from gaponet.data.sequence import Sequence
from gaponet.data.store import Dataset, Entry
from gaponet.report.evaluate import evenly_spaced
from gaponet.report.figures import dataset_figures as draw
from gaponet.report.figures.style import save
from gaponet.report.provenance import robot_label
from gaponet.robot.spec import RobotSpec
from gaponet.sim.model import model_hash
from gaponet.sim.replay import pair_dataset

Report = Callable[[int, int], None]  # called with the number of simulated recordings and their total

MAX_RANGE_SEQUENCES, MAX_RANGE_ROWS = 400, 40_000  # of joint_ranges
MAX_GAP_SEQUENCES = 240  # of gap_by_payload
MAX_TORQUE_MOTIONS = 60  # compared to find the motion with the largest change of torque
MAX_PAYLOADS = 4  # of torque_temperature
MAX_JOINTS = 3  # beside each other
SHOWN_S = 12.0  # of a long motion


def draw_all(
    dataset: Dataset, robot: RobotSpec, out: Path, progress: Progress = no_progress
) -> tuple[list[Path], dict[str, str]]:
    """Write every figure for which the dataset has data.

    Args:
        dataset: At least one sequence. Missing simulations that a figure needs are added to it.
        robot: The dataset's robot.
        out: Folder; figures of the same name are replaced.

    Returns:
        The files; and {figure: reason for its absence}.
    """
    dataset.require_robot(robot)
    if not dataset.entries:
        raise DatasetError(f"{dataset.path}: holds no sequences yet; import or collect some")
    with lock_folder(out, "figures"):
        figures, left_out = draw_figures(dataset, robot, progress=progress)
        return [file for name, fig in figures.items() for file in save(fig, out / name)], left_out


def draw_figures(
    dataset: Dataset, robot: RobotSpec, names: tuple[str, ...] = (), progress: Progress = no_progress
) -> tuple[dict[str, Figure], dict[str, str]]:
    """Draw the figures of these names, by default all. Return them, and {figure: reason for its absence}."""
    figures, left_out = dict[str, Figure](), dict[str, str]()
    names = names or tuple(FIGURES)
    for i, name in enumerate(names):

        def report(done: int, total: int, i: int = i, name: str = name) -> None:
            progress(i + done / max(total, 1), len(names), f"{name}: replaying")

        progress(i, len(names), name)
        try:
            figures[name] = FIGURES[name](dataset, robot, report)
        except _NoDataError as reason:
            left_out[name] = str(reason)
    progress(len(names), len(names), "")
    return figures, left_out


class _NoDataError(Exception):
    """The dataset has no data for a figure; the message gives the reason."""


def joint_ranges(dataset: Dataset, robot: RobotSpec, progress: Report) -> Figure:
    """Draw positions of each operated joint, of sequences that command it to move."""
    rows: dict[str, list[Array]] = defaultdict(list)
    entries = evenly_spaced(dataset.entries, MAX_RANGE_SEQUENCES)
    stride = max(1, sum(e.rows for e in entries) // MAX_RANGE_ROWS)
    for entry in entries:
        arrays = dataset.channels(entry, ("ctrl", "qpos"))
        for joint, j in zip(robot.operated, robot.operated_index, strict=True):
            if np.ptp(arrays["ctrl"][:, j]) > MIN_MOTION_RAD:
                rows[joint].append(arrays["qpos"][::stride, j])
    if not rows:
        raise _NoDataError("no operated joint is commanded to move")
    positions = {joint: np.concatenate(rows[joint]) for joint in robot.operated if joint in rows}
    limits = {j: tuple(robot.qpos_range[robot.joint_names.index(j)]) for j in positions}
    part = f"{len(entries)} of " if len(entries) < len(dataset) else ""
    title = f"{robot_label(entries)}: where joints were while commanded to move, {part}{len(dataset):,} sequences"
    return draw.joint_ranges(positions, limits, title)


def composition(dataset: Dataset, robot: RobotSpec, progress: Report) -> Figure:
    """Draw hours by payload, unit, rate and level."""
    motions = len({e.meta.motion for e in dataset.entries})
    title = f"{robot_label(dataset.entries)}: {dataset.hours():.2f} h, {motions} motions"
    return draw.composition(dataset.entries, title)


def torque_temperature(dataset: Dataset, robot: RobotSpec, progress: Report) -> Figure:
    """Draw the motion with the largest change of torque at several payloads, and the joints that bear it."""
    group = largest_torque_change(dataset, robot)
    payloads = evenly_spaced(sorted({e.meta.payload_mass for e in group}), MAX_PAYLOADS)
    takes = {p: first_part(dataset.read(next(e for e in group if e.meta.payload_mass == p))) for p in payloads}
    heaviest = takes[max(takes)]
    assert heaviest.tau is not None
    joints = largest_joints(robot, swing(heaviest.tau[:, robot.operated_index]))
    meta = heaviest.meta
    return draw.torque_temperature(takes, joints, f"{robot_label(group)}: {meta.motion}, {meta.unit_id}")


def overlay(dataset: Dataset, robot: RobotSpec, progress: Report) -> Figure:
    """Draw recording and nominal simulation of the same motion with its heaviest payload."""
    try:
        group = largest_torque_change(dataset, robot)
    except _NoDataError:  # no torque was recorded: show the longest motion
        group = [max(dataset.entries, key=lambda e: (e.rows * e.dt, e.id))]
    entry = max(group, key=lambda e: e.meta.payload_mass)
    pair_dataset(dataset, robot, progress, [entry])
    pair = dataset.pair(entry, model_hash(robot))
    real, meta, op = first_part(pair.real), entry.meta, robot.operated_index
    moved = np.ptp(real.ctrl[:, op], axis=0) > MIN_MOTION_RAD
    joints = largest_joints(
        robot, np.abs(pair.gap[: len(real), op]).mean(axis=0) + 10 * moved
    )  # joints that move come first
    title = (
        f"{robot_label([entry])}: {meta.motion}, {meta.unit_id}, {meta.payload_mass:g} kg, and the nominal simulator"
    )
    return draw.overlay(real, pair.sim.qpos[: len(real)], joints, title)


def gap_by_payload(dataset: Dataset, robot: RobotSpec, progress: Report) -> Figure:
    """Draw the mean |gap| by payload, of motions that were recorded with every payload."""
    groups = list(by_take(dataset.entries).values())
    payloads = {e.meta.payload_mass for e in dataset.entries}
    whole = [g for g in groups if {e.meta.payload_mass for e in g} == payloads]
    if len(payloads) < 2 or not whole:
        raise _NoDataError("no motion was recorded with several payloads")
    chosen = evenly_spaced(whole, max(1, MAX_GAP_SEQUENCES // len(payloads)))
    entries = [next(e for e in g if e.meta.payload_mass == p) for g in chosen for p in sorted(payloads)]
    pair_dataset(dataset, robot, progress, entries)
    errors: dict[float, list[Array]] = defaultdict(list)
    for entry in entries:
        gap = dataset.pair(entry, model_hash(robot)).gap[1:, robot.operated_index]
        errors[entry.meta.payload_mass].append(np.abs(gap).mean(axis=0))
    title = f"{robot_label(entries)}: gap to the nominal simulator, free run, {len(chosen)} takes with every payload"
    return draw.gap_by_payload({p: np.array(e) for p, e in errors.items()}, list(robot.operated), title)


FIGURES = {
    "joint_ranges": joint_ranges,
    "composition": composition,
    "torque_temperature": torque_temperature,
    "real_and_simulated": overlay,
    "gap_by_payload": gap_by_payload,
}


def by_take(entries: list[Entry]) -> dict[tuple[Any, ...], list[Entry]]:
    """Group entries that differ only in payload and repetition."""
    groups: dict[tuple[Any, ...], list[Entry]] = defaultdict(list)
    for e in entries:
        groups[e.meta.motion, e.meta.unit_id, e.meta.payload_side, round(e.dt, 7)].append(e)
    return groups


def largest_torque_change(dataset: Dataset, robot: RobotSpec) -> list[Entry]:
    """Return the entries of the motion with the largest change of torque, among those with the most payloads."""
    groups = [g for g in by_take(dataset.entries).values() if all("tau" in e.channels for e in g)]
    if not groups:
        raise _NoDataError("no torque was recorded")
    count = lambda g: len({e.meta.payload_mass for e in g})  # noqa: E731
    full = {g[0].meta.motion: g for g in reversed(groups) if count(g) == max(map(count, groups))}

    def torque(group: list[Entry]) -> float:
        entry = max(group, key=lambda e: e.meta.payload_mass)
        rows = dataset.channels(entry, ("tau",))["tau"][: round(SHOWN_S / entry.dt)]
        return float(swing(rows[:, robot.operated_index]).mean())

    return max(evenly_spaced(list(full.values()), MAX_TORQUE_MOTIONS), key=torque)


def swing(values: Array) -> Array:
    """Return the range of a signal from its 5th to its 95th percentile, (T, n) → (n,)."""
    low, high = np.percentile(values, [5, 95], axis=0)
    return high - low


def first_part(sequence: Sequence) -> Sequence:
    """Return the first SHOWN_S of a recording."""
    return sequence.rows(slice(0, max(2, round(SHOWN_S / sequence.dt))))


def largest_joints(robot: RobotSpec, size: Array) -> list[str]:
    """Return the operated joints with the largest values, in the robot's order."""
    return [robot.operated[i] for i in sorted(np.argsort(-size)[:MAX_JOINTS])]
