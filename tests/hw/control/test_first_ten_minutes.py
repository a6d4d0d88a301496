"""The steps of docs/first-minutes.md and the run of README.md, as written, on virtual robots
behind buses.
"""

from __future__ import annotations

import os
import re
import select
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

pytest.importorskip("cyclonedds", reason="pip install 'gaponet[dds]'")
pytest.importorskip("serial", reason="pip install 'gaponet[so101]'")

pytestmark = pytest.mark.faults

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs" / "first-minutes.md").read_text(encoding="utf-8")
BUSY = ["--rate", "4", "--safety.acceleration", "2"]  # machines that run tests are
DOMAIN = str(20 + os.getpid() % 150)
LONGEST = 90.0  # s for anything to be said


class TooBusyError(Exception):
    """This machine."""


def kept(play: Callable[[], str], tries: int = 8) -> str:
    """What is said by a run in which this machine kept time."""
    for _ in range(tries):
        try:
            return play()
        except TooBusyError as late:
            print(f"again: {late}")
    pytest.fail("this machine is too busy")


def answered(run: Terminal, key: str = "", code: int = 0) -> str:
    """A run that asks, is told to start and, where a key is given, stopped on its way to the first
    target.
    """
    run.until("Type 'yes' to start")
    run.key("yes\n")
    if key:
        run.until("to the first target")
        run.key(key)
    return run.end(code)


class Terminal:
    """A command of the page at a terminal: what it says, and keys."""

    def __init__(self, written: str, *more: str, cwd: Path, **names: str) -> None:
        """
        Args:
            written: A piece of the page.
            more: Options beside.
            names: What stands here for a word of the page.
        """
        assert written in PAGE, "the page says something else"
        for word, there in names.items():
            written = written.replace({"port": "/dev/ttyACM0", "link": "/tmp/so101"}[word], there)
        words = [sys.executable, "-P", "-m", *written.split(), *more]
        self.master, slave = os.openpty()
        self.process = subprocess.Popen(
            words, stdin=slave, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, cwd=cwd, bufsize=0
        )
        os.close(slave)
        self.said = ""

    def until(self, text: str) -> str:
        """Wait until it has said something; all that it has said, in one line."""
        self._read(lambda: text in self.said)
        self._kept_time()
        assert text in self.said, self.said
        return " ".join(self.said.split())

    def end(self, code: int = 0) -> str:
        """Wait for its end.

        Raises:
            TooBusyError: A late period of this machine, or an old state, ended the run.
        """
        self._read(lambda: False)
        self._kept_time()
        assert self.process.wait(LONGEST) == code, self.said
        return " ".join(self.said.split())

    def _kept_time(self) -> None:
        if late := re.search("(stale|overrun): .*", self.said):
            raise TooBusyError(late[0])

    def _read(self, done: Callable[[], bool]) -> None:
        assert self.process.stdout
        deadline = time.monotonic() + LONGEST
        while not done() and time.monotonic() < deadline:
            if select.select([self.process.stdout], [], [], 0.1)[0]:
                data = os.read(self.process.stdout.fileno(), 1 << 16)
                if not data:
                    return
                self.said += data.decode(errors="replace")

    def key(self, letter: str) -> None:
        os.write(self.master, letter.encode())

    def close(self) -> None:
        self.process.terminate()
        self.process.wait(LONGEST)
        os.close(self.master)


@pytest.fixture
def at(tmp_path: Path) -> Iterator[Callable[..., Terminal]]:
    opened: list[Terminal] = []

    def open_one(*words: str, **names: str) -> Terminal:
        opened.append(Terminal(*words, cwd=tmp_path, **names))
        return opened[-1]

    yield open_one
    for terminal in opened:
        terminal.close()


def rows(joint: str) -> str:
    """first.csv as the page has it, for a joint."""
    table = re.search(r"    time,wrist_roll\n((?:    .*\n)+)", PAGE)
    assert table
    return f"time,{joint}\n" + re.sub(r"(?m)^    ", "", table[1])


def test_an_so101_from_the_rehearsal_to_the_command_of_the_readme(at, tmp_path):
    (tmp_path / "first.csv").write_text(rows("wrist_roll"))
    link = str(tmp_path / "so101")
    file = str(tmp_path / "calibration.json")
    served = at(
        "gaponet virtual serve --robot so101 --link /tmp/so101", "--calibration", file, link=link
    )
    served.until("Ctrl-C ends it")
    time.sleep(2.0)  # it lies down

    listening = at("gaponet robot link --driver so101 --port /dev/ttyACM0", port=link).end()
    assert "states, a second" in listening
    first = "gaponet run --driver so101 --port /tmp/so101 --motion first.csv"

    said = kept(lambda: answered(at(first, *BUSY, link=link)))
    assert "held where found: shoulder_pan, shoulder_lift, elbow_flex, wrist_flex, gripper" in said
    assert "is held; a stop lowers it" in said
    assert all(
        phase in said
        for phase in ("blend_in to the first target", "run motion", "blend_out end", "stopped")
    )

    said = kept(lambda: answered(at(first, *BUSY, link=link), "x", 3))
    assert "stop: asked to stop: key 'x'" in said
    assert "stopped let go: all servos say that their torque is off" in said

    so101 = ["--port", link, *BUSY]
    dry = [*so101, "--calibration", file, "--motion", "first.csv", "--dry-run"]
    assert "nothing was sent" in kept(lambda: at("gaponet run --driver so101", *dry).end())

    readme = "gaponet run --motion FILE --robot ./my_so101 --driver so101 --compensate"
    assert readme in (ROOT / "README.md").read_text(encoding="utf-8")
    # Not an identified one.
    words = readme.replace("FILE", "first.csv").replace("./my_so101", "so101").split()[2:]
    said = kept(lambda: at("gaponet run", *words, *so101, "--yes").end())
    assert "stopped end: back where it was found; hold" in said


def test_an_h1_2_from_the_rehearsal_to_the_stop(at, tmp_path):
    (tmp_path / "first.csv").write_text(rows("left_wrist_roll_joint"))
    bus = ["--domain", DOMAIN]
    at("gaponet virtual serve --robot h1_2 --unit 4", *bus, "--rate", "100").until("Ctrl-C ends it")
    listening = at("gaponet robot link", *bus).end()
    assert "rt/arm_sdk" in listening
    first = "gaponet run --driver unitree --motion first.csv"

    said = kept(lambda: answered(at(first, *bus, *BUSY)))
    assert "torso" in said
    assert "stopped handed over" in said
    assert r"stop: asked to stop: key '\x1a'" in kept(
        lambda: answered(at(first, *bus, *BUSY), "\x1a", 3)
    )

    words = [
        "--motion",
        "sweep-left_elbow",
        "--unit-id",
        "lab",
        "--payload-mass",
        "0",
        "--out",
        "set",
        "--yes",
    ]
    words = ["--driver", "unitree", *words, *bus, *BUSY]
    assert "added to set" in kept(lambda: at("gaponet record", *words).end())
