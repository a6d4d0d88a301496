"""The simulator of a robot for other engines.

Numbers with units (facts.json), and one MJCF with its servos.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import asdict
from typing import Any

import mujoco
import numpy as np

from gaponet.base.errors import RobotError
from gaponet.export.shipped.scene_facts import joint_fields, solver_options
from gaponet.robot.fingerprint import model_fingerprint
from gaponet.robot.mjcf import compile_spec
from gaponet.robot.self_contained import self_contained_text, set_attributes
from gaponet.robot.servo_fields import SERVO_FIELDS, SERVO_TERMS, STOP_FIELDS
from gaponet.robot.spec import RobotSpec
from gaponet.sim.model import (
    STIFF_MOBILITY,
    build_model,
    build_spec,
    carried,
    model_hash,
    numbers_of_pairs,
)

UNITS = {"home": "rad", "range": "rad", "dt": "s", "payload_mass": "kg"} | {
    field.name: field.unit for field in SERVO_FIELDS.values() if field.name not in STOP_FIELDS
}
MEANING = {
    "offset": "the servo aims at command + offset",
    "zero": "the MJCF's angle is reading + zero; robot.xml has it as ref",
    "dof_invweight0_factor": "of joints' dof_invweight0 after compilation, for stiff friction; "
    "MJCF has no such field",
    "law": "servo model beyond PD, by joint; not in any MJCF, but in the helper file, and for "
    "mjlab in its actuators",
    "plain": "numbers fitted for PD servos without the servo model; equal to joints without one",
    "error_mrad": "mean |error| of joints on the motions of check.npz, in gaponet",
    "payload_mounts": "side → body of the MJCF that carries a steel ball, its centre at pos in the "
    "body's frame, m; mass in kg includes payload_mass",
    "links": "body → its identified mass in kg, centre pos in its frame in m, and inertia about "
    "the centre (xx, yy, zz, xy, xz, yz) in kg·m²; other bodies have those of the MJCF",
    "table": "level plane at height in m in the MJCF's world, friction coefficient, and stiffness "
    "under a tip in N/m; tips are spheres of radius at pos in the frame of body, m. null: no table",
    "mujoco": "fields of the compiled MjModel by their names",
}


Joints = dict[str, dict[str, Any]]  # joint → an identified servo and its joint, as of `servo_facts`


def control_period(robot: RobotSpec, periods: Iterable[float]) -> float:
    """Return the robot's control period if one of these is within 2 % of it, else the first, s."""
    periods = [*periods]
    return robot.dt if any(abs(dt / robot.dt - 1) < 0.02 for dt in periods) else periods[0]


def simulator_facts(
    robot: RobotSpec, dt: float, payload_mass: float = 0.0, plain: RobotSpec | None = None
) -> dict[str, Any]:
    """Return the content of facts.json, read from the compiled simulator of a robot.

    Args:
        robot: Simulator, e.g. of a run, or an identified robot.
        dt: Control period, s.
        payload_mass: In each hand, kg.
        plain: The robot as fitted without a servo model; default `robot`, its servo model ignored.
    """
    model = build_model(robot, payload_mass, dt=dt)
    plain_model = model if plain is None else build_model(plain, payload_mass, dt=dt)
    joints: dict[str, Any] = {}
    without_model: dict[str, Any] = {}
    for i, name in enumerate(robot.joint_names):
        joints[name] = servo_facts(robot, model, i) | {"mujoco": joint_fields(model, name)}
        if robot.servo.has_terms:
            joints[name] |= robot.servo.of_joint(i, SERVO_TERMS)
        without_model[name] = servo_facts(plain or robot, plain_model, i)
    return {
        "format": 2,
        "robot": robot.name,
        "simulator": model_hash(robot),
        "units": UNITS,
        "meaning": MEANING,
        "versions": {"mujoco": mujoco.__version__},
        "dt": dt,
        "decimation": robot.steps_per(dt),
        "payload_mass": payload_mass,
        "corrected": list(robot.operated),
        "options": solver_options(model),
        "dof_invweight0_factor": STIFF_MOBILITY,
        "law": [term for term in SERVO_TERMS if robot.servo[term].any()],
        "payload_mounts": _mount_facts(robot, payload_mass),
        "links": {name: asdict(link) for name, link in robot.links.items()},
        "table": _table_facts(robot),
        "joints": joints,
        "plain": without_model,
    }


def _mount_facts(robot: RobotSpec, payload_mass: float) -> dict[str, Any]:
    """Return what the robot carries in each hand, with a payload in kg."""
    facts = {}
    for mount in robot.payload_mounts:
        mass = carried(robot, mount, payload_mass)
        facts[mount.side] = {"body": mount.body, "pos": mount.pos, "mass": mass}
    return facts


def _table_facts(robot: RobotSpec) -> dict[str, Any] | None:
    """Return the table and the tips that can touch it; None without a table."""
    if robot.scene.table is None:
        return None
    tips = [asdict(tip) for tip in robot.scene.tips]
    return asdict(robot.scene.table) | {"tips": tips}


def servo_facts(robot: RobotSpec, model: mujoco.MjModel, i: int) -> dict[str, Any]:
    """Return joint i of a robot as its compiled model has it."""
    joint = model.joint(robot.joint_names[i])
    dof = joint.dofadr[0]
    servo = {
        "home": float(robot.qpos_home[i]),
        "range": model.jnt_range[joint.id].tolist() if model.jnt_limited[joint.id] else None,
        "kp": float(robot.servo.kp[i]),
        "kd": float(robot.servo.kd[i]),
        "effort_limit": float(robot.servo.effort_limit[i]),
        "armature": float(model.dof_armature[dof]),
        "damping": float(np.ravel(model.dof_damping[dof])[0]),
        "frictionloss": float(model.dof_frictionloss[dof]),
        "delay": float(robot.servo.delay[i]),
        "offset": float(robot.servo.offset[i]),
        "zero": float(robot.servo.zero[i]),
        "target_speed": float(robot.servo.target_speed[i]),
    }
    if robot.servo.no_load_speed[i]:
        servo["no_load_speed"] = float(robot.servo.no_load_speed[i])
    return servo


def mjcf_text(robot: RobotSpec, dt: float, payload_mass: float = 0.0) -> str:
    """Return the simulator as one MJCF without other files.

    It has joints, solver options, and servos with their delays.

    Raises:
        RobotError: One file cannot express the simulator.
    """
    model = build_model(robot, payload_mass, dt=dt)
    root = ET.fromstring(self_contained_text(build_spec(robot, payload_mass, dt=dt), robot.mjcf))
    option = root.find("option")
    assert option is not None
    set_attributes(option, timestep=model.opt.timestep)
    pairs = numbers_of_pairs(model)
    for pair in root.iter("pair"):  # a table's stiffness is set after compilation
        k = pairs[frozenset((pair.attrib["geom1"], pair.attrib["geom2"]))]
        set_attributes(
            pair,
            solref=model.pair_solref[k],
            solimp=model.pair_solimp[k],
            friction=model.pair_friction[k],
        )
    servos = ET.SubElement(root, "actuator")
    for i in range(model.nu):
        name = model.actuator(i).name
        bias = model.actuator_biasprm[i]
        if bias[0]:
            servo = ET.SubElement(
                servos, "general", {"name": name, "joint": name, "biastype": "affine"}
            )
            set_attributes(servo, gainprm=model.actuator_gainprm[i, 0], biasprm=bias[:3])
        else:
            servo = ET.SubElement(servos, "position", {"name": name, "joint": name})
            set_attributes(servo, kp=-bias[1], kv=-bias[2])
        set_attributes(servo, forcerange=model.actuator_forcerange[i])
        if model.actuator_history[i, 0]:
            servo.set("nsample", str(model.actuator_history[i, 0]))
            servo.set("interp", "linear")
            set_attributes(servo, delay=model.actuator_delay[i])
        if model.nuser_actuator:
            set_attributes(servo, user=model.actuator_user[i])
    ET.indent(root)
    text = ET.tostring(root, encoding="unicode") + "\n"
    again = compile_spec(mujoco.MjSpec.from_string(text), robot.mjcf)
    if (
        list(model_fingerprint(again)) != list(model_fingerprint(model))
        or again.opt.timestep != model.opt.timestep
    ):
        raise RobotError(
            f"{robot.mjcf}: with its servos it does not fit into one file that moves the same"
        )
    return text
