"""gaponet torque."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gaponet.base.errors import NoGainError
from gaponet.base.files import write_json
from gaponet.base.text import format_uncertainty
from gaponet.cli.options import Flag, Json, Robot, Source
from gaponet.cli.out import Out, writes
from gaponet.data.split import split_entries
from gaponet.report.tables import mrad
from gaponet.robot.folder import PROVENANCE_FILE, save_robot
from gaponet.robot.spec import RobotSpec
from gaponet.share.reading import open_dataset
from gaponet.sysid.torque_motors import TERMS, Driven, driven

UNITS = {
    "armature": ("armature, g·m²", 1e3),
    "damping": ("damping, N·m·s/rad", 1.0),
    "frictionloss": ("friction, N·m", 1.0),
}

SPLIT = 3  # motions, from which some are kept for judging; parts of fewer fit and judge in turn


@writes("robot")
def torque(dataset: Source, out: Path, current: Flag = False, robot: Robot = None, json: Json = False) -> None:
    """Fit friction, inertia and delay of a torque-driven robot.

    Recordings need torque (tau) of every operated joint; where no position was commanded, logs.toml says the position's
    column for ctrl too. What is found is judged on recordings that were not fitted: how far the simulator is from the
    robot some time after a recorded state when both are driven by the same torque. Where that is no nearer than before,
    nothing is written.

    Args:
        out: Robot folder to write.
        current: What was recorded as torque is a current, or its constant is not known: fit N·m in one unit of it.
    """
    screen = Out(json)
    data, spec = open_dataset(dataset, robot)
    data.require_robot(spec)
    few = len({e.meta.motion for e in data.entries}) < SPLIT
    parts = {"train": data.entries, "val": data.entries, "test": []} if few else split_entries(data, ())
    train = data.sequences(parts["train"])
    found = driven(train, train if few else data.sequences(parts["val"]), spec, current)
    _tell(screen, found, spec, current, "VIRTUAL " if any(e.meta.virtual for e in data.entries) else "")
    before, after = (float(np.mean(x)) for x in found.angle[0.5])
    if not after < before:
        raise NoGainError(f"nothing is written: half a second on {mrad(after)} mrad, the file's {mrad(before)}")
    save_robot(found.robot, out)
    write_json(out / PROVENANCE_FILE, {
        "dataset": str(data.path.resolve()),
        "parts": {part: {e.id: e.hash for e in entries} for part, entries in parts.items()},
        "motions": {part: sorted({e.meta.motion for e in entries}) for part, entries in parts.items()},
        "val_mpjae": {"nominal": before, "identified": after},
    })  # fmt: skip
    screen.say(f"robot folder {out}: armature, damping, friction and delay; a servo's kp and kd are the file's still")
    fields = {n: {f: float(getattr(found.robot, f)[i]) for f in (*TERMS, "delay")}
              for n, i in zip(spec.operated, spec.operated_index, strict=True)}  # fmt: skip
    for j, joint in enumerate(fields.values()):
        joint |= {"bias": float(found.bias[j]), "constant": float(found.constant[j])}
    screen.result({
        "joints": fields, "std": found.std, "torque": found.torque, "windows": found.windows,
        "angle": {str(h): x for h, x in found.angle.items()}, "robot": str(out),
    })  # fmt: skip


def _tell(screen: Out, found: Driven, spec: RobotSpec, current: bool, virtual: str) -> None:
    rows = []
    for j, name in enumerate(spec.operated):
        i = spec.operated_index[j]
        values = {f: float(getattr(found.robot, f)[i]) for f in TERMS}
        cells = [
            format_uncertainty(k * values[f], k * found.std[name][f]) if values[f] else "0"
            for f, (_, k) in UNITS.items()
        ]
        rows.append([name, *cells, f"{1e3 * found.robot.delay[i]:.0f}", f"{found.bias[j]:+.2g}",
                     *([format_uncertainty(float(found.constant[j]), found.std[name]["constant"])] if current else []),
                     *(f"{x[j]:.3g}" for x in found.torque)])  # fmt: skip
    columns = ["joint", *(title for title, _ in UNITS.values()), "delay, ms", "bias, N·m"]
    columns += ["N·m per unit"] * current + ["torque apart before, N·m", "after"]
    screen.table("Driven joints, ± standard error; medians on recordings that were not fitted", columns, rows)
    ahead = (
        f"Angle apart from the {virtual}robot, so long after its state, mrad: before → after, {found.windows} starts"
    )
    screen.table(ahead, ["joint", *(f"{h:g} s" for h in found.angle)], [
        [name, *(f"{mrad(a[j])} → {mrad(b[j])}" for a, b in found.angle.values())]
        for j, name in enumerate(spec.operated)
    ])  # fmt: skip
