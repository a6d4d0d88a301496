"""Robots and trained networks that people name: folders of the package, and hf://USER/NAME of the
Hugging Face Hub.

Identified robots of the package are here, its networks in nn/packaged_networks.py:

    IDENTIFIED/ROBOT@DATA/
        robot.toml, robot.xml  the identified robot
        card.json              what it is, and how good it is
        identified.json        hashes of its data
        uncertainty.json       of its values
        plain_servos.json      its nearest PD servos, for export without recordings

`benchmarks/ship_robots.py` makes such a folder from one of `gaponet identify`. The Hub's own
library keeps what it downloads in its cache, by commit. Nothing writes into either afterwards.
"""

from __future__ import annotations

import os
import re
import tomllib
from dataclasses import dataclass
from pathlib import Path

from gaponet.base.errors import RobotError, UsageError
from gaponet.base.network import network_errors

IDENTIFIED = Path(__file__).parent / "identified"
CARD = "card.json"
ADDRESS = re.compile(r"hf:/+(?=[^/])")  # a path of the command line has lost one of the slashes
SNAPSHOTS = "snapshots"  # folder of the Hub's cache that holds a folder for each commit
FILE_REFERENCES = re.compile(r"<include\b|\bfile\s*=|\b(mesh|texture|asset)dir\s*=")
# What a robot folder has, and what a run has that is not trained further.
FILES = (
    "robot.toml",
    "robot.xml",
    "collision.toml",
    "look.toml",
    "identified.json",
    "uncertainty.json",
    "config.json",
    "split.json",
    "delay_offset.json",
    "model/card.json",
    "model/model.onnx",
    "robot/robot.toml",
    "robot/robot.xml",
    "robot/collision.toml",
    "robot/look.toml",
    "robot/identified.json",
)


@dataclass(frozen=True)
class Catalogue:
    """Folders of one kind in the package.

    Attributes:
        what: Noun for messages.
        place: Folder that holds them; each has a card.
    """

    what: str
    place: Path

    def folders(self) -> tuple[Path, ...]:
        """Return the folders, by name."""
        return tuple(sorted(file.parent for file in self.place.glob(f"*/{CARD}")))

    def names(self) -> tuple[str, ...]:
        """Return the names."""
        return tuple(folder.name for folder in self.folders())

    def holds(self, folder: Path) -> bool:
        """Return True for a folder of the package."""
        return folder.parent == self.place

    def find(self, name_or_path: str | Path) -> Path | None:
        """Return the folder of a name; None if the package has no such name, or if it is a path.

        One word without a slash is a name if the package has it. The command line drops the slash
        of "./so101@sage", so a folder of that name in the working directory needs its absolute
        path.

        Raises:
            UsageError: It is a name of the package, and of something in the working directory.
        """
        text = str(name_or_path)
        path = Path(name_or_path)
        if path.name != text or text not in self.names():
            return None
        if path.exists():
            raise UsageError(
                f"'{text}' is a {self.what} of the package and a folder here; for the folder give "
                f"{path.absolute()}, for the {self.what} work in another directory"
            )
        return self.place / text


def identified_catalogue() -> Catalogue:
    """Return the identified robots of the package."""
    return Catalogue("robot", IDENTIFIED)


def hub_folder(name_or_path: str | Path) -> Path | None:
    """Return the folder of a robot or a run of the Hub, downloaded if need be; None if it is no
    address of the Hub.

    Args:
        name_or_path: hf://USER/NAME, with @REVISION behind it for another branch, tag or commit
            than main.

    Raises:
        RemoteError: It cannot be reached.
        RobotError: Its robot names other files, which could be any of this machine.
    """
    text = str(name_or_path)
    if not ADDRESS.match(text):
        return None
    from huggingface_hub import snapshot_download

    repository, _, revision = ADDRESS.sub("", text).partition("@")
    with network_errors(f"hf://{repository}"):
        folder = Path(
            snapshot_download(
                repository,
                revision=revision or None,
                endpoint=os.environ.get("HF_ENDPOINT"),
                allow_patterns=list(FILES),
            )
        )
    for place in (folder, folder / "robot"):
        if (place / "robot.toml").is_file():
            require_self_contained(place)
    return folder


def is_from_hub(folder: Path) -> bool:
    """Return True for a folder in the cache of the Hub."""
    return folder.parent.name == SNAPSHOTS


def require_self_contained(folder: Path) -> None:
    """Refuse a stored robot whose MJCF names other files: a downloaded one could name any file of
    this machine.
    """
    try:
        table = tomllib.loads((folder / "robot.toml").read_text(encoding="utf-8"))
    except ValueError:  # load_robot says what is wrong
        table = {}
    if table.get("mjcf", "robot.xml") != "robot.xml":
        raise RobotError(f"{folder}: robot.toml names another MJCF than its robot.xml")
    file = folder / "robot.xml"
    if not file.is_file() or FILE_REFERENCES.search(
        file.read_text(encoding="utf-8", errors="replace")
    ):
        raise RobotError(f"{file}: is missing, or names other files; a stored robot needs none")
