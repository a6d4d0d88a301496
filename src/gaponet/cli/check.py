"""gaponet check: are new logs still of the identified robot."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Annotated

import tyro

from gaponet import api
from gaponet.cli.options import Folder, Json, Motions, Unit, like
from gaponet.cli.out import Out
from gaponet.robot.spec import load_robot
from gaponet.sysid.uncertainty import ParameterUncertainty

if TYPE_CHECKING:
    from gaponet.sysid.evidence.drift import ParameterChange

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


@like(api.check)
def check(
    robot: Robot, logs: Logs, unit: Unit = "", motions: Motions = (), payload_mass: float | None = None,
    threads: int = 0, json: Json = False,
) -> None:  # fmt: skip
    """Is this still the robot that was identified? What changed?

    The exit code is 0 if the robot is unchanged, 1 if it changed, and 2 if that cannot be decided.
    """
    screen = Out(json)
    made = api.check(
        robot, logs, unit=unit, motions=motions, payload_mass=payload_mass, threads=threads
    )
    drift, uncertainty = made.drift, ParameterUncertainty.require(load_robot(robot))
    named, count = (
        {m.joint for m in drift.moved},
        f"{made.recordings} recording{'s' * (made.recordings != 1)}",
    )
    screen.table(
        f"Largest change of each joint ({count}, {drift.seconds:.0f} s)",
        ["joint", "parameter", "change", "standard errors", "effect, mrad", "verdict"],
        [
            _row(m, uncertainty, m.joint in named)
            for m in (*drift.moved, *(m for j, m in drift.largest.items() if j not in named))
        ],
    )
    for a in drift.against:
        what = f"{a.recording} differs from the others: {a.joint}, {a.field}, {abs(a.sigmas):.0f} standard errors"
        screen.say(f"  {what}", "warning", "yellow")
    screen.say(
        f"{made.verdict}: {made.advice.replace('ROBOT', robot.as_posix()).replace('LOGS', logs)}"
    )
    screen.result(made.to_dict())
    if made.verdict != "same":
        sys.stdout.flush()
        raise SystemExit(1)


def _row(m: ParameterChange, uncertainty: ParameterUncertainty, counts: bool) -> list[str]:
    from gaponet.sysid.uncertainty import format_change

    by = format_change(m.field, m.by, uncertainty, m.joint)
    return [
        m.joint,
        m.field,
        by,
        f"{m.sigmas:+.1f}",
        f"{1e3 * m.moves:.2f}",
        "changed" if counts else "same",
    ]
