"""gaponet compare."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import tyro

from gaponet.cli.out import writes
from gaponet.cli.studies.experiment import Shared, carry_out
from gaponet.data.store import open_dataset
from gaponet.errors import ModelError, UsageError
from gaponet.progress import bar
from gaponet.study.compare import Compare, identified
from gaponet.study.options import Options
from gaponet.study.study import Study
from gaponet.training.config import TrainConfig


@writes("experiments")
def compare(
    dataset: tyro.conf.Positional[Path],
    out: Path,
    identify: tyro.conf.FlagCreatePairsOff[bool] = False,
    question: Annotated[Compare, tyro.conf.arg(name="")] = Compare(),  # noqa: B008
    options: Shared = Options(budget="10m", config=TrainConfig()),  # noqa: B008
) -> None:
    """Train several models with several seeds and put them into one table and one figure, baselines beside them.

    Writes compare.json, .csv, .md, .svg and .png into OUT, and each run into OUT/cells. The same command again goes on
    where it was; more seeds or models may be added to it.

    Args:
        dataset: Dataset folder.
        out: Folder of the comparison.
        identify: Identify the simulator first and show it beside; kept in OUT/identified.
        question: What is compared.
        options: Shared.
    """
    data, robot = open_dataset(dataset, options.robot)
    data.require_robot(robot)
    if identify and robot.nominal is not None:
        raise UsageError(f"--identify: robot {options.robot} is an identified one already; all models start from it")
    study = Study.of(data, robot, out, options, question.holdout_units, one_rate=False)
    for word in question.models:
        if not identify:
            study.variant(word)  # refused before anything takes time
    if identify:
        with bar("identifying") as update:
            study = replace(study, identified=identified(study, update))
    failed = carry_out(question, study, options.json)
    if failed:
        raise ModelError(f"{failed} trainings failed; the table is of the others. Run it again to retry")
