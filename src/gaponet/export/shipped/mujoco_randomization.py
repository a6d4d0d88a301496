"""Set a MuJoCo model to one of the sampled units of a robot.

This file is copied into exports; it needs no gaponet.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

HERE = Path(__file__).parent
ON_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))


def units(file: Path = HERE / "randomization.json") -> dict[str, Any]:
    """Read the file; "units" maps each field to units × joints. A row is one unit."""
    return dict(json.loads(file.read_text(encoding="utf-8")))


def apply(model: mujoco.MjModel, drawn: dict[str, Any], row: int, prefix: str = "") -> None:
    """Set the joints and position servos of a model to a unit.

    The model is, for example, the robot.xml of gaponet export --to mjcf.

    The unit is one without the servo model, where the file has these. kd of the servos does not
    change, servos without a torque limit get none, and a delay is at most as long as the servo's
    buffer (nsample). Other actuators, such as motors and velocity servos, stay as they are.

    Args:
        prefix: Text before the names of joints and bodies in the model.

    Raises:
        ValueError: A joint has several position servos.
    """
    form = "plain_units" if "plain_units" in drawn else "units"
    joints = [model.joint(prefix + name) for name in drawn["joints"]]
    servos = [_position_servo(model, joint) for joint in joints]
    for i, (joint, servo) in enumerate(zip(joints, servos, strict=True)):
        unit = _servo(drawn[form], row, i)
        dof = joint.dofadr[0]
        model.dof_damping[dof] = unit["damping"]
        model.dof_frictionloss[dof] = unit["frictionloss"]
        model.dof_armature[dof] = unit["armature"]
        if servo is not None:
            _set_servo(model, servo, unit)
    set_links(model, drawn, row, form, prefix)


def _position_servo(model: mujoco.MjModel, joint: Any) -> int | None:
    """Return the number of the position servo of a joint; None if the joint has none."""
    servos = []
    for servo in np.flatnonzero(model.actuator_trnid[:, 0] == joint.id):
        is_on_joint = int(model.actuator_trntype[servo]) in ON_JOINT
        is_affine = model.actuator_biastype[servo] == mujoco.mjtBias.mjBIAS_AFFINE
        # The torque of a velocity servo does not depend on the position.
        if is_on_joint and is_affine and model.actuator_biasprm[servo, 1] < 0:
            servos.append(int(servo))
    if len(servos) > 1:
        raise ValueError(
            f"joint '{joint.name}' has {len(servos)} position servos, and a unit has the numbers "
            "of one: delete the others"
        )
    return servos[0] if servos else None


def _set_servo(model: mujoco.MjModel, servo: int, unit: dict[str, float]) -> None:
    """Give a position servo the numbers of a joint in a unit."""
    kp = unit["kp"]
    limit = unit["effort_limit"]
    # A servo that limits the speed of its targets (<pid>) has its stiffness in biasprm alone.
    if model.actuator_gaintype[servo] == mujoco.mjtGain.mjGAIN_FIXED:
        model.actuator_gainprm[servo, 0] = kp
    model.actuator_biasprm[servo, 0] = kp * unit["offset"]
    model.actuator_biasprm[servo, 1] = -kp
    if model.actuator_forcelimited[servo]:
        model.actuator_forcerange[servo] = -limit, limit
    samples = int(model.actuator_history[servo, 0])
    if samples:
        longest = (samples - 2) * model.opt.timestep
        model.actuator_delay[servo] = min(unit["delay"], longest)


def _servo(units: dict[str, Any], row: int, joint: int) -> dict[str, float]:
    """Return the numbers of a joint in a unit; links are none of them."""
    servo = {}
    for field, values in units.items():
        if field != "links":
            servo[field] = float(values[row][joint])
    return servo


def set_links(
    model: mujoco.MjModel,
    drawn: dict[str, Any],
    row: int,
    form: str = "units",
    prefix: str = "",
) -> None:
    """Give bodies the links of a unit, where the file has links.

    Args:
        form: "units", with the servo model, or "plain_units", without it.
        prefix: Text before the bodies' names in the model.
    """
    # Geoms and sites stay where they are. Before MuJoCo 4 mj_setConst does not see to that.
    none = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    for i, name in enumerate(drawn.get("bodies", ())):
        body = model.body(prefix + name)
        x = drawn[form]["links"][row][i]
        body.mass[:] = x[0]
        body.ipos[:] = x[1:4]
        body.inertia[:] = x[4:7]
        body.iquat[:] = x[7:]
        model.body_sameframe[body.id] = none
        model.geom_sameframe[model.geom_bodyid == body.id] = none
        model.site_sameframe[model.site_bodyid == body.id] = none
    mujoco.mj_setConst(model, mujoco.MjData(model))


def unit_facts(facts: dict[str, Any], drawn: dict[str, Any], row: int) -> dict[str, Any]:
    """Return facts.json with the numbers of a unit, for mujoco_servos.Servos.

    The facts are those of gaponet export --to mjcf.

    Servos(model, unit_facts(facts, drawn, row)) moves a model like the unit after `set_links`.
    """
    joints = {name: dict(servo) for name, servo in facts["joints"].items()}
    for i, name in enumerate(drawn["joints"]):
        joints[name] |= _servo(drawn["units"], row, i)
    return facts | {"joints": joints}
