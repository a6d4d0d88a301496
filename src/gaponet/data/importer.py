"""Logs → dataset. Everything is read and checked before anything is written."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.data.formats import find_logs, read_logs
from gaponet.data.log import Log
from gaponet.data.offsets import Gravity, UnitOffsets, fit_unit, read_offsets, record_offsets
from gaponet.data.sequence import Sequence, SequenceMeta, to_sequence
from gaponet.data.signals import estimate_delay, fast_speed
from gaponet.data.store import Dataset, Entry
from gaponet.errors import DatasetError, LogError, UsageError
from gaponet.robot import RobotSpec

Progress = Callable[[float, float, str], None]  # done, total, motion


@dataclass(frozen=True)
class ImportReport:
    """What one import added; offsets are None where no gravity model was given."""

    dataset: Dataset
    entries: list[Entry]
    offsets: UnitOffsets | None


def import_logs(
    src: str | Path,
    robot: RobotSpec,
    unit_id: str,
    payload_mass: float,
    out: str | Path,
    payload_side: str = "both",
    level: str = "whole_body",
    fmt: str | None = None,
    gravity: Gravity | None = None,
    simulator: str = "",
    progress: Progress | None = None,
    **options: Any,
) -> ImportReport:
    """Import every recording under a path; a bad one refuses them all, and nothing is written.

    Args:
        src: File or folder in one of data.formats.FORMATS.
        robot: The robot that was recorded.
        unit_id: Which of its kind; zero offsets belong to a unit.
        payload_mass: In each hand named by payload_side, kg; 0.0 when empty.
        out: Dataset folder; made, or appended to.
        payload_side: "both", or the side of one payload mount.
        level: joint, upper_body or whole_body.
        fmt: Format; default by looking.
        gravity: Nominal model's gravity, to fit offsets with (data.offsets); default: no offsets.
        simulator: Hash of that model, recorded beside the offsets.
        progress: Called after each recording.
        options: Of data.formats.read_logs: joint_map, columns, position_unit, time_unit.

    Raises:
        LogError, JointMismatchError: A recording cannot be read; the message names file and line.
        DatasetError: `out` is another robot's, or holds one of the recordings already.
    """
    src, out = Path(src), Path(out)
    known = Dataset.peek(out, robot)
    if known:
        read_offsets(known)  # a damaged one is said before anything is read
    side, name = _side(robot, payload_side), os.path.basename(os.path.abspath(src))
    meta = SequenceMeta(robot.name, unit_id, name, payload_mass, side, level, source=str(src))
    sequences: list[Sequence] = []
    total = len(find_logs(src, fmt))
    for motion, log in read_logs(src, robot, fmt, **options):
        found = replace(meta, motion=motion, source=_relative(log.source, src), source_sha256=_sha256(log))
        sequences.append(to_sequence(log, robot, found))
        if progress:
            progress(len(sequences), total, motion)
    _refuse_known(sequences, known, out)
    with _Undo(out, made=known is None):
        dataset = known or Dataset.create(out, robot)
        taken = Counter(_slot(e.meta) for e in dataset.entries)
        entries = []
        for sequence in sequences:
            slot = _slot(sequence.meta)
            numbered = replace(sequence, meta=replace(sequence.meta, repetition=taken[slot]))
            entries.append(dataset.append(numbered, findings(numbered)))
            taken[slot] += 1
    offsets = fit_unit(dataset, robot, unit_id, gravity) if gravity else None
    if offsets:
        record_offsets(dataset, unit_id, offsets, simulator)
    return ImportReport(dataset, entries, offsets)


def findings(sequence: Sequence) -> dict[str, dict[str, float | None]]:
    """By joint: delay_s, command-to-state lag (None where the motion does not say), and fast_speed of the command."""
    lag = estimate_delay(sequence.ctrl, sequence.qpos, sequence.dt)
    by_joint = lambda x: {  # noqa: E731
        j: round(float(v), 4) if np.isfinite(v) else None for j, v in zip(sequence.joint_names, x, strict=True)
    }
    return {"delay_s": by_joint(lag), "fast_speed": by_joint(fast_speed(sequence.ctrl, sequence.dt))}


class _Undo:
    """Removes a dataset folder made in this block if the block fails; one that was there keeps what was appended."""

    def __init__(self, path: Path, made: bool) -> None:
        self.path, self.made, self.there = path, made, path.exists()

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None or not self.made:
            return
        for child in self.path.iterdir() if self.path.is_dir() else ():
            shutil.rmtree(child) if child.is_dir() else child.unlink()
        if self.path.is_dir() and not self.there:
            self.path.rmdir()


def _refuse_known(sequences: list[Sequence], known: Dataset | None, out: Path) -> None:
    """Refuse recordings that the dataset holds already, or that stand twice in the source."""
    names = {e.hash: f"'{e.id}' of {out}" for e in known.entries} if known else {}
    if not sequences:
        raise LogError("no recording found")
    twice = []
    for sequence in sequences:
        digest = sequence.content_hash()
        if digest in names:
            twice.append((sequence.meta.source, names[digest]))
        names.setdefault(digest, sequence.meta.source)
    if twice:
        source, twin = twice[0]
        raise DatasetError(
            f"{len(twice)} of {len(sequences)} recordings are there already (same samples, unit and payload): {source} "
            f"is {twin}. Nothing was imported; point at new recordings only, or say another --unit-id or --payload-mass"
        )


def _slot(meta: SequenceMeta) -> tuple[str, str, float, str]:
    """Recordings in one slot are repetitions of each other."""
    return meta.motion, meta.unit_id, meta.payload_mass, meta.payload_side


def _side(robot: RobotSpec, side: str) -> str:
    sides = ("both", *(mount.side for mount in robot.payload_mounts))
    if side not in sides:
        raise UsageError(f"payload side '{side}' is unknown to {robot.name}; use one of {', '.join(sides)}")
    return side


def _relative(source: str, src: Path) -> str:
    """Path of a recording from the folder that holds src: no home folder ends up in a dataset."""
    return Path(os.path.relpath(source, Path(os.path.abspath(src)).parent)).as_posix()


def _sha256(log: Log) -> str:
    """Of the recording's files one after the other, in the order of their names (cat control.csv state_motor.csv)."""
    digest = hashlib.sha256()
    for file in sorted(set(log.meta["files"].values())):
        digest.update(Path(file).read_bytes())
    return digest.hexdigest()
