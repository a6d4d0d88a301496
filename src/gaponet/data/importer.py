"""Logs → dataset. Everything is read and checked before anything is written; one that was cut short is resumed."""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.base.errors import DatasetError, LogError, UsageError
from gaponet.base.files import lock_folder
from gaponet.base.progress import Progress, no_progress
from gaponet.data.formats import find_logs, read_logs
from gaponet.data.holds import Holds
from gaponet.data.log import Log, skipping
from gaponet.data.offsets import Gravity, UnitOffsets, read_offsets, record_offsets
from gaponet.data.sequence import ARRAYS, Sequence, SequenceMeta, to_sequence
from gaponet.data.signals import estimate_delay, fast_speed
from gaponet.data.store import KIND, Dataset, Entry
from gaponet.robot.spec import RobotSpec

HOLD = 1 << 26  # bytes of samples kept between checking and writing; a larger source is read twice
UNSTATED = -1  # repetition that the format does not state, until it is counted


@dataclass(frozen=True)
class ImportReport:
    """What one import added.

    Attributes:
        entries: Sequences that were added.
        present: Sequences of this source that were there before, by their content.
        offsets: None where no gravity model was given or several units were recorded.
        cut: Rows that were cut and recordings left out, one line each, where that was asked for.
    """

    dataset: Dataset
    entries: list[Entry]
    present: list[Entry]
    offsets: UnitOffsets | None
    cut: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class _Given:
    """What the user says of all recordings; None where it is left to the format, or to the default."""

    unit_id: str | None
    payload_mass: float | None
    payload_side: str | None
    level: str | None
    kp: tuple[float, ...] | None
    kd: tuple[float, ...] | None
    cut: float | None


def import_logs(
    src: str | Path,
    robot: RobotSpec,
    unit_id: str | None,
    payload_mass: float | None,
    out: str | Path,
    payload_side: str | None = None,
    level: str | None = None,
    fmt: str | None = None,
    gravity: Gravity | None = None,
    simulator: str = "",
    progress: Progress = no_progress,
    kp: tuple[str, ...] = (),
    kd: tuple[str, ...] = (),
    skip_bad: bool = False,
    cut: float | None = None,
    **options: Any,
) -> ImportReport:
    """Import every recording under a path that is not there yet; a bad one refuses them all, and nothing is written.

    What could be written before a full disk or a kill stays, complete, and the same call adds the rest.

    Args:
        src: File or folder in one of data.formats.formats().
        unit_id: Which of its kind; zero offsets belong to a unit. None where the format states it.
        payload_mass: In each hand named by payload_side, kg; 0.0 when empty. None where the format states it.
        out: Dataset folder; made, or appended to by one process at a time.
        payload_side: "both" (default), or the side of one payload mount.
        level: joint, upper_body or whole_body (default).
        gravity: Nominal model's gravity, to fit offsets with (data.offsets); default: no offsets.
        simulator: Hash of that model, recorded beside the offsets.
        kp, kd: Gains while recording, N·m/rad and N·m·s/rad: one number, or JOINT=NUMBER for some of the joints;
            default what the format states, else the robot's.
        skip_bad: Cut bad rows and leave out recordings that cannot be read, instead of refusing all; the report lists
            both.
        cut: Cut recordings into pieces of about so long, s, each a motion of its own.
        options: Options of data.formats.read_logs: joint_map, logs, position_unit, time_unit, rate, allow_pickle,
            strict.

    Raises:
        LogError, JointMismatchError: A recording cannot be read; the message names file and line.
        UsageError: Unit or payload are missing, or contradict what the format states.
        DatasetError: `out` is another robot's, a recording is in the source twice, or in `out` under other labels.
        FolderError: `out` is something else, or another process writes into it.
    """
    src, out = Path(src), Path(out)
    if payload_side is not None:
        _require_side(robot, payload_side)
    given = _Given(
        unit_id, payload_mass, payload_side, level, _given_gains("kp", kp, robot), _given_gains("kd", kd, robot), cut
    )
    if cut is not None and not cut >= 0.8:
        raise UsageError(f"--cut {cut:g}: pieces are 0.8 s long or more")
    with lock_folder(out, KIND):
        known = Dataset.peek(out, robot)
        if known is not None:
            read_offsets(known)  # a damaged one is said before anything is read
        rests: dict[str, Holds] | None = {} if gravity else None
        with skipping(skip_bad) as bad:
            dataset, added, present = _import(src, out, robot, given, fmt, progress, options, rests)
        units = dict.fromkeys(e.meta.unit_id for e in (*present, *added))
        offsets = {unit: UnitOffsets.of_unit(dataset, robot, unit, gravity, rests) for unit in units} if gravity else {}
        for unit, fitted in offsets.items():
            record_offsets(dataset, unit, fitted, simulator)
    only = next(iter(offsets.values())) if len(offsets) == 1 else None
    return ImportReport(dataset, added, present, only, list(dict.fromkeys(bad or ())))


def _import(
    src: Path,
    out: Path,
    robot: RobotSpec,
    given: _Given,
    fmt: str | None,
    progress: Progress,
    options: dict[str, Any],
    rests: dict[str, Holds] | None,
) -> tuple[Dataset, list[Entry], list[Entry]]:
    """Read and check all, then write what is new; where all is too much to hold, read it again for writing.

    Each recording is hashed once, and its rests, by hash, are put into `rests` where they are asked for.

    Returns:
        Dataset, entries added, entries that were there.
    """
    digests: list[tuple[str, str]] = []
    held: list[Sequence] = []
    facts: dict[str, str] = {}
    known = Dataset.peek(out, robot)
    size, total = 0, len(find_logs(src, fmt))
    for sequence, log in _sequences(src, robot, given, fmt, options):
        digests.append((sequence.content_hash(), sequence.meta.source))
        if known is not None:
            _refuse_relabelled(sequence, known)
        facts |= log.meta.get("dataset", {})
        size += sum(x.nbytes for c in ARRAYS if (x := getattr(sequence, c)) is not None)
        held.append(sequence)
        if size > HOLD:
            held.clear()
        progress(len(digests), max(total, len(digests)), sequence.meta.motion)  # a file may hold many
    _refuse_twice(digests, given.cut is not None)
    again = (s for s, _ in _sequences(src, robot, given, fmt, options))
    dataset = Dataset.create(out, robot)
    if facts and not dataset.entries:
        dataset.state(**facts)
    present = [entry for digest, _ in digests if (entry := dataset.find(digest))]
    taken = Counter(e.meta.slot for e in dataset.entries)
    added = []
    with dataset.appending():
        for (digest, _), sequence in zip(digests, held if size <= HOLD else again, strict=True):
            if rests is not None:
                rests[digest] = Holds.of(sequence, robot.operated_index)
            if dataset.find(digest):
                continue
            slot = sequence.meta.slot
            if sequence.meta.repetition < 0:  # the format does not state it
                sequence = replace(sequence, meta=replace(sequence.meta, repetition=taken[slot]))
            added.append(dataset.append(sequence, findings(sequence), digest))
            taken[slot] += 1
    return dataset, added, present


def _sequences(
    src: Path, robot: RobotSpec, given: _Given, fmt: str | None, options: dict[str, Any]
) -> Iterator[tuple[Sequence, Log]]:
    """Every recording on its grid, with what the format and the user say of it."""
    digests: dict[tuple[str, ...], str] = {}
    for motion, log in read_logs(src, robot, fmt, **options):
        files = tuple(sorted({*log.meta["files"].values(), *log.meta.get("all_files", ())}))
        if files not in digests:  # many episodes may lie in one file
            digests[files] = _sha256(files)
        meta = _meta(log, motion, src, robot, given, digests[files])
        _require_side(robot, meta.payload_side)
        sequence = to_sequence(log, robot, meta)
        if "notes" in log.meta.get("stated", {}):  # how it was first recorded, not how it was written here
            sequence = replace(sequence, meta=meta)
        for piece in _pieces(sequence, given.cut):
            yield piece, log


def _pieces(sequence: Sequence, seconds: float | None) -> Iterator[Sequence]:
    """A recording, or equal pieces of it of about so long, s; each says from when it is."""
    count = max(1, round(sequence.duration / seconds)) if seconds else 1
    if count == 1:
        yield sequence
        return
    rows = len(sequence) // count
    for start in range(0, count * rows, rows):
        at, meta = round(start * sequence.dt, 3), sequence.meta
        named = replace(meta, motion=f"{meta.motion}@{at:.0f}s", notes=meta.notes | {"from_s": at})
        yield replace(sequence.rows(slice(start, start + rows)), meta=named)


def _meta(log: Log, motion: str, src: Path, robot: RobotSpec, given: _Given, sha256: str) -> SequenceMeta:
    """The user's word, completed by the format's; contradictions and gaps are refused."""
    stated = {k: tuple(v) if k in ("kp", "kd") else v for k, v in log.meta.get("stated", {}).items() if v is not None}
    said = {name: value for name, value in vars(given).items() if name != "cut"}
    for name, value in said.items():
        flag = "--" + name.replace("_", "-")
        if value is not None and name in stated and stated[name] != value:
            raise UsageError(f"{log.source}: {flag} {value} contradicts the file's {stated[name]}; leave it out")
    needed = {"unit_id": "--unit-id NAME", "payload_mass": "--payload-mass 0 (kg in each hand, 0 when empty)"}
    missing = [flag for name, flag in needed.items() if said[name] is None and name not in stated]
    if missing:
        raise UsageError(f"{log.source}: this format does not say it: give {' and '.join(missing)}")
    fields: dict[str, Any] = {"source": _relative(log.source, src), "source_sha256": sha256, "repetition": UNSTATED}
    fields |= {name: value for name, value in said.items() if value is not None}
    return SequenceMeta(**(fields | {"robot": robot.name, "motion": motion} | stated))


def _given_gains(name: str, words: tuple[str, ...], robot: RobotSpec) -> tuple[float, ...] | None:
    """("17.8",) or ("elbow=9", …) → gains of all joints, (n); joints that are not named keep the robot's."""
    if not words:
        return None
    gains = np.array(getattr(robot.nominal or robot, name), float)
    for word in words:
        joint, equals, number = word.rpartition("=")
        try:
            value = float(number)
        except ValueError:
            value = np.nan
        if not (np.isfinite(value) and value >= 0) or (not equals and len(words) > 1):
            raise UsageError(f"--{name} {word}: give one number ≥ 0 for all joints, or JOINT=NUMBER for some")
        gains[robot.index([joint]) if equals else slice(None)] = value
    return tuple(gains.tolist())


def findings(sequence: Sequence) -> dict[str, dict[str, float | None]]:
    """Measure by joint: delay_s, command-to-state lag (None where the motion shows none); fast_speed of the command."""
    lag = estimate_delay(sequence.ctrl, sequence.qpos, sequence.dt)
    by_joint = lambda x: {  # noqa: E731
        j: round(float(v), 4) if np.isfinite(v) else None for j, v in zip(sequence.joint_names, x, strict=True)
    }
    return {"delay_s": by_joint(lag), "fast_speed": by_joint(fast_speed(sequence.ctrl, sequence.dt))}


def _refuse_twice(recordings: list[tuple[str, str]], cut: bool) -> None:
    """Refuse (content hash, source) that stand twice in the source; pieces of one recording may be equal: it rested."""
    if not recordings:
        raise LogError("no recording found")
    names: dict[str, str] = {}
    twice = []
    for digest, source in recordings:
        if digest in names and not (cut and names[digest] == source):
            twice.append((source, names[digest]))
        names.setdefault(digest, source)
    if twice:
        source, twin = twice[0]
        raise DatasetError(
            f"{len(twice)} of {len(recordings)} recordings are there twice (same samples, unit and payload): {source} "
            f"is {twin}. Nothing was imported; leave one of them out"
        )


def _refuse_relabelled(sequence: Sequence, known: Dataset) -> None:
    """Refuse samples that the dataset has under another unit or payload: one of the labels is wrong."""
    meta, alike = sequence.meta, [e.meta for e in known.entries if e.rows == len(sequence)]
    for unit, mass, side in {(m.unit_id, m.payload_mass, m.payload_side) for m in alike}:
        other = replace(meta, unit_id=unit, payload_mass=mass, payload_side=side)
        twin = known.find(replace(sequence, meta=other).content_hash())
        if twin is not None and (unit, mass, side) != (meta.unit_id, meta.payload_mass, meta.payload_side):
            raise DatasetError(
                f"{meta.source}: known samples under new labels: {known.path} holds them as unit {unit}, {mass:g} kg "
                f"({side}), not unit {meta.unit_id}, {meta.payload_mass:g} kg ({meta.payload_side}). Nothing was "
                f"imported; where the old label is the wrong one: gaponet data remove {known.path} {twin.id}"
            )


def _require_side(robot: RobotSpec, side: str) -> None:
    sides = ("both", *(mount.side for mount in robot.payload_mounts))
    if side not in sides:
        raise UsageError(f"payload side '{side}' is unknown to {robot.name}; use one of {', '.join(sides)}")


def _relative(source: str, src: Path) -> str:
    """Path of a recording from the folder that holds src: no home folder ends up in a dataset."""
    return Path(os.path.relpath(source, Path(os.path.abspath(src)).parent)).as_posix()


def _sha256(files: tuple[str, ...]) -> str:
    """SHA-256 of a recording's files one after the other, by name (cat control.csv state_motor.csv)."""
    digest = hashlib.sha256()
    for file in files:
        with Path(file).open("rb") as content:
            while block := content.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()
