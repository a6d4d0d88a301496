"""gaponet adapt."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import Annotated

import tyro

from gaponet import api
from gaponet.api.opening import as_run
from gaponet.api.results import AdaptResult
from gaponet.base.errors import UsageError
from gaponet.base.progress import progress_bar
from gaponet.cli.options import Flag, Folder, Json, Robot, Unit, like
from gaponet.cli.out import Out
from gaponet.evaluation.tables import mrad
from gaponet.robot.servo_fields import SERVO_FIELDS
from gaponet.robot.spec import robot_argument

Known = Annotated[
    Folder,
    tyro.conf.arg(
        help="Robot folder (give --out too), or run folder of gaponet train.",
        metavar="ROBOT|RUN",
    ),
]
Logs = Annotated[
    tyro.conf.Positional[str],
    tyro.conf.arg(
        help="Dataset folder. If a robot folder is adapted, it may be a folder of logs too.",
        metavar="LOGS",
    ),
]


@like(api.adapt_model)
def adapt(
    run: Known,
    dataset: Logs,
    out: Path | None = None,
    unit: Unit = "",
    motions: tuple[str, ...] = (),
    seconds: float = 30.0,
    payload_mass: float | None = None,
    robot: Robot = None,
    mixed_gains: Flag = False,
    despite_errors: Flag = False,
    json: Json = False,
) -> None:
    """Adapt an identified robot to another unit or day with short logs.

    For a robot folder, a new robot folder is written, for example by
    gaponet adapt ./my_robot LOGS --out ./my_robot_today. For a run, the network stays unchanged,
    and the run keeps the adaptation: gaponet eval then shows the unit without and with it.

    Args:
        out: Robot folder to write. Needed if a robot folder is adapted.
        unit: Unit to adapt to, or name of the robot in the logs. Needed if the dataset holds
            several units, or if the logs state none.
        payload_mass: Payload in each hand, kg. Needed for logs that do not state it.
    """
    screen = Out(json)
    folder = as_run(run)
    if (folder / "robot.toml").is_file():
        if out is None:
            raise UsageError(f"{folder}: is a robot folder; give --out FOLDER for the adapted one")
        if robot is not None or mixed_gains:
            raise UsageError("--robot and --mixed-gains are for the adaptation of a run")
        with progress_bar("adapting") as update:
            made = api.adapt_robot(
                folder,
                dataset,
                out=out,
                unit=unit,
                motions=motions,
                seconds=seconds,
                payload_mass=payload_mass,
                despite_errors=despite_errors,
                progress=update,
            )
        _show_robot(screen, made)
    else:
        _require_options_of_run(folder, out, payload_mass)
        with progress_bar("adapting") as update:
            made = api.adapt_model(
                folder,
                dataset,
                unit=unit,
                motions=motions,
                seconds=seconds,
                robot=robot,
                mixed_gains=mixed_gains,
                despite_errors=despite_errors,
                progress=update,
            )
        _show_run(screen, made, dataset)
    screen.result(made.to_dict())


def _require_options_of_run(run: Path, out: Path | None, payload_mass: float | None) -> None:
    """Refuse options that are for robot folders."""
    if out is not None:
        raise UsageError(
            f"{run}: is no robot folder (no robot.toml); --out is for those, a run keeps its "
            "adaptations"
        )
    if payload_mass is not None:
        raise UsageError(
            "--payload-mass is for the logs of a robot folder; the dataset of a run states its "
            "payload"
        )


def _show_robot(screen: Out, made: AdaptResult) -> None:
    """Print what the adaptation of a robot folder gave, and the next command."""
    ratio = made.after / made.before
    screen.say(
        f"error {mrad(made.before)} → {mrad(made.after)} mrad ({ratio:.2f} of it) on "
        f"{made.recordings} recording(s) of unit {made.unit_id}; robot folder {made.folder}"
    )
    _show_servos(screen, made)
    robot = quote(robot_argument(made.folder))
    screen.next(f"gaponet run --motion FILE --robot {robot} --compensate")


def _show_run(screen: Out, made: AdaptResult, dataset: str) -> None:
    """Print what the adaptation of a run gave, and the next command."""
    _show_servos(screen, made)
    screen.say(
        f"window RMS {mrad(made.before)} → {mrad(made.after)} mrad of the fitted windows; stored "
        f"in {made.folder}"
    )
    screen.next(f"gaponet eval {quote(str(made.folder))} {quote(dataset)}")


def _show_servos(screen: Out, made: AdaptResult) -> None:
    """Print a unit's servos."""
    fields = list(next(iter(made.servos.values())))
    rows = []
    for joint, servo in made.servos.items():
        cells = [f"{servo[field] * SERVO_FIELDS[field].factor:.3g}" for field in fields]
        rows.append([joint, *cells])
    headings = [SERVO_FIELDS[field].heading for field in fields]
    screen.table(f"Servos of unit {made.unit_id}", ["joint", *headings], rows)
    screen.findings(made.doctor.findings)
