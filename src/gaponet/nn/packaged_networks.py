"""Networks of the package by name, as load_robot has robots by name.

PACKAGE_FOLDER/NAME has these files:

    model.onnx           the network
    card.json            what it is, and how good it is
    split.json           hashes of its recordings
    delay_offset.json    the delay and offset baseline
    packaged_robot.json  its simulator: a robot of the package and the factor on its gains

`benchmarks/ship_networks.py` makes such a folder from a run. Nothing writes into it afterwards.
"""

from __future__ import annotations

import difflib
from pathlib import Path

from gaponet.base.errors import ModelError, UsageError
from gaponet.robot.by_name import Catalogue, hub_folder, identified_catalogue, is_from_hub

PACKAGE_FOLDER = Path(__file__).parent / "trained"
MAX_TOTAL_BYTES = 2_000_000  # of all networks together, so that the wheel stays small


def catalogue() -> Catalogue:
    """Return the networks of the package."""
    return Catalogue("network", PACKAGE_FOLDER)


def packaged_networks() -> tuple[str, ...]:
    """Return the names of the networks in the package."""
    return catalogue().names()


def named_folder(name_or_path: str | Path) -> Path:
    """Return the folder of a network or an identified robot of the package or of the Hub, or the
    path itself.

    Args:
        name_or_path: Name, path, or address hf://USER/NAME.

    Raises:
        UsageError: The name is one of the package, and of something in the working directory.
        ModelError: There is neither such a name nor a file or folder.
    """
    text = str(name_or_path)
    path = Path(name_or_path)
    found = (
        catalogue().find(name_or_path)
        or identified_catalogue().find(name_or_path)
        or hub_folder(name_or_path)
    )
    if found is not None:
        return found
    if path.name == text != ".." and not path.exists():
        raise ModelError(_unknown(text))
    return path


def is_packaged_network(folder: Path) -> bool:
    """Return True for the folder of a network of the package."""
    return catalogue().holds(folder)


def is_packaged(folder: Path) -> bool:
    """Return True for a folder of the package or of the Hub's cache, which is never written to."""
    packaged = is_packaged_network(folder) or identified_catalogue().holds(folder)
    return packaged or is_from_hub(folder)


def require_run_folder(run: Path, action: str, instead: str) -> None:
    """Refuse a network of the package where a run folder of gaponet train is needed.

    Args:
        action: What needs one, such as "gaponet report"; it begins the error.
        instead: What to do, for the error.

    Raises:
        UsageError: The folder is that of a network of the package.
    """
    if is_packaged_network(run):
        raise UsageError(
            f"{action} needs a run folder of gaponet train, and '{run.name}' is a network of the "
            f"package; {instead}"
        )


def _unknown(name: str) -> str:
    """Return the error for a name that the package does not have and that is no path."""
    from gaponet.robot.spec import only_as_its_maker_states_it

    nominal = only_as_its_maker_states_it(name)
    if nominal:
        return nominal
    names = (*packaged_networks(), *identified_catalogue().names())
    if not names:
        return f"{name}: no such folder, and the package has no names; give a robot or run folder"
    nearest = difflib.get_close_matches(name, names, n=1, cutoff=0.0)[0]
    return (
        f"{name}: no such folder, and no name of the package, which has {', '.join(names)}; "
        f"nearest: {nearest}; or give a robot or run folder"
    )
