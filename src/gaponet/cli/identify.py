"""gaponet identify."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import tyro

from gaponet import api
from gaponet.cli.gap import mrad
from gaponet.cli.out import Out, writes

COLUMNS = {  # field → heading, factor from SI
    "kp": ("kp, N·m/rad", 1.0),
    "damping": ("damping, N·m·s/rad", 1.0),
    "frictionloss": ("friction, N·m", 1.0),
    "armature": ("armature, g·m²", 1e3),
    "offset": ("offset, mrad", 1e3),
    "delay": ("delay, ms", 1e3),
}


@writes("robot")
def identify(
    dataset: tyro.conf.Positional[Path],
    out: Path,
    windows: int = 40,
    robot: str | None = None,
    units: tuple[str, ...] = (),
    holdout_units: tuple[str, ...] = (),
    mixed_gains: tyro.conf.FlagCreatePairsOff[bool] = False,
    json: tyro.conf.FlagCreatePairsOff[bool] = False,
) -> None:
    """Fit gains, damping, friction, armature, zero offsets and delays of the simulator to the training motions.

    The result is a robot folder: use it with --robot, e.g. gaponet train DATASET --robot OUT --out RUN.

    Args:
        dataset: Dataset folder.
        out: Robot folder to write.
        windows: Free runs of 8 s that are fitted, taken evenly from the training motions.
        robot: Robot name or folder to start from, if not the one that the dataset keeps.
        units: Only these, pooled: one set of parameters for all of them; default: every unit not held out.
        holdout_units: Units to leave out, as in gaponet train.
        mixed_gains: Take recordings made with different kp or kd together.
        json: One JSON object on stdout.
    """
    from gaponet.sim.free_runs import BOUNDS

    screen = Out(json)
    made = api.identify(dataset, out, windows, robot, units, holdout_units, mixed_gains)
    found, error, spec = made.found, made.val_mpjae, made.found.robot
    values: dict[str, Any] = {
        j: {f: float(getattr(found.robot, f)[spec.joint_names.index(j)]) for f in BOUNDS} for j in spec.operated
    }
    screen.table("Identified servos", ["joint", *(COLUMNS[f][0] for f in BOUNDS)], [
        [j, *(f"{v * COLUMNS[f][1]:.3g}" for f, v in values[j].items())] for j in spec.operated
    ])  # fmt: skip
    for warning in found.warnings:
        screen.say(f"  {warning}", "warning", "yellow")
    screen.say(
        f"window RMS {mrad(found.before)} → {mrad(found.after)} mrad; whole validation motions: nominal "
        f"{mrad(error['nominal'])}, identified {mrad(error['identified'])} mrad "
        f"({error['identified'] / error['nominal']:.2f})"
    )
    screen.say(f"robot folder {out}; next: gaponet train {dataset} --robot {out} --out RUN")
    screen.result({"joints": values, "val_mpjae": error, "warnings": list(found.warnings), "robot": str(out)})
