"""The example of a driver keeps the promises of `Driver`, and moves an arm."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from arm import commands
from motion_files import write_motion

from gaponet.base import plugins
from gaponet.hw import conformance
from gaponet.motion.motion import Motion

EXAMPLE = Path(__file__).parents[2] / "examples" / "driver"


@pytest.fixture
def my_arm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The module, as after `pip install -e .`."""
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    info = tmp_path / "site" / "my_arm-0.1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-arm\nVersion: 0.1\n")
    ((group, points),) = project["entry-points"].items()
    lines = [f"{name} = {value}" for name, value in points.items()]
    (info / "entry_points.txt").write_text("\n".join([f"[{group}]", *lines]))
    for place in (info.parent, EXAMPLE):
        monkeypatch.syspath_prepend(place)
    plugins.forget_extensions()
    import my_arm

    yield my_arm
    monkeypatch.undo()
    plugins.forget_extensions()
    sys.modules.pop("my_arm", None)


@pytest.fixture
def simulated(my_arm: Any, arm: Any) -> Iterator[Any]:
    simulated = my_arm.SimulatedArm(arm)
    yield simulated
    simulated.close()


def test_the_example_keeps_all_promises(my_arm, simulated, arm, monkeypatch):
    monkeypatch.setattr(conformance, "MAX_CALL_S", 1.0)  # this machine may be busy
    driver = my_arm.MyArm(arm, simulated.port)

    found = conformance.broken_promises(
        driver, arm, commands=simulated.commands_received, positions=simulated.positions
    )

    assert found == []


def test_gaponet_run_finds_the_example_by_its_name(simulated, arm, tmp_path):
    motion = tmp_path / "sway.npz"
    write_motion(motion, Motion("sway", "whole_body", 0.02, 0.2 * commands(20, seed=1)), arm)

    words = ["run", "--driver", "my_arm", "--port", simulated.port, "--motion", str(motion)]
    words += ["--limits-from", str(arm.folder), "--dry-run", "--yes", "--unchecked", "--json"]
    # A busy machine may delay the simulated arm's messages.
    words += ["--safety.stale", "50", "--safety.overrun", "50"]
    # The command line knows the drivers that were there when it was imported.
    run = subprocess.run(
        [sys.executable, "-m", "gaponet", *words],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )

    assert json.loads(run.stdout)["dry_run"] is True
    assert simulated.commands_received() == 0
    assert np.allclose(simulated.positions(), arm.qpos_home)
