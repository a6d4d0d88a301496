"""Datasets out again, one file per format that others read. A writer loses nothing that its format can hold.

A writer is a module with `write_recording(entry, sequence, robot, folder)`, which writes one recording below the folder
and returns the path in it; or, for a format that holds several in a file, with `write(dataset, folder, tell)`, which
calls tell with the motion of each recording. A format that cannot hold unit, payload and gains says SHEET = True: it
gets a logs.toml and a sheet, by which gaponet import reads it back without options.
"""

from __future__ import annotations

import csv
import io
import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

from gaponet.base.errors import DatasetError, UsageError
from gaponet.base.files import FOLDER_MARKER, flush_to_disk, lock_folder, write_text
from gaponet.base.progress import Progress, no_progress
from gaponet.data.store import Dataset, Entry
from gaponet.robot.spec import RobotSpec

WRITERS = {
    name: f"gaponet.data.writers.{name}" for name in ("sage", "npz", "lerobot", "asap", "mcap")
}


@dataclass(frozen=True)
class Written:
    """One set or file of an export."""

    path: Path
    episodes: int
    frames: int
    fps: float


def export(
    dataset: Dataset, robot: RobotSpec, out: str | Path, to: str, progress: Progress = no_progress
) -> list[Written]:
    """Write a dataset in a format of others.

    Args:
        robot: The robot, whose units and home the format may need.
        out: New or empty folder; appears when the export is complete.
        to: One of WRITERS.

    Raises:
        DatasetError, UsageError: Nothing to write, a folder that holds something, or no such format.
    """
    out = Path(out)
    if to not in WRITERS:
        raise UsageError(f"no writer '{to}'; use one of {', '.join(WRITERS)}")
    writer = import_module(WRITERS[to])
    dataset.require_sequences()
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise DatasetError(f"{out}: exists and is not an empty folder; choose a new one")
    done = 0

    def tell(motion: str) -> None:
        nonlocal done
        done += 1
        progress(done, len(dataset), motion)

    temporary = out.with_name(f"{FOLDER_MARKER}-{out.name}")
    with lock_folder(temporary, "export"):
        _empty(temporary)  # of an export that was killed
        try:
            written: list[Written] = []
            if hasattr(writer, "write"):
                written = writer.write(dataset, temporary, tell)
            else:
                for entry in dataset.entries:
                    path = writer.write_recording(entry, dataset.read(entry), robot, temporary)
                    written.append(Written(path, 1, entry.rows, 1 / entry.dt))
                    tell(entry.meta.motion)
            if getattr(writer, "SHEET", False):
                _describe(dataset, temporary)
            for path in temporary.rglob("*"):
                flush_to_disk(path)
            if out.exists():
                out.rmdir()
            temporary.rename(out)
        except BaseException:
            _empty(temporary)
            raise
        (out / FOLDER_MARKER).unlink()
    return [replace(w, path=out / w.path) for w in written]


def _describe(dataset: Dataset, folder: Path) -> None:
    """logs.toml and sheet.csv: what the format cannot say of each recording."""
    joints = dataset.joint_names
    gains = [f"{name}.{joint}" for name in ("kp", "kd") for joint in joints]
    text = io.StringIO()
    rows = csv.DictWriter(
        text, ["file", "motion", "unit", "payload", "side", "rep", "level", "virtual", *gains]
    )
    rows.writeheader()
    for entry in dataset.entries:
        m = entry.meta
        known = {
            f"{n}.{j}": repr(g)
            for n in ("kp", "kd")
            for j, g in zip(joints, getattr(m, n) or (), strict=False)
        }
        rows.writerow(
            {"file": entry.id, "motion": m.motion, "unit": m.unit_id, "payload": repr(m.payload_mass),
             "side": m.payload_side, "rep": m.repetition, "level": m.level, "virtual": "yes" if m.virtual else "no"}
            | known
        )  # fmt: skip
    write_text(folder / "sheet.csv", text.getvalue())
    write_text(folder / "logs.toml", 'manifest = "sheet.csv"\n')


def stated(entry: Entry) -> dict[str, Any]:
    """Return all of a recording's metadata but the robot."""
    return {k: v for k, v in asdict(entry.meta).items() if k != "robot" and v is not None}


def _empty(folder: Path) -> None:
    for child in folder.iterdir():
        if child.name != FOLDER_MARKER:
            shutil.rmtree(child) if child.is_dir() else child.unlink()


Tell = Callable[[str], None]
