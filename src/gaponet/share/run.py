"""The files of a run that are pushed: those that load, evaluate and resume it, and no HTML."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

from gaponet.base.errors import ModelError
from gaponet.base.files import lock_folder, write_text
from gaponet.base.network import RemoteError
from gaponet.evaluation.run_files import read_config, read_metrics
from gaponet.nn.artifact import CARD, WEIGHTS, GapModel, sha256
from gaponet.robot.by_name import require_self_contained
from gaponet.robot.folder import (
    STORED_ROBOT,
    has_stored_robot,
    load_stored_robot,
)
from gaponet.share.readme import ModelFacts, run_readme
from gaponet.share.remote import Index

README = "README.md"
FILES = {
    "config.json",
    "split.json",
    "delay_offset.json",
    "metrics.json",
    "progress.jsonl",
    "trajectories.npz",
    "gap.json",
    "checkpoint.pt",
    "robot/robot.toml",
    "robot/robot.xml",
    "robot/collision.toml",
    "robot/look.toml",
    "robot/identified.json",
    "model/card.json",
    "model/model.onnx",
}
ADAPTATION = re.compile(r"adaptation/[A-Za-z0-9._-]+\.json")  # one for each adapted unit


def write_files(run: Path, folder: Path, address: str, facts: ModelFacts) -> tuple[str, ...]:
    """Copy the files of a run, with a README, into an empty folder; return the hash of its
    network.
    """
    if not (run / "model" / CARD).is_file():
        raise ModelError(f"{run}: no model yet; train it first")
    write_text(folder / README, run_readme(_facts(run), address, facts))
    for file in sorted(run.rglob("*")):
        path = file.relative_to(run).as_posix()
        if file.is_file() and _is_pushed(path):
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, folder / path)
    return (sha256(run / "model" / WEIGHTS),)


def require_files(index: Index) -> None:
    """Refuse an index with files that no run has."""
    for path in index.files.keys() - {README}:
        if not _is_pushed(path):
            raise RemoteError(f"{path}: a run has no such file")


def _is_pushed(path: str) -> bool:
    """Return True for a file of a run that a push holds, by its path below the run."""
    return path in FILES or ADAPTATION.fullmatch(path) is not None


def require_pushed(folder: Path, index: Index) -> None:
    """Check that downloaded files are the run that was pushed, and mark the folder as a run.

    Raises:
        GAPONetError: It is another network, or a file is invalid.
    """
    with lock_folder(folder, "run"):
        if sha256(folder / "model" / WEIGHTS) not in index.contents:
            raise RemoteError(
                "model/model.onnx is not the network that was pushed, by its hash; push it again"
            )
        _facts(folder)
    shutil.rmtree(folder / ".cache", ignore_errors=True)  # of huggingface_hub


def _facts(run: Path) -> dict[str, Any]:
    """Read and check the files of a run; return model card, configuration, newest metrics and hash
    of the weights.
    """
    if has_stored_robot(run):
        require_self_contained(run / STORED_ROBOT)
    config = read_config(run)
    model = GapModel.load(run)
    load_stored_robot(run, config["robot"])
    metrics = read_metrics(run) if (run / "metrics.json").is_file() else None
    return {
        "card": model.card,
        "config": config,
        "metrics": metrics,
        "weights": model.weights_hash(),
    }
