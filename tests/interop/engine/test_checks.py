"""The checks that travel, in other people's engines in environments of their own: make engines."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest
import torch
from environments import environment

from gaponet.robot import load_robot
from gaponet_interop.engine import folder as exporting
from gaponet_interop.engine.forms import own_motions, plain_form

pytestmark = pytest.mark.peers

ENGINES = {  # name → what is exported, what is run, Python, what is installed
    "mujoco": ("mjcf", "check.py", "3.11", ("mujoco>=3.5",)),
    "mjlab-1.6": ("mjlab", "check.py", "3.11", (f"torch=={torch.__version__}", "mjlab==1.6.*")),
    "mjx": ("mjcf", "check_mjx.py", "3.11", ("mujoco-mjx",)),
    "newton": ("newton", "check.py", "3.11", ("newton[sim]",)),
}


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A VIRTUAL SO-101 with late servos and a law for every engine; what is fitted without the law, once for all."""
    folder, robot = tmp_path_factory.mktemp("engines"), load_robot("so101")
    law = {"stribeck": 0.03, "stribeck_speed": 0.05, "friction_motor": 0.08, "friction_external": 0.15}
    found = {j: {"delay": 0.006 * i, "offset": 0.01 * i} | law for i, j in enumerate(robot.operated, 1)}
    with pytest.MonkeyPatch.context() as patch:
        robot = robot.with_servos(found)
        plain = plain_form(robot, own_motions(robot)[::2])
        patch.setattr(exporting, "plain_form", lambda *_, **__: plain)
        for to in {to for to, *_ in ENGINES.values()}:
            exporting.export_robot(robot, to, folder / to)
    return folder


@pytest.mark.parametrize("name", ENGINES)
def test_late_servos_with_a_law_move_there_as_here(exported: Path, name: str) -> None:
    to, check, version, packages = ENGINES[name]
    python = environment(name, version, *((package,) for package in packages))
    said = subprocess.run([python, check], cwd=exported / to, capture_output=True, text=True, check=True).stdout
    print(said)
    pairs = re.findall(r": ([\d.]+) mrad; in gaponet ([\d.]+)", said)
    assert pairs
    for there, here in pairs:
        assert abs(float(there) - float(here)) <= 0.05 * float(here) + 0.05
