"""Event terms of mjlab and Isaac Lab that give each world one whole unit of randomization.json.

This file is copied into exports; it needs torch, not gaponet. A unit is a row of the file.

    # mjlab
    EventTermCfg(func=mjlab_units(FILE), mode="reset")
    # Isaac Lab
    params = {"asset_cfg": SceneEntityCfg("robot"), "file": FILE}
    EventTermCfg(func=apply_units, mode="reset", params=params)

FILE is the path of randomization.json. Mode "reset" draws a unit for each episode, "startup" one
for each world.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Collection, Iterable
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

MODEL_FIELDS = (
    "dof_armature",
    "dof_frictionloss",
    "dof_damping",
    "actuator_gainprm",
    "actuator_biasprm",
    "actuator_forcerange",
)
BODY_FIELDS = "body_mass", "body_ipos", "body_inertia", "body_iquat", "body_subtreemass"
DELAY_BUFFERS = "positions_delay_buffer", "velocities_delay_buffer", "efforts_delay_buffer"
Units = dict[str, Tensor]  # field → (worlds, joints), SI units


@cache
def read_units(file: str | Path, form: str) -> tuple[list[str], Units]:
    """Return joints and all units, (units, joints).

    A robot without a servo model has one form of them.
    """
    drawn = json.loads(Path(file).read_text(encoding="utf-8"))
    units = drawn.get(form, drawn["units"])
    return drawn["joints"], {field: torch.tensor(values) for field, values in units.items()}


def draw_units(
    file: str | Path, form: str, env: Any, env_ids: Any, rows: Any
) -> tuple[Tensor, list[str], Units]:
    """Draw a unit for each of the worlds `env_ids` (indices, a slice; None for all).

    Args:
        form: "units", with the servo model, or "plain_units", without it.
        rows: Row for each world instead of a random one, (num_envs,).

    Returns:
        Indices of the worlds, joints, and the units' numbers.
    """
    joints, units = read_units(file, form)
    ids = torch.arange(env.num_envs, device=env.device)
    if env_ids is not None:
        ids = ids[env_ids]
    if rows is None:
        row = torch.randint(len(units["kp"]), (len(ids),))
    else:
        row = torch.as_tensor(rows)[ids.cpu()]
    return ids, joints, {field: x[row].to(env.device) for field, x in units.items()}


def require_joints(joints: Iterable[str], names: Collection[str], what: str) -> None:
    """Raise ValueError if a joint is not among names; `what` says whose names they are."""
    for joint in joints:
        if joint not in names:
            raise ValueError(f"randomization.json has joint '{joint}'; {what}: {', '.join(names)}")


def columns_of(joints: Iterable[str], names: Collection[str], what: str) -> list[int]:
    """Return the places of joints among names; errors as of `require_joints`."""
    require_joints(joints, names, what)
    return [list(names).index(joint) for joint in joints]


# ---- mjlab


def mjlab_units(file: str | Path, term: str = "joint_pos", rows: Any = None) -> Any:
    """Return the function of an event term for mjlab. Delays stay as they are.

    With the servos of `mjlab_entity`, units have the servo model. With other position servos they
    have not.

    Args:
        term: Action term of the robot.
        rows: As in `draw_units`.
    """
    from mjlab.managers.event_manager import requires_model_fields

    bodies = json.loads(Path(file).read_text(encoding="utf-8")).get("bodies", [])
    written = (*MODEL_FIELDS, *BODY_FIELDS) if bodies else MODEL_FIELDS

    @requires_model_fields(*written)
    def use_units(env: Any, env_ids: Any) -> None:
        action = env.action_manager.get_term(term)
        robot = env.scene[action.cfg.entity_name]
        identified = [a.servos for a in robot.actuators if hasattr(a, "servos")]
        form = "units" if identified else "plain_units"
        ids, joints, units = draw_units(file, form, env, env_ids, rows)
        if bodies:
            names = [f"{action.cfg.entity_name}/{name}" for name in bodies]
            write_links(env.sim, ids, names, units["links"])
        if identified:
            identified[0].set_units(env.sim.model, ids, joints, units)
            return
        joints = [f"{action.cfg.entity_name}/{name}" for name in joints]
        servos, dofs = _addresses(env.sim.mj_model, joints)
        servo = torch.tensor(servos, device=env.device)
        dof = torch.tensor(dofs, device=env.device)
        write_model(env.sim.model, ids, dof, servo, units)

    return use_units


def _addresses(model: Any, joints: list[str]) -> tuple[list[int], list[int]]:
    """Return the numbers of the joints' position servos, and of their degrees of freedom.

    Raises:
        ValueError: A joint has no position servo, or several.
    """
    driven: dict[str, int] = {}  # joint → number of its position servo
    for servo, number in enumerate(model.actuator_trnid[:, 0]):
        is_on_joint = model.actuator_trntype[servo] in (0, 1)  # joint, jointinparent
        is_affine = model.actuator_biastype[servo] == 1
        # The torque of a velocity servo does not depend on the position.
        if not (is_on_joint and is_affine and model.actuator_biasprm[servo, 1] < 0):
            continue
        joint = model.joint(number).name
        if joint in driven and joint in joints:
            raise ValueError(
                f"joint '{joint}' has several position servos, and a unit has the numbers of one: "
                "delete the others"
            )
        driven[joint] = servo
    require_joints(joints, driven, "joints with position servos")
    servos = [driven[name] for name in joints]
    dofs = [model.joint(name).dofadr[0] for name in joints]
    return servos, dofs


def write_model(model: Any, env_ids: Tensor, dof: Tensor, servo: Tensor, units: Units) -> None:
    """Write units to a model of mjlab, at the addresses of the joints."""
    at = env_ids[:, None]
    kp = units["kp"]
    limit = units["effort_limit"]
    model.dof_armature[at, dof] = units["armature"]
    model.dof_frictionloss[at, dof] = units["frictionloss"]
    if model.dof_damping.ndim == 3:  # of newer MuJoCo a polynomial of the speed
        model.dof_damping[at, dof, 0] = units["damping"]
    else:
        model.dof_damping[at, dof] = units["damping"]
    model.actuator_gainprm[at, servo, 0] = kp
    model.actuator_biasprm[at, servo, 0] = kp * units["offset"]
    model.actuator_biasprm[at, servo, 1] = -kp
    model.actuator_forcerange[at, servo] = torch.stack([-limit, limit], dim=-1)


def write_links(sim: Any, env_ids: Tensor, bodies: list[str], links: Tensor) -> None:
    """Write links to a model of mjlab, (worlds, bodies, 11): mass, centre of mass, principal
    inertias and their orientation.
    """
    model = sim.model
    parents = sim.mj_model.body_parentid.tolist()
    numbers = [sim.mj_model.body(name).id for name in bodies]
    at = (env_ids[:, None], torch.tensor(numbers, device=links.device))
    model.body_mass[at] = links[..., 0]
    model.body_ipos[at] = links[..., 1:4]
    model.body_inertia[at] = links[..., 4:7]
    model.body_iquat[at] = links[..., 7:]
    total = model.body_mass[env_ids].clone()
    for body in range(len(parents) - 1, 0, -1):
        total[:, parents[body]] += total[:, body]
    model.body_subtreemass[env_ids] = total


# ---- Isaac Lab


def apply_units(
    env: Any,
    env_ids: Any,
    asset_cfg: Any,
    file: str,
    term: str | None = "joint_pos",
    rows: Any = None,
) -> None:
    """Give worlds units: the function of an event term for Isaac Lab 2.3 and 3.

    Units are those without the servo model, of which only torque-speed lines are left. kd stays.

    Args:
        asset_cfg: SceneEntityCfg of the robot. All joints of the file are set.
        term: Action term of `isaaclab_action`, which applies delays and offsets. None:
            DelayedPDActuators apply delays in whole physics steps, in mode "reset" only, and
            offsets are not applied.
        rows: As in `draw_units`.

    Raises:
        ValueError: The scene cannot have a number of a unit; the message says which.
    """
    robot = env.scene[asset_cfg.name]
    ids, joints, units = draw_units(file, "plain_units", env, env_ids, rows)
    columns = columns_of(joints, robot.joint_names, "joints of the articulation")
    groups = _actuator_groups(robot)
    require_joints(
        joints, groups, "joints with PD actuators (set cfg.sim.use_newton_actuators = False)"
    )
    if "no_load_speed" in units:
        _speed_lines(robot, joints, groups, units, ids)
    if term is None:
        _delay(joints, groups, units["delay"] / env.physics_dt, ids)
    else:
        action = env.action_manager.get_term(term)
        if not hasattr(action, "set_units"):
            raise ValueError(
                f"action term '{term}' has no delays and offsets; use isaaclab_action, or term=None"
            )
        action.set_units(ids, joints, units)
    _write(robot, "armature", columns, ids, units["armature"])
    _write_friction(robot, columns, ids, units)
    # The simulation itself has gains and limits of implicit actuators only.
    implicit = [i for i, joint in enumerate(joints) if _is_implicit(groups[joint])]
    implicit_columns = [columns[i] for i in implicit]
    for what, field in (("stiffness", "kp"), ("effort_limit", "effort_limit")):
        for i, joint in enumerate(joints):
            _set_actuator(groups[joint], what, joint, ids, units[field][:, i])
        if implicit:
            _write(robot, what, implicit_columns, ids, units[field][:, implicit])


def _actuator_groups(robot: Any) -> dict[str, Any]:
    """Return joint → its group of actuators without a network."""
    groups = {}
    for group in robot.actuators.values():
        if hasattr(group, "network"):
            continue
        for joint in getattr(group, "joint_names", ()):
            groups[joint] = group
    return groups


def _is_implicit(group: Any) -> bool:
    """Return True for actuators that the simulation computes, not Isaac Lab."""
    return bool(getattr(group, "is_implicit_model", False))


def _set_actuator(group: Any, what: str, joint: str, ids: Tensor, values: Tensor) -> None:
    """Set "stiffness" or "effort_limit" of a joint in the worlds `ids`, (worlds)."""
    own = getattr(group, f"actuator_{what}", None)  # Isaac Lab 3 renamed the limit
    if own is None:
        own = getattr(group, what)
    column = list(group.joint_names).index(joint)
    getattr(own, "torch", own)[ids, column] = values


def _write_friction(robot: Any, columns: list[int], ids: Tensor, units: Units) -> None:
    """Write static, dynamic and viscous friction, which is the damping of joints."""
    friction = units["frictionloss"]
    dynamic: Tensor | None = None
    if any(name.startswith("write_joint_dynamic_friction") for name in dir(robot)):
        dynamic = friction  # of PhysX, where it is at most the static one
    _write(robot, "friction_coefficient", columns, ids, friction, dynamic, units["damping"])


def _write(robot: Any, what: str, columns: list[int], ids: Tensor, *values: Tensor | None) -> None:
    """Call the writer of Isaac Lab 3 or 2 for `what`, such as "armature".

    Args:
        columns: Numbers of the joints in the articulation.
        ids: Worlds.
        values: For the writer's first parameters, (worlds, joints) each; None for their default.
    """
    name = f"write_joint_{what}_to_sim"
    write = getattr(robot, f"{name}_index", getattr(robot, name, None))  # of 3, else of 2
    parameters: list[str] = []
    if write is not None:
        parameters = list(inspect.signature(write).parameters)
    for_values = [parameter for parameter in parameters if not parameter.endswith("_ids")]
    if write is None or len(for_values) < len(values):
        raise ValueError(f"{name} is missing or lacks parameters: take Isaac Lab 2.3 or 3")
    write(**dict(zip(for_values, values, strict=False)), joint_ids=columns, env_ids=ids)


def _speed_lines(
    robot: Any, joints: list[str], groups: dict[str, Any], units: Units, ids: Tensor
) -> None:
    """Set the torque-speed lines of DCMotors: torque at rest, and the speed without torque.

    A speed of 0 is no line.

    Isaac Lab 3 computes the groups of a class as one, by an actuator of its own.
    """
    together = [batch.actuator for batch in getattr(robot.actuators, "_execution_batches", ())]
    for i, joint in enumerate(joints):
        limit = units["effort_limit"][:, i]
        speed = units["no_load_speed"][:, i]
        actuators = [one for one in (groups[joint], *together) if joint in one.joint_names]
        motors = [one for one in actuators if hasattr(one, "_saturation_effort")]
        if not motors and (speed > 0).any():
            raise ValueError(
                f"joint '{joint}' needs a torque-speed line: take isaaclab_actuators, or a "
                "DCMotorCfg"
            )
        for motor in motors:
            column = list(motor.joint_names).index(joint)
            top = getattr(motor, "actuator_velocity_limit", None)
            top = motor.velocity_limit if top is None else top
            top = getattr(top, "torch", top)
            motor._saturation_effort = (
                torch.as_tensor(motor._saturation_effort, device=top.device).expand_as(top).clone()
            )
            motor._saturation_effort[ids, column] = limit
            top[ids, column] = torch.where(speed > 0, speed, torch.inf)
            motor._vel_at_effort_lim[ids, column] = 2 * top[ids, column]


def _delay(joints: list[str], groups: dict[str, Any], steps: Tensor, ids: Tensor) -> None:
    """Set the delays of DelayedPDActuators, physics steps (worlds, joints).

    A group has one delay for all joints.
    """
    lags = dict[int, Tensor]()
    for joint, lag in zip(joints, steps.round().int().T, strict=True):
        group = groups[joint]
        if (lags.setdefault(id(group), lag) != lag).any():
            raise ValueError(
                f"joint '{joint}' needs a delay of its own: make an actuator group for each joint"
            )
        buffers = [getattr(group, name) for name in DELAY_BUFFERS if hasattr(group, name)]
        if lag.any() and not buffers:
            raise ValueError(
                f"joint '{joint}' needs a delay: take DelayedPDActuatorCfg, or isaaclab_action"
            )
        for buffer in buffers:
            buffer.set_time_lag(lag, ids)
