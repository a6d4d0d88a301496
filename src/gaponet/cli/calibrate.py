"""gaponet calibrate."""

from __future__ import annotations

from dataclasses import asdict
from math import isfinite
from typing import Literal

from gaponet import api
from gaponet.cli.identify import COLUMNS
from gaponet.cli.options import Flag, Json, Robot, Run, Source, like
from gaponet.cli.out import Out
from gaponet.eval.tables import mrad


@like(api.calibrate)
def calibrate(
    run: Run,
    dataset: Source,
    unit: str = "",
    motions: tuple[str, ...] = (),
    seconds: float = 30.0,
    payload_mass: Literal["recorded", "unknown"] = "recorded",
    robot: Robot = None,
    mixed_gains: Flag = False,
    json: Json = False,
) -> None:
    """Fit what is particular to one unit (gain, damping, friction, zero offset, delay of each joint) from a short log.

    The trained model stays as it is. gaponet eval then shows the unit without and with its calibration.

    Args:
        payload_mass: unknown: do not believe the recordings' payload, estimate it too; all must carry the same.
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
