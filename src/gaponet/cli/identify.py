"""gaponet identify."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from gaponet import api
from gaponet.base.text import format_uncertainty
from gaponet.cli.options import Flag, Json, Robot, Source, like
from gaponet.cli.out import Out, writes
from gaponet.report.tables import mrad
from gaponet.robot.spec import robot_argument
from gaponet.sim.metrics import standard_error

if TYPE_CHECKING:
    from gaponet.sysid.fit import Identified

COLUMNS = {  # field → heading, factor from SI
    "kp": ("kp, N·m/rad", 1.0),
    "kd": ("kd, N·m·s/rad", 1.0),
    "damping": ("damping, N·m·s/rad", 1.0),
    "frictionloss": ("friction, N·m", 1.0),
    "armature": ("armature, g·m²", 1e3),
    "offset": ("offset, mrad", 1e3),
    "delay": ("delay, ms", 1e3),
    "target_speed": ("ramp, rad/s", 1.0),
    "stribeck": ("more at rest, N·m", 1.0),
    "stribeck_speed": ("until, mrad/s", 1e3),
    "friction_motor": ("friction, % of motor", 1e2),
    "friction_external": ("friction, % of load", 1e2),
    "effort_limit": ("most torque, N·m", 1.0),
    "min_torque": ("least torque, N·m", 1.0),
    "encoder_step": ("encoder, mrad", 1e3),
    "zero": ("zero, mrad", 1e3),
    "stop_low": ("low stop, rad", 1.0),
    "stop_high": ("high stop, rad", 1.0),
}

WIDE = 4  # columns of a table
UNDETERMINED = "not determined by these logs"


@writes("robot")
@like(api.identify)
def identify(
    dataset: Source,
    out: Path,
    windows: int = 40,
    terms: tuple[Literal["stribeck", "load", "limit", "external", "min_torque", "encoder"], ...] = ("stribeck", "load"),
    table: bool = True,
    shared: Flag = False,
    threads: int = 0,
    budget: str | None = None,
    stops: Flag = False,
    details: Flag = False,
    robot: Robot = None,
    units: tuple[str, ...] = (),
    holdout_units: tuple[str, ...] = (),
    json: Json = False,
) -> None:
    """Fit the simulator's servos to logs: a robot folder.

    Gains, damping, friction, armature, zero offsets and delays are fitted to the training motions.

    The result is a robot folder: use it with --robot, with a slash: gaponet gap DATASET --robot ./OUT. What the robot's
    file says of gains is where the fit starts; those that recordings state are believed. Where nothing does better than
    the robot as it is, nothing is written and the exit status is 2.

    Args:
        terms: Terms of the servo's law; each is kept where validation motions say so, by more than its standard error.
        details: Say of every joint what these logs do not determine.
    """
    screen = Out(json)
    made = api.identify(
        dataset, out, windows, robot, units, holdout_units, terms, table, shared, threads, budget, stops
    )
    found = made.found
    _tell(screen, found, made.val, details)
    screen.say(f"{made.seconds:.0f} s; robot folder {out}; next: gaponet gap {dataset} --robot {robot_argument(out)}")
    screen.result({
        "chosen": found.chosen, "joints": _values(found), "std": found.std, "val_mpjae": made.val_mpjae,
        "val_standard_error": {k: standard_error(v) for k, v in made.val.items()},
        "terms": {t.name: {"gain": t.gain[0], "standard_error": t.gain[1], "kept": t.kept} for t in found.tried},
        "shared": {
            t.name: {"own": t.before.mean(), "one": t.after.mean(), "standard_error": t.gain[1]} for t in found.shared
        },
        "table": vars(found.robot.table) if found.robot.table else None,
        "touching": list(found.touch.motions) if found.touch else [],
        "warnings": list(found.warnings), "undetermined": found.undetermined,
        "seconds": made.seconds, "robot": str(out),
    })  # fmt: skip


def _values(found: Identified) -> dict[str, dict[str, float]]:
    """Joint → field → value of the fields that say something."""
    robot = found.robot
    return {
        joint: {
            f: float(getattr(robot, f)[i])
            for f in COLUMNS
            if np.isfinite(getattr(robot, f)[i]) and (f != "effort_limit" or f in found.std[joint])
        }
        for joint, i in zip(robot.operated, robot.operated_index, strict=True)
    }


def _tell(screen: Out, found: Identified, errors: dict[str, np.ndarray], details: bool) -> None:
    """The verdict, the servos as a table, what was tried and what it gave."""
    nominal, left = (f"{mrad(e.mean())} ± {mrad(standard_error(e))}" for e in errors.values())
    screen.say(
        f"nominal {nominal} → identified {left} mrad on {len(errors['nominal'])} whole validation motion(s) "
        f"({errors['identified'].mean() / errors['nominal'].mean():.2f})"
    )
    values = _values(found)
    shown = [f for f in COLUMNS if any(v.get(f) for v in values.values())]
    for start in range(0, len(shown), WIDE):
        part = shown[start : start + WIDE]
        rows = [[j, *(_cell(v.get(f), found.std[j].get(f), COLUMNS[f][1]) for f in part)] for j, v in values.items()]
        for servo in dict.fromkeys(filter(None, (found.robot.servos[i] for i in found.robot.operated_index))):
            known = [_cell(servo.published.get(f), None, COLUMNS[f][1]) for f in part]
            rows += [[f"published for {servo.name}, {servo.source}", *known]] * any(known)
        title = "Identified servos" if start == 0 else "The same"
        screen.table(f"{title}, ± standard error", ["joint", *(COLUMNS[f][0] for f in part)], rows)
    for term in found.tried:
        fell, error = (mrad(x) for x in term.gain)
        told = (
            f"{len(term.before)} {'motions' if term.name == 'torque' else 'recordings'}; {'not ' * (not term.kept)}kept"
        )
        screen.say(f"{term.name}: validation error falls by {fell} ± {error} mrad over {told}")
    if found.judged:
        screen.say("from torque, then fitted to the validation motions, too: the numbers are from before that")
        for m in found.robot.payload_mounts:
            screen.say(
                f"payload_mount {m.side}: at {m.pos} m of {m.body}, where {m.mass:g} kg hang that the model lacks"
            )
    for law in found.shared:
        own, one = (mrad(e.mean()) for e in (law.before, law.after))
        costs = f"{mrad(-law.gain[0])} ± {mrad(law.gain[1])}"
        screen.say(f"one law for every {law.name}: {own} → {one} mrad over {len(law.before)} recordings, costs {costs}")
    if found.touch is not None and found.touch.motions:
        touch, table = found.touch, found.robot.table
        what = "none that explains them"
        if touch.kept and table is not None:
            what = f"height {table.height:.4f} m, friction {table.friction:.2f}, {table.stiffness:.0f} N/m"
        screen.say(
            f"table: {what}; where tips are low {mrad(touch.before.mean())} → {mrad(touch.after.mean())} mrad, in "
            f"{', '.join(touch.motions)}"
        )
    unknown = [w for w in found.warnings if UNDETERMINED in w]
    for warning in found.warnings:
        if details or warning not in unknown:
            screen.say(f"  {warning}", "warning", "yellow")
    if unknown and not details:
        joints = ", ".join(w.partition(":")[0] for w in unknown)
        screen.say(f"not determined in part: {joints}; --details says what. Take a joint's values as a set")


def _cell(value: float | None, std: float | None, factor: float) -> str:
    if value is None:
        return ""
    return format_uncertainty(value * factor, std * factor) if std else f"{value * factor:.3g}"
