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
from gaponet.base.structure import read_json
from gaponet.cli.logs import joint_map, show_diagnosis
from gaponet.cli.main import COMMANDS, main
from gaponet.cli.options import Flag, Json, Logs, Model
from gaponet.cli.out import Out
from gaponet.data.store import Dataset, dataset_hash
from gaponet.robot.finding import abbreviate
from gaponet.robot.spec import RobotSpec, load_robot, packaged_robots, robot_argument

if TYPE_CHECKING:
    from gaponet.data.log import Log
    from gaponet.robot.new import RobotOptions

RAN = "commands.sh"  # what ran to its end, a line each
MADE_FROM, ROBOT = "start.json", "the model"
FEWEST = 3  # recordings, from which some are kept for judging; fewer are cut
PIECE, SHORTEST = 8.0, 4.0  # s of a piece, and below which it is none
NEAR = 0.01  # of a rate in whole Hz, from which a clock's rounding is told


@dataclass(frozen=True)
class Understood:
    """What a model and a folder of logs say of themselves.

    Attributes:
        robot: The model's robot; a file's with its default joints.
        packaged: What to write after --robot where nothing is to be made; "" for a model file.
        log: The first recording.
        recordings: How many there are.
        described: A logs.toml that was guessed; "" where the logs explain themselves.
    """

    robot: RobotSpec
    packaged: str
    log: Log
    recordings: int
    described: str

    @property
    def rate(self) -> float:
        """The rate of the commands, Hz; whole where it is near that."""
        rate = 1 / float(np.median(np.diff(self.log.channels["ctrl"].time)))
        return float(round(rate)) if abs(rate - round(rate)) < NEAR * rate else rate


def start(
    model: Model,
    logs: Logs,
    out: Path = Path("started"),
    unit_id: str = "lab",
    payload_mass: float = 0.0,
    joints: tuple[str, ...] = (),
    kp: tuple[str, ...] = (),
    kd: tuple[str, ...] = (),
    effort_limit: tuple[str, ...] = (),
    map: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),
    format: str | None = None,
    position_unit: Literal["rad", "deg", "fraction", "signed_percent"] | None = None,
    time_unit: Literal["s", "ms", "us", "ns"] | None = None,
    rate: float | None = None,
    cut: float | None = None,
    skip_bad: Flag = False,
    allow_pickle: Flag = False,
    to: Literal["mjcf", "mjlab", "isaaclab", "newton", "drake", "json"] = "mjcf",
    budget: str | None = None,
    dry_run: Flag = False,
    anyway: Flag = False,
    json: Json = False,
) -> None:
    """All of it in one command: model file and logs in, report out.

    What ran stands in OUT/commands.sh. The same command again goes on where it was interrupted, or stopped to ask. Logs
    that were added to the folder are imported, and what follows runs again; other logs need another OUT.

    Args:
        model: MJCF or URDF file; or a robot folder, or a packaged robot's name.
        logs: Folder of logs, in any format that gaponet import reads.
        out: Folder for all that is made.
        unit_id: Which of its kind.
        payload_mass: kg in each hand while recording.
        joints: Those of the model's joints that were recorded, by name or pattern; default those that the logs name.
        kp: The gain of the controller while recording, N·m/rad: a number, or PATTERN=NUMBER; default the model's.
        kd: Likewise, N·m·s/rad.
        effort_limit: Likewise, N·m.
        map: A joint's name in the log and the robot's, as a=b; may be repeated.
        format: Format of the logs; gaponet import --formats lists them.
        position_unit: Unit of positions, where the format leaves it open.
        time_unit: Unit of time, where the format leaves it open.
        rate: Hz, of logs without a clock.
        cut: Length of the pieces of long recordings, s; default 8 where there are fewer than three recordings.
        skip_bad: Cut bad rows and leave out logs that cannot be read.
        allow_pickle: Open pickled files.
        to: Engine to export to.
        budget: Time that identification may take, such as 4m; default as long as it takes.
        dry_run: Say what was understood and which commands would run, and write nothing.
        anyway: Go on where the doctor found errors in the logs.
    """
    from gaponet.report.view.portrait import prepare

    prepare()  # before MuJoCo is imported, which the report's picture would be too late for
    from gaponet.data.reading import UnreadError
    from gaponet.robot.new import RobotOptions

    screen, told = Out(json), out / "logs.toml"
    values = {"format": format, "position_unit": position_unit, "time_unit": time_unit, "rate": rate, "cut": cut}
    stated = ["--unit-id", unit_id, "--payload-mass", f"{payload_mass:g}", *(f"--map={pair}" for pair in map)]
    stated += [f"--{k.replace('_', '-')}={v}" for k, v in values.items() if v is not None]
    stated += ["--skip-bad"] * skip_bad + ["--allow-pickle"] * allow_pickle
    options = {"fmt": format, "joint_map": joint_map(map), "position_unit": position_unit, "time_unit": time_unit,
               "rate": rate, "skip_bad": skip_bad, "allow_pickle": allow_pickle}  # fmt: skip
    files = _hashes(logs, out)
    made = _earlier(out, logs, files)
    wanted = RobotOptions(joints=joints, kp=kp, kd=kd, effort_limit=effort_limit)
    with contextlib.redirect_stdout(sys.stderr if json else sys.stdout):
        try:
            found = understand(model, logs, told, wanted, options, keep=not dry_run)
        except UnreadError as unread:
            for line in unread.text.splitlines():
                screen.say(f"  {line}")
            raise UsageError(f"{unread}. The lines above are what these logs show of themselves; without "
                             f"--dry-run they are written to {told}, to be looked over") from None  # fmt: skip
        _tell(screen, found, model, logs, unit_id, payload_mass)
        todo = plan(found, model, logs, out, wanted, stated, cut is None)
        for words in todo:
            words += ["--to", to] if words[0] == "export" else []
            words += ["--budget", budget] if words[0] == "identify" and budget else []
        lines = [shlex.join(["gaponet", *words]) for words in todo]
        said = shlex.join(next(words for words in todo if words[0] == "import")[2:])
        if made["options"] not in ("", said):
            data = out / "data"
            raise UsageError(
                f"{data} was imported with {made['options']}, not with {said}. Give another --out, or the same options "
                f"again; or delete {data}, and it is made anew"
            )
        if dry_run:
            for line in lines:
                screen.say(line, "  ")
        else:
            with lock_folder(out, "started"):
                if found.described:
                    write_text(told, found.described)
                    files[f"{out.name}/logs.toml"] = _sha256(told)
                now = made | {"logs": str(logs.resolve()), "files": files, "options": said}
                if not (out / "data").exists():  # an import that is interrupted leaves data of these
                    write_json(out / MADE_FROM, now)
                _run(screen, todo, lines, out, anyway, now)
            screen.say(f"what ran, command by command: {out / RAN}")
    screen.result({
        "robot": found.robot.name, "joints": found.log.joint_names, "recordings": found.recordings,
        "rate_hz": found.rate, "logs_toml": found.described, "commands": lines, "ran": not dry_run,
    })  # fmt: skip


def understand(
    model: Path, logs: Path, told: Path, wanted: RobotOptions, options: dict[str, Any], keep: bool = True
) -> Understood:
    """Compile the model, and read the first recording as it lies there, or by a logs.toml that is guessed from it.

    Args:
        model: File, robot folder, or name of a packaged robot.
        logs: Folder.
        told: Where a guess goes, is corrected by the user, and is read from the next time.
        wanted: What the user says about a robot that is made from a file.
        options: What the user says about the logs, as read_first takes it.
        keep: Write a guess there that these logs cannot be read by, or that a person has to look at.

    Raises:
        UnreadError: Without `keep`, what a person has to look at.
        RobotError, UsageError, LogError: The model is broken, or the logs cannot be read; the message says what to do.
    """
    from gaponet.data.reading import UnreadError, read_first
    from gaponet.robot.new import new_robot

    with tempfile.TemporaryDirectory() as place:
        if (model / "robot.toml").is_file():
            robot, packaged = load_robot(model), robot_argument(model)
        elif not model.exists() and str(model) in packaged_robots():
            robot = load_robot(packaged := str(model))
        else:
            robot, packaged = new_robot(model, Path(place) / "robot", wanted).robot, ""
        try:
            by = told if told.is_file() else None
            return Understood(robot, packaged, *read_first(logs, robot, by, not keep, **options))
        except UnreadError as unread:
            if not keep:
                raise
            told.parent.mkdir(parents=True, exist_ok=True)
            write_text(told, unread.text)
            raise UsageError(
                f"{unread}: {told} says what these logs show of themselves; look it over, then the same command again"
            ) from None


def plan(
    found: Understood, model: Path, logs: Path, out: Path, wanted: RobotOptions, stated: list[str], cuts: bool
) -> list[list[str]]:
    """The commands of the whole way, as words after `gaponet`.

    Args:
        stated: What import is told of the recordings.
        cuts: Cut the recordings where they are few.
    """
    data, known, todo = str(out / "data"), out / "identified", list[list[str]]()
    if not found.packaged:
        given = {name: getattr(wanted, name) for name in ("joints", "kp", "kd", "effort_limit")}
        if not given["joints"] and len(found.log.joint_names) < len(found.robot.joint_names):
            given["joints"] = found.log.joint_names
        words = [x for name, said in given.items() if said for x in (f"--{name.replace('_', '-')}", *said)]
        todo.append(["robot", "new", str(model), "--out", str(out / "robot"), "--rate", f"{found.rate:g}", *words])
    robot, told = found.packaged or robot_argument(out / "robot"), out / "logs.toml"
    described = ["--logs", str(told)] if found.described or told.is_file() else []
    time = found.log.channels["ctrl"].time
    piece = min(PIECE, float(time[-1] - time[0]) / FEWEST)
    described += ["--cut", f"{piece:.3g}"] if cuts and found.recordings < FEWEST and piece >= SHORTEST else []
    todo += [
        ["import", str(logs), "--robot", robot, *stated, *described, "--out", data],
        ["doctor", data],
        ["gap", data],
        ["identify", data, "--out", str(known)],
        ["gap", data, "--robot", robot_argument(known)],
        ["export", str(known)],
        ["report", str(known)],
    ]
    return [words for words in todo if words[0] in COMMANDS]


def _tell(screen: Out, found: Understood, model: Path, logs: Path, unit_id: str, payload_mass: float) -> None:
    log, robot = found.log, found.robot
    time, still = log.channels["ctrl"].time, [j for j in robot.joint_names if j not in log.joint_names]
    first = f"{time[-1] - time[0]:.1f} s at {found.rate:g} Hz, {', '.join(log.channels)}"
    rows = {
        "robot": f"{robot.name}, from {found.packaged or model}; kp {', '.join(f'{x:g}' for x in robot.kp)} N·m/rad",
        "logs": f"{found.recordings} recording(s) below {logs}; the first: {first}",
        "joints recorded": ", ".join(log.joint_names),
        "frozen" if not found.packaged else "taken to stand at home": ", ".join(still),
        "taken as given": f"unit {unit_id}, {payload_mass:g} kg in each hand (--unit-id, --payload-mass)",
    }
    for what, said in rows.items():
        if said:
            screen.say(f": {said}", what)
    for line in found.described.splitlines():
        screen.say(f"  {line}", "logs.toml, guessed" if line.startswith("# Lines") else "", "yellow")


class _MadeFrom(TypedDict):
    """start.json: logs is their path, files their hashes, options import's, done a command that ran → on what."""

    logs: str
    options: str
    files: dict[str, str]
    done: dict[str, str]


def _hashes(logs: Path, out: Path) -> dict[str, str]:
    """File → SHA-256, of all logs and of the logs.toml in OUT, which may lie among the logs."""
    below, root = (logs.rglob("*"), logs) if logs.is_dir() else ([logs], logs.parent)
    files = {}
    for file in below:
        name = file.relative_to(root)
        if out.resolve() not in file.resolve().parents and not any(part.startswith(".") for part in name.parts):
            files[name.as_posix()] = file
    files[f"{out.name}/logs.toml"] = out / "logs.toml"
    return {name: _sha256(file) for name, file in sorted(files.items()) if file.is_file()}


def _sha256(file: Path) -> str:
    with file.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()


def _earlier(out: Path, logs: Path, files: dict[str, str]) -> _MadeFrom:
    """What start.json says of OUT, without data there only how its robot was made; refuses data of other logs."""
    data, made, where = (
        out / "data",
        _MadeFrom(logs="", files={}, options="", done={}),
        "logs that no file names",
    )
    if (out / MADE_FROM).is_file():
        made = read_json(_MadeFrom, out / MADE_FROM, UsageError, f"delete it and {data}")
        where = f"{made['logs']}"
    if not data.exists():
        return _MadeFrom(
            logs="", files={}, options="", done={line: on for line, on in made["done"].items() if on == ROBOT}
        )
    other = [name for name, digest in made["files"].items() if files.get(name) != digest]
    if made["logs"] and not other:
        return made
    if other:
        where += f", of which {abbreviate(other)} {'is' if len(other) == 1 else 'are'} missing or changed"
        where += f" in {logs}" * (str(logs.resolve()) != made["logs"])
    raise UsageError(
        f"{data} was made from {where}. Give another --out for these logs, or the same logs again; or delete {data}, "
        "and it is made anew"
    )


def _run(screen: Out, todo: list[list[str]], lines: list[str], out: Path, anyway: bool, made: _MadeFrom) -> None:
    """Run what has not run to its end yet, on these logs or on these data."""
    done, logs = made["done"], hashlib.sha256(str(sorted(made["files"].items())).encode()).hexdigest()
    for words, line in zip(todo, lines, strict=True):
        on = {"robot": ROBOT, "import": logs}.get(words[0]) or dataset_hash(Dataset(out / "data").entries)
        if done.get(line) == on:
            screen.say(line, "done before: ", "green")
            continue
        screen.say(line, "$ ", "bold cyan")
        if words[0] == "doctor":
            diagnosis = api.doctor(words[1])
            show_diagnosis(screen, diagnosis)
            if diagnosis.count("error") and not anyway:
                raise UsageError(
                    "stopped: what the doctor calls an error is one of the logs, and no fit mends it. "
                    f"Mend the logs or {out / 'logs.toml'} (gaponet doctor {words[1]} --fix proposes lines), delete "
                    f"{words[1]}, and start again; or --anyway"
                )
        elif code := main(words):
            if code == 128 + signal.SIGINT:
                raise KeyboardInterrupt
            raise UsageError(f"stopped at: {line}; what to do is said above; then give the same start command again")
        done[line] = on
        write_json(out / MADE_FROM, made)
        write_text(out / RAN, "\n".join(done) + "\n")
