"""The checks that travel, in other people's engines in environments of their own: make engines."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest
import torch
from environments import environment

from gaponet.robot import load_robot
from gaponet_interop.engine.folder import export_robot

pytestmark = pytest.mark.peers

ENGINES = {  # name → what is exported, what is run, Python, what is installed
    "mujoco": ("mjcf", "check.py", "3.11", ("mujoco>=3.5",)),
    "mjlab-1.6": ("mjlab", "check.py", "3.11", (f"torch=={torch.__version__}", "mjlab==1.6.*")),
    "mjx": ("mjcf", "check_mjx.py", "3.11", ("mujoco-mjx",)),
    "newton": ("newton", "check.py", "3.11", ("newton[sim]",)),
}


@pytest.mark.parametrize("name", ENGINES)
def test_late_servos_with_a_law_move_there_as_here(tmp_path: Path, name: str) -> None:
    to, check, version, packages = ENGINES[name]
    robot = load_robot("so101")
    law = {"stribeck": 0.03, "stribeck_speed": 0.05, "friction_motor": 0.08, "friction_external": 0.15}
    found = {j: {"delay": 0.006 * i, "offset": 0.01 * i} | law for i, j in enumerate(robot.operated, 1)}
    export_robot(robot.with_servos(found), to, tmp_path / to)
    python = environment(name, version, *((package,) for package in packages))
    said = subprocess.run([python, check], cwd=tmp_path / to, capture_output=True, text=True, check=True).stdout
    print(said)
    pairs = re.findall(r": ([\d.]+) mrad; in gaponet ([\d.]+)", said)
    assert pairs
    for there, here in pairs:
        assert abs(float(there) - float(here)) <= 0.05 * float(here) + 0.05
