"""The checks that travel, in other people's engines in environments of their own: make engines."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
from environments import environment
from late_servos import FRICTION_LAW, with_late_servos

from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.export import export_folder
from gaponet.export.plain_servos import own_motions, rollout_error
from gaponet.export.shipped.mujoco_servos import Check
from gaponet.robot.servo_fields import SERVO_TERMS
from gaponet.robot.spec import RobotSpec, load_robot

pytestmark = pytest.mark.peers


class Engine(NamedTuple):
    name: str  # of the folder of its environment
    to: str  # what is exported
    python: str
    packages: tuple[str, ...]

    def check(self, exported: Path, *arguments: str) -> str:
        """What an export's check.py says in this engine."""
        python = environment(self.name, self.python, *((package,) for package in self.packages))
        command = [python, "check.py", *arguments]
        folder = exported / self.to
        run = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
        print(run.stdout)
        return run.stdout


MUJOCO = Engine("mujoco", "mjcf", "3.11", ("mujoco>=3.5",))
MJLAB = Engine("mjlab-1.6", "mjlab", "3.11", (f"torch=={torch.__version__}", "mjlab==1.6.*"))
ISAAC_LAB = Engine("isaaclab-3", "isaaclab", "3.12", ("isaaclab==3.*", "mujoco-usd-converter"))
NEWTON = Engine("newton", "newton", "3.11", ("newton[sim,onnx]",))
ENGINES = (MUJOCO, MJLAB, ISAAC_LAB, NEWTON)

# "mjlab, 3 worlds: 1.23 mrad; in gaponet 1.21"
ERRORS = re.compile(r": ([\d.]+) mrad; in gaponet ([\d.]+)")
MAX_DIFFERENCE = 0.05  # relative
RESOLUTION_MRAD = 0.05  # of the errors that a check prints
UNITS = 3


def name_of(engine: Engine) -> str:
    return engine.name


def without_law(robot: RobotSpec, *_: object, **__: object) -> RobotSpec:
    """PD servos for the robot, instead of the nearest, which test_export_robot.py searches for."""
    return robot.with_identified(
        {joint: dict.fromkeys(FRICTION_LAW, 0.0) for joint in robot.operated}
    )


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A VIRTUAL SO-101 with late servos and a law for every engine; motions of 2 to 4 s, so that
    worlds end apart.
    """
    folder = tmp_path_factory.mktemp("engines")
    robot = with_late_servos(load_robot("so101"))
    motions = []
    for i, motion in enumerate(own_motions(robot, count=5)):
        motions.append(motion.rows(slice(0, 100 + 27 * i)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(export_folder, "fit_plain_servos", without_law)
        for engine in ENGINES:
            export_folder.export_robot(robot, engine.to, folder / engine.to, (motions, motions))
    return folder


@pytest.mark.parametrize("engine", ENGINES, ids=name_of)
def test_late_servos_with_a_law_move_there_as_here_in_worlds_that_begin_anew_by_themselves(
    exported: Path, engine: Engine
) -> None:
    said = engine.check(exported)
    errors = np.array(ERRORS.findall(said), float)
    assert len(errors)
    there, here = errors.T
    assert (np.abs(there - here) <= MAX_DIFFERENCE * here + RESOLUTION_MRAD).all()


def servos_of(check: Check, engine: Engine) -> dict[str, np.ndarray]:
    """Fields of the servos that are exported, (n) in the order of the corrected joints."""
    servos = check.facts["joints" if engine is MJLAB else "plain"]
    joints = check.facts["corrected"]
    fields = {}
    for field in (
        "kp",
        "damping",
        "frictionloss",
        "armature",
        "offset",
        "effort_limit",
        "delay",
        *SERVO_TERMS,
    ):
        if field in servos[joints[0]]:
            fields[field] = np.array([servos[joint][field] for joint in joints])
    return fields


def drawn_units(check: Check, engine: Engine) -> dict[str, np.ndarray]:
    """Fields of units whose servos are 0.6 to 1.6 times those that are exported, (UNITS, n)."""
    rng = np.random.default_rng(0)
    units = {}
    for field, values in servos_of(check, engine).items():
        factor = rng.uniform(0.6, 1.6, (UNITS, len(values)))
        if engine is MJLAB and field == "delay":  # which it keeps
            factor = np.ones_like(factor)
        units[field] = values * factor
    return units


def error_mrad(check: Check, unit: RobotSpec) -> float:
    """How far a unit's motions in gaponet are from those of an export's check."""
    meta = SequenceMeta(unit.name, "itself", "m", 0.0, virtual=True)
    motions = []
    for motion in check.motions:
        states = (motion["ctrl"], motion["qpos"], motion["qvel"])
        motions.append(Sequence(meta, unit.joint_names, float(motion["dt"]), *states))
    return 1e3 * rollout_error(motions, unit)


@pytest.mark.parametrize("engine", [MJLAB, ISAAC_LAB], ids=name_of)
def test_a_drawn_unit_moves_in_an_engine_as_in_gaponet(
    exported: Path, tmp_path: Path, engine: Engine
) -> None:
    check = Check(exported / engine.to)
    joints = check.facts["corrected"]
    units = drawn_units(check, engine)
    content = {"joints": joints, "units": {field: rows.tolist() for field, rows in units.items()}}
    file = tmp_path / "randomization.json"
    file.write_text(json.dumps(content))
    last = {}
    for i, joint in enumerate(joints):
        last[joint] = {field: float(rows[-1, i]) for field, rows in units.items()}
    here = error_mrad(check, load_robot("so101").with_identified(last))

    said = engine.check(exported, str(file), str(UNITS - 1))

    print(f"the unit in gaponet: {here:.2f}")
    ((there, _),) = ERRORS.findall(said)
    assert here > 5
    assert abs(float(there) - here) <= MAX_DIFFERENCE * here
