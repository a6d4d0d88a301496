"""A compiled simulator with another simulator's gains, damping, friction, inertias, delay and
mounting.
"""

from __future__ import annotations

import copy

import mujoco
import numpy as np

from gaponet.base.errors import UsageError
from gaponet.robot.simulator_change import SimulatorChange
from gaponet.robot.spec import RobotSpec
from gaponet.sim.model import soften_table, stiffen_friction


def changed_model(
    model: mujoco.MjModel, robot: RobotSpec, joint_names: tuple[str, ...], change: SimulatorChange
) -> mujoco.MjModel:
    """Return a changed copy of the robot's compiled simulator.

    It equals a new compilation, and takes less time.

    Args:
        model: Of `build_model`, with the joints of `joint_names`.
        change: For all joints of the robot, locked ones included.

    Raises:
        UsageError: The change is for another number of joints, or delays servos in a model without
            buffers for it.
    """
    if not len(change.kp) == len(change.damping) == len(robot.joint_names):
        raise UsageError(
            f"the changed simulator has {len(change.kp)} joints, {robot.name} has "
            f"{len(robot.joint_names)}"
        )
    if change.delay and not model.nhistory:
        raise UsageError(
            f"{robot.name}: this model has no buffer for servos that are later by "
            f"{change.delay:g} s"
        )
    joints = robot.index(joint_names)
    kp = np.array(change.kp)[joints]
    damping = np.array(change.damping)[joints]
    changed = copy.copy(model)
    changed.actuator_gainprm[:, 0] *= kp
    changed.actuator_biasprm[:, 0] *= kp
    changed.actuator_biasprm[:, 1] *= kp
    changed.actuator_biasprm[:, 2] *= damping
    changed.dof_damping[:] *= damping.reshape(-1, *[1] * (changed.dof_damping.ndim - 1))
    changed.dof_armature[:] *= change.armature
    changed.dof_frictionloss[:] *= change.friction
    if change.delay:
        changed.actuator_delay[:] += change.delay
    for mount in robot.payload_mounts:
        changed.body_pos[changed.body(f"payload_{mount.side}").id] += change.mount
    mujoco.mj_setConst(changed, mujoco.MjData(changed))
    stiffen_friction(changed)
    soften_table(changed, robot)
    return changed
