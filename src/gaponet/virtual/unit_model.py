"""MuJoCo models of virtual units: the effects that MuJoCo simulates itself."""

from __future__ import annotations

import mujoco
import numpy as np

from gaponet.robot.spec import RobotSpec
from gaponet.sim.model import build_model, forget_same_frames, stiffen_friction
from gaponet.virtual.physics import Physics
from gaponet.virtual.time_steps import TimeSteps


def unit_models(
    robot: RobotSpec,
    units: list[Physics],
    payloads: list[tuple[float, str]],
    steps: TimeSteps,
    locked: tuple[str, ...],
) -> list[mujoco.MjModel]:
    """Return one model per row, the same object for rows with the same unit and payload.

    Args:
        units: Hidden parameters of each row.
        payloads: Mass, kg per hand, and side of each row.
        locked: Joints clamped at home.
    """
    made: dict[tuple[int, float, str], mujoco.MjModel] = {}
    rows = []
    for unit, (mass, side) in zip(units, payloads, strict=True):
        key = (id(unit), mass, side)
        if key not in made:
            model = build_model(robot, mass, side, steps.control, locked, physics_only=True)
            model.opt.timestep = steps.physics
            _add_effects(model, robot, unit, locked)
            made[key] = model
        rows.append(made[key])
    return rows


def _add_effects(
    model: mujoco.MjModel, robot: RobotSpec, unit: Physics, locked: tuple[str, ...]
) -> None:
    """Set damping, cable springs, link masses, payload places and the direction of gravity."""
    for i, name in enumerate(robot.joint_names):
        if name in locked:
            continue
        joint = model.joint(name)
        dof = int(joint.dofadr[0])
        body = int(joint.bodyid[0])
        model.dof_damping[dof] += unit.damping[i]
        model.jnt_stiffness[joint.id] += unit.cable_stiffness[i]
        model.qpos_spring[joint.qposadr[0]] += unit.cable_angle[i]
        model.body_mass[body] *= unit.mass_scale[i]
        model.body_inertia[body] *= unit.mass_scale[i]
        model.body_ipos[body] += (unit.com_x[i], unit.com_y[i], unit.com_z[i])
        forget_same_frames(model, body)
    for mount in robot.payload_mounts:
        model.body(f"payload_{mount.side}").pos += (unit.grip_x[0], 0.0, unit.grip_z[0])
    roll = float(unit.tilt_roll[0])
    pitch = float(unit.tilt_pitch[0])
    if roll or pitch:
        model.opt.gravity = _tilted_gravity(model, roll, pitch)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    stiffen_friction(model)


def _tilted_gravity(model: mujoco.MjModel, roll: float, pitch: float) -> np.ndarray:
    """Return gravity as a base sees it that is tilted by roll and pitch, rad; (3,) m/s²."""
    about_x = np.array(
        [
            [1.0, 0.0, 0.0],
            [0.0, np.cos(roll), np.sin(roll)],
            [0.0, -np.sin(roll), np.cos(roll)],
        ]
    )
    about_y = np.array(
        [
            [np.cos(pitch), 0.0, -np.sin(pitch)],
            [0.0, 1.0, 0.0],
            [np.sin(pitch), 0.0, np.cos(pitch)],
        ]
    )
    result: np.ndarray = about_x @ about_y @ model.opt.gravity
    return result
