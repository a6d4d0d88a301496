"""gaponet train, gaponet eval."""

from __future__ import annotations

import math
from pathlib import Path
from shlex import quote
from typing import Annotated, Literal

import tyro

from gaponet import api
from gaponet.base.installation import install_command
from gaponet.base.progress import progress_bar
from gaponet.cli.options import Data, Flag, Json, Known, Motions, Robot, like
from gaponet.cli.out import Out
from gaponet.cli.show import show_methods, show_verdict
from gaponet.evaluation.methods import title
from gaponet.evaluation.tables import mrad
from gaponet.evaluation.verdict import NetworkGain
from gaponet.nn.config import ModelKind
from gaponet.nn.training.config import TrainConfig
from gaponet.robot.folder import STORED_ROBOT


@like(api.train)
def train(
    dataset: Data,
    out: Path,
    model: ModelKind | Literal["auto"] = "auto",
    recipe: Literal["labels", "paper"] = "labels",
    budget: str = "10m",
    resume: Flag = False,
    robot: Robot = None,
    holdout_units: tuple[str, ...] = (),
    log: tuple[Literal["tensorboard", "wandb"], ...] = (),
    despite_errors: Flag = False,
    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = TrainConfig(),  # noqa: B008
    json: Json = False,
) -> None:
    """Train a network on top of an identified robot.

    Ctrl-C ends training and leaves a usable run.

    Args:
        recipe: labels: supervised pre-training, then PPO. paper: PPO from an untrained network, with settings for that;
            PPO options that are given keep their values.
        log: Also write the training curve to TensorBoard event files in OUT/tensorboard, or to Weights & Biases.
        config: Settings of the training.
    """
    from gaponet.nn.artifact import GapModel

    screen = Out(json)
    config = config.paper_recipe() if recipe == "paper" else config
    with progress_bar(f"training {model}") as update:
        trained = api.train(
            dataset, out=out, budget=budget, config=config, model=model, robot=robot, holdout_units=holdout_units,
            resume=resume, log=log, despite_errors=despite_errors, progress=update,
        )  # fmt: skip
    card, kind = trained.card, title(trained.card["model"]["kind"])
    val = card["val_mpjae"]
    if trained.candidates:
        rows = {"without a network": val["start"]} | {
            title(name): e for name, e in trained.candidates.items()
        }
        rows[f"{kind}, at the end"] = val["model"]
        columns = ["each with a fifth of the budget", "mrad"]
        screen.table(
            "Validation error", columns, [[name, mrad(error)] for name, error in rows.items()]
        )
        if "trees" not in trained.candidates:
            screen.say(f"boosted trees were not tried: {install_command('train')}")
    screen.say(
        f"best on validation: {mrad(val['model'])} mrad, without the network {mrad(val['start'])}, nominal "
        f"{mrad(val['nominal'])} ({val['model'] / val['nominal']:.2f}); {card['steps']:,} control steps in "
        f"{card['seconds']:.0f} s: {GapModel.how_trained(card)}"
        + (" (interrupted)" if card["interrupted"] else "")
    )
    gain = NetworkGain("identified", val["added"], val.get("error", math.nan), val["start"])
    screen.say(f"with {kind} the error of validation motions falls by {gain.text}")
    step = f"gaponet eval {out} {quote(str(dataset))}"
    if not gain.helps and val["start"] != val["nominal"]:
        step = f"gaponet export {quote(str(out / STORED_ROBOT))} --to mjcf"
        screen.say(
            "that is within what motions scatter, or less than 2 %: the identified robot is as good without it"
        )
    screen.findings(trained.doctor.findings)
    screen.say(f"{kind} in {trained.model.path}")
    screen.next(step)
    screen.result(trained.to_dict())


@like(api.evaluate)
def evaluate(
    run: Known, dataset: Data, also: tuple[Path, ...] = (), motions: Motions = (), robot: Robot = None,
    units: tuple[str, ...] = (), json: Json = False,
) -> None:  # fmt: skip
    """Measure robots and runs on motions that they never saw."""
    out = Out(json)
    with progress_bar("evaluating") as update:
        result = api.evaluate(
            run, dataset, also=also, motions=motions, robot=robot, units=units, progress=update
        )  # fmt: skip
    table = result.to_dict()
    if not result.unseen:
        out.say(
            "",
            "a model was trained or chosen on some of these motions: the errors are no test errors",
            "yellow",
        )
    for name, delta in table["delta"].items():
        if delta["at_limit"]:
            out.say(
                f"{title(name)}: {delta['at_limit']:.2%} of the corrections are at the limit (--model.delta-max)"
            )
    for note in table["notes"]:
        out.say(note)
    show_methods(out, table)
    show_verdict(out, result.methods, str(dataset), run)
    out.result(table)
