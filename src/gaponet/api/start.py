"""What gaponet start does: from the model and the logs of a laboratory to a report.

report/steps.py has the list of steps. `StartRecord` remembers which have finished.
"""

from __future__ import annotations

import hashlib
import shlex
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from typing_extensions import TypedDict

from gaponet.api.options import parse_joint_map
from gaponet.base.errors import LogError, UsageError
from gaponet.base.files import lock_folder, write_json, write_text
from gaponet.base.structure import read_json
from gaponet.data.formats import PositionUnit, ReadOptions, TimeUnit, files_below
from gaponet.data.store import Dataset, dataset_hash
from gaponet.report.steps import Option, Target, make_robot
from gaponet.report.steps import Step as Step
from gaponet.report.steps import measure_error as measure_error
from gaponet.report.steps import steps_from_logs as steps_from_logs
from gaponet.robot.finding import abbreviate
from gaponet.robot.spec import RobotSpec, load_robot, named_robots, robot_argument
from gaponet.robot.toml_file import RobotOptions
from gaponet.share.remote import FileRecord

if TYPE_CHECKING:
    from gaponet.data.doctor import DoctorResult
    from gaponet.data.log import Log

COMMANDS_FILE = "commands.sh"  # the commands that have finished, one per line
RECORD_FILE = "start.json"
MODEL_INPUT = "the model"  # what the command that makes the robot depends on
MIN_RECORDINGS = 3  # fewer are cut into pieces, so that some can validate
PIECE_S = 8.0
MIN_PIECE_S = 4.0
MAX_RELATIVE_ROUNDING = 0.01  # of the measured rate to a whole number of Hz


@dataclass(frozen=True)
class StartOptions:
    """What the steps are told about the robot and its logs."""

    unit_id: str = "lab"
    """Name that you choose for the recorded robot."""
    payload_mass: float = 0.0
    """Payload in each hand in all logs, kg."""
    joints: tuple[str, ...] = ()
    """Joints of the model that were recorded, by name or pattern ('*_elbow_*'). Default: those that
    the logs name."""
    kp: tuple[str, ...] = ()
    """Stiffness of the controller that recorded the logs, N·m/rad: NUMBER for all joints,
    PATTERN=NUMBER for some. Default: the model's."""
    kd: tuple[str, ...] = ()
    """Damping gain of that controller, N·m·s/rad: NUMBER or PATTERN=NUMBER. Default: the
    model's.
    """
    effort_limit: tuple[str, ...] = ()
    """Largest torque of the motors, N·m: NUMBER or PATTERN=NUMBER. Default: the model's."""
    format: str | None = None
    """Format of the logs; gaponet import --formats lists all. Default: recognised from the
    files."""
    position_unit: PositionUnit | None = None
    """Unit of the positions. Needed if the logs do not state it."""
    time_unit: TimeUnit | None = None
    """Unit of the clock. Needed if the logs do not state it."""
    rate: float | None = None
    """Rows per second, Hz, of logs that have no clock."""
    cut: float | None = None
    """Cut long recordings into equal pieces of about this length, s. Default: no cut, but 8 s if
    there are fewer than three recordings."""
    skip_bad: bool = False
    """Cut bad rows and leave out logs that cannot be read. Without this option one bad log stops
    the command."""
    allow_pickle: bool = False
    """Open pickled files (ASAP). The unpickler makes only arrays, numbers and text, and runs no
    code of the file."""
    to: Target = "mjcf"
    """Engine for which the identified robot is exported; mjcf is plain MuJoCo."""
    budget: str | None = None
    """Time that identification may take, such as 4m. Default: no limit."""
    despite_errors: bool = False
    """Go on although the doctor finds errors in the logs. The identified robot then contains
    them."""
    map: tuple[str, ...] = ()
    """NAME_IN_LOG=NAME_OF_ROBOT of a joint; give the option once for each joint."""

    @property
    def robot(self) -> RobotOptions:
        """Options of the command that makes a robot."""
        return RobotOptions(self.joints, self.kp, self.kd, self.effort_limit)

    def import_options(self) -> dict[str, Option]:
        """Return the options of gaponet import about the recordings."""
        return {
            "unit_id": self.unit_id,
            "payload_mass": f"{self.payload_mass:g}",
            "map": self.map,
            "format": self.format,
            "position_unit": self.position_unit,
            "time_unit": self.time_unit,
            "rate": self.rate,
            "skip_bad": self.skip_bad,
            "allow_pickle": self.allow_pickle,
        }

    def read_options(self, logs: Path | None = None) -> ReadOptions:
        """Return how a recording is read, by this logs.toml if there is one."""
        return ReadOptions(
            format=self.format,
            joint_map=parse_joint_map(self.map),
            logs=logs,
            position_unit=self.position_unit,
            time_unit=self.time_unit,
            rate=self.rate,
            allow_pickle=self.allow_pickle,
        )


# ---- inspection of a model and logs


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
    def seconds(self) -> float:
        """Duration of the first recording, s."""
        time = self.log.channels["ctrl"].time
        return float(time[-1] - time[0])

    @property
    def rate(self) -> float:
        """Rate of the commands, Hz, rounded to a whole number that is near."""
        rate = 1 / float(np.median(np.diff(self.log.channels["ctrl"].time)))
        is_near = abs(rate - round(rate)) < MAX_RELATIVE_ROUNDING * rate
        return float(round(rate)) if is_near else rate


@dataclass(frozen=True, kw_only=True)
class Start:
    """Steps from a model file and a folder of logs to a report.

    Attributes:
        out: Folder for all results.
        logs: Folder of logs.
    """

    model: Path
    logs: Path
    out: Path
    options: StartOptions = field(default_factory=StartOptions)

    @property
    def logs_toml(self) -> Path:
        """Description of the logs that a person checked, if the file exists."""
        return self.out / "logs.toml"

    def inspect(self, *, guess_joints: bool = False) -> Inspection:
        """Compile the model and read the first recording, with a guessed logs.toml if needed.

        Args:
            guess_joints: Accept a guess of which joint is which.

        Raises:
            UnclearLogsError: A person has to check the guess.
            RobotError, UsageError, LogError: The model is broken, or the logs cannot be read.
        """
        from gaponet.report.view.gl import prepare

        prepare()  # before MuJoCo is imported, which the report's picture would be too late for
        from gaponet.data.describe.preview import DescriptionNeededError, read_first_recording
        from gaponet.robot.new import new_robot

        with tempfile.TemporaryDirectory() as place:
            packaged = self._packaged()
            if packaged:
                robot = load_robot(packaged)
            else:
                robot = new_robot(self.model, Path(place) / "robot", self.options.robot).robot
            checked = self.logs_toml if self.logs_toml.is_file() else None
            try:
                read_options = self.options.read_options(checked)
                log, recordings, guessed = read_first_recording(
                    self.logs, robot, read_options, guess_joints, self.options.skip_bad
                )
            except DescriptionNeededError as error:
                raise UnclearLogsError(str(error), error.text) from None
        return Inspection(robot, packaged, log, recordings, guessed)

    def _packaged(self) -> str:
        """Return --robot of a robot folder or of a robot of the package; "" for a model file."""
        if (self.model / "robot.toml").is_file():
            return robot_argument(self.model)
        if not self.model.exists() and str(self.model) in named_robots():
            return str(self.model)
        return ""

    def steps(self, inspection: Inspection) -> list[Step]:
        """Return the steps from model and logs to a report."""
        options = self.options
        steps = []
        robot = inspection.packaged
        if not robot:
            steps.append(self._make_robot(inspection))
            robot = robot_argument(self.out / "robot")
        import_options = options.import_options()
        if inspection.logs_toml or self.logs_toml.is_file():
            import_options["logs"] = str(self.logs_toml)
        piece = min(PIECE_S, inspection.seconds / MIN_RECORDINGS)
        few = inspection.recordings < MIN_RECORDINGS
        import_options["cut"] = options.cut
        if options.cut is None and few and piece >= MIN_PIECE_S:
            import_options["cut"] = f"{piece:.3g}"
        identify_options = {"budget": options.budget, "despite_errors": options.despite_errors}
        return steps + steps_from_logs(
            self.logs, robot, import_options, self.out, identify_options, options.to
        )

    def _make_robot(self, inspection: Inspection) -> Step:
        """Return the step that makes a robot folder from a model file."""
        given = self.options.robot
        joints = given.joints
        recorded = inspection.log.joint_names
        if not joints and len(recorded) < len(inspection.robot.joint_names):
            joints = recorded
        return make_robot(
            str(self.model),
            str(self.out / "robot"),
            rate=f"{inspection.rate:g}",
            joints=joints,
            kp=given.kp,
            kd=given.kd,
            effort_limit=given.effort_limit,
        )

    def keep_guess(self, text: str) -> None:
        """Write a guessed logs.toml into the folder, for a person to check."""
        with lock_folder(self.out, "started"):
            write_text(self.logs_toml, text)

    def require_sound(self, dataset: str, diagnosis: DoctorResult) -> None:
        """Refuse recordings in which the doctor found an error, unless the options accept it.

        Raises:
            DatasetError: With the first error, and what to do.
        """
        from gaponet.data.checks.gate import refuse_errors

        if self.options.despite_errors:
            return
        way_out = (
            f"Correct the logs or {self.logs_toml} (gaponet doctor {dataset} --fix proposes "
            f"lines), delete {dataset}, and give the same command again"
        )
        refuse_errors(diagnosis.findings, dataset, way_out)


class UnclearLogsError(LogError):
    """A person has to look at `text`, a guessed logs.toml."""

    def __init__(self, why: str, text: str) -> None:
        super().__init__(why)
        self.text = text


# ---- what has run


class _RecordFields(TypedDict):
    """What start.json holds."""

    logs: str  # path
    options: str  # of import, as they are typed
    files: dict[str, str]  # file → SHA-256
    done: dict[str, str]  # finished command → its inputs (StartRecord.inputs)


class StartRecord:
    """Logs, options and finished commands of a folder that `gaponet start` fills, in start.json."""

    def __init__(self, out: Path, logs: Path) -> None:
        """Read the record of a folder, or start one.

        Raises:
            UsageError: The folder holds data of other logs.
        """
        self.out = out
        self.data = out / "data"
        known = _RecordFields(logs="", files={}, options="", done={})
        path = out / RECORD_FILE
        if path.is_file():
            known = read_json(_RecordFields, path, UsageError, f"delete it and {self.data}")
        self.fields = _RecordFields(
            logs=str(logs.resolve()),
            files=hash_logs(logs, out),
            options=known["options"],
            done=known["done"],
        )
        if self.data.exists():
            self._require_same_logs(known, path.is_file(), logs)
            return
        # The data are made anew, with any options; only the step that makes the robot stays done.
        self.fields["options"] = ""
        self.fields["done"] = {
            line: inputs for line, inputs in known["done"].items() if inputs == MODEL_INPUT
        }

    def _require_same_logs(self, known: _RecordFields, stored: bool, logs: Path) -> None:
        """Refuse data that were made from other logs.

        Raises:
            UsageError: A file is missing, has changed, or is not known.
        """
        other = []
        for name, digest in known["files"].items():
            if self.fields["files"].get(name) != digest:
                other.append(name)
        if known["logs"] and not other:
            return
        source = known["logs"] if stored else "logs that no file names"
        if other:
            verb = "is" if len(other) == 1 else "are"
            source += f", of which {abbreviate(other)} {verb} missing or changed"
            if self.fields["logs"] != known["logs"]:
                source += f" in {logs}"
        raise UsageError(
            f"{self.data} was made from {source}. Give another --out for these logs, or the same "
            f"logs again; or delete {self.data}, and it is made anew"
        )

    def begin(self, steps: list[Step]) -> None:
        """Take the present logs and the options of import as those of this run.

        Raises:
            UsageError: The data that are there were imported with other options.
        """
        (options,) = [shlex.join(step.words[2:]) for step in steps if step.name == "import"]
        if self.fields["options"] not in ("", options):
            raise UsageError(
                f"{self.data} was imported with {self.fields['options']}, not with {options}. Give "
                f"another --out, or the same options again; or delete {self.data}, and it is made "
                "anew"
            )
        self.fields["options"] = options
        logs_toml = self.out / "logs.toml"
        if logs_toml.is_file():
            self.fields["files"][f"{self.out.name}/logs.toml"] = FileRecord.of(logs_toml).sha256
        # An interrupted import leaves data, and the next start has to know of which logs. Where
        # data are there already, `finish` writes: if the import refuses a log that was added, the
        # log can be taken away again.
        if not self.data.exists():
            write_json(self.out / RECORD_FILE, self.fields)

    def inputs(self, step: Step) -> str:
        """Return what a step depends on: the model, the logs, or the recordings in the dataset."""
        if step.name == "robot":
            return MODEL_INPUT
        if step.name == "import":
            return hashlib.sha256(str(sorted(self.fields["files"].items())).encode()).hexdigest()
        return dataset_hash(Dataset(self.data).entries)

    def has_finished(self, step: Step, inputs: str) -> bool:
        """Return True if a step has finished on these inputs."""
        return self.fields["done"].get(step.line) == inputs

    def finish(self, step: Step, inputs: str) -> None:
        """Record a finished step."""
        self.fields["done"][step.line] = inputs
        write_json(self.out / RECORD_FILE, self.fields)
        write_text(self.out / COMMANDS_FILE, "\n".join(self.fields["done"]) + "\n")


def hash_logs(logs: Path, out: Path) -> dict[str, str]:
    """Return file → SHA-256 of all logs, and of the logs.toml in `out`, which may lie among
    them.
    """
    root = logs if logs.is_dir() else logs.parent
    files = {}
    for file in files_below(logs) if logs.is_dir() else [logs]:
        if out.resolve() not in file.resolve().parents:
            files[file.relative_to(root).as_posix()] = file
    files[f"{out.name}/logs.toml"] = out / "logs.toml"
    hashes = {}
    for name, file in sorted(files.items()):
        if file.is_file():
            hashes[name] = FileRecord.of(file).sha256
    return hashes
