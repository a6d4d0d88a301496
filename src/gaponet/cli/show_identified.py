"""Tables and sentences about an identification."""

from __future__ import annotations

from gaponet.api.options import IdentifyOptions
from gaponet.api.results import IdentifyResult, TorqueResult
from gaponet.cli.out import Out
from gaponet.evaluation.tables import mrad, mrad_with_error
from gaponet.robot.finding import abbreviate
from gaponet.robot.servo_fields import PASSIVE_FIELDS, SERVO_FIELDS

UNDETERMINED = "not determined by these logs"  # in warnings of a fit
NO_BACKLASH = (
    "backlash: no gap makes a joint's rollouts better. Only a load that changes its sign shows one"
)


def show_identified(
    screen: Out, made: IdentifyResult, options: IdentifyOptions, details: bool
) -> None:
    """Print the verdict, the servos as a table, and what each term gave.

    Args:
        details: Print the warnings about parameters that are not determined, too.
    """
    _show_errors(screen, made)
    _show_servos(screen, made)
    _show_terms(screen, made)
    _show_table(screen, made)
    screen.findings(made.doctor.findings)
    _show_warnings(screen, made, details)
    tried = {comparison.name for comparison in made.fit.comparisons}
    if "backlash" in (options.terms or ()) and "backlash" not in tried:
        screen.say(NO_BACKLASH)


def _show_errors(screen: Out, made: IdentifyResult) -> None:
    """Print the errors before and after, and on what they were measured."""
    fit = made.fit
    before = made.val_mpjae["nominal"]
    after = made.val_mpjae["identified"]
    errors_of = made.standard_errors()
    nominal = mrad_with_error(before, errors_of["nominal"])
    identified = mrad_with_error(after, errors_of["identified"])
    count = len(made.errors["nominal"])
    measured_on = (
        f"Measured on {count} independent validation motions, which chose among the fits. Test "
        "motions are others: gaponet gap measures those."
    )
    if count == 1:
        measured_on = (
            "Measured on a single validation motion: the error of other motions is not known. "
            "Record three motions or more."
        )
    screen.say(
        f"nominal {nominal} → identified {identified} ({after / before:.2f} of nominal). "
        f"{measured_on}"
    )
    folds = len(fit.held_out)
    if folds > 1:
        screen.say(
            f"These are errors of {folds}-fold cross-validation, since few motions validate. "
            "The robot was then fitted to all motions."
        )
    if made.taken_from:
        taken = ", ".join(f"{joint} from {source}" for joint, source in made.taken_from.items())
        end = "" if fit.improved else " No fit was better, so these servos are written as they are."
        screen.say(f"Start and prior: {taken}.{end}")


def _show_servos(screen: Out, made: IdentifyResult) -> None:
    """Print the parameters of each joint, and those of its servo type with their source."""
    values = made.values()
    shown = []
    for field in SERVO_FIELDS:
        if any(servo.get(field) for servo in values.values()):
            shown.append(field)
    rows = made.rows(shown)
    sources = []
    for servo in made.servo_types():
        cells = [servo.measured_text(field) for field in shown]
        if any(cells):
            rows.append([f"servo {servo.name}", *cells])
            sources.append(f"servo {servo.name}: {servo.source}")
    columns = ["joint", *(SERVO_FIELDS[field].heading for field in shown)]
    screen.table("Identified servos, ± standard error", columns, rows)
    for source in sources:
        screen.say(source)


def _show_terms(screen: Out, made: IdentifyResult) -> None:
    """Print what each term gave, the findings, and masses that the model lacks."""
    fit = made.fit
    for term in fit.comparisons:
        judges = "motions" if term.name == "torque" else "recordings"
        over = f" over {len(term.before)} {judges}" if len(term.before) > 1 else ""
        accepted = "accepted" if term.accepted else "not accepted"
        gain, error = term.gain
        direction = "rises" if gain < 0 else "falls"
        moves = f"{direction} by {mrad_with_error(abs(gain), error)}"
        screen.say(f"{term.name}: validation error {moves}{over}; {accepted}")
    for sentence in fit.findings:
        screen.say(f"  {sentence}")
    if fit.chosen != "torque":
        return
    for mount in fit.robot.payload_mounts:
        screen.say(
            f"payload_mount {mount.side}: at {mount.pos} m of {mount.body}, where {mount.mass:g} "
            "kg hang that the model lacks"
        )


def _show_table(screen: Out, made: IdentifyResult) -> None:
    """Print the table under the robot, if a tip came near one."""
    touch = made.fit.table_fit
    table = made.robot.scene.table
    if touch is None or not touch.motions:
        return
    what = "none that explains them"
    if touch.accepted and table is not None:
        what = (
            f"height {table.height:.4f} m, friction {table.friction:.2f}, {table.stiffness:.0f} N/m"
        )
    screen.say(
        f"table: {what}; mean |error| of fitted windows with a low tip "
        f"{mrad(touch.before.mean())} → {mrad(touch.after.mean())} mrad, in "
        f"{', '.join(touch.motions)}"
    )


def _show_warnings(screen: Out, made: IdentifyResult, details: bool) -> None:
    """Print the warnings; those about undetermined parameters in one sentence, or each with
    `details`.
    """
    unknown = [warning for warning in made.fit.warnings if UNDETERMINED in warning]
    for warning in made.fit.warnings:
        if details or warning not in unknown:
            screen.say(f"  {warning}", "warning", "yellow")
    if unknown and not details:
        joints = abbreviate([warning.partition(":")[0] for warning in unknown])
        screen.say(
            f"some parameters of {joints} are not determined (--details). Use all values of a "
            "joint together"
        )


def show_torque_driven(screen: Out, made: TorqueResult, current: bool) -> None:
    """Print the parameters of a torque-driven robot and its errors before and after.

    Args:
        current: The torque constant was fitted too.
    """
    fit = made.fit
    headings = [SERVO_FIELDS[field].heading for field in PASSIVE_FIELDS]
    columns = ["joint", *headings, "delay, ms", "bias, N·m"]
    if current:
        columns.append("N·m per unit")
    columns += ["torque apart before, N·m", "after"]
    rows = [made.row(joint, with_constant=current) for joint in made.robot.operated]
    title = "Torque-driven joints, ± standard error; medians on recordings that were not fitted"
    screen.table(title, columns, rows)
    virtual = "VIRTUAL " if made.virtual else ""
    title = (
        f"Angle apart from the {virtual}robot, so long after its state, mrad: before → after, "
        f"{fit.windows} starts"
    )
    rows = []
    for j, joint in enumerate(made.robot.operated):
        cells = []
        for before, after in fit.angle.values():
            cells.append(f"{mrad(before[j])} → {mrad(after[j])}")
        rows.append([joint, *cells])
    screen.table(title, ["joint", *(f"{horizon:g} s" for horizon in fit.angle)], rows)
    screen.findings(made.doctor.findings)
    screen.say(
        f"robot folder {made.folder}: armature, damping, friction and delay; a servo's kp and kd "
        "are the file's still"
    )
