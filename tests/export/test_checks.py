"""The checks that travel, in other people's engines in environments of their own: make engines."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from environments import environment

from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.export import export_folder as exporting
from gaponet.export.plain_servos import own_motions, rollout_error
from gaponet.export.shipped.mujoco_servos import Check
from gaponet.robot.servo_fields import SERVO_TERMS
from gaponet.robot.spec import load_robot

pytestmark = pytest.mark.peers

ENGINES = {  # name → what is exported, what is run, Python, what is installed
    "mujoco": ("mjcf", "check.py", "3.11", ("mujoco>=3.5",)),
    "mjlab-1.6": ("mjlab", "check.py", "3.11", (f"torch=={torch.__version__}", "mjlab==1.6.*")),
    "isaaclab-3": ("isaaclab", "check.py", "3.12", ("isaaclab==3.*", "mujoco-usd-converter")),
    "newton": ("newton", "check.py", "3.11", ("newton[sim,onnx]",)),
}


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A VIRTUAL SO-101 with late servos and a law for every engine; motions of 2 to 4 s, so that
    worlds end apart.
    """
    folder, robot = tmp_path_factory.mktemp("engines"), load_robot("so101")
    law = {
        "stribeck": 0.03,
        "stribeck_speed": 0.05,
        "friction_motor": 0.08,
        "friction_external": 0.15,
    }
    found = {
        j: {"delay": 0.006 * i, "offset": 0.01 * i} | law for i, j in enumerate(robot.operated, 1)
    }
    robot = robot.with_identified(found)
    motions = [s.rows(slice(0, 100 + 27 * i)) for i, s in enumerate(own_motions(robot, count=5))]
    with (
        pytest.MonkeyPatch.context() as patch
    ):  # the nearest numbers are searched for in test_export_robot.py
        patch.setattr(
            exporting,
            "fit_plain_servos",
            lambda r, *_, **__: r.with_identified({j: dict.fromkeys(law, 0.0) for j in found}),
        )
        for to in {to for to, *_ in ENGINES.values()}:
            exporting.export_robot(robot, to, folder / to, (motions, motions))
    return folder


@pytest.mark.parametrize("name", ENGINES)
def test_late_servos_with_a_law_move_there_as_here_in_worlds_that_begin_anew_by_themselves(
    exported: Path, name: str
) -> None:
    to, check, version, packages = ENGINES[name]
    python = environment(name, version, *((package,) for package in packages))
    said = subprocess.run(
        [python, check], cwd=exported / to, capture_output=True, text=True, check=True
    ).stdout
    print(said)
    pairs = re.findall(r": ([\d.]+) mrad; in gaponet ([\d.]+)", said)
    assert pairs
    for there, here in pairs:
        assert abs(float(there) - float(here)) <= 0.05 * float(here) + 0.05


@pytest.mark.parametrize("name", ["mjlab-1.6", "isaaclab-3"])
def test_a_drawn_unit_moves_in_an_engine_as_in_gaponet(
    exported: Path, tmp_path: Path, name: str
) -> None:
    to, script, version, packages = ENGINES[name]
    check, rng = Check(exported / to), np.random.default_rng(0)
    joints, servos = check.facts["corrected"], check.facts["joints" if to == "mjlab" else "plain"]
    fields = (
        "kp",
        "damping",
        "frictionloss",
        "armature",
        "offset",
        "effort_limit",
        "delay",
        *SERVO_TERMS,
    )
    now = {f: np.array([servos[j][f] for j in joints]) for f in fields if f in servos[joints[0]]}
    units = {f: (x * rng.uniform(0.6, 1.6, (3, len(joints)))).tolist() for f, x in now.items()}
    if to == "mjlab":  # it keeps the delays
        units["delay"] = [now["delay"].tolist()] * 3
    file = tmp_path / "randomization.json"
    file.write_text(json.dumps({"joints": joints, "units": units}))
    python = environment(name, version, *((package,) for package in packages))
    command = [python, script, str(file), "2"]
    said = subprocess.run(
        command, cwd=exported / to, capture_output=True, text=True, check=True
    ).stdout
    unit = load_robot("so101").with_identified(
        {j: {f: x[2][i] for f, x in units.items()} for i, j in enumerate(joints)}
    )
    meta = SequenceMeta(unit.name, "itself", "m", 0.0, virtual=True)
    motions = [
        Sequence(meta, unit.joint_names, float(m["dt"]), m["ctrl"], m["qpos"], m["qvel"])
        for m in check.motions
    ]
    here = 1e3 * rollout_error(motions, unit)
    (there,) = (float(x) for x in re.findall(r": ([\d.]+) mrad; in gaponet", said))
    print(f"{said}the unit in gaponet: {here:.2f}")
    assert here > 5
    assert abs(there - here) <= 0.05 * here
