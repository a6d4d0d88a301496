"""The first change on the architecture page: what it shows is there, its robot is recorded, it
reaches every engine.
"""

import inspect
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from gaponet.cli.main import main
from gaponet.data.store import Dataset
from gaponet.sim import servo

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
LINES = re.findall(r"^([-+])    (return .*)$", PAGE, re.M)
COMMANDS = [shlex.split(c, comments=True) for c in re.findall(r"^gaponet .*$", PAGE, re.M)]

# Two joints under a law with friction at rest: what numba makes of it, and what numpy does.
PLAY = """
import sys; sys.path.insert(0, sys.argv[1])
import numpy as np
from pathlib import Path
from arm import recordings, write_arm
from gaponet.sysid import joint_rollouts
robot = write_arm(Path(sys.argv[2]))
values = {"kp": 20, "damping": 0.5, "frictionloss": 0.05, "armature": 0.02}
values |= {"stribeck": 0.3, "stribeck_speed": 0.1}
runs = joint_rollouts.JointRollouts(recordings(robot, 1, rows=100), robot)
values = {f: np.full((1, 2), float(values.get(f, 0))) for f in (*values, "offset", "delay")}
from gaponet.sim.servo import resting_friction
print(np.abs(runs.errors(values)).mean(), resting_friction(0.3, 0.1, np.array([0.2]))[0])
"""


def test_the_law_that_the_page_shows_and_the_files_that_it_names_are_there():
    assert inspect.getsource(servo.resting_friction) in PAGE
    assert [sign for sign, _ in LINES] == ["-", "+"]
    assert LINES[0][1] in inspect.getsource(servo.resting_friction)
    for file in re.findall(r"`((?:src|tests|examples)/[\w/.]+)`", PAGE):
        assert (ROOT / file).exists(), file


def test_the_robot_of_the_page_is_recorded(tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    collect, *others = COMMANDS
    assert [c[1] for c in others] == ["identify", "identify", "gap"]
    (tmp_path / "short.toml").write_text(
        (ROOT / "examples" / "friction_motions.toml")
        .read_text()
        .replace('"tour-all-*", "creep-*", "multisine-*"', '"multisine-shoulder_pan"')
    )
    words = [
        {"examples/friction_motions.toml": str(tmp_path / "short.toml")}.get(w, w)
        for w in collect[1:]
    ]
    assert main([*words[:-1], str(tmp_path / "data"), "--nproc", "1"]) == 0
    assert Dataset(tmp_path / "data").entries[0].meta.virtual


@pytest.mark.slow
def test_the_change_of_the_page_reaches_numpy_and_what_numba_compiles(tmp_path):
    said = {}
    shutil.copytree(
        ROOT / "src" / "gaponet", tmp_path / "gaponet", ignore=shutil.ignore_patterns("__pycache__")
    )
    law = tmp_path / "gaponet" / "sim" / "servo.py"
    for name, change in (("before", str), ("after", lambda t: t.replace(LINES[0][1], LINES[1][1]))):
        law.write_text(change(law.read_text(encoding="utf-8")), encoding="utf-8")
        words = [sys.executable, "-c", PLAY, str(ROOT / "tests"), str(tmp_path / "arm")]
        done = subprocess.run(
            words, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": str(tmp_path)}
        )
        assert done.returncode == 0, done.stderr
        said[name] = [float(x) for x in done.stdout.split()]
    for before, after in zip(*said.values(), strict=True):
        assert abs(after / before - 1) > 0.02
