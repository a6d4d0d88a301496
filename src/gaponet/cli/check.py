"""gaponet check: are new logs still of the identified robot; of many robots, every night."""

from __future__ import annotations

import sys
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from gaponet import api
from gaponet.base.errors import UsageError
from gaponet.cli.options import Flag, Folder, Json, Motions, Unit, like
from gaponet.cli.out import Out
from gaponet.robot.spec import load_robot
from gaponet.sysid.uncertainty import ParameterUncertainty

if TYPE_CHECKING:
    from gaponet.sysid.evidence.drift import ParameterChange

Robot = Annotated[
    Folder,
    tyro.conf.arg(
        help="Robot folder of gaponet identify or adapt; with --fleet a folder of those.",
        metavar="ROBOT",
    ),
]
Logs = Annotated[
    tyro.conf.Positional[str],
    tyro.conf.arg(
        help="Dataset folder, or logs that gaponet import reads; with --fleet a folder of each robot's logs "
        "or dataset, or one dataset of all units.",
        metavar="LOGS",
    ),
]


@like(api.check)
def check(
    robot: Robot, logs: Logs, unit: Unit = "", motions: Motions = (), payload_mass: float | None = None,
    threads: int = 0, fleet: Flag = False, out: Path | None = None, night: str = "", adapt: bool = True,
    executor: str = "local", workers: int = 0, json: Json = False,
) -> None:  # fmt: skip
    """Is this still the robot that was identified? What changed?

    The exit code is 0 if the robot is unchanged, 1 if it changed, and 2 if that cannot be decided. With --fleet many
    robots are checked, robots that drifted are adapted, and one page shows all. The same command again continues.

    Args:
        fleet: Check a folder of robots and show which drifted, in which parameters, and since when. The options below
            are for this.
        out: Folder for fleet.html, adapted/ROBOT, and ROBOT.json with all its checks.
        night: Name of this check; default today's date.
        adapt: Adapt robots that drifted.
        executor: local, ray or ray:ADDRESS (docs/install.md); all machines must see the folders.
        workers: Number of robots at a time; 0 for one per core.
    """
    screen = Out(json)
    if fleet:
        if out is None:
            raise UsageError("--fleet: give a folder for the page and the results, --out FOLDER")
        _check_fleet(screen, robot, logs, out, night, adapt, payload_mass, executor, workers)
        return
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


def _check_fleet(
    screen: Out, robots: Path, logs: str, out: Path, night: str, adapt: bool, payload_mass: float | None,
    executor: str, workers: int,
) -> None:  # fmt: skip
    from gaponet import fleet
    from gaponet.base.progress import progress_bar

    when, results = night or date.today().isoformat(), dict[str, fleet.Night]()
    with progress_bar("checking") as update:
        checked = fleet.check_fleet(
            robots, Path(logs), out, when, adapt, payload_mass, executor, workers
        )
        for name, result, count in checked:
            results[name] = result
            update(len(results), count, f"{name}: {result['verdict']}")
    changed = {
        name: result for name, result in sorted(results.items()) if result["verdict"] != fleet.SAME
    }
    if changed:
        screen.table(f"Changed robots, {when}", ["robot", "since", "parameters that changed, or the problem"], [
            [name, fleet.changed_since(fleet.load_nights(out / f"{name}.json")), "; ".join(n["moved"]) or n["advice"]]
            for name, n in changed.items()
        ])  # fmt: skip
    took, page = sum(n["took"] for n in results.values()), out / "fleet.html"
    unchanged = len(results) - len(changed)
    screen.say(
        f"{unchanged} of {len(results)} are the same; {took:.0f} s of processor time; {page}"
    )
    screen.result({"night": when, "robots": results, "page": str(page)})
    if changed:
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
