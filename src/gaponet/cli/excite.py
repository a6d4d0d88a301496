"""`gaponet excite`: what to play on a robot of which there is no data yet, or what to play next."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from gaponet.base.errors import UsageError
from gaponet.cli.options import Json
from gaponet.cli.out import Out, writes

if TYPE_CHECKING:
    from gaponet.robot.spec import RobotSpec
    from gaponet.sysid.motion.plan import Plan

FIRST, NEXT = 10.0, 0.5  # minutes
WIDE = 4  # columns of a table


@writes("motions")
def excite(
    out: Path,
    robot: str = "",
    known: Annotated[Path | None, tyro.conf.arg(name="for")] = None,
    minutes: float | None = None,
    payloads: tuple[float, ...] = (0.0,),
    rate: float = 50.0,
    format: Literal["txt", "csv", "npz"] = "txt",
    seed: int = 0,
    json: Json = False,
) -> None:
    """Write the motions to play on a robot: first, or next.

    No data yet: --robot NAME. A robot that was identified: --for FOLDER chooses what tells most beside its logs, and
    says how much more is worth playing.

    Args:
        robot: Robot name or folder; its range, torque and payload limits bound the motions.
        known: Robot folder of gaponet identify or adapt.
        out: Folder for the motion files and sheet.md.
        minutes: How long all motions are together. 10 (the default) identify gains, friction and delay, 40 make a good
            model. With --for half a minute.
        payloads: kg in each hand; every motion is played with each. With --for what they may be.
        rate: How many commands a second, Hz.
        format: txt (SAGE, 50 Hz), csv (with time) or npz; gaponet run and record play each.
        seed: What the drawing of motions starts from.
    """
    from gaponet.base.files import write_text
    from gaponet.robot.spec import load_robot
    from gaponet.sysid.motion.files import write_motion
    from gaponet.sysid.motion.plan import make_plan, sheet

    screen = Out(json)
    if bool(robot) == (known is not None):
        raise UsageError("give --robot NAME where there is no data yet, or --for FOLDER of a robot that was identified")
    spec, masses, told = load_robot(known or robot), tuple(sorted(set(payloads))), dict[str, Any]()
    if known is None:
        plan = make_plan(spec, FIRST if minutes is None else minutes, masses, seed)
    else:
        plan, told = _next(screen, spec, 60 * (NEXT if minutes is None else minutes), masses, seed)
    files = {motion.name: f"{i:02d}_{motion.name}.{format}" for i, motion in enumerate(plan.motions, 1)}
    for motion in plan.motions:
        write_motion(out / files[motion.name], motion, spec, rate)
    write_text(out / "sheet.md", sheet(spec, plan, files, rate, known))
    held = ", ".join(f"{p:g}" for p in plan.payloads)
    screen.say(f"{len(files)} motions, {plan.minutes:.1f} min at {held} kg for {spec.name}: {out!s}")
    screen.say(f"Next: print {out / 'sheet.md'}; play them (gaponet run or record --motion FILE, or your own player)")
    screen.result({"motions": list(files.values()), "minutes": plan.minutes, "payloads": plan.payloads,
                   "sheet": str(out / "sheet.md"), **told})  # fmt: skip


def _next(
    screen: Out, spec: RobotSpec, seconds: float, payloads: tuple[float, ...], seed: int
) -> tuple[Plan, dict[str, Any]]:
    """Motions that tell most beside the logs, and what they would."""
    from gaponet.base.progress import progress_bar
    from gaponet.sysid.motion.experiment_design import ExperimentDesign, candidates, expected, open_gains
    from gaponet.sysid.motion.library import Library
    from gaponet.sysid.motion.plan import Plan
    from gaponet.sysid.uncertainty import ParameterUncertainty

    mine = ParameterUncertainty.require(spec)
    if payloads[0] < 0 or (payloads[-1] > 0 and not spec.payload_mounts):
        raise UsageError(f"--payloads {payloads}: give kg ≥ 0; {spec.name} has {len(spec.payload_mounts)} mounts")
    with progress_bar("looking for motions") as update:
        motions = candidates(Library(spec, seed, payloads[-1]), update)
    pairs = [(mass, motion) for mass in payloads for motion in motions]
    told = ExperimentDesign.from_recordings(spec, mine, [s for mass in payloads for s in expected(spec, motions, mass)])
    picks = sorted(told.choose(seconds), key=lambda i: pairs[i][0])
    if not picks:
        raise UsageError(f"--minutes {seconds / 60:g}: no motion is so short; give {told.seconds.min() / 60:.2f}")
    now, then = (_errors(mine, told.after(p)) for p in ([], picks))
    worth, open_ = told.worth(), open_gains(spec, mine, told, motions, payloads)
    _tell(screen, spec, now, then)
    screen.say(
        f"{worth:.0f} s are worth playing: after them half a minute more makes the errors less than 5 % smaller"
        if worth else "no more is worth playing: half a minute makes the errors less than 5 % smaller"
    )  # fmt: skip
    for joint, why in open_.items():
        screen.say(f"  {joint}: {why}", "warning", "yellow")
    return Plan(tuple(pairs[i] for i in picks)), {
        "errors": now, "errors_then": then, "worth_seconds": worth, "open": open_,
        "played": [(mass, motion.name) for mass, motion in (pairs[i] for i in picks)],
    }  # fmt: skip


def _errors(known: Any, covariance: np.ndarray) -> dict[str, dict[str, float]]:
    """Joint → field → standard error, SI."""
    return {
        j: dict(zip(known.fields, np.sqrt(np.diag(known.si(j, covariance[i])[1])).tolist(), strict=True))
        for i, j in enumerate(known.joints)
    }


def _tell(screen: Out, spec: RobotSpec, now: dict[str, dict[str, float]], then: dict[str, dict[str, float]]) -> None:
    """A table of standard errors, now and when the motions have been recorded."""
    from gaponet.cli.identify import COLUMNS

    fields = [f for f in next(iter(now.values())) if any(by[f] > 0 for by in now.values())]
    for start in range(0, len(fields), WIDE):
        part = fields[start : start + WIDE]
        title = f"{spec.name}: standard errors, now → at best" if start == 0 else "The same"
        screen.table(title, ["joint", *(COLUMNS[f][0] for f in part)], [
            [j, *(" → ".join(f"{float(f'{by[j][f] * COLUMNS[f][1]:.2g}'):g}" for by in (now, then)) for f in part)]
            for j in now
        ])  # fmt: skip
