"""Why nothing under a path is a log: files to be unpacked, converted or downloaded first."""

from __future__ import annotations

import re
from pathlib import Path

from gaponet.data.describe.raw_recording import require_content

PACKED = (".zip", ".gz", ".tgz", ".tar", ".bz2", ".xz", ".zst", ".7z", ".rar")
SPREADSHEETS = (".xlsx", ".xls", ".ods")
JSON = (".json", ".jsonl", ".ndjson")
TEXT = (".txt", ".dat")
MAX_FILES = 2000  # that are looked at
OWN_RUN = ".cycles.npy"  # as hw/control/rows.py names the periods of a run on a robot
ADDRESS = re.compile(r"(hf|https?|s3|gs):/+(?:datasets/)?(.*)")


def why_unread(path: Path, files: list[Path]) -> str:
    """Return what to do with files that are no log as they lie there; "" if nothing is known.

    Args:
        files: Those at or below the path.

    Raises:
        LogError: One of them is a Git LFS pointer.
    """
    by_suffix: dict[str, Path] = {}
    for file in files[:MAX_FILES]:
        require_content(file)
        by_suffix.setdefault(file.suffix.lower(), file)
    for suffix, file in by_suffix.items():
        name = file.relative_to(path) if path.is_dir() else file.name
        if suffix in PACKED:
            return f". {name} is packed: unpack it first"
        if suffix in SPREADSHEETS:
            return f". {name} is a spreadsheet: save its sheet as CSV"
        if file.name.endswith(OWN_RUN):
            return (
                f". {name} has the periods of a run of gaponet whose motion did not begin; the "
                f"events in {file.name.removesuffix(OWN_RUN)}.json say why"
            )
        if suffix == ".npy":
            return (
                f". {name} is one array without a name: put command, position and time into one "
                "file: numpy.savez('log.npz', time=…, ctrl=…, qpos=…)"
            )
        if suffix in JSON:
            return (
                f'. {name} is JSON: make a table of it: python -c "import pandas; '
                f"pandas.read_json('{name}', lines={suffix != '.json'})"
                f".to_parquet('{file.stem}.parquet')\""
            )
        if suffix in TEXT:
            return f". If {name} is a table, say --format table"
    return ""


def what_address(path: Path) -> str:
    """Return how to get what an address names, such as hf://USER/DATASET; "" for a path."""
    match = ADDRESS.fullmatch(path.as_posix())
    if match is None:
        return ""
    if match[1] != "hf":
        return ": an address; download what it names, and import the folder"
    name = "/".join(match[2].split("/")[:2])  # without a file or folder in the dataset
    return (
        f": an address of the Hugging Face Hub; gaponet import hf://{name} reads the whole dataset "
        "there, other commands read the dataset that it makes"
    )
