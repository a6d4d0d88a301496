"""gaponet train, gaponet eval."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from shlex import quote
from typing import Annotated, Literal

import tyro

from gaponet import TrainConfig, api
from gaponet.api.fit import ModelKind
from gaponet.api.options import TrainOptions
from gaponet.api.results import EvalResult, TrainResult
from gaponet.base.installation import install_command
from gaponet.base.progress import progress_bar
from gaponet.cli.options import Data, Json, Known, Motions, Robot, like
from gaponet.cli.out import Out
from gaponet.cli.show import show_methods, show_verdict
from gaponet.evaluation.methods import title
from gaponet.evaluation.tables import mrad
from gaponet.robot.folder import STORED_ROBOT


@dataclass(frozen=True)
class TrainArgs(TrainOptions):
    """Which network is trained, how, to which units, and how its run is kept."""

    model: ModelKind | Literal["auto"] = "auto"
    recipe: Literal["labels", "paper"] = "labels"
    """labels: supervised pre-training, then PPO. paper: PPO from an untrained network, with
    settings for that; PPO options that are given keep their values."""

    def options(self) -> TrainOptions:
        """Return the options of api.train."""
        return TrainOptions(**{f.name: getattr(self, f.name) for f in fields(TrainOptions)})


@like(api.train)
def train(
    dataset: Data,
    out: Path,
    budget: str = "10m",
    robot: Robot = None,
    args: Annotated[TrainArgs, tyro.conf.arg(name=""), tyro.conf.FlagCreatePairsOff] = TrainArgs(),
    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = TrainConfig(),  # noqa: B008
    json: Json = False,
) -> None:
    """Train a network on top of an identified robot.

    Ctrl-C ends training and leaves a usable run.

    Args:
        args: Kind of network, and what happens to the run.
        config: Settings of the training.
    """
    screen = Out(json)
    if args.recipe == "paper":
        config = config.paper_recipe()
    with progress_bar(f"training {args.model}") as update:
        trained = api.train(
            dataset,
            out=out,
            budget=budget,
            config=config,
            robot=robot,
            options=args.options(),
            progress=update,
        )
    _show_candidates(screen, trained)
    _warn_of_rate(screen, trained, config)
    _show_trained(screen, trained, dataset, out)
    screen.result(trained.to_dict())


def _show_candidates(screen: Out, trained: TrainResult) -> None:
    """Print the errors of the kinds of networks that were tried."""
    if not trained.candidates:
        return
    errors = trained.val_mpjae
    rows = [["without a network", mrad(errors["start"])]]
    for name, error in trained.candidates.items():
        rows.append([title(name), mrad(error)])
    rows.append([f"{title(trained.kind)}, at the end", mrad(errors["model"])])
    columns = ["each with a fifth of the budget", "mrad"]
    screen.table("Validation error", columns, rows)
    if "trees" not in trained.candidates:
        screen.say(f"boosted trees were not tried: {install_command('train')}")


def _show_trained(screen: Out, trained: TrainResult, dataset: Path, out: Path) -> None:
    """Print the errors, the gain of the network, and the next command."""
    card = trained.card
    errors = trained.val_mpjae
    kind = title(trained.kind)
    interrupted = " (interrupted)" if card["interrupted"] else ""
    screen.say(
        f"best on validation: {mrad(errors['model'])} mrad, without the network "
        f"{mrad(errors['start'])}, nominal {mrad(errors['nominal'])} "
        f"({errors['model'] / errors['nominal']:.2f}); {card['steps']:,} control steps in "
        f"{card['seconds']:.0f} s: {trained.how_trained}{interrupted}"
    )
    gain = trained.gain
    screen.say(f"with {kind} the error of validation motions falls by {gain.text}")
    step = f"gaponet eval {out} {quote(str(dataset))}"
    identified = errors["start"] != errors["nominal"]
    if identified and not gain.helps:
        step = f"gaponet export {quote(str(out / STORED_ROBOT))} --to mjcf"
        screen.say(
            "that is within what motions scatter, or less than 2 %: the identified robot is as "
            "good without it"
        )
    screen.findings(trained.doctor.findings)
    screen.say(f"{kind} in {trained.model.path}")
    screen.next(step)


def _warn_of_rate(screen: Out, trained: TrainResult, config: TrainConfig) -> None:
    """Name the options that count control periods and are short at the rate of the recordings."""
    if trained.kind == "trees":  # they have no history and no PPO
        return
    dt = min(trained.card["dt"])
    short = config.short_options(dt)
    if short:
        screen.say(
            f": the recordings have {1 / dt:.4g} Hz, and defaults that count control periods are "
            f"made for 50 Hz: scale {' and '.join(short)}",
            "warning",
            "yellow",
        )


@like(api.evaluate)
def evaluate(
    run: Known,
    dataset: Data,
    also: tuple[Path, ...] = (),
    motions: Motions = (),
    robot: Robot = None,
    units: tuple[str, ...] = (),
    json: Json = False,
) -> None:
    """Measure robots and runs on motions that they never saw."""
    screen = Out(json)
    with progress_bar("evaluating") as update:
        result = api.evaluate(
            run,
            dataset,
            also=also,
            motions=motions,
            robot=robot,
            units=units,
            progress=update,
        )
    _show_evaluation(screen, result)
    show_verdict(screen, result.methods, str(dataset), run)
    screen.result(result.to_dict())


def _show_evaluation(screen: Out, result: EvalResult) -> None:
    """Print warnings and notes, and the errors of each method."""
    table = result.to_dict()
    if not result.unseen:
        text = (
            "a model was trained or chosen on some of these motions: the errors are no test errors"
        )
        screen.say("", text, "yellow")
    for name, delta in table["delta"].items():
        share = delta["at_limit"]
        if share:
            screen.say(
                f"{title(name)}: {share:.2%} of the corrections are at the limit "
                "(--model.delta-max)"
            )
    for note in table["notes"]:
        screen.say(note)
    show_methods(screen, table)
