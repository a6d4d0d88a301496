"""Identified servos in a user's own scene: an mjSpec with other objects, other robots or another
table.

`apply` writes what MuJoCo can hold into the specification, by joint name. What it cannot hold, the
servo model, is computed before each physics step by the object that `Applied.servos` returns.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import RobotError
from gaponet.export.mjcf_edit import has_earlier_zero
from gaponet.export.shipped.mujoco_servos import Servos
from gaponet.export.simulator_facts import simulator_facts
from gaponet.export.targets import temperature_note
from gaponet.robot.spec import PayloadMount, RobotSpec
from gaponet.sim.model import (
    STIFF_SOLIMP,
    STIFF_SOLREF,
    TOLERANCE,
    add_payload_body,
    build_model,
    carried,
    write_link,
)

MAX_AXIS_DIFFERENCE_RAD = 0.02  # between two joints' axes, in the scene and in the robot
# Of an end of a joint's range; official files of one robot differ by less.
MAX_RANGE_DIFFERENCE_RAD = 0.1
MAX_GAIN_DIFFERENCE = 1e-6  # relative, of the two gains of a servo whose targets are in rad
POSITION_INPUT = 1  # of a <pid>: its only input is the target position
DELAY_SAMPLES = 2  # of a delay's buffer, beyond the delay itself


@dataclass(frozen=True)
class Applied:
    """What `apply` wrote into a scene, and what is left to do.

    Attributes:
        joints: Joints of the robot whose servos were written, without the prefix.
        prefix: Text before their names in the scene.
        servo_model: Terms of the servo model, which no MJCF holds; `servos` computes them.
        notes: What else differs from the simulator in which the robot was identified, in sentences.
        facts: Numbers of the servos, as in facts.json of an export.
    """

    joints: tuple[str, ...]
    prefix: str
    servo_model: tuple[str, ...]
    notes: tuple[str, ...]
    facts: dict[str, Any]

    def servos(self, model: mujoco.MjModel) -> Servos:
        """Return the servos of the compiled scene.

        Call their `before(data)` before each physics step.

        This also makes joint friction as stiff as in gaponet, which no MJCF can express, so it is
        worth a call where there is no servo model, too.
        """
        return Servos(model, self.facts, self.prefix)


def apply(robot: RobotSpec, spec: mujoco.MjSpec, *, prefix: str = "") -> Applied:
    """Write the identified servos of a robot into a scene, by the names of its joints.

        spec = mujoco.MjSpec.from_file("my_scene.xml")
        applied = gp.apply(gp.load_robot("./my_so101"), spec, prefix="left/")
        model = spec.compile()

    Joints get armature, damping, dry friction and the encoder's zero; links their identified
    inertias. A mass that the robot always carries, such as a hand that its file lacks, becomes a
    body `payload_SIDE`. A servo gets its gains, torque limit, offset and delay, and a limit of its
    target's speed where one was identified. A joint without an actuator gets one of the joint's
    name. Names, classes and groups stay, like everything else in the scene. Only operated joints
    change. Nothing is changed if anything contradicts.

    Args:
        robot: Identified, or nominal.
        spec: The scene; it is changed. Set its timestep before, because buffers of delays are as
            long as it asks.
        prefix: Text before the names of the robot's joints and bodies in the scene.

    Raises:
        RobotError: The scene contradicts the robot: a joint is missing, has another kind, axis or
            range, or more than one actuator, or one that takes no position targets in rad; a body
            with identified inertia or with a mount is missing; the robot was applied to this scene
            before; or this MuJoCo is too old for what was identified. Every contradiction is named.
    """
    problems = [*_joint_problems(robot, spec, prefix), *_body_problems(robot, spec, prefix)]
    if not problems:
        problems = _geometry_problems(robot, spec, prefix)
    if problems:
        raise RobotError(f"{robot.name} does not fit into the scene: {'; '.join(problems)}")
    model = build_model(robot)
    for name in robot.operated:
        i = robot.joint_names.index(name)
        _write_joint(spec, spec.joint(prefix + name), robot, i)
        _write_servo(spec, _servo_of(spec, prefix + name), robot, i)
    for name, link in robot.links.items():
        write_link(spec.body(prefix + name), link)
    for mount in _loaded_mounts(robot):
        body = spec.body(prefix + mount.body)
        add_payload_body(body, _payload_name(prefix, mount), mount, carried(robot, mount, 0.0))
    notes = _notes(robot, spec, model)
    spec.option.tolerance = min(spec.option.tolerance, TOLERANCE)
    facts = simulator_facts(robot, robot.dt)
    facts["joints"] = {name: facts["joints"][name] for name in robot.operated}
    facts["plain"] = {name: facts["plain"][name] for name in robot.operated}
    return Applied(robot.operated, prefix, tuple(facts["law"]), notes, facts)


# ---- contradictions


def _joint_problems(robot: RobotSpec, spec: mujoco.MjSpec, prefix: str) -> list[str]:
    """Return what contradicts in names, kinds and actuators of the joints."""
    problems = []
    have = {joint.name for joint in spec.joints}
    for name in robot.operated:
        full = prefix + name
        if full not in have:
            listed = ", ".join(sorted(have)) or "none"
            problems.append(f"there is no joint '{full}' (joints are {listed}; give prefix)")
            continue
        if spec.joint(full).type != mujoco.mjtJoint.mjJNT_HINGE:
            problems.append(f"joint '{full}' is no hinge")
        problems += _actuator_problems(spec, full)
    if robot.servo.target_speed.any() and not hasattr(mujoco.MjsActuator, "set_to_pid"):
        problems.append(
            f"MuJoCo {mujoco.__version__} cannot limit the speed of targets; install a newer one"
        )
    return problems


def _actuator_problems(spec: mujoco.MjSpec, joint: str) -> list[str]:
    """Return what contradicts in the actuators of a joint."""
    actuators = _actuators_of(spec, joint)
    if not actuators:
        return []
    if len(actuators) > 1:
        names = ", ".join(actuator.name for actuator in actuators)
        return [f"joint '{joint}' has {len(actuators)} actuators ({names}); delete all but one"]
    actuator = actuators[0]
    if not _takes_positions(actuator):
        return [
            f"actuator '{actuator.name}' of joint '{joint}' takes no position targets; delete it, "
            "or make it a <position>"
        ]
    stiffness = -actuator.biasprm[1]
    gain = actuator.gainprm[0]
    is_pid = actuator.gaintype != mujoco.mjtGain.mjGAIN_FIXED
    in_rad = is_pid or abs(gain - stiffness) <= MAX_GAIN_DIFFERENCE * stiffness
    if not in_rad or actuator.gear[0] != 1.0:
        return [f"targets of actuator '{actuator.name}' are not in rad of joint '{joint}'"]
    return []


def _takes_positions(actuator: mujoco.MjsActuator) -> bool:
    """Return True for <position>, <pid>, and a <general> that equals one of them."""
    if actuator.biastype != mujoco.mjtBias.mjBIAS_AFFINE or actuator.biasprm[1] >= 0:
        return False
    plain = actuator.gaintype == mujoco.mjtGain.mjGAIN_FIXED
    if plain and actuator.dyntype == mujoco.mjtDyn.mjDYN_NONE:
        return True
    pid = getattr(mujoco.mjtGain, "mjGAIN_PID", None)
    return pid is not None and actuator.gaintype == pid


def _body_problems(robot: RobotSpec, spec: mujoco.MjSpec, prefix: str) -> list[str]:
    """Return which bodies with identified inertias or masses are missing, or are there already."""
    have = {body.name for body in spec.bodies}
    problems = []
    for name in robot.links:
        full = prefix + name
        if full not in have:
            problems.append(f"there is no body '{full}', whose inertia was identified")
    for mount in _loaded_mounts(robot):
        full = prefix + mount.body
        if full not in have:
            problems.append(f"there is no body '{full}', which carries the mass '{mount.side}'")
        payload = _payload_name(prefix, mount)
        if payload in have:
            problems.append(
                f"there is a body '{payload}' already; begin with the original scene, or delete it"
            )
    return problems


def _loaded_mounts(robot: RobotSpec) -> list[PayloadMount]:
    """Return the mounts that carry a mass even without a payload."""
    return [mount for mount in robot.payload_mounts if carried(robot, mount, 0.0)]


def _payload_name(prefix: str, mount: PayloadMount) -> str:
    return f"{prefix}payload_{mount.side}"


def _geometry_problems(robot: RobotSpec, spec: mujoco.MjSpec, prefix: str) -> list[str]:
    """Return what contradicts in ranges and axes of the joints, which must exist."""
    scene = spec.copy().compile()
    own = build_model(robot.before_identification)
    return [
        *_zero_problems(robot, scene, own, prefix),
        *_range_problems(robot, scene, own, prefix),
        *_axis_problems(robot, scene, own, prefix),
    ]


def _zero_problems(
    robot: RobotSpec, scene: mujoco.MjModel, own: mujoco.MjModel, prefix: str
) -> list[str]:
    """Return the joints from which gaponet has subtracted an encoder's zero before."""
    problems = []
    for name in robot.operated:
        if has_earlier_zero(scene, prefix + name, own, name):
            problems.append(
                f"joint '{prefix}{name}' has the encoder zero of an earlier apply or export; begin "
                "with the original scene"
            )
    return problems


def _range_problems(
    robot: RobotSpec, scene: mujoco.MjModel, own: mujoco.MjModel, prefix: str
) -> list[str]:
    """Return the joints whose range in the scene is another one; an unlimited joint fits."""
    problems = []
    for name in robot.operated:
        joint = scene.joint(prefix + name).id
        expected = own.joint(name).id
        if not scene.jnt_limited[joint] or not own.jnt_limited[expected]:
            continue
        difference = np.abs(scene.jnt_range[joint] - own.jnt_range[expected]).max()
        if difference > MAX_RANGE_DIFFERENCE_RAD:
            ends = " to ".join(f"{x:.2f}" for x in scene.jnt_range[joint])
            known = " to ".join(f"{x:.2f}" for x in own.jnt_range[expected])
            problems.append(
                f"joint '{prefix}{name}' has a range of {ends} rad, the robot {known}: is its zero "
                "another one?"
            )
    return problems


def _axis_problems(
    robot: RobotSpec, scene: mujoco.MjModel, own: mujoco.MjModel, prefix: str
) -> list[str]:
    """Return the joints whose axis stands otherwise to that of the operated joint before.

    The robot may stand anywhere in the scene, so only angles between its own axes count. Both stand
    at home.
    """
    names = robot.operated
    home = robot.qpos_home[robot.operated_index]
    there = _axes(scene, [prefix + name for name in names], home)
    here = _axes(own, list(names), home)
    problems = []
    for k in range(1, len(names)):
        angle = _angle(there[k - 1], there[k])
        known = _angle(here[k - 1], here[k])
        if abs(angle - known) > MAX_AXIS_DIFFERENCE_RAD:
            problems.append(
                f"the axes of joints '{prefix}{names[k - 1]}' and '{prefix}{names[k]}' stand at "
                f"{math.degrees(angle):.0f}°, in the robot at {math.degrees(known):.0f}°"
            )
    return problems


def _axes(model: mujoco.MjModel, joints: list[str], qpos: Array) -> Array:
    """Return the axes of joints in the world, (n, 3), at positions (n,) rad."""
    data = mujoco.MjData(model)
    ids = [model.joint(name).id for name in joints]
    data.qpos[model.jnt_qposadr[ids]] = qpos
    mujoco.mj_kinematics(model, data)
    return np.array(data.xaxis[ids])


def _angle(one: Array, other: Array) -> float:
    """Return the angle between two unit vectors, rad."""
    return math.acos(float(np.clip(one @ other, -1.0, 1.0)))


# ---- writing


def _actuators_of(spec: mujoco.MjSpec, joint: str) -> list[mujoco.MjsActuator]:
    on_joint = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    return [a for a in spec.actuators if a.trntype in on_joint and a.target == joint]


def _servo_of(spec: mujoco.MjSpec, joint: str) -> mujoco.MjsActuator:
    """Return the actuator of a joint, which has at most one; it is added if there is none."""
    actuators = _actuators_of(spec, joint)
    if actuators:
        return actuators[0]
    return spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)


def _write_joint(spec: mujoco.MjSpec, joint: mujoco.MjsJoint, robot: RobotSpec, i: int) -> None:
    """Write armature, damping, friction and zero of joint i; NaN leaves what the scene has."""
    servo = robot.servo
    if np.isfinite(servo.armature[i]):
        joint.armature = servo.armature[i]
    if np.isfinite(servo.frictionloss[i]):
        joint.frictionloss = servo.frictionloss[i]
    if np.isfinite(servo.damping[i]):
        higher_orders = np.zeros(np.size(joint.damping) - 1)
        joint.damping = np.concatenate([[servo.damping[i]], higher_orders])
    # A joint that was attached from another file keeps the unit of that file.
    in_degrees = getattr(joint, "compiler", spec.compiler).degree
    joint.ref -= math.degrees(servo.zero[i]) if in_degrees else servo.zero[i]
    joint.solref_friction = STIFF_SOLREF
    joint.solimp_friction = STIFF_SOLIMP


def _write_servo(
    spec: mujoco.MjSpec, actuator: mujoco.MjsActuator, robot: RobotSpec, i: int
) -> None:
    """Write gains, limits, offset, delay and speed of targets of joint i."""
    servo = robot.servo
    kp = servo.kp[i]
    limit = servo.effort_limit[i]
    if servo.target_speed[i] > 0:
        speed = servo.target_speed[i]
        actuator.set_to_pid(kp=kp, kv=servo.kd[i], slewmax=speed, ctrlspec=POSITION_INPUT)
    else:
        actuator.set_to_position(kp=kp, kv=servo.kd[i])
    actuator.biasprm[0] = kp * servo.offset[i]
    actuator.forcelimited = True
    actuator.forcerange = (-limit, limit)
    low, high = robot.qpos_range[i]
    if np.isfinite([low, high]).all():
        actuator.ctrllimited = True
        actuator.ctrlrange = (low, high)
    if hasattr(actuator, "armature"):  # from MuJoCo 4 on; the identified ones are the joint's
        actuator.armature = 0.0
        actuator.damping = np.zeros(np.size(actuator.damping))
    actuator.delay = servo.delay[i]
    actuator.nsample = 0
    if servo.delay[i] > 0:
        steps = math.ceil(servo.delay[i] / spec.option.timestep - 1e-9)
        actuator.nsample = steps + DELAY_SAMPLES
        actuator.interp = 1


def _notes(robot: RobotSpec, spec: mujoco.MjSpec, own: mujoco.MjModel) -> tuple[str, ...]:
    """Return what of the simulator of the robot the scene does not have."""
    notes = []
    if spec.option.integrator != own.opt.integrator:
        integrator = mujoco.mjtIntegrator(own.opt.integrator).name.split("_")[1].lower()
        notes.append(f"the robot was identified with the integrator {integrator}")
    if spec.option.timestep > own.opt.timestep * (1 + 1e-6):
        step = 1e3 * own.opt.timestep
        notes.append(f"the robot was identified with a physics step of {step:g} ms, not longer")
    if robot.scene.table is not None:
        height = robot.scene.table.height
        notes.append(f"the identified table (height {height:.3f} m) was not added to the scene")
    stopped = np.isfinite(robot.servo.stop_low) | np.isfinite(robot.servo.stop_high)
    if stopped.any():
        names = ", ".join(np.array(robot.joint_names)[stopped])
        notes.append(f"identified stops of {names} limit targets, not the ranges of joints")
    if robot.servo.friction_per_kelvin.any():
        notes.append(temperature_note(robot))
    if robot.servo.target_speed.any():
        notes.append(
            "the speed of targets is limited in each physics step, in gaponet in each control "
            "period: targets differ by up to the way of one period"
        )
    return tuple(notes)
