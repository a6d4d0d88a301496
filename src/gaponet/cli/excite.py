"""`gaponet excite`: what to play on a robot of which there is no data yet, or what to play next."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from gaponet import api
from gaponet.api.options import ExciteOptions
from gaponet.api.results import Prediction
from gaponet.base.errors import UsageError
from gaponet.base.progress import progress_bar
from gaponet.cli.options import Json
from gaponet.cli.out import Out, writes
from gaponet.robot.servo_fields import SERVO_FIELDS
from gaponet.robot.spec import load_robot


@writes("motions")
def excite(
    out: Path,
    robot: str = "",
    known: Annotated[Path | None, tyro.conf.arg(name="for")] = None,
    options: Annotated[ExciteOptions, tyro.conf.arg(name="")] = ExciteOptions(),  # noqa: B008
    json: Json = False,
) -> None:
    """Write the motions to play on a robot: first, or next.

    Without data, give --robot NAME. For an identified robot, --for FOLDER chooses the motions that
    add most information to its logs, and says how much more is worth playing.

    Args:
        robot: Robot name or folder; its range, torque and payload limits bound the motions.
        known: Robot folder of gaponet identify or adapt.
        out: Folder for the motion files and sheet.md.
        options: Duration, payloads, rate and file format.
    """
    screen = Out(json)
    if bool(robot) == (known is not None):
        raise UsageError(
            "give --robot NAME where there is no data yet, or --for FOLDER of a robot that was "
            "identified"
        )
    spec = load_robot(known or robot)
    with progress_bar("choosing motions") as update:
        made = api.excite(
            spec,
            out=out,
            further=known is not None,
            options=options,
            progress=update,
        )
    if made.prediction is not None:
        _show_prediction(screen, spec.name, made.prediction)
    masses = ", ".join(f"{mass:g}" for mass in made.payloads)
    screen.say(
        f"{len(made.motions)} motions, {made.minutes:.1f} min at {masses} kg for {spec.name}: "
        f"{out!s}"
    )
    screen.next(
        f"print {made.sheet}; play them (gaponet run or record --motion FILE, or your own player)"
    )
    screen.result(made.to_dict())


def _show_prediction(screen: Out, name: str, prediction: Prediction) -> None:
    """Print standard errors before and after the motions, and how much more playing is useful."""
    before = prediction.before
    fields = []
    for field in next(iter(before.values())):
        if any(errors[field] > 0 for errors in before.values()):
            fields.append(field)
    rows = []
    for joint in before:
        cells = []
        for field in fields:
            factor = SERVO_FIELDS[field].factor
            now = _two_digits(before[joint][field] * factor)
            then = _two_digits(prediction.after[joint][field] * factor)
            cells.append(f"{now} → {then}")
        rows.append([joint, *cells])
    headings = [SERVO_FIELDS[field].heading for field in fields]
    screen.table(f"{name}: standard errors, now → at best", ["joint", *headings], rows)
    seconds = prediction.useful_seconds
    if seconds:
        screen.say(
            f"{seconds:.0f} s are worth playing: after them half a minute more makes the errors "
            "less than 5 % smaller"
        )
    else:
        screen.say("no more is worth playing: half a minute makes the errors less than 5 % smaller")
    for joint, why in prediction.undetermined.items():
        screen.say(f"  {joint}: {why}", "warning", "yellow")


def _two_digits(value: float) -> str:
    return f"{float(f'{value:.2g}'):g}"
