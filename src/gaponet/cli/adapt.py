"""gaponet adapt."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from gaponet import api
from gaponet.api.results import AdaptResult
from gaponet.base.errors import UsageError
from gaponet.base.progress import progress_bar
from gaponet.cli.options import Flag, Folder, Json, Robot, Unit, like
from gaponet.cli.out import Out
from gaponet.evaluation.tables import mrad
from gaponet.nn.packaged_networks import named_folder
from gaponet.robot.spec import robot_argument

Known = Annotated[
    Folder,
    tyro.conf.arg(
        help="Robot folder (with --out), or run folder of gaponet train.", metavar="ROBOT|RUN"
    ),
]
Logs = Annotated[
    tyro.conf.Positional[str],
    tyro.conf.arg(help="Dataset folder; for a robot folder logs as well.", metavar="LOGS"),
]


@like(api.adapt_model)
def adapt(
    run: Known, dataset: Logs, out: Path | None = None, unit: Unit = "", motions: tuple[str, ...] = (),
    seconds: float = 30.0, payload_mass: float | None = None, robot: Robot = None, mixed_gains: Flag = False,
    despite_errors: Flag = False, json: Json = False,
) -> None:  # fmt: skip
    """Adapt an identified robot to another unit or day with short logs.

    For a robot folder, a new robot folder is written: gaponet adapt ./my_robot LOGS --out ./my_robot_today. For a run,
    the trained model stays unchanged, and gaponet eval then shows the unit without and with its adaptation.

    Args:
        out: Robot folder to write; required for a robot folder.
        payload_mass: kg in each hand, for logs of a robot folder whose format does not state it.
    """
    screen = Out(json)
    run = named_folder(run)
    if (run / "robot.toml").is_file():
        if out is None:
            raise UsageError(f"{run}: is a robot folder; give --out FOLDER for the adapted one")
        if robot is not None or mixed_gains:
            raise UsageError("--robot and --mixed-gains are for the adaptation of a run")
        with progress_bar("adapting") as update:
            made = api.adapt_robot(
                run, dataset, out=out, unit=unit, motions=motions, seconds=seconds, payload_mass=payload_mass,
                despite_errors=despite_errors, progress=update,
            )  # fmt: skip
        screen.say(
            f"error {mrad(made.before)} → {mrad(made.after)} mrad ({made.after / made.before:.2f} of it) on "
            f"{made.recordings} recording(s) of unit {made.unit_id}; robot folder {out}"
        )
        _show(screen, made)
        screen.next(f"gaponet run --motion FILE --robot {robot_argument(out)} --compensate")
        screen.result(made.to_dict())
        return
    if out is not None:
        raise UsageError(
            f"{run}: is no robot folder (no robot.toml); --out is for those, a run keeps its adaptations"
        )
    if payload_mass is not None:
        raise UsageError(
            "--payload-mass is for the logs of a robot folder; the dataset of a run states its payload"
        )
    with progress_bar("adapting") as update:
        made = api.adapt_model(
            run, dataset, unit=unit, motions=motions, seconds=seconds, robot=robot, mixed_gains=mixed_gains,
            despite_errors=despite_errors, progress=update,
        )  # fmt: skip
    _show(screen, made)
    screen.say(
        f"window RMS {mrad(made.before)} → {mrad(made.after)} mrad of the fitted windows; stored in {run}"
    )
    screen.next(f"gaponet eval {run} {dataset}")
    screen.result(made.to_dict())


def _show(screen: Out, made: AdaptResult) -> None:
    """Print a unit's servos."""
    from gaponet.robot.servo_fields import SERVO_FIELDS
    from gaponet.sysid.adapt import FIELDS

    screen.table(f"Servos of unit {made.unit_id}", ["joint", *(SERVO_FIELDS[f].heading for f in FIELDS)], [
        [j, *(f"{v[f] * SERVO_FIELDS[f].factor:.3g}" for f in FIELDS)] for j, v in made.servos.items()
    ])  # fmt: skip
    screen.findings(made.doctor.findings)
