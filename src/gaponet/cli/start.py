"""gaponet start: from a model file and a folder of logs to a report, by single commands, which it prints as it goes."""

from __future__ import annotations

import contextlib
import hashlib
import shlex
import signal
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro
from typing_extensions import TypedDict

from gaponet import api
from gaponet.base.errors import UsageError
from gaponet.base.files import lock_folder, write_json, write_text
from gaponet.base.progress import progress_bar
from gaponet.base.structure import read_json
from gaponet.cli.logs import joint_map, show_diagnosis
from gaponet.cli.main import main
from gaponet.cli.options import Flag, Json, Logs, Model
from gaponet.cli.out import Out
from gaponet.data.checks.gate import refuse_errors
from gaponet.data.store import Dataset, dataset_hash
from gaponet.robot.finding import abbreviate
from gaponet.robot.spec import RobotSpec, load_robot, named_robots, robot_argument
from gaponet.share.remote import FileRecord

if TYPE_CHECKING:
    from gaponet.data.log import Log
    from gaponet.robot.new import RobotOptions

COMMANDS_FILE = "commands.sh"  # the commands that have finished, one per line
RECORD_FILE, MODEL_INPUT = (
    "start.json",
    "the model",
)  # MODEL_INPUT: what the robot's command depends on
MIN_RECORDINGS = 3  # fewer are cut into pieces, so that some can validate
PIECE_S, MIN_PIECE_S = 8.0, 4.0
MAX_RELATIVE_ROUNDING = 0.01  # of the measured rate to a whole number of Hz


@dataclass(frozen=True)
class Inspection:
    """A model and the first of its logs.

    Attributes:
        robot: The model's robot; of a model file with its default joints.
        packaged: Argument of --robot for a robot that exists; "" for a model file.
        log: The first recording.
        recordings: Number of recordings.
        logs_toml: Text of a logs.toml that was guessed; "" where the logs need none.
    """

    robot: RobotSpec
    packaged: str
    log: Log
    recordings: int
    logs_toml: str

    @property
    def rate(self) -> float:
        """Rate of the commands, Hz, rounded to a whole number that is near."""
        rate = 1 / float(np.median(np.diff(self.log.channels["ctrl"].time)))
        return (
            float(round(rate)) if abs(rate - round(rate)) < MAX_RELATIVE_ROUNDING * rate else rate
        )


def start(
    model: Model, logs: Logs, out: Path = Path("started"), unit_id: str = "lab", payload_mass: float = 0.0,
    joints: tuple[str, ...] = (), kp: tuple[str, ...] = (), kd: tuple[str, ...] = (),
    effort_limit: tuple[str, ...] = (), map: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),
    format: str | None = None,
    position_unit: Literal["rad", "deg", "fraction", "ticks", "signed_percent"] | None = None,
    time_unit: Literal["s", "ms", "us", "ns"] | None = None, rate: float | None = None, cut: float | None = None,
    skip_bad: Flag = False, allow_pickle: Flag = False,
    to: Literal["mjcf", "mjlab", "isaaclab", "newton", "json"] = "mjcf", budget: str | None = None,
    dry_run: Flag = False, despite_errors: Flag = False, json: Json = False,
) -> None:  # fmt: skip
    """All steps in one command: from model file and logs to a report.

    OUT/commands.sh lists the commands that ran. The same command again continues after an interruption or a question.
    Logs that were added to the folder are imported, and later commands run again. Other logs need another OUT.

    Args:
        model: MJCF or URDF file; or a robot folder, or a packaged robot's name.
        logs: Folder of logs, in any format that gaponet import reads.
        out: Folder for all results.
        unit_id: Name of the recorded robot.
        payload_mass: kg in each hand while recording.
        joints: Recorded joints of the model, by name or pattern. Default: those that the logs name.
        kp: Position gain of the controller while recording, N·m/rad: NUMBER or PATTERN=NUMBER. Default: the model's.
        kd: Damping gain, likewise, N·m·s/rad.
        effort_limit: Torque limit, likewise, N·m.
        map: A joint's name in the log and the robot's, as a=b; may be repeated.
        format: Format of the logs; gaponet import --formats lists them.
        position_unit: Unit of positions, where the format leaves it open.
        time_unit: Unit of time, where the format leaves it open.
        rate: Hz, of logs without a clock.
        cut: Length of the pieces of long recordings, s; default 8 where there are fewer than three recordings.
        skip_bad: Cut bad rows and leave out logs that cannot be read.
        allow_pickle: Open pickled files.
        to: Engine to export to.
        budget: Time that identification may take, such as 4m; default no limit.
        dry_run: Print the inspection and the commands, and write nothing.
        despite_errors: Continue although the doctor finds errors in the logs; the identified robot keeps them.
    """
    from gaponet.report.view.gl import prepare

    prepare()  # before MuJoCo is imported, which the report's picture would be too late for
    from gaponet.data.describe.preview import DescriptionNeededError
    from gaponet.robot.new import RobotOptions

    screen, logs_toml = Out(json), out / "logs.toml"
    values = {
        "format": format,
        "position_unit": position_unit,
        "time_unit": time_unit,
        "rate": rate,
        "cut": cut,
    }
    import_options = [
        "--unit-id",
        unit_id,
        "--payload-mass",
        f"{payload_mass:g}",
        *(f"--map={pair}" for pair in map),
    ]
    import_options += [f"--{k.replace('_', '-')}={v}" for k, v in values.items() if v is not None]
    import_options += ["--skip-bad"] * skip_bad + ["--allow-pickle"] * allow_pickle
    read_options: dict[str, Any] = {
        "fmt": format, "joint_map": joint_map(map), "skip_bad": skip_bad, "allow_pickle": allow_pickle,
        **{name: values[name] for name in ("position_unit", "time_unit", "rate")},
    }  # fmt: skip
    record = StartRecord(out, logs)
    robot_options = RobotOptions(joints=joints, kp=kp, kd=kd, effort_limit=effort_limit)
    with contextlib.redirect_stdout(sys.stderr if json else sys.stdout):
        try:
            inspection = inspect_inputs(
                model, logs, logs_toml, robot_options, read_options, guess_joints=dry_run
            )
        except DescriptionNeededError as error:
            for line in error.text.splitlines():
                screen.say(f"  {line}")
            if dry_run:
                then = f"without --dry-run they are written to {logs_toml} for you to check"
            else:
                then = f"they are in {logs_toml}: check those with a ?, then give the same command again"
                with lock_folder(out, "started"):
                    write_text(logs_toml, error.text)
            raise UsageError(
                f"{error}. The lines above are a guess from these logs; {then}"
            ) from None
        _print_inspection(screen, inspection, model, logs, unit_id, payload_mass)
        commands = make_commands(
            inspection, model, logs, out, robot_options, import_options, cut is None
        )
        for words in commands:
            words += ["--to", to] if words[0] == "export" else []
            words += ["--budget", budget] if words[0] == "identify" and budget else []
            words += ["--despite-errors"] if words[0] == "identify" and despite_errors else []
        lines = [shlex.join(["gaponet", *words]) for words in commands]
        if dry_run:
            for line in lines:
                screen.say(line, "  ")
        else:
            with lock_folder(out, "started"):
                if inspection.logs_toml:
                    write_text(logs_toml, inspection.logs_toml)
                record.begin(
                    shlex.join(next(words for words in commands if words[0] == "import")[2:])
                )
                _run(screen, commands, lines, record, despite_errors)
            screen.say(f"commands that ran: {out / COMMANDS_FILE}")
            screen.next(f"look at {out / 'identified' / 'report.html'}")
    screen.result({
        "robot": inspection.robot.name, "joints": inspection.log.joint_names, "recordings": inspection.recordings,
        "rate_hz": inspection.rate, "logs_toml": inspection.logs_toml, "commands": lines, "ran": not dry_run,
    })  # fmt: skip


def inspect_inputs(
    model: Path, logs: Path, logs_toml: Path, robot_options: RobotOptions, read_options: dict[str, Any],
    guess_joints: bool,
) -> Inspection:  # fmt: skip
    """Compile the model and read the first recording, with a guessed logs.toml where one is needed.

    Args:
        model: File, robot folder, or name of a packaged robot.
        logs_toml: Description of the logs that a user checked, if the file exists.
        robot_options: Options for a robot that is made from a file.
        read_options: Options for the logs, as read_first_recording takes them.
        guess_joints: Accept a guess of which joint is which.

    Raises:
        DescriptionNeededError: A person has to check the guess.
        RobotError, UsageError, LogError: The model is broken, or the logs cannot be read; the message says what to do.
    """
    from gaponet.data.describe.preview import read_first_recording
    from gaponet.robot.new import new_robot

    with tempfile.TemporaryDirectory() as place:
        if (model / "robot.toml").is_file():
            robot, packaged = load_robot(model), robot_argument(model)
        elif not model.exists() and str(model) in named_robots():
            robot = load_robot(packaged := str(model))
        else:
            robot, packaged = new_robot(model, Path(place) / "robot", robot_options).robot, ""
        checked = logs_toml if logs_toml.is_file() else None
        return Inspection(
            robot,
            packaged,
            *read_first_recording(logs, robot, checked, guess_joints, **read_options),
        )


def make_commands(
    inspection: Inspection, model: Path, logs: Path, out: Path, robot_options: RobotOptions,
    import_options: list[str], cut_few: bool,
) -> list[list[str]]:  # fmt: skip
    """Return the commands from model and logs to a report, as words after `gaponet`.

    Args:
        import_options: Options of import about the recordings.
        cut_few: Cut the recordings into pieces if they are fewer than MIN_RECORDINGS.
    """
    data, identified, commands = str(out / "data"), out / "identified", list[list[str]]()
    if not inspection.packaged:
        options = {
            name: getattr(robot_options, name) for name in ("joints", "kp", "kd", "effort_limit")
        }
        if not options["joints"] and len(inspection.log.joint_names) < len(
            inspection.robot.joint_names
        ):
            options["joints"] = inspection.log.joint_names
        words = [
            x
            for name, value in options.items()
            if value
            for x in (f"--{name.replace('_', '-')}", *value)
        ]
        rate = f"{inspection.rate:g}"
        commands.append(
            ["robot", "new", str(model), "--out", str(out / "robot"), "--rate", rate, *words]
        )
    robot, logs_toml = inspection.packaged or robot_argument(out / "robot"), out / "logs.toml"
    described = ["--logs", str(logs_toml)] if inspection.logs_toml or logs_toml.is_file() else []
    time = inspection.log.channels["ctrl"].time
    piece = min(PIECE_S, float(time[-1] - time[0]) / MIN_RECORDINGS)
    if cut_few and inspection.recordings < MIN_RECORDINGS and piece >= MIN_PIECE_S:
        described += ["--cut", f"{piece:.3g}"]
    return [
        *commands,
        ["import", str(logs), "--robot", robot, *import_options, *described, "--out", data],
        ["doctor", data],
        ["gap", data],
        ["identify", data, "--out", str(identified)],
        ["gap", data, "--robot", robot_argument(identified)],
        ["export", str(identified)],
        ["report", str(identified)],
    ]


def _print_inspection(
    screen: Out, inspection: Inspection, model: Path, logs: Path, unit_id: str, payload_mass: float
) -> None:
    log, robot = inspection.log, inspection.robot
    time, absent = (
        log.channels["ctrl"].time,
        [j for j in robot.joint_names if j not in log.joint_names],
    )
    first = f"{time[-1] - time[0]:.1f} s at {inspection.rate:g} Hz, {', '.join(log.channels)}"
    gains = ", ".join(f"{x:g}" for x in robot.kp)
    rows = {
        "robot": f"{robot.name}, from {inspection.packaged or model}; kp {gains} N·m/rad",
        "logs": f"{inspection.recordings} recording(s) below {logs}; the first: {first}",
        "joints recorded": ", ".join(log.joint_names),
        "frozen" if not inspection.packaged else "assumed at the home position": ", ".join(absent),
        "assumed": f"unit {unit_id}, {payload_mass:g} kg in each hand (--unit-id, --payload-mass)",
    }
    for label, text in rows.items():
        if text:
            screen.say(f": {text}", label)
    for line in inspection.logs_toml.splitlines():
        screen.say(
            f"  {line}", "logs.toml, guessed" if line.startswith("# Lines") else "", "yellow"
        )


class _RecordFields(TypedDict):
    """start.json: path of the logs, their hashes, options of import, finished command → hash of its inputs."""

    logs: str
    options: str
    files: dict[str, str]
    done: dict[str, str]


class StartRecord:
    """Logs, options and finished commands of a folder that `gaponet start` fills, in start.json."""

    def __init__(self, out: Path, logs: Path) -> None:
        """Read the record of a folder, or start one.

        Raises:
            UsageError: The folder holds data of other logs.
        """
        self.out, self.data, path = out, out / "data", out / RECORD_FILE
        known, source = (
            _RecordFields(logs="", files={}, options="", done={}),
            "logs that no file names",
        )
        if path.is_file():
            known = read_json(_RecordFields, path, UsageError, f"delete it and {self.data}")
            source = known["logs"]
        self.fields = known | {"logs": str(logs.resolve()), "files": hash_logs(logs, out)}
        if not self.data.exists():  # only the robot is there
            done = {line: inputs for line, inputs in known["done"].items() if inputs == MODEL_INPUT}
            self.fields |= {"options": "", "done": done}
            return
        other = [
            name
            for name, digest in known["files"].items()
            if self.fields["files"].get(name) != digest
        ]
        if known["logs"] and not other:
            return
        if other:
            source += f", of which {abbreviate(other)} {'is' if len(other) == 1 else 'are'} missing or changed"
            source += f" in {logs}" * (self.fields["logs"] != known["logs"])
        raise UsageError(
            f"{self.data} was made from {source}. Give another --out for these logs, or the same logs again; or delete "
            f"{self.data}, and it is made anew"
        )

    def begin(self, options: str) -> None:
        """Take the present logs and these options of import as those of this run.

        Raises:
            UsageError: The data that are there were imported with other options.
        """
        if self.fields["options"] not in ("", options):
            raise UsageError(
                f"{self.data} was imported with {self.fields['options']}, not with {options}. Give another --out, or "
                f"the same options again; or delete {self.data}, and it is made anew"
            )
        self.fields["options"] = options
        logs_toml = self.out / "logs.toml"
        if logs_toml.is_file():
            self.fields["files"][f"{self.out.name}/logs.toml"] = FileRecord.of(logs_toml).sha256
        if not self.data.exists():  # an interrupted import leaves data of these logs
            write_json(self.out / RECORD_FILE, self.fields)

    def inputs(self, command: str) -> str:
        """Return what a command depends on: the model, the logs, or the recordings in the dataset."""
        if command == "robot":
            return MODEL_INPUT
        if command == "import":
            return hashlib.sha256(str(sorted(self.fields["files"].items())).encode()).hexdigest()
        return dataset_hash(Dataset(self.data).entries)

    def finish(self, line: str, inputs: str) -> None:
        """Record a finished command."""
        self.fields["done"][line] = inputs
        write_json(self.out / RECORD_FILE, self.fields)
        write_text(self.out / COMMANDS_FILE, "\n".join(self.fields["done"]) + "\n")


def hash_logs(logs: Path, out: Path) -> dict[str, str]:
    """Return file → SHA-256 of all logs, and of the logs.toml in `out`, which may lie among the logs."""
    paths, root = (logs.rglob("*"), logs) if logs.is_dir() else ([logs], logs.parent)
    files = {
        file.relative_to(root).as_posix(): file
        for file in paths
        if out.resolve() not in file.resolve().parents
    }
    files = {
        name: file
        for name, file in files.items()
        if not any(part.startswith(".") for part in name.split("/"))
    }
    files[f"{out.name}/logs.toml"] = out / "logs.toml"
    return {
        name: FileRecord.of(file).sha256 for name, file in sorted(files.items()) if file.is_file()
    }


def _run(
    screen: Out,
    commands: list[list[str]],
    lines: list[str],
    record: StartRecord,
    despite_errors: bool,
) -> None:
    """Run the commands that have not finished on the present inputs; none of them names the next one."""
    Out.names_next = False
    try:
        for words, line in zip(commands, lines, strict=True):
            inputs = record.inputs(words[0])
            if record.fields["done"].get(line) == inputs:
                screen.say(line, "done before: ", "green")
                continue
            screen.say(line, "$ ", "bold cyan")
            if words[0] == "doctor":
                with progress_bar("examining") as update:
                    diagnosis = api.doctor(words[1], progress=update)
                show_diagnosis(screen, diagnosis)
                if not despite_errors:
                    way_out = (
                        f"Correct the logs or {record.out / 'logs.toml'} (gaponet doctor {words[1]} --fix proposes "
                        f"lines), delete {words[1]}, and give the same command again"
                    )
                    refuse_errors(diagnosis.findings, words[1], way_out)
            elif code := main(words):
                if code == 128 + signal.SIGINT:
                    raise KeyboardInterrupt("the same command again goes on")
                raise UsageError(
                    f"stopped at: {line}; the message above says what to do; then give the same command again"
                )
            record.finish(line, inputs)
    finally:
        Out.names_next = True
