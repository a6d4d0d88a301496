"""The table of gaponet identify for a torque-driven robot."""

from __future__ import annotations

from gaponet.api.results import TorqueResult
from gaponet.base.text import format_uncertainty
from gaponet.cli.out import Out
from gaponet.report.tables import mrad
from gaponet.robot.servo_fields import SERVO_FIELDS
from gaponet.sysid.torque_motors import PASSIVE_FIELDS


def show_torque(screen: Out, made: TorqueResult, current: bool) -> None:
    """Print the parameters of a torque-driven robot and its errors before and after."""
    found, spec, virtual = made.fit, made.robot, "VIRTUAL " if made.virtual else ""
    rows = []
    for j, name in enumerate(spec.operated):
        i = spec.operated_index[j]
        values = {f: float(getattr(found.robot, f)[i]) for f in PASSIVE_FIELDS}
        cells = [
            format_uncertainty(SERVO_FIELDS[f].factor * v, SERVO_FIELDS[f].factor * found.std[name][f]) if v else "0"
            for f, v in values.items()
        ]
        rows.append([name, *cells, f"{1e3 * found.robot.delay[i]:.0f}", f"{found.bias[j]:+.2g}",
                     *([format_uncertainty(float(found.constant[j]), found.std[name]["constant"])] if current else []),
                     *(f"{x[j]:.3g}" for x in found.torque)])  # fmt: skip
    columns = ["joint", *(SERVO_FIELDS[f].heading for f in PASSIVE_FIELDS), "delay, ms", "bias, N·m"]
    columns += ["N·m per unit"] * current + ["torque apart before, N·m", "after"]
    screen.table("Torque-driven joints, ± standard error; medians on recordings that were not fitted", columns, rows)
    ahead = (
        f"Angle apart from the {virtual}robot, so long after its state, mrad: before → after, {found.windows} starts"
    )
    screen.table(ahead, ["joint", *(f"{h:g} s" for h in found.angle)], [
        [name, *(f"{mrad(a[j])} → {mrad(b[j])}" for a, b in found.angle.values())]
        for j, name in enumerate(spec.operated)
    ])  # fmt: skip
    screen.say(
        f"robot folder {made.folder}: armature, damping, friction and delay; a servo's kp and kd are the file's still"
    )
