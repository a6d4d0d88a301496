"""Commands that the page runs, each in a process of its own, and their results in a folder."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import threading
from functools import cached_property
from pathlib import Path
from typing import Any

from gaponet.base.child_process import module_command
from gaponet.base.errors import UsageError
from gaponet.base.files import write_json, write_text
from gaponet.base.progress import LINE_INTERVAL_VARIABLE

# Step → the step whose result it uses. A result that is older than what it was made from is out of date.
NEEDS = {
    "import": "robot", "doctor": "import", "gap": "import", "identify": "import", "causes": "identify",
    "export": "identify", "randomization": "identify", "train": "identify", "new": "identify", "check": "new",
    "adapt": "new",
}  # fmt: skip
OUT = "\0"  # word that `start` replaces by the name of a new folder
PROGRESS_LINE = re.compile(r"^[^:]+: (\d+) %, \d+ s(?:, (.*))?$")


class Job:
    """One command and its files; `out` is the folder that it writes, or the robot or dataset that it looks at."""

    def __init__(self, folder: Path) -> None:
        number, _, self.step = folder.name.partition("-")
        self.folder, self.number = folder, int(number)
        self.words: list[str] = json.loads((folder / "command.json").read_text(encoding="utf-8"))
        self.command = shlex.join(["gaponet", *self.words])
        written = self.words.index("--out") + 1 if "--out" in self.words else 0
        self.out = f"./{self.words[written]}" if written else "".join(self.words[2:3])

    @cached_property
    def result(self) -> dict[str, Any] | None:
        """Result of the command; None if it failed, was cancelled, or has not ended."""
        try:
            return dict(json.loads((self.folder / "result.json").read_text(encoding="utf-8")))
        except ValueError:
            return None

    @cached_property
    def lines(self) -> list[str]:
        """Lines that the command printed for people."""
        return (self.folder / "log.txt").read_text(encoding="utf-8", errors="replace").splitlines()

    def progress(self) -> tuple[float, str]:
        """Return the percentage that is done, and the note beside it."""
        last = next((m for line in reversed(self.lines) if (m := PROGRESS_LINE.match(line))), None)
        return (float(last[1]), last[2] or "") if last else (0.0, "")


class Jobs:
    """All commands of a folder, one at a time. Their state is in files, which survive this process."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.started = folder, folder
        self.process: subprocess.Popen[bytes] | None = None
        self.lock = threading.Lock()  # each click has a thread

    @property
    def all(self) -> list[Job]:
        """Jobs in their order; the last one may be running."""
        files = (self.folder / "jobs").glob("[0-9]*-*/log.txt")
        return sorted((Job(file.parent) for file in files), key=lambda job: job.number)

    @property
    def running(self) -> Job | None:
        """The job that runs now."""
        return (
            Job(self.started) if self.process is not None and self.process.poll() is None else None
        )

    def result(self, step: str) -> Job | None:
        """Return the last successful job of a step with its folder, unless what it was made from is newer."""
        jobs = (job for job in reversed(self.all) if job.step == step and job.result is not None)
        last = next(
            (job for job in jobs if "--out" not in job.words or (self.folder / job.out).exists()),
            None,
        )
        if last is None or step not in NEEDS:
            return last
        before = self.result(NEEDS[step])
        return last if before is not None and before.number < last.number else None

    def add(self, step: str, *words: str, result: str = "") -> Path:
        """Write the files of a new job and return their folder; OUT becomes a new name: step and number."""
        number = max((job.number for job in self.all), default=0) + 1
        folder = self.folder / "jobs" / f"{number:03d}-{step}"
        folder.mkdir(parents=True, exist_ok=True)
        write_json(
            folder / "command.json", [f"{step}{number}" if word == OUT else word for word in words]
        )
        write_text(folder / "result.json", result)
        write_text(folder / "log.txt", "")
        return folder

    def start(self, step: str, *words: str) -> None:
        """Start a command, or raise UsageError if one runs."""
        with self.lock:
            self.require_idle()
            self.started = folder = self.add(step, *words)
            with (folder / "result.json").open("wb") as out, (folder / "log.txt").open("wb") as log:
                self.process = subprocess.Popen(
                    module_command("gaponet", *Job(folder).words, "--json"), stdin=subprocess.DEVNULL, stdout=out,
                    stderr=log, cwd=self.folder,
                    env=os.environ | {LINE_INTERVAL_VARIABLE: "0.5", "COLUMNS": "9999"},  # s; no table is divided
                )  # fmt: skip

    def require_idle(self) -> None:
        """Raise UsageError while a command runs."""
        if job := self.running:
            raise UsageError(f"gaponet {job.words[0]} is running; wait for it, or cancel it")

    def cancel(self) -> None:
        """End the running command. Files are written whole or not at all, and each command has its own folder."""
        with self.lock:
            if self.process is not None:
                self.process.terminate()
                self.process.wait()
