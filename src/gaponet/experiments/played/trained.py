"""The trained models that an experiment compares: run folders → method, seed, artifact and simulator corrected."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from pathlib import Path

from gaponet.base.errors import UsageError
from gaponet.experiments.kept import read_kept
from gaponet.nn.artifact import GapModel
from gaponet.report.candidate import corrected_robot
from gaponet.report.methods import IDENTIFIED, method, title
from gaponet.robot.spec import RobotSpec

SAME = ("mlp_match=on",)  # changes that make no other method of it


@dataclass(frozen=True)
class Trained:
    """A trained model and the run that it comes from.

    Attributes:
        method: Kind of model, with identified+ in front where it corrects an identified simulator.
        robot: The simulator that it corrects.
    """

    method: str
    seed: int
    run: Path
    model: GapModel
    robot: RobotSpec


def load_trained(folders: ListOf[Path], robot: RobotSpec) -> list[Trained]:
    """Runs by method and seed, plain before identified.

    Args:
        folders: Run folders, or folders of them such as the cells of gaponet experiment compare, of which those that
            change something of a model are passed over.

    Raises:
        UsageError: Nothing there, the same method and seed twice, or a model that no loop can ask.
    """
    runs: list[Path] = []
    for folder in folders:
        if (folder / "model" / "card.json").is_file():
            runs.append(folder)
            continue
        cards = [c for place in ("*", "cells/*") for c in folder.glob(f"{place}/model/card.json")]
        inside = sorted(card.parent.parent for card in cards)
        runs += [run for run in inside if not _changed(run)]
    if not runs:
        names = ", ".join(map(str, folders))
        raise UsageError(f"--runs {names}: no run of gaponet train or cells of gaponet experiment compare there")
    found: dict[tuple[str, int], Trained] = {}
    for run in runs:
        model = GapModel.load(run)
        corrected = corrected_robot(run, robot)
        model.require(corrected)
        key = method(model.config.kind, corrected), int(model.card["seed"])
        if key in found:
            raise UsageError(
                f"{run}: {title(key[0])} seed {key[1]} is there already ({found[key].run}); give one of them"
            )
        found[key] = Trained(*key, run, model, corrected)
    return [found[key] for key in sorted(found, key=lambda k: (k[0].startswith(IDENTIFIED), k[0] != "mlp", k))]


def _changed(run: Path) -> bool:
    file = run / "cell.json"
    return file.is_file() and bool(set(read_kept(file)["changes"]) - set(SAME))
