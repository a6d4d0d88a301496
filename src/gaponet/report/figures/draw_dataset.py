"""Draws a dataset: chooses what each picture shows, by fixed rules, reads it, and writes SVG and PNG."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from gaponet.base.arrays import Array
from gaponet.base.errors import DatasetError
from gaponet.base.files import lock_folder
from gaponet.base.progress import Progress, no_progress
from gaponet.data.repeatability import MOVED
from gaponet.data.sequence import Sequence
from gaponet.data.store import Dataset, Entry
from gaponet.report.evaluate import evenly_spaced
from gaponet.report.figures import dataset_figures as draw
from gaponet.report.figures.style import save
from gaponet.report.provenance import robot_label
from gaponet.robot.spec import RobotSpec
from gaponet.sim.model import model_hash
from gaponet.sim.replay import pair_dataset

RANGE_SEQUENCES, RANGE_ROWS = 400, 40_000  # most read for joint ranges, and rows kept of each joint
GAP_SEQUENCES = 240  # most paired for the gap against payload
MOTIONS = 60  # most looked at to find the one with the most torque
COLUMNS = 3  # joints shown beside each other
SHOWN_S = 12.0  # s of a long motion


def draw_all(
    dataset: Dataset, robot: RobotSpec, out: Path, progress: Progress = no_progress
) -> tuple[list[Path], dict[str, str]]:
    """Write every picture that the dataset has data for.

    Args:
        dataset: At least one sequence. Twins that a picture needs and that are not there are made and kept.
        robot: The dataset's robot.
        out: Folder; made, pictures of the same name replaced.

    Returns:
        Files written; and {picture: why it was left out}.
    """
    dataset.require_robot(robot)
    if not dataset.entries:
        raise DatasetError(f"{dataset.path}: holds no sequences yet; import or collect some")
    with lock_folder(out, "figures"):
        figures, left_out = pictures(dataset, robot, progress=progress)
        return [file for name, fig in figures.items() for file in save(fig, out / name)], left_out


def pictures(
    dataset: Dataset, robot: RobotSpec, names: tuple[str, ...] = (), progress: Progress = no_progress
) -> tuple[dict[str, Figure], dict[str, str]]:
    """The pictures of these names, all by default; and {picture: why it was left out}."""
    figures, left_out = dict[str, Figure](), dict[str, str]()
    names = names or tuple(PICTURES)
    for i, name in enumerate(names):

        def tell(done: int, total: int, i: int = i, name: str = name) -> None:
            progress(i + done / max(total, 1), len(names), f"{name}: replaying")

        progress(i, len(names), name)
        try:
            figures[name] = PICTURES[name](dataset, robot, tell)
        except _Nothing as reason:
            left_out[name] = str(reason)
    progress(len(names), len(names), "")
    return figures, left_out


class _Nothing(Exception):  # noqa: N818
    """A picture has nothing to show: the message says why."""


def joint_ranges(dataset: Dataset, robot: RobotSpec, tell: Any) -> Figure:
    """Positions of each operated joint, of sequences that command it to move."""
    kept: dict[str, list[Array]] = defaultdict(list)
    entries = evenly_spaced(dataset.entries, RANGE_SEQUENCES)
    stride = max(1, sum(e.rows for e in entries) // RANGE_ROWS)
    for entry in entries:
        arrays = dataset.channels(entry, ("ctrl", "qpos"))
        for joint, j in zip(robot.operated, robot.operated_index, strict=True):
            if np.ptp(arrays["ctrl"][:, j]) > MOVED:
                kept[joint].append(arrays["qpos"][::stride, j])
    if not kept:
        raise _Nothing("no operated joint is commanded to move")
    positions = {joint: np.concatenate(kept[joint]) for joint in robot.operated if joint in kept}
    limits = {j: tuple(robot.qpos_range[robot.joint_names.index(j)]) for j in positions}
    part = f"{len(entries)} of " if len(entries) < len(dataset) else ""
    title = f"{robot_label(entries)}: where joints were while commanded to move, {part}{len(dataset):,} sequences"
    return draw.joint_ranges(positions, limits, title)


def composition(dataset: Dataset, robot: RobotSpec, tell: Any) -> Figure:
    """Hours by payload, unit, rate and level."""
    motions = len({e.meta.motion for e in dataset.entries})
    title = f"{robot_label(dataset.entries)}: {dataset.hours():.2f} h, {motions} motions"
    return draw.composition(dataset.entries, title)


def torque_temperature(dataset: Dataset, robot: RobotSpec, tell: Any) -> Figure:
    """The motion whose torques change most, at up to four payloads, and the joints that bear it."""
    group = liveliest(dataset, robot)
    payloads = evenly_spaced(sorted({e.meta.payload_mass for e in group}), 4)
    takes = {p: shown(dataset.read(next(e for e in group if e.meta.payload_mass == p))) for p in payloads}
    heaviest = takes[max(takes)]
    assert heaviest.tau is not None
    joints = most(robot, swing(heaviest.tau[:, robot.operated_index]))
    meta = heaviest.meta
    return draw.torque_temperature(takes, joints, f"{robot_label(group)}: {meta.motion}, {meta.unit_id}")


def overlay(dataset: Dataset, robot: RobotSpec, tell: Any) -> Figure:
    """The same motion with its heaviest payload, the joints with the largest gap."""
    try:
        group = liveliest(dataset, robot)
    except _Nothing:  # no torque recorded: the longest motion will do
        group = [max(dataset.entries, key=lambda e: (e.rows * e.dt, e.id))]
    entry = max(group, key=lambda e: e.meta.payload_mass)
    pair_dataset(dataset, robot, tell, [entry])
    pair = dataset.pair(entry, model_hash(robot))
    real, meta, op = shown(pair.real), entry.meta, robot.operated_index
    moved = np.ptp(real.ctrl[:, op], axis=0) > MOVED
    joints = most(robot, np.abs(pair.gap[: len(real), op]).mean(axis=0) + 10 * moved)  # those that move, first
    title = (
        f"{robot_label([entry])}: {meta.motion}, {meta.unit_id}, {meta.payload_mass:g} kg, and the nominal simulator"
    )
    return draw.overlay(real, pair.sim.qpos[: len(real)], joints, title)


def gap_by_payload(dataset: Dataset, robot: RobotSpec, tell: Any) -> Figure:
    """Mean |gap| of sequences of motions that were played with every payload, so that payload alone differs."""
    groups = list(by_take(dataset.entries).values())
    payloads = {e.meta.payload_mass for e in dataset.entries}
    whole = [g for g in groups if {e.meta.payload_mass for e in g} == payloads]
    if len(payloads) < 2 or not whole:
        raise _Nothing("no motion was played with several payloads")
    chosen = evenly_spaced(whole, max(1, GAP_SEQUENCES // len(payloads)))
    entries = [next(e for e in g if e.meta.payload_mass == p) for g in chosen for p in sorted(payloads)]
    pair_dataset(dataset, robot, tell, entries)
    errors: dict[float, list[Array]] = defaultdict(list)
    for entry in entries:
        gap = dataset.pair(entry, model_hash(robot)).gap[1:, robot.operated_index]
        errors[entry.meta.payload_mass].append(np.abs(gap).mean(axis=0))
    title = f"{robot_label(entries)}: gap to the nominal simulator, free run, {len(chosen)} takes with every payload"
    return draw.gap_by_payload({p: np.array(e) for p, e in errors.items()}, list(robot.operated), title)


PICTURES = {
    "joint_ranges": joint_ranges,
    "composition": composition,
    "torque_temperature": torque_temperature,
    "real_and_twin": overlay,
    "gap_by_payload": gap_by_payload,
}


def by_take(entries: list[Entry]) -> dict[tuple[Any, ...], list[Entry]]:
    """Entries that differ in payload (and repetition) alone."""
    groups: dict[tuple[Any, ...], list[Entry]] = defaultdict(list)
    for e in entries:
        groups[e.meta.motion, e.meta.unit_id, e.meta.payload_side, round(e.dt, 7)].append(e)
    return groups


def liveliest(dataset: Dataset, robot: RobotSpec) -> list[Entry]:
    """The take whose torques at the operated joints change most, among those with the most payloads."""
    groups = [g for g in by_take(dataset.entries).values() if all("tau" in e.channels for e in g)]
    if not groups:
        raise _Nothing("no torque was recorded")
    count = lambda g: len({e.meta.payload_mass for e in g})  # noqa: E731
    full = {g[0].meta.motion: g for g in reversed(groups) if count(g) == max(map(count, groups))}

    def torque(group: list[Entry]) -> float:
        entry = max(group, key=lambda e: e.meta.payload_mass)
        rows = dataset.channels(entry, ("tau",))["tau"][: round(SHOWN_S / entry.dt)]
        return float(swing(rows[:, robot.operated_index]).mean())

    return max(evenly_spaced(list(full.values()), MOTIONS), key=torque)


def swing(values: Array) -> Array:
    """How far a signal swings, (T, n) → (n): from its 5th to its 95th percentile, so that spikes do not count."""
    low, high = np.percentile(values, [5, 95], axis=0)
    return high - low


def shown(sequence: Sequence) -> Sequence:
    """Its first part, where it is long."""
    return sequence.rows(slice(0, max(2, round(SHOWN_S / sequence.dt))))


def most(robot: RobotSpec, size: Array) -> list[str]:
    """Operated joints with the largest values, in the robot's order."""
    return [robot.operated[i] for i in sorted(np.argsort(-size)[:COLUMNS])]
