"""The files of a robot folder that are pushed: those that load it and say how sure its values are,
and no HTML.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from gaponet.base.errors import UsageError
from gaponet.base.files import FOLDER_MARKER, write_json, write_text
from gaponet.base.network import RemoteError
from gaponet.evaluation.candidate import read_origin
from gaponet.robot.by_name import require_self_contained
from gaponet.robot.folder import COPIED_FILES, PROVENANCE_FILE, save_robot
from gaponet.robot.spec import load_robot
from gaponet.share.readme import ModelFacts, robot_readme
from gaponet.share.remote import FileRecord, Index
from gaponet.sim.model import model_hash

README = "README.md"
DESCRIPTION = ("robot.toml", "robot.xml")  # the robot itself; the other files say more about it


def write_files(robot: Path, folder: Path, address: str, facts: ModelFacts) -> tuple[str, ...]:
    """Write a robot, with a README, into an empty folder; return the hashes of its description.

    Raises:
        UsageError: Nothing was identified of the robot.
    """
    spec = load_robot(robot)
    if not spec.is_identified:
        raise UsageError(f"{robot}: nothing was identified of this robot; gaponet identify does")
    save_robot(spec, folder)
    (folder / FOLDER_MARKER).unlink()
    hide_place_of_dataset(folder)
    origin = read_origin(folder)
    require_self_contained(folder)
    write_text(folder / README, robot_readme(load_robot(folder), origin, address, facts))
    return _contents(folder)


def hide_place_of_dataset(robot: Path) -> None:
    """Let a robot folder name the dataset that it was identified from, and not where it lies on
    this machine.
    """
    origin = read_origin(robot)
    if origin is not None:
        name = Path(origin["dataset"]).name
        write_json(robot / PROVENANCE_FILE, dict(origin) | {"dataset": name})


def require_files(index: Index) -> None:
    """Refuse an index with files that no robot has."""
    unknown = index.files.keys() - {README, *DESCRIPTION, *COPIED_FILES}
    if unknown:
        raise RemoteError(f"{min(unknown)}: a robot has no such file")


def require_pushed(folder: Path, index: Index) -> None:
    """Check that downloaded files are the robot that was pushed, and mark the folder as a robot.

    Raises:
        GAPONetError: It is another robot, or a file is invalid.
    """
    require_self_contained(folder)
    if _contents(folder) != index.contents:
        raise RemoteError("robot.toml and robot.xml are not what was pushed; push it again")
    model_hash(load_robot(folder))  # raises an error for an invalid robot
    shutil.rmtree(folder / ".cache", ignore_errors=True)  # of huggingface_hub
    write_text(folder / FOLDER_MARKER, "robot\n")


def _contents(folder: Path) -> tuple[str, ...]:
    return tuple(FileRecord.of(folder / name).sha256 for name in DESCRIPTION)
