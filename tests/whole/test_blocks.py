"""Blocks of README.md and docs: Python is run, each gaponet line is parsed, and quick commands are
run.
"""

from __future__ import annotations

import ast
import io
import re
import shlex
import shutil
import typing
from collections.abc import Callable, Iterator
from contextlib import nullcontext, redirect_stdout, suppress
from functools import wraps
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from arm import XML, record
from logs import wave, write_sage
from runs import random_run, untrained
from strange_logs import write_bag

import gaponet.api
from gaponet.api.options import IdentifyOptions
from gaponet.base.plugins import load
from gaponet.cli.main import COMMANDS, main
from gaponet.data.store import Dataset
from gaponet.export import drawn_robots
from gaponet.nn.artifact import GapModel
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import load_robot
from gaponet.sim.model import build_model

ROOT = Path(__file__).parents[2]
PAGES = [
    ROOT / "README.md",
    *sorted(p for p in (ROOT / "docs").glob("*.md") if p.name != "results.md"),
    *sorted((ROOT / "docs/reference").glob("*.md")),
]
PATHS = {page.name: page for page in PAGES}
WITH_PYTHON = (
    "README.md",
    "api.md",
    "deploy.md",
    "export.md",
    "network.md",
)  # architecture.md shows a piece of servo.py: test_newcomer.py
# A part of a block → why it is not run here.
NOT_RUN = {
    "from gaponet_action import": "needs mjlab; make engines",
    "from actuators import": "needs mjlab, Isaac Lab and Newton; make engines",
    "mujoco_servos.Servos": "needs an exported folder; tests/export plays it",
    'driver="so101"': "moves a real arm; tests/api/test_run_robot.py",
    'follow="nominal"': "runs beside a robot without end; tests/deploy/test_follow.py",
    "gp.RemoteRobot()": "needs a run that takes live targets; tests/hw/targets",
    "from lerobot.envs.factory": "needs LeRobot and the Hub; tests/export/test_envhub.py",
}
# First words of console lines that are not gaponet's → why they are not run here.
OTHERS = {
    "pip": "installs",
    "git": "needs a network",
    "cmake": "installs",
    "CYCLONEDDS_HOME=$HOME/cyclonedds": "installs",
    "source": "needs an environment",
    "make": "takes minutes",
    "pytest": "takes minutes",
    "cd": "needs a folder of an export",
    "python": "needs a folder of an export",
}
ROWS = 100  # of a recording
SO101_IN_SAGE = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw")
OPTION = re.compile(r"(?<![\w-])--[a-z][\w.-]*\w")
MENTION = re.compile(
    r"\bgaponet ([a-z]+)(?: ([a-z]+))?((?:(?!gaponet )[^;`\n)])*)"
)  # command, action, what follows


class Understood(Exception):  # noqa: N818
    """The command line was parsed, and the command would begin now."""


def understood() -> None:
    raise Understood


def blocks(page: Path, *languages: str) -> list[str]:
    return re.findall(
        rf"```(?:{'|'.join(languages)})\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL
    )


def lines(page: Path) -> list[str]:
    """Lines of a page's console blocks, and its indented lines that call gaponet."""
    text = page.read_text(encoding="utf-8")
    found = (
        "\n".join(blocks(page, "console", "sh", "bash", "shell")).replace("\\\n", " ").splitlines()
    )
    outside = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    return [
        *filter(str.strip, found),
        *re.findall(r"^ {4,}((?:.* \| )?gaponet .*)$", outside, re.MULTILINE),
    ]


def words(line: str) -> list[str]:
    """What follows `gaponet` in a line of a shell, up to the next pipe; or nothing."""
    found = shlex.split(line, comments=True)
    while found and found[0] != "gaponet":
        found.pop(0)
    ends = [i for i, word in enumerate(found) if word in ("|", ">", "&&", "||", ";", "&")]
    return found[1 : min(ends, default=len(found))]


def actions(command: str) -> dict[str, Any]:
    """Name → tyro's entry of each action of a command that has some: gaponet robot new."""
    found: dict[str, Any] = {}

    def walk(hint: Any) -> None:
        for note in getattr(hint, "__metadata__", ()):
            if type(note).__name__ == "_SubcommandConfig":
                found[note.name] = note
        for inner in (*typing.get_args(hint), getattr(hint, "__origin__", None)):
            if hasattr(inner, "__metadata__") or typing.get_origin(inner):
                walk(inner)

    walk(typing.get_type_hints(load(COMMANDS[command]), include_extras=True).get("action"))
    return found


@pytest.fixture
def parse(monkeypatch: pytest.MonkeyPatch) -> Callable[[list[str]], None]:
    """Parse a command line without running it.

    An action runs while it is parsed, so a function stands in for it.
    """

    def one(argv: list[str]) -> None:
        for note in actions(argv[0]).values() if argv[0] in COMMANDS else ():
            stand_in = wraps(note.constructor_factory())(lambda *args, **kwargs: understood())
            monkeypatch.setitem(vars(note), "constructor_factory", lambda f=stand_in: f)
        with pytest.raises(Understood):
            main(argv, understood)

    return one


@pytest.fixture(scope="module")
def options() -> dict[tuple[str, ...], set[str]]:
    """Command, or command and action → its options, as its help lists them."""
    found: dict[tuple[str, ...], set[str]] = {}
    patch = pytest.MonkeyPatch()
    patch.setenv("COLUMNS", "100")  # one column of options
    for command in COMMANDS:
        for path in [(command, action) for action in actions(command)] or [(command,)]:
            said = io.StringIO()
            with redirect_stdout(said), suppress(SystemExit):
                main([*path, "--help"])
            rows = re.findall(r"^\W+?(-.*)$", said.getvalue(), re.MULTILINE)
            found[path] = {option for row in rows for option in OPTION.findall(row.split("  ")[0])}
    patch.undo()
    return found


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """LOGS and NEW_LOGS of two VIRTUAL SO-101 with weaker and late servos."""
    folder = tmp_path_factory.mktemp("blocks")
    robot = load_robot("so101")
    low, high = robot.qpos_range[5]
    for seed, name in enumerate(["LOGS"] * 4 + ["NEW_LOGS"] * 3):
        pace = 0.3 + 0.1 * seed
        ctrl = robot.qpos_home + wave(ROWS, 6, robot.dt, 0.2, pace) * [1, 1, 1, 1, 1, 0.5]
        s = record(
            robot,
            np.clip(ctrl, *robot.qpos_range.T),
            name,
            kp=0.8 if name == "LOGS" else 0.6,
            delay=1,
        )
        logged = [values.copy() for values in (s.ctrl, s.qpos)]
        for values in logged:  # SAGE has the gripper as a fraction of its range
            values[:, 5] = (values[:, 5] - low) / (high - low)
        time = 1e6 * robot.dt * np.arange(ROWS)
        write_sage(folder / name / f"m{seed}", *logged, names=SO101_IN_SAGE, time=time, qvel=s.qvel)
    return folder


@pytest.fixture
def quick(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Identification of seconds, done once; few drawn units; and a network that nobody trained.

    All have tests of their own.
    """
    original = gaponet.api.identify

    def identify(dataset: str, *, out: str, **others: object) -> None:
        if not (place / "identified").exists():
            options = IdentifyOptions(windows=4, terms=(), table=False, budget="1s")
            original(dataset, out=place / "identified", options=options)
        shutil.copytree(place / "identified", out)

    def train(dataset: str, *, out: str, budget: str, progress: object) -> SimpleNamespace:
        parts = {"train": ("m0", "m1"), "val": ("m2",), "test": ("m3",)}
        model = GapModel.load(untrained(Path(out), load_robot("so101"), Dataset(dataset), **parts))
        return SimpleNamespace(model=model)

    monkeypatch.setattr(drawn_robots, "DRAWN", 8)
    monkeypatch.setattr(drawn_robots, "JUDGED", 2)
    monkeypatch.setattr(gaponet.api, "identify", identify)
    monkeypatch.setattr(gaponet.api, "train", train)


def in_copy(place: Path, folder: Path) -> None:
    """The logs in a folder of a block's own."""
    for name in ("LOGS", "NEW_LOGS"):
        shutil.copytree(place / name, folder / name)


def names_of_a_reader(page: str, folder: Path) -> dict[str, Any]:
    """What a page's Python blocks take from their reader: names, and run and robot folders below
    `folder`.
    """
    if page not in ("deploy.md", "export.md", "network.md"):
        return dict.fromkeys(("qpos", "qvel", "target"), np.zeros(5)) if page == "api.md" else {}
    robot = load_robot("h1_2")
    model = random_run(folder / "run", robot, payload_seen=(0.0, 3.0))
    for name in ("my_h1_2", "my_robot", "identified"):
        save_robot(robot, folder / name)
    mj_model = build_model(robot, 3.0)
    data = mujoco.MjData(mj_model)
    at_home = {"qpos": robot.qpos_home, "qvel": 0 * robot.qpos_home, "target": robot.qpos_home}
    return at_home | {
        "mj_model": mj_model,
        "data": data,
        "mujoco": mujoco,
        "targets": [robot.qpos_home] * 3,
        "model": model,
        "mine": robot.with_servo(kp=1.1 * robot.servo.kp),
    }


@pytest.mark.parametrize("page", WITH_PYTHON)
def test_the_python_blocks_of_a_page_run(page, place, quick, tmp_path, monkeypatch):
    found = [b for b in blocks(PATHS[page], "python") if not any(part in b for part in NOT_RUN)]
    assert found
    in_copy(place, tmp_path)
    monkeypatch.chdir(tmp_path)
    names = {"__name__": page, **names_of_a_reader(page, tmp_path)}
    for block in found:
        exec(compile(block, page, "exec"), names)


QUICK = {  # Page → commands of it that take seconds; the others are parsed
    "README.md": (
        "import",
        "doctor",
        "gap",
        "robot show",
        "export my_so101 --to randomization",
        "replay",
        "adapt",
    ),
    "logs.md": ("import --formats",),
    "tutorial.md": ("robot", "import bags", "doctor", "gap data"),
    "install.md": ("--version", "--tyro-print-completion"),
}


def is_quick(argv: list[str], page: str) -> bool:
    """Whether a command of a page runs here, and on what is there."""
    if "run" in argv or "./my_arm_identified" in argv:
        return False
    return " ".join(argv).startswith(QUICK[page])


def run_quick_commands(page: str) -> str:
    """Run the quick commands of a page in its order; what they printed."""
    told = io.StringIO()
    for line in lines(PATHS[page]):
        argv = words(line)
        if not argv:
            continue
        if argv[0] == "identify" and page == "README.md":
            gaponet.api.identify(argv[1], out=argv[3])
        elif is_quick(argv, page):
            argv = ["LOGS" if word == "ROLLOUTS" else word for word in argv]
            ends = suppress(SystemExit) if argv[0].startswith("--tyro") else nullcontext()
            with redirect_stdout(told), ends:
                assert main(argv) == 0, argv
    return told.getvalue()


@pytest.mark.parametrize("page", [page for page in QUICK if page != "tutorial.md"])
def test_quick_commands_of_a_page_run_in_its_order(page, place, quick, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    in_copy(place, tmp_path)
    run_quick_commands(page)


def test_quick_commands_of_the_tutorial_run_and_say_what_they_found(quick, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_arm_and_bags(tmp_path)
    said = " ".join(run_quick_commands("tutorial.md").split())
    assert "ok: arm compiles, holds its home and is stable" in said
    assert "2 recordings" in said
    assert "mean |error|, mrad" in said


def write_arm_and_bags(folder: Path) -> None:
    """A vendor's model and ROS bags."""
    servos = "".join(
        f'<position joint="{joint}" kp="20" forcerange="-5 5"/>' for joint in ("shoulder", "elbow")
    )
    (folder / "arm.xml").write_text(
        XML.replace("</mujoco>", f"<actuator>{servos}</actuator></mujoco>")
    )
    for name, rows in (("wave", 400), ("sway", 300)):
        write_bag(folder / "bags" / name, rows=rows)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_each_line_of_a_console_block_is_understood(page, parse, capsys):
    for line in lines(page):
        argv = words(line)
        first = shlex.split(line, comments=True)[:1]
        if not argv:
            assert not first or first[0] in OTHERS, f"{page.name}: {line}"
        elif argv[0] not in ("--version", "--tyro-print-completion") and "…" not in line:
            try:
                parse(argv)
            except (SystemExit, pytest.fail.Exception):
                pytest.fail(f"{page.name}: {line}\n{capsys.readouterr().err}")


def literals(file: Path) -> Iterator[str]:
    """Text in a source file: messages, help and docstrings; X stands for what is filled in."""
    inner = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.JoinedStr):
            inner |= {id(value) for value in node.values}
            yield "".join(
                value.value if isinstance(value, ast.Constant) else "X" for value in node.values
            )
        elif (
            isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in inner
        ):
            yield node.value


FOREIGN = {
    "--repo-type": "hf",
    "--index-url": "pip",
    "--python": "uv",
    "--version": "gaponet itself",
    "--tyro": "gaponet itself",
}


def absent(text: str, options: dict[tuple[str, ...], set[str]]) -> Iterator[str]:
    """Options that a text gives to a command that has no such option, and options that no command
    has.
    """
    every = set().union(*options.values(), FOREIGN)
    seen = set()
    for command, action, rest in MENTION.findall(text):
        there = [have for path, have in options.items() if path in ((command,), (command, action))]
        there = there or [have for path, have in options.items() if path[0] == command]
        wanted = set(OPTION.findall(rest)) - FOREIGN.keys()
        seen |= wanted if there else set()
        yield from (
            f"gaponet {command}: {option}"
            for option in wanted
            if there and option not in set().union(*there)
        )
    yield from set(OPTION.findall(text)) - every - seen


def test_every_option_that_a_message_names_is_there(options):
    files = (
        f for part in sorted((ROOT / "src").glob("gaponet*")) for f in sorted(part.rglob("*.py"))
    )
    wrong = {
        f"{file.relative_to(ROOT)}: {problem}"
        for file in files
        if file.name != "page.py"  # variables of a style sheet
        for text in literals(file)
        if "--" in text
        for problem in absent(text, options)
    }
    assert wrong == set()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_option_that_a_sentence_of_a_page_gives_to_a_command_is_there(page, options):
    pieces = re.findall(r"`(gaponet [^`]*)`", page.read_text(encoding="utf-8"))
    assert [problem for piece in pieces for problem in absent(piece, options)] == []


def test_a_wrong_command_option_or_value_is_found(parse, options):
    for wrong in (
        "robot nwe",
        "robot check so101 --dta x",
        "gap data --robto x",
        "doctor",
        "import L --out d --rate x",
    ):
        with pytest.raises(SystemExit, match="2"):
            parse(wrong.split())
    assert [*absent("take `gaponet gap DATA --fix`, or --fixx", options)] == [
        "gaponet gap: --fix",
        "--fixx",
    ]
