"""gaponet check: are new logs still of the identified robot."""

from __future__ import annotations

import sys
from typing import Annotated

import tyro

from gaponet import api
from gaponet.api.results import CheckResult
from gaponet.cli.options import Folder, Json, Motions, Unit, like
from gaponet.cli.out import Out

Robot = Annotated[
    Folder,
    tyro.conf.arg(
        help="Robot folder of gaponet identify or adapt.",
        metavar="ROBOT",
    ),
]
Logs = Annotated[
    tyro.conf.Positional[str],
    tyro.conf.arg(
        help="Dataset folder, or logs that gaponet import reads.",
        metavar="LOGS",
    ),
]
COLUMNS = ["joint", "parameter", "change", "standard errors", "effect, mrad", "verdict"]


@like(api.check)
def check(
    robot: Robot,
    logs: Logs,
    unit: Unit = "",
    motions: Motions = (),
    payload_mass: float | None = None,
    threads: int = 0,
    json: Json = False,
) -> None:
    """Is this still the robot that was identified? What changed?

    The exit code is 0 if the robot is unchanged, 1 if it changed or its recordings contradict each
    other, and 2 if that cannot be decided.
    """
    screen = Out(json)
    made = api.check(
        robot, logs, unit=unit, motions=motions, payload_mass=payload_mass, threads=threads
    )
    _show_changes(screen, made)
    advice = made.advice.replace("ROBOT", robot.as_posix()).replace("LOGS", logs)
    screen.say(f"{made.verdict}: {advice}")
    screen.result(made.to_dict())
    if made.verdict != "same":
        sys.stdout.flush()
        raise SystemExit(1)


def _show_changes(screen: Out, made: CheckResult) -> None:
    """Print the largest change of each joint, and recordings that contradict the others."""
    plural = "" if made.recordings == 1 else "s"
    count = f"{made.recordings} recording{plural}"
    title = f"Largest change of each joint ({count}, {made.drift.seconds:.0f} s)"
    screen.table(title, COLUMNS, made.rows())
    for found in made.drift.against:
        text = (
            f"  {found.recording} differs from the others: {found.joint}, {found.field}, "
            f"{abs(found.sigmas):.0f} standard errors"
        )
        screen.say(text, "warning", "yellow")
