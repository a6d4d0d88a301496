"""Set a MuJoCo model to one of the sampled units of a robot. This file is copied into exports; it needs no gaponet.

python mujoco_randomization.py MODEL.xml     # tries three units
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

HERE = Path(__file__).parent


def units(file: Path = HERE / "randomization.json") -> dict[str, Any]:
    """Read the file; "units" maps each field to samples × joints. A row is one unit."""
    return dict(json.loads(file.read_text(encoding="utf-8")))


def apply(model: mujoco.MjModel, drawn: dict[str, Any], row: int) -> dict[str, dict[str, float]]:
    """Set kp, damping, friction, armature and torque limit of every joint to those of a unit.

    kd of the servos does not change, and servos without a torque limit get none.

    Returns:
        Joint → values without a field in the model: offset (rad, added to every target), delay (s), servo model.
    """
    rest: dict[str, dict[str, float]] = {}
    for i, name in enumerate(drawn["joints"]):
        unit = {field: float(values[row][i]) for field, values in drawn["units"].items()}
        joint = model.joint(name)
        dof = joint.dofadr[0]
        model.dof_damping[dof] = unit.pop("damping")
        model.dof_frictionloss[dof], model.dof_armature[dof] = unit.pop("frictionloss"), unit.pop("armature")
        limit = unit.pop("effort_limit")
        for servo in np.flatnonzero(model.actuator_trnid[:, 0] == joint.id):
            if model.actuator_trntype[servo] == mujoco.mjtTrn.mjTRN_JOINT:
                model.actuator_gainprm[servo, 0], model.actuator_biasprm[servo, 1] = unit["kp"], -unit["kp"]
                if model.actuator_forcelimited[servo]:
                    model.actuator_forcerange[servo] = -limit, limit
        del unit["kp"]
        rest[name] = unit
    return rest


if __name__ == "__main__":
    model, drawn = mujoco.MjModel.from_xml_path(sys.argv[1]), units()
    for row in range(3):
        print(row, apply(model, drawn, row))
