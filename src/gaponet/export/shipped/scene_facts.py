"""Compare a compiled scene with the simulator of an export.

This file is copied into exports; it needs MuJoCo and numpy, not gaponet.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gaponet.export.shipped.mujoco_servos import read

RELATIVE_TOLERANCE = 1e-5
FREE_FLAGS = {"contact", "island"}  # flags in which a scene may differ
FIELDS = (
    "dof_armature",
    "dof_damping",
    "dof_frictionloss",
    "dof_solref",
    "dof_solimp",
    "jnt_range",
    "jnt_stiffness",
    "actuator_gainprm",
    "actuator_biasprm",
    "actuator_forcerange",
    "actuator_delay",
    "actuator_history",
)
OPTIONS = (
    "timestep",
    "gravity",
    "impratio",
    "iterations",
    "tolerance",
    "ls_iterations",
    "ls_tolerance",
    "ccd_iterations",
    "noslip_iterations",
    "density",
    "viscosity",
    "wind",
)


def require_scene(
    model: Any, prefix: str, folder: str | Path, skipped: tuple[str, ...] = ()
) -> None:
    """Refuse a compiled MjModel in which the robot's joints and servos are not those of training.

    Args:
        prefix: Text before each joint's name in the model.
        folder: Export.
        skipped: Fields of joints and servos that may differ.

    Raises:
        ValueError: The message names the fields that differ.
    """
    facts = read(Path(folder) / "facts.json")
    wrong = []
    for name, joint in facts["joints"].items():
        for field, value in joint_fields(model, prefix + name).items():
            if field in skipped:
                continue
            wrong += _differs(f"{field} of {name}", value, joint["mujoco"][field])
    here = solver_options(model)
    for field, value in facts["options"].items():
        if field.endswith("flags"):
            now = sorted(set(here[field]) - FREE_FLAGS)
            then = sorted(set(value) - FREE_FLAGS)
            wrong += [] if now == then else [f"{field} {now} instead of {then}"]
        elif isinstance(value, str):
            wrong += [] if here[field] == value else [f"{field} {here[field]} instead of {value}"]
        else:
            wrong += _differs(field, here[field], value)
    if wrong:
        shown = "; ".join(wrong[:5])
        if len(wrong) > 5:
            shown += " and more"
        raise ValueError(
            f"{folder}: was trained in simulator {facts['simulator']}; here {shown}. Take "
            "mjlab_entity and mjlab_options, or check=False"
        )


def _differs(what: str, now: Any, wanted: Any) -> list[str]:
    """Return a text on two values that differ, or nothing."""
    here = np.array(now, float)
    there = np.array(wanted, float)
    same = here.shape == there.shape and np.allclose(
        here, there, rtol=RELATIVE_TOLERANCE, atol=1e-12
    )
    return [] if same else [f"{what} {now} instead of {wanted}"]


def joint_fields(model: Any, name: str) -> dict[str, Any]:
    """Return the fields of an MjModel for a joint and the servo of that name.

    Three of each of a servo's parameters.
    """
    row = {
        "jnt": model.joint(name).id,
        "dof": model.joint(name).dofadr[0],
        "actuator": model.actuator(name).id,
    }
    fields = {}
    for field in FIELDS:
        values = getattr(model, field)[row[field.split("_")[0]]]
        if field.endswith("prm"):
            values = values[:3]
        fields[field] = values.tolist()
    return fields


def solver_options(model: Any) -> dict[str, Any]:
    """Return the options of an MjModel that affect motion.

    The names are those of MuJoCo and of mjlab's MujocoCfg.
    """
    import mujoco

    options = {}
    for name in OPTIONS:
        value = getattr(model.opt, name)
        options[name] = value.tolist() if hasattr(value, "tolist") else value
    for name, kind in (
        ("integrator", "Integrator"),
        ("cone", "Cone"),
        ("jacobian", "Jacobian"),
        ("solver", "Solver"),
    ):
        options[name] = (
            getattr(mujoco, f"mjt{kind}")(getattr(model.opt, name)).name.split("_", 1)[1].lower()
        )
    for name, kind in (("disableflags", "Disable"), ("enableflags", "Enable")):
        value = getattr(model.opt, name)
        flags = []
        for key, bit in getattr(mujoco, f"mjt{kind}Bit").__members__.items():
            if "BL_" in key and value & bit.value:
                flags.append(key.split("BL_")[1].lower())
        options[name] = sorted(flags)
    return options
