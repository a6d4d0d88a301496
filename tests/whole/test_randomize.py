"""docs/randomize.md, run as it stands on an arm that nobody tuned on."""

import json
import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arm import commands, record, write_arm

from gaponet.cli.main import main
from gaponet.data.store import Dataset

PAGE = Path(__file__).parents[2] / "docs" / "randomize.md"


def logs(robot, place, first, count, **how):
    data = Dataset.create(place, robot)
    for seed in range(first, first + count):
        one = record(robot, commands(400, seed), f"m{seed}", **how)
        noise = 3e-4 * np.random.default_rng(seed).standard_normal(one.qpos.shape)
        data.append(replace(one, qpos=one.qpos + noise))


@pytest.mark.slow
def test_the_page_runs_as_it_stands(tmp_path, monkeypatch):
    robot = write_arm(tmp_path / "arm")
    logs(robot, tmp_path / "data", 0, 8, kp=0.8, delay=1)
    logs(robot, tmp_path / "new_logs", 20, 4, kp=0.7, delay=1)
    logs(robot, tmp_path / "logs" / "a", 40, 4, kp=0.8, delay=1)
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(
        r"```(console|python)\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL
    )
    # mjlab and Isaac Lab are not installed here
    blocks = [block for block in blocks if "EventTermCfg" not in block[1]]
    kinds = ["console", "console", "python", "python", "console", "console", "python"]
    assert [kind for kind, _ in blocks] == kinds
    assert main(["identify", "data", "--out", "my_arm"]) == 0
    codes = {}
    for kind, text in blocks:
        if kind == "python":
            if "robots" in text:
                shutil.copytree("my_arm", "robots/a")
            exec(compile(text, "randomize.md", "exec"), {})
            continue
        for line in text.strip().splitlines():
            try:
                codes[line] = main(shlex.split(line, comments=True)[1:])
            except SystemExit as end:
                codes[line] = end.code
    assert {line.partition("  #")[0]: code for line, code in codes.items() if code} == {
        "gaponet check my_arm new_logs": 1  # it is softer
    }
    made = json.loads((tmp_path / "my_arm_today/randomization/randomization.json").read_text())
    kp = made["ranges"]["elbow"]["kp"]
    assert kp["low"] < 14 < 16 < kp["high"]  # both days' are inside
