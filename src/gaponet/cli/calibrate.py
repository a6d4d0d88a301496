"""gaponet calibrate."""

from __future__ import annotations

from dataclasses import asdict
from math import isfinite
from pathlib import Path
from typing import Literal

import tyro

from gaponet import api
from gaponet.cli.gap import mrad
from gaponet.cli.identify import COLUMNS
from gaponet.cli.out import Out


def calibrate(
    run: tyro.conf.Positional[Path],
    dataset: tyro.conf.Positional[Path],
    unit: str = "",
    motions: tuple[str, ...] = (),
    seconds: float = 30.0,
    payload_mass: Literal["recorded", "unknown"] = "recorded",
    robot: str | None = None,
    mixed_gains: tyro.conf.FlagCreatePairsOff[bool] = False,
    json: tyro.conf.FlagCreatePairsOff[bool] = False,
) -> None:
    """Fit what is particular to one unit (gain, damping, friction, zero offset, delay of each joint) from a short log.

    The trained model stays as it is. gaponet eval then shows the unit without and with its calibration.

    Args:
        run: Run folder of gaponet train.
        dataset: Recordings of the unit, perhaps among others.
        unit: Which one, where the dataset holds several.
        motions: Only these; default: those that the run was trained on, so that its test motions
            stay unseen, or all, where the unit played none of them.
        seconds: How much of the recordings to use, in windows of 8 s.
        payload_mass: unknown: do not believe the recordings' payload, estimate it too; all must carry the same.
        robot: Robot name or folder, if not the one that the dataset keeps.
        mixed_gains: Take recordings made with different kp or kd together.
        json: One JSON object on stdout.
    """
    from gaponet.model import calibration

    out = Out(json)
    unknown = payload_mass == "unknown"
    found = api.calibrate(run, dataset, unit, motions, seconds, unknown, robot, mixed_gains)
    out.table(f"Unit {found.unit_id}", ["joint", *(COLUMNS[f][0] for f in calibration.FIELDS)], [
        [j, *(f"{v[f] * COLUMNS[f][1]:.3g}" for f in calibration.FIELDS)] for j, v in found.servos.items()
    ])  # fmt: skip
    if found.payload_mass is not None:
        known = found.payload_std is not None and isfinite(found.payload_std)  # it takes two windows to tell
        spread = f" ± {found.payload_std:.2f}" if known else ""
        out.say(f"payload {found.payload_mass:.2f}{spread} kg in each hand that carries")
    out.say(f"window RMS {mrad(found.before)} → {mrad(found.after)} mrad on what was fitted; kept in {run}")
    out.say(f"next: gaponet eval {run} {dataset}")
    out.result(asdict(found))
