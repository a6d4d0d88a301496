"""docs/randomize.md, run as it stands on an arm that nobody tuned on."""

import json
import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from arm import commands, record, write_arm

from gaponet.cli.main import main
from gaponet.data.store import Dataset

PAGE = Path(__file__).parents[2] / "docs" / "randomize.md"
BLOCK = re.compile(r"```(console|python)\n(.*?)```", re.DOTALL)
NOISE_RAD = 3e-4


class Block(NamedTuple):
    kind: str  # console or python
    text: str


def blocks_of_the_page():
    """The blocks of the page but those for mjlab and Isaac Lab, which are not installed here."""
    found = [Block(*parts) for parts in BLOCK.findall(PAGE.read_text(encoding="utf-8"))]
    return [block for block in found if "EventTermCfg" not in block.text]


def write_logs(robot, folder, seeds, kp):
    """Write a dataset with a motion for each seed, of an arm with kp times its stiffness."""
    data = Dataset.create(folder, robot)
    for seed in seeds:
        sequence = record(robot, commands(400, seed), f"m{seed}", kp=kp, delay=1)
        noise = NOISE_RAD * np.random.default_rng(seed).standard_normal(sequence.qpos.shape)
        data.append(replace(sequence, qpos=sequence.qpos + noise))


def exit_code(line):
    """Run a line of a console in this process."""
    try:
        return main(shlex.split(line, comments=True)[1:])
    except SystemExit as end:
        return end.code


def run_block(block):
    """Run a block; return the commands of a console that failed → their exit codes."""
    if block.kind == "python":
        exec(compile(block.text, "randomize.md", "exec"), {})
        return {}
    failed = {}
    for line in block.text.strip().splitlines():
        code = exit_code(line)
        if code:
            failed[line.partition("  #")[0]] = code
    return failed


def run_page():
    """Run the page in the current folder; return the commands that failed → their exit codes."""
    failed = {}
    for block in blocks_of_the_page():
        if block.kind == "python" and "robots" in block.text:
            shutil.copytree("my_arm", "robots/a")
        failed |= run_block(block)
    return failed


class PageRun(NamedTuple):
    folder: Path
    failed: dict[str, int]  # command → exit code


@pytest.fixture(scope="module")
def page_run(tmp_path_factory):
    """The page, run beside logs of three arms, of which one was identified."""
    folder = tmp_path_factory.mktemp("randomize")
    robot = write_arm(folder / "arm")
    write_logs(robot, folder / "data", range(8), kp=0.8)
    write_logs(robot, folder / "new_logs", range(20, 24), kp=0.7)
    write_logs(robot, folder / "logs" / "a", range(40, 44), kp=0.8)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main(["identify", "data", "--out", "my_arm"]) == 0
        return PageRun(folder, run_page())


def test_the_blocks_of_the_page_that_run_here():
    kinds = ["console", "console", "python", "python", "console", "console", "python"]
    assert [block.kind for block in blocks_of_the_page()] == kinds


@pytest.mark.slow
def test_the_page_runs_as_it_stands(page_run):
    assert page_run.failed == {"gaponet check my_arm new_logs": 1}  # it is softer


@pytest.mark.slow
def test_the_ranges_of_an_adapted_arm_hold_the_stiffness_of_both_days(page_run):
    file = page_run.folder / "my_arm_today" / "randomization" / "randomization.json"
    kp = json.loads(file.read_text())["ranges"]["elbow"]["kp"]
    nominal = 20.0
    assert kp["low"] < 0.7 * nominal
    assert 0.8 * nominal < kp["high"]
