"""Networks of the package by name, as load_robot has robots by name.

PACKAGE_FOLDER/NAME/model.onnx           the network               card.json         what it is, and
                    how good it is split.json           hashes of its recordings  delay_offset.json
                    the delay and offset baseline packaged_robot.json  its simulator: a robot of the
                    package and the factor on its gains

`benchmarks/ship_networks.py` makes such a folder from a run. Nothing writes into it afterwards.
"""

from __future__ import annotations

import difflib
from pathlib import Path

from gaponet.base.errors import ModelError, UsageError

PACKAGE_FOLDER = Path(__file__).parent / "trained"
MAX_TOTAL_BYTES = 2_000_000  # of all networks together, so that the wheel stays small
CARD = "card.json"


def packaged_folders() -> tuple[Path, ...]:
    """Return the folders of the networks in the package, by name."""
    return tuple(sorted(file.parent for file in PACKAGE_FOLDER.glob(f"*/{CARD}")))


def packaged_networks() -> tuple[str, ...]:
    """Return the names of the networks in the package."""
    return tuple(folder.name for folder in packaged_folders())


def network_folder(name_or_path: str | Path) -> Path:
    """Return the folder of a network of the package, or the path itself.

    One word without a slash is a name if the package has a network of that name. All else is a
    path. The command line drops the slash of "./so101-sage", so a folder of that name in the
    working directory needs its absolute path.

    Raises:
        UsageError: The name is that of a network and of something in the working directory.
        ModelError: There is neither a network nor a file or folder of that name.
    """
    text = str(name_or_path)
    path = Path(name_or_path)
    if path.name != text or text == "..":
        return path
    if text in packaged_networks():
        if path.exists():
            raise UsageError(
                f"'{text}' is a network of the package and a folder here; for the folder give "
                f"{path.absolute()}, for the network work in another directory"
            )
        return PACKAGE_FOLDER / text
    if not path.exists():
        raise ModelError(_unknown(text))
    return path


def is_packaged(folder: Path) -> bool:
    """Return True for the folder of a network of the package. Such a folder is never written to."""
    return folder.parent == PACKAGE_FOLDER


def require_run_folder(run: Path, action: str, instead: str) -> None:
    """Refuse a network of the package where a run folder of gaponet train is needed.

    Args:
        action: What needs one, such as "gaponet report"; it begins the error.
        instead: What to do, for the error.

    Raises:
        UsageError: The folder is that of a network of the package.
    """
    if is_packaged(run):
        raise UsageError(
            f"{action} needs a run folder of gaponet train, and '{run.name}' is a network of the "
            f"package; {instead}"
        )


def _unknown(name: str) -> str:
    """Return the error for a name that is neither a network nor a path."""
    names = packaged_networks()
    if not names:
        return (
            f"{name}: no such folder, and the package has no networks; give a robot or run folder"
        )
    nearest = difflib.get_close_matches(name, names, n=1, cutoff=0.0)[0]
    return (
        f"{name}: no such folder, and no network of the package, which has {', '.join(names)}; "
        f"nearest: {nearest}; or give a robot or run folder"
    )
