"""RobotSpec → MjModel. The only place that touches MJCF."""

from __future__ import annotations

import copy
import hashlib
import math
from collections.abc import Sequence as ListOf
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import GAPONetError, RobotError, UsageError
from gaponet.robot.drives import ON_JOINT
from gaponet.robot.fingerprint import model_fingerprint
from gaponet.robot.folder import (
    STORED_ROBOT,
    has_robot_folder,
    has_stored_robot,
    load_stored_robot,
)
from gaponet.robot.freeze import delete_references, freeze, units_per_si
from gaponet.robot.mjcf import compile_spec, read_mjcf
from gaponet.robot.servo_fields import SERVO_TERMS, TERMS
from gaponet.robot.spec import Link, PayloadMount, RobotSpec

if TYPE_CHECKING:
    from mujoco.batch import Batch


# Joint friction loss is a soft constraint in MuJoCo: a joint that should stick creeps by (1 −
# d)·w·f/b rad/s, f the torque it holds, b ≤ 500 1/s of solref, d ≤ 0.9999 of solimp and w the
# joint's mobility, dof_invweight0. A tenth of w is the stiffest that the solver still meets at this
# tolerance.
STIFF_SOLREF = (0.004, 1.0)
STIFF_SOLIMP = (0.9999, 0.9999, 0.001, 0.5, 2.0)
STIFF_MOBILITY = 0.1
MAX_MASS_ERROR_KG = 1.1e-3  # a boundmass of a gram, which is usual, harms nothing
WORLD = -1  # of dof_treeid and body_treeid: no limb
LOOSE_IMPEDANCE = 0.999
TOLERANCE = 1e-10

PAYLOAD_DENSITY = 7850.0  # standard payload: a solid steel ball, kg/m³
MIN_PAYLOAD_RADIUS_M = 1e-3  # of the ball of an empty hand, because MuJoCo refuses a size of 0


def build_model(
    robot: RobotSpec,
    payload_mass: float = 0.0,
    payload_side: str = "both",
    dt: float | None = None,
    locked: tuple[str, ...] = (),
    physics_only: bool = False,
    shortest_step: float = math.inf,
) -> mujoco.MjModel:
    """Return the nominal simulator of a robot with a payload.

    Position actuators with the gains and torque limits of `robot.toml` replace whatever actuators
    the MJCF has. Degrees of freedom and actuators are in the order of `robot.joint_names`, without
    locked joints. The physics step is the robot's, stretched a little where it does not divide dt.

    Args:
        payload_mass: Mass in each hand named by `payload_side`, kg.
        payload_side: "both" (every mount), or the side of one mount.
        dt: Control period, s; default robot.dt.
        locked: Joints clamped at home, without a degree of freedom (`idle_joints` finds those that
            change nothing).
        physics_only: Leave out geoms that touch nothing and bodies that are locked to the world:
            faster, same motion.
        shortest_step: Of the models with which this one shares a batch, the shortest physics step,
            s. Buffers of late servos are as long as that model needs.

    Raises:
        RobotError: The MJCF does not compile, or lacks a joint or body that robot.toml names.
        UsageError: Negative payload, unknown side, or a dt that is not positive, or above 1 s.
    """
    spec = build_spec(robot, payload_mass, payload_side, dt, locked, physics_only, shortest_step)
    model = compile_spec(spec, robot.mjcf)
    _require_payload(model, robot, payload_mass, payload_side)
    if model.nq != model.nv or model.nq != len(robot.joint_names) - len(locked):
        names = {j.name for j in spec.joints}
        raise RobotError(
            f"{robot.mjcf}: has {model.nq} degrees of freedom ({', '.join(sorted(names))}), but "
            f"robot.toml names {len(robot.joint_names)} hinge joints. Name each actuated joint "
            "once; weld or delete the others"
        )
    free = [name for name in robot.joint_names if name not in locked]
    address, _ = joint_addresses(model, free)
    if address.tolist() != list(range(model.nq)):
        order = ", ".join(model.joint(i).name for i in range(model.njnt))
        raise RobotError(
            f"{robot.mjcf}: robot.toml must list the joints in the MJCF's order: {order}"
        )
    stiffen_friction(model)
    soften_table(model, robot)
    return model


def joint_addresses(model: mujoco.MjModel, names: ListOf[str]) -> tuple[Array, Array]:
    """Return the places of hinge joints in qpos and in qvel, (n,) each."""
    joints = np.array([model.joint(name).id for name in names], int)  # names may be empty
    return model.jnt_qposadr[joints], model.jnt_dofadr[joints]


def driven_joints(model: mujoco.MjModel) -> Array:
    """Return the number of the joint that each actuator drives, (nu,); -1: it drives a tendon, a
    site or a body.
    """
    on_joint = np.isin(model.actuator_trntype, ON_JOINT)
    return np.where(on_joint, model.actuator_trnid[:, 0], -1)


def numbers_of_pairs(model: mujoco.MjModel) -> dict[frozenset[str], int]:
    """Return the number of each contact pair by the names of its two geoms.

    MuJoCo sorts pairs by their bodies, so a pair's number is not its place in the file.
    """
    numbers = {}
    for k in range(model.npair):
        first = model.geom(model.pair_geom1[k]).name
        second = model.geom(model.pair_geom2[k]).name
        numbers[frozenset((first, second))] = k
    return numbers


def stiffen_friction(model: mujoco.MjModel) -> None:
    """Make friction hold; once after each compilation or mj_setConst, which undo it."""
    model.dof_invweight0 *= STIFF_MOBILITY


def _require_joints(spec: mujoco.MjSpec, robot: RobotSpec) -> None:
    """Refuse a robot with joints that its MJCF lacks, or with an operated one that is no hinge."""
    names = sorted(joint.name for joint in spec.joints)
    for name in robot.joint_names:
        if name not in names:
            raise RobotError(
                f"{robot.mjcf}: robot.toml names joint '{name}', the MJCF has: {', '.join(names)}"
            )
    for name in robot.operated:
        kind = spec.joint(name).type
        if kind != mujoco.mjtJoint.mjJNT_HINGE:
            kind_name = kind.name.removeprefix("mjJNT_").lower()
            raise RobotError(
                f"{robot.mjcf}: joint '{name}' is a {kind_name} joint, and gaponet identifies "
                "hinges only (rad, N·m): write operated = false for it in robot.toml"
            )


def build_spec(
    robot: RobotSpec,
    payload_mass: float = 0.0,
    payload_side: str = "both",
    dt: float | None = None,
    locked: tuple[str, ...] = (),
    physics_only: bool = False,
    shortest_step: float = math.inf,
) -> mujoco.MjSpec:
    """Return `build_model` before compilation, for a scene of several robots
    (report/view/scene.py).
    """
    spec = read_mjcf(robot.mjcf)
    _require_joints(spec, robot)
    # few joints, no contacts: islands cost more
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
    period = robot.dt if dt is None else dt
    if not 0 < period <= 1:
        raise UsageError(
            f"dt is {dt}; the control period in seconds must be positive and at most 1"
        )
    spec.option.timestep = period / robot.steps_per(period)
    spec.option.tolerance = TOLERANCE
    if robot.payload_mounts:
        spec.compiler.fusestatic = False  # it would fuse the payload with the hand
    for joint in spec.joints:
        joint.solref_friction = STIFF_SOLREF
        joint.solimp_friction = STIFF_SOLIMP
    if not robot.scene.contacts:
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    _set_joints(spec, robot)
    _set_links(spec, robot)
    _add_table(spec, robot)
    delete_references(spec, set(locked))
    for name in locked:
        freeze(spec, spec.joint(name), robot.qpos_home[robot.joint_names.index(name)])
    _add_actuators(spec, robot, locked, min(shortest_step, spec.option.timestep))
    if physics_only:
        spec.compiler.discardvisual = True
        _remove_fixed(spec, spec.worldbody, {mount.body for mount in robot.payload_mounts})
    _add_payload(spec, robot, payload_mass, payload_side)
    return spec


def idle_joints(robot: RobotSpec, moved: tuple[str, ...]) -> tuple[str, ...]:
    """Return the joints of limbs without a moving joint: on a fixed base they share no dynamics
    with the rest, unless an equality or a tendon couples them to a limb that moves.

    `moved` names the joints that a command moves, or holds away from home.
    """
    model = build_model(robot)
    limb = dict(zip(robot.joint_names, model.dof_treeid.tolist(), strict=True))
    busy = {limb[name] for name in moved}
    couplings = _couplings(model)
    for _ in couplings:  # a coupling may reach a limb by way of others
        for limbs in couplings:
            if limbs & busy:
                busy |= limbs
    return tuple(name for name in robot.joint_names if limb[name] not in busy)


def _couplings(model: mujoco.MjModel) -> list[set[int]]:
    """Return the limbs that each equality and each tendon holds together, as numbers of
    dof_treeid.
    """
    of_joint = model.dof_treeid[model.jnt_dofadr]
    of_body = model.body_treeid
    of_kind = {
        int(mujoco.mjtWrap.mjWRAP_JOINT): of_joint,
        int(mujoco.mjtWrap.mjWRAP_SITE): of_body[model.site_bodyid],
        int(mujoco.mjtWrap.mjWRAP_SPHERE): of_body[model.geom_bodyid],
        int(mujoco.mjtWrap.mjWRAP_CYLINDER): of_body[model.geom_bodyid],
    }
    tendons = []
    for first, count in zip(model.tendon_adr, model.tendon_num, strict=True):
        limbs = set()
        for wrap in range(first, first + count):
            of_object = of_kind.get(int(model.wrap_type[wrap]))
            if of_object is not None:
                limbs.add(int(of_object[model.wrap_objid[wrap]]))
        tendons.append(limbs)
    couplings = list(tendons)
    for equality in range(model.neq):
        limbs = set()
        for number in (model.eq_obj1id[equality], model.eq_obj2id[equality]):
            limbs |= _limbs_of(model, equality, int(number), tendons)
        couplings.append(limbs)
    return [limbs - {WORLD} for limbs in couplings]


def _limbs_of(
    model: mujoco.MjModel, equality: int, number: int, tendons: list[set[int]]
) -> set[int]:
    """Return the limbs of one of the two objects of an equality; none if it has one object."""
    if number < 0:
        return set()
    if model.eq_type[equality] == mujoco.mjtEq.mjEQ_TENDON:
        return tendons[number]
    if model.eq_type[equality] == mujoco.mjtEq.mjEQ_JOINT:
        return {int(model.dof_treeid[model.jnt_dofadr[number]])}
    body = number
    if model.eq_objtype[equality] == mujoco.mjtObj.mjOBJ_SITE:
        body = int(model.site_bodyid[number])
    return {int(model.body_treeid[body])}


def qpos_range(model: mujoco.MjModel) -> Array:
    """Joint limits, (n, 2), rad; ±inf where a joint is unlimited."""
    limited = model.jnt_limited.astype(bool)[:, None]
    return np.where(limited, model.jnt_range, [-np.inf, np.inf])


def model_hash(robot: RobotSpec) -> str:
    """Return 12 hex digits of the nominal simulator: every value of its compiled model that
    determines its motion.

    Two robots with the same hash move the same, wherever their folders lie and however their MJCF
    is written.
    """
    if "_model_hash" not in vars(robot):
        text = [
            f"step {robot.timestep:.7g} density {PAYLOAD_DENSITY:g} mobility {STIFF_MOBILITY:g}"
        ]
        if not robot.scene.carries_payload:
            text.append("carries no payload")
        if robot.servo.target_speed.any():
            text.append(f"target speed {robot.servo.target_speed}")
        if robot.servo.friction_per_kelvin.any():
            warm = [robot.servo[name].tolist() for name in TERMS["temperature"]]
            text.append(f"friction per kelvin {warm}")
        text += model_fingerprint(build_model(robot))
        digest = hashlib.sha256("\n".join(text).encode()).hexdigest()[:12]
        object.__setattr__(robot, "_model_hash", digest)
    return str(vars(robot)["_model_hash"])


def require_stored_robot(
    holder: Path, robot: RobotSpec, error: type[GAPONetError], hint: str
) -> RobotSpec:
    """Return the robot stored in a run or dataset; refuse `robot` if the nominal simulators
    differ, whatever the names.

    Args:
        holder: Run or dataset; `robot` itself is returned for one of a version that stored none.
        error: Raised if the robots differ.
        hint: What to do about it.
    """
    if not has_stored_robot(holder):
        return robot
    use = hint
    if has_robot_folder(holder):
        use = f"--robot {holder / STORED_ROBOT} where that is the right one, or {hint}"
    return require_same_robot(load_stored_robot(holder, robot.name), robot, holder, error, use)


def require_same_robot(
    own: RobotSpec, robot: RobotSpec, folder: Path, error: type[GAPONetError], use: str
) -> RobotSpec:
    """Return `own`, the robot in a folder, or raise `error` if it differs from `robot` before
    identification.
    """
    ours = model_hash(own.before_identification)
    theirs = model_hash(robot.before_identification)
    if ours != theirs:
        raise error(
            f"{folder}: its nominal simulator is {ours}, that of {robot.folder} is {theirs}: "
            f"another robot, or other gains or inertias. Use {use}"
        )
    return own


def _set_joints(spec: mujoco.MjSpec, robot: RobotSpec) -> None:
    """Set identified values in place of the MJCF's."""
    for i, name in enumerate(robot.joint_names):
        joint = spec.joint(name)
        for field in ("armature", "frictionloss"):
            value = robot.servo[field][i]
            if np.isfinite(value):
                setattr(joint, field, value)
        unit = units_per_si(spec, joint)
        joint.ref -= unit * robot.servo.zero[i]
        stops = unit * robot.servo.stop_low[i], unit * robot.servo.stop_high[i]
        if np.isfinite(stops).any():
            low, high = joint.range if joint.range[0] < joint.range[1] else (-np.inf, np.inf)
            # a stop only narrows the range
            joint.range = [
                np.fmax(low, stops[0]),
                np.fmin(high, stops[1]),
            ]
            joint.limited = True
        if np.isfinite(robot.servo.damping[i]):
            joint.damping = np.concatenate(
                [[robot.servo.damping[i]], np.zeros(np.size(joint.damping) - 1)]
            )


def _set_links(spec: mujoco.MjSpec, robot: RobotSpec) -> None:
    """Set identified masses, centres of mass and inertias in place of the MJCF's."""
    if (
        robot.links
        and spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    ):
        spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
        for body in spec.bodies:
            body.explicitinertial = False
    for name, link in robot.links.items():
        body = spec.body(name)
        if body is None:
            raise RobotError(
                f"{robot.mjcf}: an [identified_link] names body '{name}', which is missing"
            )
        write_link(body, link)


def write_link(body: mujoco.MjsBody, link: Link) -> None:
    """Write the mass, centre of mass and inertia of an identified link."""
    body.explicitinertial = True
    body.mass = link.mass
    body.ipos = link.pos
    body.iquat = (1, 0, 0, 0)
    body.inertia = (0, 0, 0)
    body.fullinertia = link.inertia


# Fields of a model that follow from its links; the *_sameframe are MuJoCo's shortcuts for frames
# that coincide.
LINK_FIELDS = (
    "body_mass",
    "body_ipos",
    "body_inertia",
    "body_iquat",
    "body_sameframe",
    "geom_sameframe",
    "site_sameframe",
    "body_subtreemass",
    "body_invweight0",
    "dof_invweight0",
    "dof_M0",
    "tendon_invweight0",
    "pair_solref",
)


def principal_axes(link: Link) -> tuple[Array, Array]:
    """Return a link's principal moments of inertia, the largest first as compiled, and their axes
    as a quaternion.
    """
    inertia = np.array(link.inertia)[[0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(3, 3)
    quat = np.zeros(4)
    axes = np.linalg.eigh(inertia)[1][:, ::-1].copy()
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    mujoco.mju_mat2Quat(quat, axes.ravel())
    return np.diag(axes.T @ inertia @ axes), quat


def with_links(model: mujoco.MjModel, robot: RobotSpec) -> mujoco.MjModel:
    """Return a copy of a compiled model with the links of a robot, as if it were compiled with
    them.
    """
    model = copy.copy(model)
    for name, link in robot.links.items():
        if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name) < 0:
            continue  # of a locked limb
        body = model.body(name)
        body.mass[:] = link.mass
        body.ipos[:] = link.pos
        body.inertia[:], body.iquat[:] = principal_axes(link)
        forget_same_frames(model, body.id)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    stiffen_friction(model)
    soften_table(model, robot)
    return model


def forget_same_frames(model: mujoco.MjModel, body: int) -> None:
    """Let the geoms and sites of a body stay where they are when its centre of mass moves.

    MuJoCo puts a geom that coincided with the frame of the inertia into that frame. Before MuJoCo 4
    mj_setConst does not notice that they no longer coincide.
    """
    none = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    model.body_sameframe[body] = none
    model.geom_sameframe[model.geom_bodyid == body] = none
    model.site_sameframe[model.site_bodyid == body] = none


def _remove_fixed(spec: mujoco.MjSpec, body: mujoco.MjsBody, keep: set[str]) -> None:
    """Delete bodies that are fixed to a standing body and carry neither a joint nor a payload."""
    for child in list(body.bodies):
        limb = [child, *child.find_all("body")]
        if not any(len(part.joints) or part.name in keep for part in limb):
            spec.delete(child)
        elif not len(child.joints):
            _remove_fixed(spec, child, keep)


def _add_actuators(
    spec: mujoco.MjSpec, robot: RobotSpec, locked: tuple[str, ...], shortest_step: float
) -> None:
    servo = robot.servo
    if servo.has_terms:
        spec.nuser_actuator = len(SERVO_TERMS)
    # One buffer length at all control periods, so that models of one robot share a layout; none
    # where nothing is late.
    shortest = min(0.75 * robot.timestep, shortest_step)
    samples = math.ceil(servo.delay.max() / shortest - 1e-9) + 1 if servo.delay.any() else 0
    for i, name in enumerate(robot.joint_names):
        if name in locked:
            continue
        kp = servo.kp[i]
        limit = servo.effort_limit[i]
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=kp, kv=servo.kd[i])
        actuator.biasprm[0] = kp * servo.offset[i]
        actuator.forcelimited = True
        actuator.forcerange = (-limit, limit)
        if servo.has_terms:
            actuator.userdata = [servo[term][i] for term in SERVO_TERMS]
        if samples:
            actuator.nsample = samples
            actuator.interp = 1
            actuator.delay = servo.delay[i]


def _add_payload(spec: mujoco.MjSpec, robot: RobotSpec, mass: float, side: str) -> None:
    if mass < 0 or not math.isfinite(mass):
        raise UsageError(f"payload_mass is {mass}; give the mass in kg, 0 for an empty hand")
    sides = [m.side for m in robot.payload_mounts]
    if side != "both" and side not in sides:
        raise UsageError(
            f"payload side '{side}' is unknown to {robot.name}; use both or one of "
            f"{', '.join(sides)}"
        )
    if mass and not sides:
        raise RobotError(
            f"{robot.name} has no [[payload_mount]]; add one to robot.toml to attach {mass} kg"
        )
    for mount in robot.payload_mounts:
        # An empty hand carries a massless ball: all payloads share one MjData layout, so one Batch
        # steps them together.
        weight = carried(robot, mount, mass, side)
        parent = spec.body(mount.body)
        if parent is None:
            raise RobotError(
                f"{robot.mjcf}: payload mount '{mount.side}' names body '{mount.body}', which is "
                "missing"
            )
        add_payload_body(parent, f"payload_{mount.side}", mount, weight)


def add_payload_body(parent: mujoco.MjsBody, name: str, mount: PayloadMount, mass: float) -> None:
    """Add a body with a ball of a mass, kg, at a mount; nothing touches it."""
    radius = max((3 * mass / (4 * math.pi * PAYLOAD_DENSITY)) ** (1 / 3), MIN_PAYLOAD_RADIUS_M)
    body = parent.add_body(name=name, pos=mount.pos)
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=(radius, 0, 0),
        mass=mass,
        contype=0,
        conaffinity=0,
        rgba=(0.8, 0.25, 0.2, 1),
    )


def carried(robot: RobotSpec, mount: PayloadMount, mass: float, side: str = "both") -> float:
    """Return the mass at a mount with a payload, kg."""
    if robot.scene.carries_payload and side in ("both", mount.side):
        return mount.mass + mass
    return mount.mass


def _require_payload(model: mujoco.MjModel, robot: RobotSpec, mass: float, side: str) -> None:
    """Refuse a model whose compiler settings change the mass of payloads."""
    for mount in robot.payload_mounts:
        weighs = float(model.body(f"payload_{mount.side}").mass[0])
        require_payload_mass(robot.mjcf, mount, carried(robot, mount, mass, side), weighs)


def require_payload_mass(file: Path, mount: PayloadMount, wanted: float, weighs: float) -> None:
    """Refuse a payload that weighs something else than wanted, kg, in the model of a file."""
    if abs(weighs - wanted) > MAX_MASS_ERROR_KG:
        raise RobotError(
            f"{file}: a payload of {wanted:g} kg at '{mount.side}' weighs {weighs:g} kg in the "
            "model; delete settotalmass, boundmass and inertiagrouprange of its <compiler>"
        )


TABLE = "gaponet_table"
# of the contact: with a constant one its stiffness in N/m does not depend on the posture
IMPEDANCE = 0.5
SIZE = 2.0  # m, for looking at


def _add_table(spec: mujoco.MjSpec, robot: RobotSpec) -> None:
    """Add a plane, a sphere per tip, and contacts between them alone, if the robot has a table."""
    if robot.scene.table is None:
        return
    spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC  # a pyramid's stiffness depends on friction
    for geom in spec.geoms:
        geom.contype = 0
        geom.conaffinity = 0
    for pair in list(spec.pairs):
        spec.delete(pair)
    # With a contact type, because physics_only leaves out geoms without one; only the pairs below
    # touch.
    spec.worldbody.add_geom(
        name=TABLE,
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=(SIZE, SIZE, 0.1),
        pos=(0, 0, robot.scene.table.height),
        contype=2,
        conaffinity=0,
        rgba=(0.55, 0.5, 0.45, 1),
    )
    for i, tip in enumerate(robot.scene.tips):
        body = spec.body(tip.body)
        if body is None:
            raise RobotError(f"{robot.mjcf}: a [[tip]] names body '{tip.body}', which is missing")
        name = f"{TABLE}_tip_{i}"
        body.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=(tip.radius, 0, 0),
            pos=tip.pos,
            mass=0.0,
            contype=0,
            conaffinity=4,
            rgba=(0.3, 0.3, 0.3, 1),
        )
        slide = robot.scene.table.friction
        spec.add_pair(
            geomname1=name,
            geomname2=TABLE,
            condim=3,
            friction=(slide, slide, 0.005, 1e-4, 1e-4),
            solimp=(IMPEDANCE, IMPEDANCE, 0.001, 0.5, 2.0),
        )


def soften_table(model: mujoco.MjModel, robot: RobotSpec) -> None:
    """Give the contacts of a compiled model the table's stiffness, critically damped."""
    if robot.scene.table is not None:
        model.pair_solref[:] = _solref(model, np.array(robot.scene.table.stiffness))


def write_table(
    batch: Batch, model: mujoco.MjModel, height: Array, friction: Array, stiffness: Array
) -> None:
    """Give every simulation of a batch a table of its own, (nsim,) m, 1 and N/m; their model has
    one.
    """
    batch.expand("geom_pos")[:, model.geom(TABLE).id, 2] = height
    batch.expand("pair_friction")[:, :, :2] = friction[:, None, None]
    batch.expand("pair_solref")[:] = _solref(model, stiffness)


def _solref(model: mujoco.MjModel, stiffness: Array) -> Array:
    """The pairs' direct solref for stiffnesses (…) in N/m, (…, npair, 2).

    A contact at rest pushes with d²k/((1 − d)·w) N per metre, w the mobility of the bodies that
    touch.
    """
    bodies = model.geom_bodyid[np.stack([model.pair_geom1, model.pair_geom2])]
    mobility = model.body_invweight0[bodies, 0].sum(axis=0)
    k = stiffness[..., None] * (1 - IMPEDANCE) * mobility / IMPEDANCE**2
    return np.stack([-k * IMPEDANCE**2, -2 * np.sqrt(k) * IMPEDANCE], axis=-1)
