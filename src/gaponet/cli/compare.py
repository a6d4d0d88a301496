"""gaponet compare."""

from __future__ import annotations

import json as js
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from gaponet.cli.inputs import open_dataset
from gaponet.cli.out import Out, writes
from gaponet.cli.progress import bar, bars
from gaponet.errors import ModelError, UsageError
from gaponet.robot import RobotSpec, load_robot
from gaponet.train.config import TrainConfig

if TYPE_CHECKING:
    from gaponet.data.store import Dataset
    from gaponet.study.pool import Cell


@writes("comparison")
def compare(
    dataset: tyro.conf.Positional[Path],
    out: Path,
    models: tuple[str, ...] = ("gaponet", "mlp"),
    seeds: int = 3,
    budget: str = "10m",
    robot: str | None = None,
    identify: tyro.conf.FlagCreatePairsOff[bool] = False,
    holdout_units: tuple[str, ...] = (),
    workers: int = 0,
    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = TrainConfig(),  # noqa: B008
    json: tyro.conf.FlagCreatePairsOff[bool] = False,
) -> None:
    """Train several models with several seeds and put them into one table and one figure, baselines beside them.

    Writes compare.json, .csv, .md, .svg and .png into OUT, and each run into OUT/cells. The same command again goes on
    where it was; more seeds or models may be added to it.

    Args:
        dataset: Dataset folder.
        out: Folder of the comparison.
        models: Kinds, each with changed fields where wanted: mlp:mlp_hidden=256,128 or gaponet:sensors=off:history=8.
            identified+KIND trains in the identified simulator (with --identify).
        seeds: How many, counted from --seed.
        budget: Of each run: time such as 90s, 10m or 2h, or control steps such as 2000000.
        robot: Robot name or folder, if not the one that the dataset keeps; all models correct it.
        identify: Identify the simulator first and show it beside; kept in OUT/identified.
        holdout_units: Units never trained on; shown as a group of their own.
        workers: Runs at a time, each on --threads (here 1 by default) threads; 0 for as many as there are cores.
        config: Of all models.
        json: One JSON object on stdout.
    """
    from gaponet.study.compare import group_table, heading, main_table, write
    from gaponet.study.pool import plan, run_cells
    from gaponet.study.study import train_and_evaluate
    from gaponet.study.variant import Variant, parse_variant

    screen = Out(json)
    if seeds < 1 or workers < 0:
        raise UsageError("--seeds is at least 1 and --workers at least 0")
    data, spec = open_dataset(dataset, robot)
    data.require_robot(spec)
    variants = [parse_variant(text, config) for text in models]
    if identify and spec.nominal is not None:
        raise UsageError(f"--identify: robot {robot} is an identified one already; all models start from it")
    strays = [v.name for v in variants if v.identified]
    if strays and not identify:
        raise UsageError(
            f"--models {strays[0]}: add --identify, or give an identified robot with --robot for all models"
        )
    fitted = _identified(data, spec, out, holdout_units) if identify else spec if spec.nominal is not None else None

    def simulator(variant: Variant) -> RobotSpec:
        return fitted if variant.identified and fitted is not None else spec

    threads = config.threads or 1
    numbers = range(config.seed, config.seed + seeds)
    cells = plan(data, variants, numbers, simulator, out, budget, holdout_units, threads)
    todo = [c for c in cells if not c.done]
    if len(todo) < len(cells):
        screen.say(f"{len(cells) - len(todo)} of {len(cells)} runs are there already")
    failed: dict[str, str] = {}
    if todo:
        with bars("runs", len(todo)) as show:
            failed = run_cells(todo, train_and_evaluate, workers or max(1, (os.cpu_count() or 1) // threads), show)
    for name, reason in failed.items():
        screen.say(f"  {name}: {reason}", "failed", "red")
    finished = [c for c in cells if c.done]
    if not finished:
        raise ModelError(f"{out}: every run failed; the first: {next(iter(failed.values()))}")
    result = _collect(data, spec, fitted, finished, budget, holdout_units, out)
    files = write(result, out)
    screen.say(heading(result))
    screen.table("Comparison", *main_table(result))
    columns, rows = group_table(result)
    screen.table("By payload, unit and joint", columns, rows)
    screen.say(f"written: {', '.join(str(f) for f in files)}")
    screen.result(result)
    if failed:
        raise ModelError(
            f"{len(failed)} of {len(cells)} runs failed; the table is of the others. Run it again to retry"
        )


def _identified(data: Dataset, spec: RobotSpec, out: Path, holdout: tuple[str, ...]) -> RobotSpec:
    """The simulator identified on the training motions; once."""
    from gaponet.data.split import split_entries
    from gaponet.robot_folder import save_robot
    from gaponet.sim.identify import identify

    folder = out / "identified"
    if not (folder / "robot.toml").is_file():
        with bar("identifying") as update:
            train = data.sequences(split_entries(data, holdout)["train"])
            found = identify(
                train, spec, progress=lambda done, total, rms: update(done, total, f"{rms * 1e3:.2f} mrad")
            )
        save_robot(found.robot, folder)
    return load_robot(folder)


def _collect(
    data: Dataset, spec: RobotSpec, fitted: RobotSpec | None, cells: list[Cell], budget: str, holdout: tuple[str, ...],
    out: Path,
) -> dict[str, Any]:  # fmt: skip
    """All cells and the baselines as one result; baselines are simulated once and kept."""
    from gaponet.study.compare import comparison, evaluate_baselines

    run, nominal = cells[0].folder, spec.nominal or spec
    with bar("baselines") as update:
        update(0, 1, "")
        baselines = evaluate_baselines(run, data, nominal, fitted, holdout)
        update(1, 1, "")
    by_method: dict[str, list[dict[str, Any]]] = {}
    for cell in cells:
        found = js.loads((cell.folder / "cell.json").read_text(encoding="utf-8"))
        by_method.setdefault(cell.variant.name, []).append(found)
    facts = {"budget": budget, "holdout_units": list(holdout)}
    return comparison(data, run, nominal, baselines, by_method, facts)
