"""gaponet start: from a model file and a folder of logs to a report, by single commands, which it
prints as it goes."""

from __future__ import annotations

import contextlib
import signal
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from gaponet import api
from gaponet.api.start import (
    COMMANDS_FILE,
    Inspection,
    Start,
    StartOptions,
    StartRecord,
    Step,
    UnclearLogsError,
)
from gaponet.base.errors import UsageError
from gaponet.base.files import lock_folder, write_text
from gaponet.base.progress import progress_bar
from gaponet.cli.logs import show_diagnosis
from gaponet.cli.main import main
from gaponet.cli.options import Flag, Json, Logs, Model
from gaponet.cli.out import Out


@dataclass(frozen=True)
class StartArgs(StartOptions):
    """What the steps are told about the robot and its logs."""

    map: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """NAME_IN_LOG=NAME_OF_ROBOT of a joint; give the option once for each joint."""


def start(
    model: Model,
    logs: Logs,
    out: Path = Path("started"),
    options: Annotated[
        StartArgs, tyro.conf.arg(name=""), tyro.conf.FlagCreatePairsOff
    ] = StartArgs(),
    dry_run: Flag = False,
    json: Json = False,
) -> None:
    """All steps in one command: from model file and logs to a report.

    OUT/commands.sh lists the commands that ran. After an interruption or a question, give the same
    command again: it continues. Logs that were added to the folder are then imported, and later
    commands run again. Other logs need another OUT.

    Args:
        model: MJCF or URDF file of the robot, a robot folder, or a name such as so101.
        logs: Folder of logs, in any format that gaponet import reads.
        out: Folder for all results.
        options: The robot and its logs.
        dry_run: Print how the model and the logs were understood and which commands would run;
            write nothing.
    """
    screen = Out(json)
    task = Start(model=model, logs=logs, out=out, options=options)
    record = StartRecord(out, logs)
    with contextlib.redirect_stdout(sys.stderr if json else sys.stdout):
        inspection = _inspect(screen, task, dry_run)
        _show_inspection(screen, task, inspection)
        steps = task.steps(inspection)
        if dry_run:
            for step in steps:
                screen.say(step.line, "  ")
        else:
            with lock_folder(out, "started"):
                if inspection.logs_toml:
                    write_text(task.logs_toml, inspection.logs_toml)
                record.begin(steps)
                _walk(screen, task, steps, record)
            screen.say(f"commands that ran: {out / COMMANDS_FILE}")
            screen.next(f"look at {out / 'identified' / 'report.html'}")
    found = {
        "robot": inspection.robot.name,
        "joints": inspection.log.joint_names,
        "recordings": inspection.recordings,
        "rate_hz": inspection.rate,
        "logs_toml": inspection.logs_toml,
        "commands": [step.line for step in steps],
        "ran": not dry_run,
    }
    screen.result(found)


def _inspect(screen: Out, task: Start, dry_run: bool) -> Inspection:
    """Inspect model and logs; a guess that a person has to check is shown and kept.

    Raises:
        UsageError: There is such a guess.
    """
    try:
        return task.inspect(guess_joints=dry_run)
    except UnclearLogsError as error:
        for line in error.text.splitlines():
            screen.say(f"  {line}")
        then = f"without --dry-run they are written to {task.logs_toml} for you to check"
        if not dry_run:
            task.keep_guess(error.text)
            then = (
                f"they are in {task.logs_toml}: check those with a ?, then give the same command "
                "again"
            )
        raise UsageError(f"{error}. The lines above are a guess from these logs; {then}") from None


def _show_inspection(screen: Out, task: Start, inspection: Inspection) -> None:
    """Print what was understood of model and logs."""
    log = inspection.log
    robot = inspection.robot
    options = task.options
    gains = ", ".join(f"{kp:g}" for kp in robot.servo.kp)
    source = inspection.packaged or task.model
    channels = ", ".join(log.channels)
    first = f"{inspection.seconds:.1f} s at {inspection.rate:g} Hz, {channels}"
    absent = [joint for joint in robot.joint_names if joint not in log.joint_names]
    held = "assumed at the home position" if inspection.packaged else "frozen"
    assumed = f"unit {options.unit_id}, {options.payload_mass:g} kg in each hand"
    rows = {
        "robot": f"{robot.name}, from {source}; kp {gains} N·m/rad",
        "logs": f"{inspection.recordings} recording(s) below {task.logs}; the first: {first}",
        "joints recorded": ", ".join(log.joint_names),
        held: ", ".join(absent),
        "assumed": f"{assumed} (--unit-id, --payload-mass)",
    }
    for label, text in rows.items():
        if text:
            screen.say(f": {text}", label)
    for line in inspection.logs_toml.splitlines():
        label = "logs.toml, guessed" if line.startswith("# Lines") else ""
        screen.say(f"  {line}", label, "yellow")


def _walk(screen: Out, task: Start, steps: list[Step], record: StartRecord) -> None:
    """Run the steps that have not finished on the present inputs; none of them names the next."""
    Out.names_next = False
    try:
        for step in steps:
            inputs = record.inputs(step)
            if record.has_finished(step, inputs):
                screen.say(step.line, "done before: ", "green")
                continue
            screen.say(step.line, "$ ", "bold cyan")
            if step.name == "doctor":
                _examine(screen, task, step.words[1])
            else:
                _run(step)
            record.finish(step, inputs)
    finally:
        Out.names_next = True


def _examine(screen: Out, task: Start, dataset: str) -> None:
    """Show what the doctor finds in a dataset, and stop at an error."""
    with progress_bar("examining") as update:
        diagnosis = api.doctor(dataset, progress=update)
    show_diagnosis(screen, diagnosis)
    task.require_sound(dataset, diagnosis)


def _run(step: Step) -> None:
    """Run the command of a step.

    Raises:
        UsageError: It failed; its own message stands above.
    """
    code = main(list(step.words))
    if code == 128 + signal.SIGINT:
        raise KeyboardInterrupt("the same command again continues")
    if code:
        raise UsageError(
            f"stopped at: {step.line}; the message above says what to do; then give the same "
            "command again"
        )
