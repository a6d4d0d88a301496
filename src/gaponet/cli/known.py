"""gaponet show, check and fleet: what is known of a robot, whether logs are still of it; and of many, every night."""

from __future__ import annotations

import sys
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from gaponet.base.errors import UsageError
from gaponet.cli.options import Folder, Json, Motions, Unit
from gaponet.cli.out import Out
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sysid.uncertainty import ParameterUncertainty

if TYPE_CHECKING:
    from gaponet.sysid.drift import Moved

Known = Annotated[Folder, tyro.conf.arg(help="Robot folder of gaponet identify or gaponet adapt.", metavar="ROBOT")]
Logs = Annotated[
    tyro.conf.Positional[str],
    tyro.conf.arg(help="Dataset folder or address, or logs that gaponet import reads.", metavar="LOGS"),
]
WIDE = 4  # columns of a table


def show(robot: Known, out: Path | None = None, json: Json = False) -> None:
    """What is known of an identified robot, and how surely.

    Args:
        out: Picture to write, .png or .svg.
    """
    from gaponet.report.figures.uncertainty import picture
    from gaponet.sysid.uncertainty_table import FIELD_UNITS, sentences, summarize, table_rows

    screen = Out(json)
    spec, known = _opened(robot)
    sure = {j: summarize(known, j) for j in known.joints}
    fields = tuple(f for f in known.fields if any(c.values[f] for c in sure.values()))
    for start in range(0, len(fields), WIDE):
        part = fields[start : start + WIDE]
        title = f"{spec.name}, ± standard error" if start == 0 else "The same"
        screen.table(title, ["joint", *(FIELD_UNITS[f][0] for f in part)], table_rows(known, part))
    for line in sentences(known):
        screen.say(line)
    if out is not None:
        from gaponet.base.files import atomic_write

        if out.suffix not in (".png", ".svg"):
            raise UsageError(f"--out {out}: a picture is a .png or an .svg")
        with atomic_write(out) as temporary:
            picture(known, f"{spec.name}: what is known").savefig(temporary, format=out.suffix[1:], dpi=200)
        screen.say(f"picture: {out}")
    screen.result({
        "robot": spec.name, "sources": known.sources, "held": known.validated,
        "joints": {
            j: {
                "values": c.values, "standard_errors": c.errors, "together": c.sets,
                "left": known.joints[j].residual_rms, "band_90": known.joints[j].residual_p90,
                "predicted": known.joints[j].parameter_rms,
                "scale": known.joints[j].residual_rms / max(known.joints[j].parameter_rms, 1e-12),
            }
            for j, c in sure.items()
        },
        "picture": None if out is None else str(out),
    })  # fmt: skip


def _opened(folder: Path) -> tuple[RobotSpec, ParameterUncertainty]:
    """A robot folder, and what is known of it."""
    if not (folder / "robot.toml").is_file():
        raise UsageError(f"{folder}: is no robot folder (no robot.toml); give what gaponet identify wrote")
    spec = load_robot(folder)
    return spec, ParameterUncertainty.require(spec)


def check(
    robot: Known,
    logs: Logs,
    unit: Unit = "",
    motions: Motions = (),
    payload_mass: float | None = None,
    threads: int = 0,
    json: Json = False,
) -> None:
    """Is this still the robot that was identified? What moved?

    The exit code is 0 where it is, 1 where it is not, 2 where that cannot be told.

    Args:
        unit: Which one, where the dataset holds several, or logs do not say.
        payload_mass: kg in each hand, of logs whose format does not state it.
        threads: 0 for all cores.
    """
    from gaponet.api import unit_recordings
    from gaponet.sysid.drift import drift

    screen = Out(json)
    spec, known = _opened(robot)
    with unit_recordings(logs, spec, unit, motions, payload_mass) as (_, sequences):
        found = drift(spec, known, sequences, threads)
    named = {m.joint for m in found.moved}
    screen.table(
        f"{len(sequences)} recordings, {found.seconds:.0f} s: what changed most, in standard deviations",
        ["joint", "number", "by", "deviations", "moves it, mrad", "left anyway, mrad", ""],
        [
            _row(m, known, m.joint in named)
            for m in (*found.moved, *(m for j, m in found.largest.items() if j not in named))
        ],
    )
    for a in found.against:
        what = f"{a.recording} differs from the others: {a.joint}, {a.field}, {abs(a.sigmas):.0f} deviations"
        screen.say(f"  {what}", "warning", "yellow")
    screen.say(f"{found.verdict}: {found.advice}")
    screen.result({
        "verdict": found.verdict, "advice": found.advice, "recordings": len(sequences), "seconds": found.seconds,
        "moved": [_plain(m) for m in found.moved], "largest": {j: _plain(m) for j, m in found.largest.items()},
        "against": [vars(a) for a in found.against], "threshold": found.threshold, "far": found.far,
    })  # fmt: skip
    if found.verdict != "same":
        sys.stdout.flush()
        raise SystemExit(1)


def fleet(
    robots: Annotated[Folder, tyro.conf.arg(help="Folder of robot folders, each of gaponet identify or adapt.")],
    logs: Annotated[Folder, tyro.conf.arg(help="Folder of each robot's logs or dataset; or one dataset of all units.")],
    out: Path,
    night: str = "",
    adapt: bool = True,
    payload_mass: float | None = None,
    executor: str = "local",
    workers: int = 0,
    json: Json = False,
) -> None:
    """Check many robots, adapt those that drifted, one page of them.

    A fleet's nightly job: who drifted, by what, since when.

    The same command again goes on where it was. The exit code is 0 where all are the same, else 1.

    Args:
        out: Folder of what is found: fleet.html, adapted/ROBOT, ROBOT.json with its nights.
        night: Its name; default today.
        adapt: Whether those that drifted are adapted.
        payload_mass: kg in each hand, of logs whose format does not state it.
        executor: Where: local, ray or ray:ADDRESS (docs/scale.md); folders are on a disk that all machines see.
        workers: Robots at a time; 0 for as many as there are cores.
    """
    from gaponet import fleet as known
    from gaponet.base.progress import progress_bar

    screen, when, found = Out(json), night or date.today().isoformat(), dict[str, known.Night]()
    with progress_bar("checking") as update:
        for name, mine, count in known.night(robots, logs, out, when, adapt, payload_mass, executor, workers):
            found[name] = mine
            update(len(found), count, f"{name}: {mine['verdict']}")
    odd = {name: mine for name, mine in sorted(found.items()) if mine["verdict"] != known.SAME}
    if odd:
        screen.table(f"Not as they were, {when}", ["robot", "since", "what moved, or what is wrong"], [
            [name, known.since(known.history(out / f"{name}.json")), "; ".join(n["moved"]) or n["advice"]]
            for name, n in odd.items()
        ])  # fmt: skip
    took = sum(n["took"] for n in found.values())
    screen.say(f"{len(found) - len(odd)} of {len(found)} are the same; {took:.0f} s of processor; {out / 'fleet.html'}")
    screen.result({"night": when, "robots": found, "page": str(out / "fleet.html")})
    if odd:
        sys.stdout.flush()
        raise SystemExit(1)


def _row(m: Moved, known: ParameterUncertainty, counts: bool) -> list[str]:
    from gaponet.sysid.uncertainty_table import format_change

    mine = [k.residual_rms for j, k in known.joints.items() if m.joint == j or m.joint not in known.joints]
    left = sum(mine) / len(mine)
    by = format_change(m.field, m.by, known, m.joint)
    return [m.joint, m.field, by, f"{m.sigmas:+.1f}", f"{1e3 * m.moves:.2f}", f"{1e3 * left:.2f}",
            "moved" if counts else ""]  # fmt: skip


def _plain(m: Moved) -> dict[str, object]:
    return {**vars(m), "sigmas": m.sigmas}
