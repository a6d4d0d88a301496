"""gaponet adapt."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from math import isfinite
from pathlib import Path
from typing import Annotated, Any

import tyro

from gaponet import api
from gaponet.base.errors import UsageError
from gaponet.cli.identify import COLUMNS
from gaponet.cli.options import Flag, Folder, Json, Robot, Unit, like
from gaponet.cli.out import Out
from gaponet.report.tables import mrad
from gaponet.robot.spec import RobotSpec, robot_argument

Known = Annotated[
    Folder, tyro.conf.arg(help="Robot folder (with --out), or run folder of gaponet train.", metavar="ROBOT|RUN")
]
Logs = Annotated[
    tyro.conf.Positional[str],
    tyro.conf.arg(help="Dataset folder or address; for a robot folder logs as well.", metavar="LOGS"),
]


@like(api.adapt_model)
def adapt(
    run: Known,
    dataset: Logs,
    out: Path | None = None,
    unit: Unit = "",
    motions: tuple[str, ...] = (),
    seconds: float = 30.0,
    payload_mass: str = "recorded",
    robot: Robot = None,
    mixed_gains: Flag = False,
    json: Json = False,
) -> None:
    """Bring an identified robot to another unit or day: short logs.

    A robot folder in, a robot folder out: gaponet adapt ./my_robot LOGS --out ./my_robot_today. Of a run the
    trained model stays as it is; gaponet eval then shows the unit without and with its adaptation.

    Args:
        out: Robot folder to write, where a robot folder is adapted.
        payload_mass: unknown: do not believe the recordings' payload, estimate it too; all must carry the same. A
            number: kg in each hand, of logs whose format does not state it.
    """
    screen = Out(json)
    unknown = payload_mass == "unknown"
    if (run / "robot.toml").is_file():
        if out is None:
            raise UsageError(f"{run}: is a robot folder; give --out FOLDER for the adapted one")
        if robot is not None or mixed_gains:
            raise UsageError("--robot and --mixed-gains are for the adaptation of a run")
        told = None if unknown or payload_mass == "recorded" else _mass(payload_mass)
        made = api.adapt_robot(run, dataset, out, unit, motions, seconds, unknown, told)
        before, after = (float(e.mean()) for e in made.errors.values())
        screen.say(
            f"{mrad(before)} → {mrad(after)} mrad over {len(made.errors['after'])} recording(s) of unit {made.unit} "
            f"({after / before:.2f}); robot folder {out}"
        )
        servos = _servos(made.robot)
        _show(screen, made.unit, servos, made.payload_mass, made.payload_std)
        screen.say(f"next: gaponet run --motion FILE --robot {robot_argument(out)} --compensate")
        screen.result({
            "unit_id": made.unit, "before": before, "after": after, "servos": servos, "robot": str(out),
            "payload_mass": made.payload_mass, "payload_std": made.payload_std,
        })  # fmt: skip
        return
    if out is not None:
        raise UsageError(f"{run}: is no robot folder (no robot.toml); --out is for those, a run keeps its adaptations")
    if not unknown and payload_mass != "recorded":
        raise UsageError(f"--payload-mass {payload_mass}: a run takes recorded or unknown")
    found = api.adapt_model(run, dataset, unit, motions, seconds, unknown, robot, mixed_gains)
    _show(screen, found.unit_id, found.servos, found.payload_mass, found.payload_std)
    screen.say(f"window RMS {mrad(found.before)} → {mrad(found.after)} mrad on what was fitted; kept in {run}")
    screen.say(f"next: gaponet eval {run} {dataset}")
    screen.result(asdict(found))


def _show(
    screen: Out, unit: str, servos: Mapping[str, Mapping[Any, float]], mass: float | None, std: float | None
) -> None:
    """A unit's servos, and its payload."""
    from gaponet.sysid.refit import FIELDS

    screen.table(f"Unit {unit}", ["joint", *(COLUMNS[f][0] for f in FIELDS)], [
        [j, *(f"{v[f] * COLUMNS[f][1]:.3g}" for f in FIELDS)] for j, v in servos.items()
    ])  # fmt: skip
    if mass is not None:
        spread = f" ± {std:.2f}" if std is not None and isfinite(std) else ""  # it takes two windows to tell
        screen.say(f"payload {mass:.2f}{spread} kg in each hand that carries")


def _servos(robot: RobotSpec) -> dict[str, dict[str, float]]:
    from gaponet.sysid.refit import FIELDS

    at = robot.joint_names.index
    return {j: {f: float(getattr(robot, f)[at(j)]) for f in FIELDS} for j in robot.operated}


def _mass(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise UsageError(f"--payload-mass {text}: give recorded, unknown, or a number of kg") from None
