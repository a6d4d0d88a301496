"""gaponet identify."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import tyro

from gaponet.cli.gap import mrad
from gaponet.cli.inputs import open_dataset
from gaponet.cli.out import Out, writes
from gaponet.cli.progress import bar

COLUMNS = {  # field → heading, factor from SI
    "kp": ("kp\nN·m/rad", 1.0),
    "damping": ("damping\nN·m·s/rad", 1.0),
    "frictionloss": ("friction\nN·m", 1.0),
    "armature": ("armature\ng·m²", 1e3),
    "offset": ("offset\nmrad", 1e3),
    "delay": ("delay\nms", 1e3),
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
    from gaponet.data.sequence import require_same_gains
    from gaponet.data.split import split_entries
    from gaponet.errors import UsageError
    from gaponet.robot_folder import save_robot
    from gaponet.sim.free_runs import BOUNDS
    from gaponet.sim.identify import identify as fit
    from gaponet.sim.replay import replay

    screen = Out(json)
    data, spec = open_dataset(dataset, robot)
    data.require_robot(spec)
    others = {e.meta.unit_id for e in data.entries} - set(units) if units else set()
    strangers = set(units) - {e.meta.unit_id for e in data.entries}
    if strangers:
        raise UsageError(f"--units {min(strangers)}: not in {dataset}")
    parts = split_entries(data, tuple(sorted(others | set(holdout_units))))
    if not mixed_gains:
        require_same_gains((e.meta for e in parts["train"]), data.joint_names, spec.operated)
    with bar("identifying") as update:
        found = fit(
            data.sequences(parts["train"]), spec, windows,
            progress=lambda done, total, rms: update(done, total, f"window RMS {mrad(rms)} mrad"),
        )  # fmt: skip
    save_robot(found.robot, out)
    held, op = data.sequences(parts["val"]), spec.operated_index
    nominal = spec.nominal or spec
    error = {
        name: float(np.mean([
            np.abs(t.qpos - s.qpos)[1:, op].mean()
            for s, t in zip(held, replay(held, simulator, lock_idle=True), strict=True)
        ]))
        for name, simulator in (("nominal", nominal), ("identified", found.robot))
    }  # fmt: skip
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
