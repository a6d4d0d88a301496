"""Import of logs into a dataset. Everything is read and checked before anything is written.

An import that was interrupted is completed by the same call.
"""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import DatasetError, LogError, UsageError
from gaponet.base.files import lock_folder
from gaponet.base.progress import Progress, no_progress
from gaponet.data.formats import ReadOptions, find_logs, read_logs
from gaponet.data.journal import Findings
from gaponet.data.log import Log, skip_bad_rows, skipped_rows
from gaponet.data.offsets import Gravity, JointOffset, read_offsets, record_offsets, unit_offsets
from gaponet.data.sequence import ARRAYS, Sequence, SequenceMeta, recorded_gains, to_sequence
from gaponet.data.signals import FAST_COMMAND_RAD_S, estimate_delay, fast_speed
from gaponet.data.static_poses import StaticPoses
from gaponet.data.store import KIND, Dataset, Entry
from gaponet.robot.spec import RobotSpec

# Of the samples that are held between checking and writing; a larger source is read twice.
MAX_HELD_BYTES = 1 << 26
MIN_PIECE_S = 0.8  # of a recording that is cut
UNSTATED_REPETITION = -1


@dataclass(frozen=True)
class ImportResult:
    """Logs that were read into a dataset.

    Attributes:
        added: Sequences that were added.
        present: Sequences of the same logs that the dataset held before.
        offsets: Lag and static errors of the unit; None without a gravity model or with several
            units.
        cut: Rows that were cut and logs that were left out, one line each.
    """

    dataset: Dataset
    robot: RobotSpec
    added: tuple[Entry, ...]
    present: tuple[Entry, ...]
    offsets: dict[str, JointOffset] | None
    cut: tuple[str, ...]

    @property
    def entries(self) -> tuple[Entry, ...]:
        """Sequences that were added, or those that were present where nothing was added."""
        return self.added or self.present

    def fast_lags(self, joint: str) -> list[float]:
        """Lags of a joint in the sequences that command it fast, s."""
        lags = []
        for entry in self.entries:
            speed = entry.findings.get("fast_speed", {}).get(joint) or 0.0
            lag = entry.findings.get("delay_s", {}).get(joint)
            if speed >= FAST_COMMAND_RAD_S and lag is not None:
                lags.append(lag)
        return lags

    def to_dict(self) -> dict[str, Any]:
        """Return the result as plain data."""
        offsets = self.offsets or {}
        return {
            "dataset": str(self.dataset.path),
            "imported": [entry.id for entry in self.added],
            "present": [entry.id for entry in self.present],
            "sequences": len(self.dataset),
            "minutes": sum(entry.rows * entry.dt for entry in self.entries) / 60,
            "rate_hz": sorted({round(1 / entry.dt, 2) for entry in self.entries}),
            "fast_lag_s": {joint: self.fast_lags(joint) for joint in self.robot.operated},
            "delay_s": {entry.id: entry.findings.get("delay_s", {}) for entry in self.entries},
            "offsets": {name: vars(joint) for name, joint in offsets.items()},
            "offsets_applied": False,
            "cut": list(self.cut),
        }


@dataclass(frozen=True)
class ImportOptions(ReadOptions):
    """How logs are read, and what they are of."""

    payload_side: str | None = None
    """Hand that carries the payload: both (default), or the side of one payload mount, such as
    left."""
    cut: float | None = None
    """Cut long recordings into equal pieces of about this length, s. Each piece counts as a motion
    of its own."""
    level: Literal["joint", "upper_body", "whole_body"] | None = None
    """What the motions move: a single joint, the upper body or the whole body. Default:
    whole_body."""
    kp: tuple[str, ...] = ()
    """Stiffness of the controller while it recorded, N·m/rad: NUMBER for all joints, JOINT=NUMBER
    for some. Default: what the logs state, or else the robot's file."""
    kd: tuple[str, ...] = ()
    """Damping gain of the controller while it recorded, N·m·s/rad: NUMBER for all joints,
    JOINT=NUMBER for some. Default: what the logs state, or else the robot's file."""
    skip_bad: bool = False
    """Cut bad rows and leave out logs that cannot be read. Without this option one bad log refuses
    the whole import."""


@dataclass(frozen=True, kw_only=True)
class ImportRequest(ImportOptions):
    """How logs are read, and whose they are; what is not stated is as the format has it."""

    unit_id: str | None = None
    """Name of the recorded robot."""
    payload_mass: float | None = None
    """kg in each hand."""

    def labels(self, robot: RobotSpec) -> dict[str, Any]:
        """Return the labels that are given, as fields of SequenceMeta; a gain is NaN for joints
        that are not named.

        Raises:
            UsageError: The robot has no such hand or joint, or a gain is no number.
        """
        if self.payload_side is not None:
            _require_side(robot, self.payload_side)
        labels = {
            "unit_id": self.unit_id,
            "payload_mass": self.payload_mass,
            "payload_side": self.payload_side,
            "level": self.level,
            "kp": _parse_gains("kp", self.kp, robot),
            "kd": _parse_gains("kd", self.kd, robot),
        }
        return {name: value for name, value in labels.items() if value is not None}


def import_logs(
    src: str | Path,
    robot: RobotSpec,
    out: str | Path,
    request: ImportRequest,
    *,
    gravity: Gravity | None = None,
    simulator: str = "",
    progress: Progress = no_progress,
) -> ImportResult:
    """Import every recording under a path that the dataset does not hold yet.

    A bad recording refuses all of them.

    What was written before a full disk or a kill stays, complete, and the same call adds the rest.

    Args:
        gravity: Gravity of the nominal model, to measure offsets (data.offsets); default: no
            offsets.
        simulator: Hash of that model, recorded beside the offsets.

    Raises:
        LogError, JointMismatchError: A recording cannot be read; the message names file and line.
        UsageError: Unit or payload are missing, or contradict what the format states.
        DatasetError: `out` is another robot's, a recording is in the source twice, or in `out`
            under other labels.
        FolderError: `out` is something else, or another process writes into it.
    """
    src = Path(src)
    out = Path(out)
    labels = request.labels(robot)
    if request.cut is not None:
        _require_piece(request.cut)
    with lock_folder(out, KIND):
        existing = Dataset.open_existing(out, robot)
        if existing is not None:
            read_offsets(existing)  # a damaged file is refused before anything is read
        source = _Source(src, robot, labels, request.cut, request)
        with skip_bad_rows(request.skip_bad) as skipped:
            source.check(existing, progress)
            dataset = Dataset.create(out, robot)
            poses: dict[str, StaticPoses] = {}
            added, present = source.write(dataset, poses if gravity else None)
        offsets: dict[str, dict[str, JointOffset]] = {}  # unit → joint → offset
        if gravity is not None:
            for unit in dict.fromkeys(entry.meta.unit_id for entry in (*present, *added)):
                offsets[unit] = unit_offsets(dataset, robot, unit, gravity, poses)
        for unit, of_unit in offsets.items():
            record_offsets(dataset, unit, of_unit, simulator)
    only = next(iter(offsets.values())) if len(offsets) == 1 else None
    cut_rows = tuple(dict.fromkeys(skipped or ()))
    return ImportResult(dataset, robot, tuple(added), tuple(present), only, cut_rows)


def _require_piece(seconds: float) -> None:
    if not seconds >= MIN_PIECE_S:
        raise UsageError(f"--cut {seconds:g}: pieces are {MIN_PIECE_S} s long or more")


@dataclass
class _Source:
    """Logs to import, with what the user states of them.

    `check` fills hashes, held and provenance, and `write` needs them.
    """

    src: Path
    robot: RobotSpec
    labels: dict[str, Any]  # fields of SequenceMeta that the user states
    cut: float | None  # length of pieces, s
    options: ReadOptions
    hashes: list[str] = field(default_factory=list)  # of the content of each recording or piece
    # the recordings; None if they are more than MAX_HELD_BYTES
    held: list[Sequence] | None = field(default_factory=list)
    provenance: dict[str, str] = field(default_factory=dict)  # licence and source that logs state

    def check(self, existing: Dataset | None, progress: Progress) -> None:
        """Read every recording; refuse those that are in the source twice, or in the dataset under
        other labels.

        Args:
            existing: Dataset into which they will be written; None if it is new.
        """
        total = len(find_logs(self.src, self.options.format))
        source_of: dict[str, str] = {}  # content hash → source
        read_of: dict[_LogIdentity, set[str]] = {}  # log → content hashes of what is read of it
        duplicates: list[tuple[str, str]] = []
        size = 0
        for sequence, log in self.sequences():
            content_hash = sequence.content_hash()
            source = sequence.meta.source
            self.hashes.append(content_hash)
            first = source_of.get(content_hash)
            # Pieces of one recording may be equal, where the robot rested.
            if first is not None and not (self.cut and first == source):
                duplicates.append((source, first))
            source_of.setdefault(content_hash, source)
            read_of.setdefault(_log_identity(sequence.meta), set()).add(content_hash)
            if existing is not None:
                _refuse_relabelled(sequence, existing)
                _refuse_other_gains(sequence, existing, self.labels)
            self.provenance |= log.meta.get("dataset", {})
            size += _count_bytes(sequence)
            if size > MAX_HELD_BYTES:
                self.held = None
            if self.held is not None:
                self.held.append(sequence)
            progress(len(self.hashes), max(total, len(self.hashes)), sequence.meta.motion)
        if not self.hashes:
            left_out = skipped_rows()
            if left_out:
                raise LogError(
                    f"no recording is left of {len(left_out)}; the first was {left_out[0]}"
                )
            raise LogError(f"{self.src}: no recording found")
        if duplicates:
            again, first = duplicates[0]
            raise DatasetError(
                f"{len(duplicates)} of {len(self.hashes)} recordings are there twice (same "
                f"samples, unit and payload): {again} is {first}. Nothing was imported; leave one "
                "of them out"
            )
        if existing is not None:
            _refuse_read_otherwise(read_of, existing)

    def write(
        self, dataset: Dataset, poses: dict[str, StaticPoses] | None
    ) -> tuple[list[Entry], list[Entry]]:
        """Append what is new; return the added and the present entries.

        Call `check` first.

        Args:
            poses: Filled with content hash → static poses, of what is present too; None: not
                measured.
        """
        if self.provenance and not dataset.entries:
            dataset.set_provenance(**self.provenance)
        found = map(dataset.find, self.hashes)
        present = [entry for entry in found if entry is not None]
        repetitions: Counter[tuple[Any, ...]] = Counter()  # the next number of each slot
        for entry in dataset.entries:
            key = entry.meta.repetition_key
            repetitions[key] = max(repetitions[key], entry.meta.repetition + 1)
        sequences: Iterable[Sequence]
        if self.held is None:  # too large to hold: read again
            sequences = (sequence for sequence, _ in self.sequences())
        else:
            sequences = self.held
        added = []
        with dataset.appending():
            for content_hash, sequence in zip(self.hashes, sequences, strict=True):
                if poses is not None:
                    poses[content_hash] = StaticPoses.of(sequence, self.robot.operated_index)
                if dataset.find(content_hash):  # present, or an equal piece was just added
                    continue
                key = sequence.meta.repetition_key
                if sequence.meta.repetition == UNSTATED_REPETITION:
                    numbered = replace(sequence.meta, repetition=repetitions[key])
                    sequence = replace(sequence, meta=numbered)
                added.append(dataset.append(sequence, measure_delays(sequence), content_hash))
                repetitions[key] = max(repetitions[key], sequence.meta.repetition + 1)
        return added, present

    def sequences(self) -> Iterator[tuple[Sequence, Log]]:
        """Yield every recording, or every piece, on its grid and with its labels."""
        file_hashes: dict[tuple[str, ...], str] = {}  # many episodes may be in one file
        for motion, log in read_logs(self.src, self.robot, self.options):
            files = tuple(sorted({*log.meta["files"].values(), *log.meta.get("all_files", ())}))
            if files not in file_hashes:
                file_hashes[files] = _sha256(files)
            meta = self._meta(log, motion, file_hashes[files])
            _require_side(self.robot, meta.payload_side)
            sequence = to_sequence(log, self.robot, meta)
            # an export of ours: notes of the first import
            if "notes" in log.meta.get("stated", {}):
                sequence = replace(sequence, meta=meta)
            for piece in _pieces(sequence, self.cut):
                yield piece, log

    def _meta(self, log: Log, motion: str, sha256: str) -> SequenceMeta:
        """Combine what the user and the format state; refuse contradictions and gaps."""
        stated: dict[str, Any] = {}
        for name, value in log.meta.get("stated", {}).items():
            if value is not None:
                stated[name] = tuple(value) if name in ("kp", "kd") else value
        labels = self.labels | self._gains(log, stated)
        for name, value in labels.items():
            if name in stated and stated[name] != value:
                flag = "--" + name.replace("_", "-")
                raise UsageError(
                    f"{log.source}: {flag} {value} contradicts the file's {stated[name]}; leave "
                    "it out"
                )
        needed = {
            "unit_id": "--unit-id NAME",
            "payload_mass": "--payload-mass 0 (kg in each hand, 0 when empty)",
        }
        missing = [flag for name, flag in needed.items() if name not in labels | stated]
        if missing:
            raise UsageError(
                f"{log.source}: this format does not state unit or payload: give "
                f"{' and '.join(missing)}"
            )
        # A relative path: no home folder gets into a dataset.
        root = Path(os.path.abspath(self.src)).parent
        source = Path(os.path.relpath(log.source, root)).as_posix()
        fields: dict[str, Any] = {
            "source": source,
            "source_sha256": sha256,
            "repetition": UNSTATED_REPETITION,
        }
        fields |= labels
        fields |= {"robot": self.robot.name, "motion": motion}
        return SequenceMeta(**(fields | stated))

    def _gains(self, log: Log, stated: dict[str, Any]) -> dict[str, tuple[float, ...]]:
        """Return the gains of all joints, (n), where the user states some: the others are what the
        recording states, or the robot's.
        """
        gains: dict[str, tuple[float, ...]] = {}
        for name in ("kp", "kd"):
            if name in self.labels:
                of_user = np.array(self.labels[name])
                of_log = stated.get(name) or recorded_gains(name, log, self.robot)
                gains[name] = tuple(np.where(np.isnan(of_user), of_log, of_user).tolist())
        return gains


def _count_bytes(sequence: Sequence) -> int:
    arrays = [getattr(sequence, name) for name in ARRAYS]
    return sum(array.nbytes for array in arrays if array is not None)


def _pieces(sequence: Sequence, seconds: float | None) -> Iterator[Sequence]:
    """Yield a recording, or equal pieces of it; each piece notes its start."""
    count = 1
    if seconds:
        count = max(1, round(sequence.duration / seconds))
    if count == 1:
        yield sequence
        return
    meta = sequence.meta
    rows = len(sequence) // count
    places = ".0" if rows * sequence.dt >= 1 else ".1"  # of the start, so that no two are the same
    for start in range(0, count * rows, rows):
        from_s = round(start * sequence.dt, 3)
        notes = meta.notes | {"from_s": from_s}
        named = replace(meta, motion=f"{meta.motion}@{from_s:{places}f}s", notes=notes)
        yield replace(sequence.rows(slice(start, start + rows)), meta=named)


def _parse_gains(
    name: str, stated: float | str | Iterable[float | str], robot: RobotSpec
) -> tuple[float, ...] | None:
    """Parse 17.8, ("17.8",) or ("elbow=9", …) to gains of all joints, (n); NaN for joints that are
    not named.
    """
    words = _words(stated)
    if not words:
        return None
    gains = np.full(len(robot.joint_names), np.nan)
    for word in words:
        joint, equals, number = word.rpartition("=")
        try:
            value = float(number)
        except ValueError:
            value = np.nan
        if not (np.isfinite(value) and value >= 0) or (not equals and len(words) > 1):
            raise UsageError(
                f"--{name} {word}: give one number ≥ 0 for all joints, or JOINT=NUMBER for some"
            )
        gains[robot.index([joint]) if equals else slice(None)] = value
    if len({word.rpartition("=")[0] for word in words}) < len(words):
        raise UsageError(f"--{name} {' '.join(words)}: names a joint twice")
    return tuple(gains.tolist())


def _words(stated: float | str | Iterable[float | str]) -> list[str]:
    """Return gains as the command line would state them, also of one that is given alone."""
    if isinstance(stated, str | float | int):
        return [str(stated)]
    return [str(word) for word in stated]


def measure_delays(sequence: Sequence) -> Findings:
    """Return by joint: delay_s, lag of the state (None if the motion does not show it), and
    fast_speed.
    """
    delay = estimate_delay(sequence.ctrl, sequence.qpos, sequence.dt)
    speed = fast_speed(sequence.ctrl, sequence.dt)
    delay[[name in sequence.copied for name in sequence.joint_names]] = np.nan
    return {
        "delay_s": _rounded(sequence.joint_names, delay),
        "fast_speed": _rounded(sequence.joint_names, speed),
    }


def _rounded(joint_names: tuple[str, ...], values: Array) -> dict[str, float | None]:
    """Return values (n) by joint, None for one that is not finite."""
    rounded = {}
    for name, value in zip(joint_names, values, strict=True):
        rounded[name] = round(float(value), 4) if np.isfinite(value) else None
    return rounded


def _refuse_relabelled(sequence: Sequence, existing: Dataset) -> None:
    """Refuse samples that the dataset holds under another unit or payload: one of the labels is
    wrong.
    """
    meta = sequence.meta
    labels = _labels(meta)
    same_length = [entry for entry in existing.entries if entry.rows == len(sequence)]
    for other_labels in {_labels(entry.meta) for entry in same_length} - {labels}:
        unit, mass, side = other_labels
        relabelled = replace(meta, unit_id=unit, payload_mass=mass, payload_side=side)
        entry = existing.find(replace(sequence, meta=relabelled).content_hash())
        if entry is not None:
            raise DatasetError(
                f"{meta.source}: known samples under new labels: {existing.path} holds them as "
                f"unit {unit}, {mass:g} kg ({side}), not unit {meta.unit_id}, "
                f"{meta.payload_mass:g} kg ({meta.payload_side}). Nothing was imported; where the "
                f"old label is the wrong one: gaponet data remove {existing.path} {entry.id}"
            )


def _refuse_other_gains(sequence: Sequence, existing: Dataset, stated: dict[str, Any]) -> None:
    """Refuse gains that are stated of a recording that the dataset holds with others: it would
    keep the old ones.

    Args:
        stated: Labels that the user states.
    """
    present = existing.find(sequence.content_hash())
    if present is None:
        return
    for name in ("kp", "kd"):
        old = getattr(present.meta, name)
        new = getattr(sequence.meta, name)
        if name in stated and old is not None and old != new:
            raise DatasetError(
                f"{sequence.meta.source}: is in the dataset with another {name}, {list(old)} "
                f"instead of {list(new)}. Nothing was imported; to replace it, first: "
                f"gaponet data remove {existing.path} {present.id}"
            )


# Of which log a recording was read: hash of its files, part of the file, unit.
_LogIdentity = tuple[str, str, str]


def _log_identity(meta: SequenceMeta) -> _LogIdentity:
    _, _, part = meta.source.partition("#")
    return meta.source_sha256, part, meta.unit_id


def _refuse_read_otherwise(read_of: dict[_LogIdentity, set[str]], existing: Dataset) -> None:
    """Refuse a log that the dataset holds read otherwise, such as cut or with another sign: its
    samples would be there twice, some perhaps in training and some in the test.

    Args:
        read_of: Log → content hashes of the recordings that are read of it now.
    """
    for entry in existing.entries:
        now = read_of.get(_log_identity(entry.meta))
        if now is None or entry.hash in now:
            continue
        if all(existing.find(content_hash) for content_hash in now):
            continue
        raise DatasetError(
            f"{entry.meta.source}: is in {existing.path} as {entry.id}, read in another way (cut, "
            "rate, signs, units or columns). Nothing was imported; use another folder, or first: "
            f"gaponet data remove {existing.path} {entry.id}"
        )


def _labels(meta: SequenceMeta) -> tuple[str, float, str]:
    """Return unit, payload and side: what a person says of a recording, and may say wrongly."""
    return meta.unit_id, meta.payload_mass, meta.payload_side


def _require_side(robot: RobotSpec, side: str) -> None:
    sides = ("both", *(mount.side for mount in robot.payload_mounts))
    if side not in sides:
        raise UsageError(
            f"payload side '{side}' is unknown to {robot.name}; use one of {', '.join(sides)}"
        )


def _sha256(files: tuple[str, ...]) -> str:
    """Return the SHA-256 of files one after the other (cat control.csv state_motor.csv)."""
    digest = hashlib.sha256()
    for file in files:
        with Path(file).open("rb") as content:
            hashlib.file_digest(content, lambda: digest)
    return digest.hexdigest()
