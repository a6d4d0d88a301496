"""A run as the files that are pushed, and back: what loads, evaluates and resumes it; nothing that a browser runs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from gaponet.base.errors import ModelError
from gaponet.base.files import write_text
from gaponet.nn.artifact import CARD, WEIGHTS, GapModel, sha256
from gaponet.report.run_files import read_config, read_metrics
from gaponet.robot.folder import KEPT, keeps_robot, kept_robot, require_bare
from gaponet.share.errors import RemoteError
from gaponet.share.readme import run_readme
from gaponet.share.target import Index

README = "README.md"
FILES = re.compile(
    r"config\.json|split\.json|delay_offset\.json|metrics\.json|progress\.jsonl|trajectories\.npz|gap\.json|"
    r"checkpoint\.pt|calibration/[A-Za-z0-9._-]+\.json|robot/(robot\.toml|robot\.xml|collision\.toml|look\.toml|identified\.json)|"
    r"model/(inverse/)?(card\.json|model\.onnx|weights\.npz)"
)


def lay_out(run: Path, folder: Path, address: str) -> tuple[dict[str, Path], tuple[str, ...]]:
    """The files of a run by their paths, the README written into a folder; and the hash of its network."""
    if not (run / "model" / CARD).is_file():
        raise ModelError(f"{run}: no model yet; train it first")
    facts = facts_of(run)
    write_text(folder / README, run_readme(facts, address))
    there = (file for file in sorted(run.rglob("*")) if file.is_file())
    files = {place: file for file in there if FILES.fullmatch(place := file.relative_to(run).as_posix())}
    return files | {README: folder / README}, (sha256(run / "model" / WEIGHTS),)


def take_in(folder: Path, index: Index, out: Path) -> dict[str, Any]:
    """Move what was downloaded to a new run, and look whether it loads.

    Raises:
        RemoteError: A file is no file of a run, or the network is not the one that was pushed.
        GAPONetError: A file is not what it should be.
    """
    for place in index.files.keys() - {README}:
        if not FILES.fullmatch(place):
            raise RemoteError(f"{place}: a run has no such file; nothing was kept")
    for place in index.files.keys() - {README}:
        (out / place).parent.mkdir(parents=True, exist_ok=True)
        (folder / place).replace(out / place)
    if sha256(out / "model" / WEIGHTS) not in index.contents:
        raise RemoteError("model/model.onnx is not the network that was pushed, by its hash; push it again")
    return facts_of(out)


def facts_of(run: Path) -> dict[str, Any]:
    """What the card of the model and the newest evaluation say, all of it read and checked."""
    if keeps_robot(run):
        require_bare(run / KEPT)
    config, model = read_config(run), GapModel.load(run)
    kept_robot(run, config["robot"])
    metrics = read_metrics(run) if (run / "metrics.json").is_file() else None
    return {"card": model.card, "config": config, "metrics": metrics, "weights": model.weights_hash()}
