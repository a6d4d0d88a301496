"""The trained models that an experiment compares, loaded from run folders."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from pathlib import Path

from gaponet.base.errors import UsageError
from gaponet.experiments.cells import RESULT_FILE, read_record
from gaponet.nn.artifact import GapModel
from gaponet.report.candidate import corrected_robot
from gaponet.report.methods import IDENTIFIED, method, title
from gaponet.robot.spec import RobotSpec

SAME_METHOD = ("mlp_match=on",)  # changed settings that leave the method's name as it is


@dataclass(frozen=True)
class TrainedModel:
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


def load_trained(folders: ListOf[Path], robot: RobotSpec) -> list[TrainedModel]:
    """Load runs, ordered by method and seed; models on the nominal simulator come first.

    Args:
        folders: Run folders, or folders of them such as the cells of gaponet experiment compare. Of the latter, cells
            with changed settings are left out.

    Raises:
        UsageError: No run, or the same method and seed twice.
        ModelError: The model does not fit the robot.
    """
    runs: list[Path] = []
    for folder in folders:
        if (folder / "model" / "card.json").is_file():
            runs.append(folder)
            continue
        cards = [c for place in ("*", "cells/*") for c in folder.glob(f"{place}/model/card.json")]
        inside = sorted(card.parent.parent for card in cards)
        runs += [run for run in inside if not _has_changed_settings(run)]
    if not runs:
        names = ", ".join(map(str, folders))
        raise UsageError(f"--runs {names}: no run of gaponet train or cells of gaponet experiment compare there")
    trained: dict[tuple[str, int], TrainedModel] = {}
    for run in runs:
        model = GapModel.load(run)
        corrected = corrected_robot(run, robot)
        model.require(corrected)
        key = method(model.config.kind, corrected), int(model.card["seed"])
        if key in trained:
            raise UsageError(
                f"{run}: {title(key[0])} seed {key[1]} is there already ({trained[key].run}); give one of them"
            )
        trained[key] = TrainedModel(*key, run, model, corrected)
    return [trained[key] for key in sorted(trained, key=lambda k: (k[0].startswith(IDENTIFIED), k[0] != "mlp", k))]


def _has_changed_settings(run: Path) -> bool:
    file = run / RESULT_FILE
    return file.is_file() and bool(set(read_record(file)["changes"]) - set(SAME_METHOD))
