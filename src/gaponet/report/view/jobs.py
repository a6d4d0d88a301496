"""Commands that the page runs, each in a process of its own, and their results in a folder.

The folder may come from somebody else. Everything that is read here is validated, nothing that is
stored runs again, and a job that does not look like one of the page is left out, with the reason.
"""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Interval
from typing_extensions import TypedDict

from gaponet.base.child_process import module_command
from gaponet.base.errors import UsageError
from gaponet.base.files import WINDOWS, lock_file, write_json, write_text
from gaponet.base.progress import LINE_INTERVAL_VARIABLE
from gaponet.base.structure import Number, parse_json
from gaponet.report.steps import Step
from gaponet.report.view.inside import path_inside, read_inside, require_inside_name
from gaponet.report.view.run_job import CANCELLED, ENDED, LOCK, WITH_SERVER, write_ending
from gaponet.robot.finding import Finding

# Step → the step whose result it uses. A result that is older than what it was made from is out of
# date.
NEEDS = {
    "import": "robot",
    "doctor": "import",
    "gap": "import",
    "identify": "import",
    "causes": "identify",
    "export": "identify",
    "randomization": "identify",
    "train": "identify",
    "new": "identify",
    "check": "new",
    "adapt": "new",
}
OUT = "\0"  # word that `start` replaces by the name of a new folder
PROGRESS_LINE = re.compile(r"^[^:]+: (\d+) %, \d+ s(?:, (.*))?$")
FOLDER_NAME = re.compile(r"(\d{1,6})-([a-z_]{1,40})")  # number and step
ROBOT_NAME = re.compile(r"\w[\w-]*", re.ASCII)  # of a robot of the package
TERMINATION_S = 5.0  # for which a cancelled command may tidy up, before it is killed
PICTURE_SUFFIXES = (".png", ".svg")


class Result(TypedDict, total=False):
    """What the page reads of the result of a command; more may stand beside it."""

    figures: list[str]  # pictures, relative to the page's folder
    findings: list[Finding]
    val_mpjae: dict[str, Number]  # of a network, rad


class Ending(TypedDict):
    """How a job ended (run_job.py)."""

    how: Literal["exit", "cancelled", "server"]
    code: Annotated[int, Interval(ge=-(1 << 31), le=1 << 32)]  # exit code


class Job:
    """One command and its files.

    Attributes:
        folder: Folder of the files.
        number, step: Which command of the folder it is, and of which step of the page.
        words: The command line after "gaponet".
        command: The command line as one types it.
        out: Folder that it writes, or the robot or dataset that it looks at; "" if there is none.
    """

    def __init__(self, root: Path, name: str, outside: tuple[Path, ...] = ()) -> None:
        """Read the job root/jobs/name.

        Args:
            outside: Folders outside of `root` that a job may use.

        Raises:
            UsageError: These are not the files of a job, or it uses another folder outside.
        """
        matched = FOLDER_NAME.fullmatch(name)
        if matched is None:
            raise UsageError(f"jobs/{name}: is not called like a job: number, dash, step")
        self.number = int(matched[1])
        self.step = matched[2]
        self.folder = root / "jobs" / name
        self._root = root
        self._name = f"jobs/{name}"
        self.words = self._read_words()
        self.command = shlex.join(["gaponet", *self.words])
        self.out = self._read_out(outside)

    def _read_words(self) -> list[str]:
        content = read_inside(self._root, f"{self._name}/command.json")
        where = f"{self._name}/command.json"
        words = parse_json(list[str], content, where, UsageError)
        if not words:
            raise UsageError(f"{where}: holds no command")
        return words

    def _read_out(self, outside: tuple[Path, ...]) -> str:
        words = self.words
        if "--out" in words[:-1]:
            written = words[words.index("--out") + 1]
            try:
                path_inside(self._root, written)
            except UsageError as error:
                raise UsageError(f"{self._name}: --out: {error}") from None
            return f"./{written}"
        if words[:2] not in (["robot", "check"], ["data", "card"]) or len(words) < 3:
            return ""
        used = words[2]
        if not ROBOT_NAME.fullmatch(used) and Path(used) not in outside:
            raise UsageError(
                f"{self._name}: uses {used}, which is not in this folder; if you trust it: "
                f"gaponet app {self._root} --outside {used}"
            )
        return used

    @cached_property
    def result(self) -> Result | None:
        """Result of the command; None if it failed, was cancelled, has not ended, or is not one of
        gaponet.
        """
        try:
            return self.read_result()
        except UsageError:
            return None

    def read_result(self) -> Result | None:
        """Return the result of the command; None if there is none.

        Raises:
            UsageError: The file is not one that gaponet writes.
        """
        where = f"{self._name}/result.json"
        content = read_inside(self._root, where)
        if not content.strip():
            return None
        result = parse_json(Result, content, where, UsageError, allow_extra=True)
        for name in result.get("figures", []):
            _require_picture(name, where)
        return result

    @cached_property
    def lines(self) -> list[str]:
        """Lines that the command printed for people, or why they cannot be read."""
        try:
            content = read_inside(self._root, f"{self._name}/log.txt")
        except UsageError as error:
            return [str(error)]
        return content.decode("utf-8", "replace").splitlines()

    @property
    def ending(self) -> Ending | None:
        """How the command ended; None if it runs, or was killed, or an older gaponet did not store
        it.
        """
        try:
            content = read_inside(self._root, f"{self._name}/{ENDED}")
            return parse_json(Ending, content, ENDED, UsageError)
        except UsageError:
            return None

    @property
    def lives(self) -> bool:
        """True while a process of the command lives, whoever started it."""
        lock = self.folder / LOCK
        if lock.is_symlink() or not lock.is_file():
            return False
        descriptor = lock_file(lock)
        if descriptor is None:
            return True
        os.close(descriptor)
        return False

    def progress(self) -> tuple[float, str]:
        """Return the percentage that is done, and the note beside it."""
        for line in reversed(self.lines):
            matched = PROGRESS_LINE.match(line)
            if matched is not None:
                return float(matched[1]), matched[2] or ""
        return 0.0, ""


class Jobs:
    """All commands of a folder, one at a time. Their state is in files, which survive this process.

    Attributes:
        folder: The page's folder.
        outside: Folders outside of it that stored jobs may use; the user named them.
        started: The job that was started last here.
        process: Its process.
        lock: Held while a command is started, and while files are put where commands read them.
    """

    def __init__(self, folder: Path, outside: tuple[Path, ...] = ()) -> None:
        self.folder = folder
        self.outside = outside
        self.started: Job | None = None
        self.process: subprocess.Popen[bytes] | None = None
        self.lock = threading.Lock()  # each click has a thread

    @property
    def all(self) -> list[Job]:
        """Jobs in their order without those that cannot be read; the last one may be running."""
        jobs = []
        for name in self._names():
            with suppress(UsageError):
                jobs.append(Job(self.folder, name, self.outside))
        return sorted(jobs, key=lambda job: job.number)

    def unreadable(self) -> list[str]:
        """Return why jobs are left out, or have no result although there is a file of it."""
        reasons = []
        for name in sorted(self._names()):
            try:
                Job(self.folder, name, self.outside).read_result()
            except UsageError as error:
                reasons.append(str(error))
        return reasons

    def _names(self) -> list[str]:
        """Return the names of the folders that are called like a job and have an output."""
        names = [file.parent.name for file in (self.folder / "jobs").glob("*/log.txt")]
        return [name for name in names if FOLDER_NAME.fullmatch(name)]

    @property
    def running(self) -> Job | None:
        """The job that this server runs now."""
        if self.process is None or self.process.poll() is not None or self.started is None:
            return None
        return Job(self.folder, self.started.folder.name, self.outside)

    def started_here(self, job: Job) -> bool:
        """Return True for the job that was started last here: neither by an earlier page nor by a
        stranger.
        """
        return self.started is not None and self.started.number == job.number

    def result(self, step: str) -> Job | None:
        """Return the last successful job of a step with its folder, unless what it was made from
        is newer.
        """
        last = None
        for job in self.all:
            if job.step == step and job.result is not None and self._has_folder(job):
                last = job
        if last is None or step not in NEEDS:
            return last
        before = self.result(NEEDS[step])
        if before is None or before.number > last.number:
            return None
        return last

    def _has_folder(self, job: Job) -> bool:
        return "--out" not in job.words or (self.folder / job.out).exists()

    def add(self, step: Step, result: str = "") -> Job:
        """Write the files of a new job; OUT becomes a new name: that of the step, and a number."""
        number = self._new_number(step.name)
        folder = self.folder / "jobs" / f"{number:03d}-{step.name}"
        folder.mkdir(parents=True)
        given = [f"{step.name}{number}" if word == OUT else word for word in step.words]
        write_json(folder / "command.json", given)
        write_text(folder / "result.json", result)
        write_text(folder / "log.txt", "")
        return Job(self.folder, folder.name, self.outside)

    def _new_number(self, step: str) -> int:
        """Return a number above those of all jobs, readable or not, whose output folder does not
        exist.
        """
        names = [FOLDER_NAME.fullmatch(path.name) for path in (self.folder / "jobs").glob("*")]
        number = 1 + max((int(name[1]) for name in names if name), default=0)
        while os.path.lexists(self.folder / f"{step}{number}"):
            number += 1
        return number

    def start(self, step: Step) -> None:
        """Start the command of a step, or raise UsageError if one runs."""
        with self.idle():
            job = self.add(step)
            command = module_command(
                "gaponet.report.view.run_job", str(job.folder), *job.words, "--json"
            )
            variables = {LINE_INTERVAL_VARIABLE: "0.5", "COLUMNS": "9999"}  # s; no table is divided
            result = job.folder / "result.json"
            log = job.folder / "log.txt"
            with result.open("wb") as stdout, log.open("wb") as stderr:
                self.process = subprocess.Popen(
                    command,
                    stdin=subprocess.PIPE,
                    stdout=stdout,
                    stderr=stderr,
                    cwd=self.folder,
                    env=os.environ | variables,
                    start_new_session=True,
                )
            self.started = job

    @contextmanager
    def idle(self) -> Iterator[None]:
        """A block in which no command runs; UsageError if one does."""
        with self.lock:
            self.require_idle()
            yield

    def require_idle(self) -> None:
        """Raise UsageError while a command runs."""
        job = self.running
        if job is not None:
            raise UsageError(f"gaponet {job.words[0]} is running; wait for it, or cancel it")
        job = self.running_elsewhere
        if job is not None:
            raise UsageError(
                f"gaponet {job.words[0]} of an earlier page is still running "
                f"(jobs/{job.folder.name}); wait for it"
            )

    @property
    def running_elsewhere(self) -> Job | None:
        """The last job if one of its processes lives although this server does not run it."""
        jobs = self.all
        if not jobs or self.running is not None or not jobs[-1].lives:
            return None
        return jobs[-1]

    def cancel(self, how: str = CANCELLED) -> None:
        """End the running command.

        Files are written whole or not at all, and each command has its own folder.

        Args:
            how: CANCELLED by the user, or WITH_SERVER.
        """
        with self.lock:
            if self.process is None or self.started is None or self.process.poll() is not None:
                return
            _end_group(self.process)
            write_ending(self.started.folder, how)

    def close(self) -> None:
        """End the running command because the server ends."""
        self.cancel(WITH_SERVER)


def _require_picture(name: str, where: str) -> None:
    """Refuse what is no name of a picture inside the folder."""
    try:
        require_inside_name(name)
    except UsageError as error:
        raise UsageError(f"{where}: figures: {error}") from None
    if not name.endswith(PICTURE_SUFFIXES):
        raise UsageError(f"{where}: figures: '{name}' is no picture (.png, .svg)")


def _end_group(process: subprocess.Popen[Any]) -> None:
    """End a process and, where there are process groups, all that it started."""
    if WINDOWS:
        process.terminate()
        process.wait()
        return
    os.killpg(process.pid, signal.SIGTERM)
    with suppress(subprocess.TimeoutExpired):
        process.wait(TERMINATION_S)
    with suppress(ProcessLookupError, PermissionError):  # macOS: all that is left are zombies
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
