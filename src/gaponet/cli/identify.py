"""gaponet identify."""

from __future__ import annotations

from pathlib import Path

from gaponet import api
from gaponet.api.opening import copies_with_torque, driven_by_torque
from gaponet.api.results import IdentifyResult, TorqueResult
from gaponet.base.errors import UsageError
from gaponet.base.progress import progress_bar
from gaponet.base.text import format_uncertainty
from gaponet.cli import options
from gaponet.cli.options import Data, Flag, Json, Robot
from gaponet.cli.out import Out, writes
from gaponet.evaluation.tables import mrad, mrad_with_error
from gaponet.robot.finding import abbreviate
from gaponet.robot.servo_fields import PASSIVE_FIELDS, SERVO_FIELDS, Term
from gaponet.robot.spec import robot_argument
from gaponet.robot.toml_file import MEASURED_FIELDS
from gaponet.sim.dataset_robot import open_dataset
from gaponet.sim.metrics import standard_error
from gaponet.sysid.uncertainty import JointSummary

UNDETERMINED = "not determined by these logs"


@writes("robot")
@options.like(api.identify)
def identify(
    dataset: Data, out: Path, windows: int = 40, terms: tuple[Term, ...] | None = None, table: bool = True,
    threads: int = 0, budget: str | None = None, stops: Flag = False, masses: Flag = False, current: Flag = False,
    details: Flag = False, robot: Robot = None, like: str | None = None, units: tuple[str, ...] = (),
    holdout_units: tuple[str, ...] = (), despite_errors: Flag = False, json: Json = False,
) -> None:  # fmt: skip
    """Fit the simulator's servos to logs and write a robot folder.

    Gains, damping, friction, armature, zero offsets and delays are fitted to the training motions. For a robot that is
    driven by torque (no position was commanded), armature, damping, friction and delay are fitted.

    Use the robot folder with --robot and a slash: gaponet gap DATASET --robot ./OUT. The fit starts from the gains in
    the robot's file. Gains that recordings state are not changed. If no fit is better than the robot as it is, nothing
    is written and the exit status is 2.

    Args:
        current: Torque-driven robots: fit the torque constant too, where the recorded torque is a current or its
            unit is unknown.
        details: List the parameters of every joint that these logs do not determine.
    """
    screen = Out(json)
    data, spec = open_dataset(dataset, robot)
    by_torque = driven_by_torque(data)
    if current and not by_torque:
        by_torque = copies_with_torque(data)
        _refuse_current_beside_commands(dataset, by_torque)
    if by_torque:
        if like or units or holdout_units or terms or stops or masses:
            what = "--like, --units, --holdout-units, --terms, --stops and --masses"
            raise UsageError(f"{dataset} holds a robot that is driven by torque; leave out {what}")
        with progress_bar("identifying"):
            driven = api.identify_torque(
                data, out=out, current=current, robot=spec, despite_errors=despite_errors
            )
        _show_torque(screen, driven, current)
        screen.result(driven.to_dict())
        return
    with progress_bar("identifying") as update:
        made = api.identify(
            data, out=out, windows=windows, robot=spec, like=like, units=units, holdout_units=holdout_units,
            terms=terms, table=table, threads=threads, budget=budget, stops=stops, masses=masses,
            despite_errors=despite_errors, progress=update,
        )  # fmt: skip
    _show(screen, made, details)
    if "backlash" in (terms or ()) and "backlash" not in [c.name for c in made.fit.comparisons]:
        screen.say(
            "backlash: no gap makes a joint's rollouts better. Only a load that changes its sign shows one"
        )
    screen.say(f"robot folder: {out}, after {made.seconds:.0f} s")
    screen.next(f"gaponet gap {dataset} --robot {robot_argument(out)}")
    screen.result(made.to_dict())


def _refuse_current_beside_commands(dataset: Path, by_torque: bool) -> None:
    if not by_torque:
        raise UsageError(
            f"--current is for a robot that is driven by torque or current, and {dataset} holds position commands "
            "beside the positions, or no torque. Leave --current out. If no position was commanded, name the "
            "position's column for ctrl too, and the torque's or current's for tau (docs/logs.md, 'Driven by torque "
            "or current')"
        )


def _show(screen: Out, made: IdentifyResult, details: bool) -> None:
    """Print the verdict, the servos as a table, and what each term gave."""
    fit, errors, values = made.fit, made.errors, made.values()
    nominal, left = (mrad_with_error(e.mean(), standard_error(e)) for e in errors.values())
    ratio = errors["identified"].mean() / errors["nominal"].mean()
    count = len(errors["nominal"])
    folds = fit.held_out
    measured_on = (
        f"Measured on {count} independent validation motions, which chose among the fits. Test motions are others: "
        "gaponet gap measures those."
    )
    if count == 1:
        measured_on = (
            "Measured on a single validation motion: the error of other motions is not known. "
            "Record three motions or more."
        )
    screen.say(f"nominal {nominal} → identified {left} ({ratio:.2f} of nominal). {measured_on}")
    if len(folds) > 1:
        screen.say(
            f"These are errors of {len(folds)}-fold cross-validation, since few motions validate. "
            "The robot was then fitted to all motions."
        )
    if made.taken_from:
        taken = ", ".join(f"{joint} from {source}" for joint, source in made.taken_from.items())
        end = "" if fit.improved else " No fit was better, so these servos are written as they are."
        screen.say(f"Start and prior: {taken}.{end}")
    shown = [f for f in SERVO_FIELDS if any(v.get(f) for v in values.values())]
    rows, sources = (
        [[j, *(_cell(v, fit.std[j], f) for f in shown)] for j, v in values.items()],
        list[str](),
    )
    for servo in dict.fromkeys(
        filter(None, (fit.robot.servos[i] for i in fit.robot.operated_index))
    ):
        if any(cells := [servo.text(f) if f in MEASURED_FIELDS else "" for f in shown]):
            rows.append([f"servo {servo.name}", *cells])
            sources.append(f"servo {servo.name}: {servo.source}")
    columns = ["joint", *(SERVO_FIELDS[f].heading for f in shown)]
    screen.table("Identified servos, ± standard error", columns, rows)
    for source in sources:
        screen.say(source)
    for term in fit.comparisons:
        judges = "motions" if term.name == "torque" else "recordings"
        over = f" over {len(term.before)} {judges}" * (len(term.before) > 1)
        verdict = f"{over}; {'not ' * (not term.accepted)}accepted"
        gain, error = term.gain
        moves = f"{'rises' if gain < 0 else 'falls'} by {mrad_with_error(abs(gain), error)}"
        screen.say(f"{term.name}: validation error {moves}{verdict}")
    for sentence in fit.findings:
        screen.say(f"  {sentence}")
    if fit.chosen == "torque":
        for m in fit.robot.payload_mounts:
            screen.say(
                f"payload_mount {m.side}: at {m.pos} m of {m.body}, where {m.mass:g} kg hang that the model lacks"
            )
    if fit.table_fit is not None and fit.table_fit.motions:
        touch, table = fit.table_fit, fit.robot.table
        what = "none that explains them"
        if touch.accepted and table is not None:
            what = f"height {table.height:.4f} m, friction {table.friction:.2f}, {table.stiffness:.0f} N/m"
        screen.say(
            f"table: {what}; mean |error| of fitted windows with a low tip {mrad(touch.before.mean())} → "
            f"{mrad(touch.after.mean())} mrad, in {', '.join(touch.motions)}"
        )
    screen.findings(made.doctor.findings)
    unknown = [w for w in fit.warnings if UNDETERMINED in w]
    for warning in fit.warnings:
        if details or warning not in unknown:
            screen.say(f"  {warning}", "warning", "yellow")
    if unknown and not details:
        joints = abbreviate([w.partition(":")[0] for w in unknown])
        screen.say(
            f"some parameters of {joints} are not determined (--details). Use all values of a joint together"
        )


def _cell(joint: dict[str, float], errors: dict[str, float], field: str) -> str:
    if field not in joint or (field == "stribeck_speed" and not joint["stribeck"]):
        return ""
    if errors.get(field):
        return JointSummary(joint, errors).cell(field)
    return f"{joint[field] * SERVO_FIELDS[field].factor:.3g}"


def _show_torque(screen: Out, made: TorqueResult, current: bool) -> None:
    """Print the parameters of a torque-driven robot and its errors before and after."""
    fit, spec, virtual = made.fit, made.robot, "VIRTUAL " if made.virtual else ""
    rows = []
    for j, name in enumerate(spec.operated):
        i = spec.operated_index[j]
        values = {f: float(getattr(fit.robot, f)[i]) for f in PASSIVE_FIELDS}
        cells = [
            format_uncertainty(
                SERVO_FIELDS[f].factor * v, SERVO_FIELDS[f].factor * fit.std[name][f]
            )
            if v
            else "0"
            for f, v in values.items()
        ]
        rows.append([name, *cells, f"{1e3 * fit.robot.delay[i]:.0f}", f"{fit.bias[j]:+.2g}",
                     *([format_uncertainty(float(fit.constant[j]), fit.std[name]["constant"])] if current else []),
                     *(f"{x[j]:.3g}" for x in fit.torque)])  # fmt: skip
    columns = [
        "joint",
        *(SERVO_FIELDS[f].heading for f in PASSIVE_FIELDS),
        "delay, ms",
        "bias, N·m",
    ]
    columns += ["N·m per unit"] * current + ["torque apart before, N·m", "after"]
    screen.table(
        "Torque-driven joints, ± standard error; medians on recordings that were not fitted",
        columns,
        rows,
    )
    ahead = f"Angle apart from the {virtual}robot, so long after its state, mrad: before → after, {fit.windows} starts"
    screen.table(ahead, ["joint", *(f"{h:g} s" for h in fit.angle)], [
        [name, *(f"{mrad(a[j])} → {mrad(b[j])}" for a, b in fit.angle.values())]
        for j, name in enumerate(spec.operated)
    ])  # fmt: skip
    screen.findings(made.doctor.findings)
    screen.say(
        f"robot folder {made.folder}: armature, damping, friction and delay; a servo's kp and kd are the file's still"
    )
