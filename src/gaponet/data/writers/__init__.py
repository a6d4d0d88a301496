"""A dataset out again, as a set of LeRobot's format, which loses nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from gaponet.base.errors import DatasetError
from gaponet.base.files import FOLDER_MARKER, clear_folder, flush_to_disk, lock_folder
from gaponet.base.progress import Progress, no_progress
from gaponet.data.store import Dataset
from gaponet.data.writers.lerobot import Written, write


def export(dataset: Dataset, out: str | Path, progress: Progress = no_progress) -> list[Written]:
    """Write a dataset as LeRobotDataset v3.0, one set for each rate.

    Args:
        out: New or empty folder; appears when the export is complete.

    Raises:
        DatasetError: Nothing to write, or a folder that holds something.
    """
    out = Path(out)
    dataset.require_sequences()
    if out.name in ("", ".."):
        raise DatasetError(f"{out}: name a new folder")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise DatasetError(f"{out}: exists and is not an empty folder; choose a new one")
    done = 0

    def tell(motion: str) -> None:
        nonlocal done
        done += 1
        progress(done, len(dataset), motion)

    temporary = out.with_name(f"{FOLDER_MARKER}-{out.name}")
    with lock_folder(temporary, "export"):
        clear_folder(temporary)  # of an export that was killed
        try:
            written = write(dataset, temporary, tell)
            for path in temporary.rglob("*"):
                flush_to_disk(path)
            if out.exists():
                out.rmdir()
            temporary.rename(out)
        except BaseException:
            clear_folder(temporary)
            raise
        (out / FOLDER_MARKER).unlink()
    return [replace(w, path=out / w.path) for w in written]
