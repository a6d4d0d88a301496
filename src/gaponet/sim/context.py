"""Context: how a simulator answers fixed probes. It tells a network which simulator this is.

The robot rests at home. A null probe leaves the targets there. Another probe moves the target of
one joint by PROBE_RAD. Each joint has eight values: the answer to the null probe, and the
difference that its own probe makes, each as position (rad) and velocity times the control period
(rad), after READ_AFTER_S.

This is the branch input of a DeepONet (Lu et al. 2021): the input function, here the response of
the simulator, at fixed sensors. It is measured once per simulator and is constant while the network
runs.
"""

from __future__ import annotations

import copy
from collections.abc import Callable

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import Batch, BatchSim, Condition
from gaponet.sim.model import driven_joints, joint_addresses

PROBE_RAD = 0.2
READ_AFTER_S = (0.04, 0.2)  # the start of the motion, and most of it


def contexts(
    robot: RobotSpec, conditions: list[Condition], nthread: int = 1, *, loaded: bool = False
) -> Array:
    """Measure the answers of simulators.

    Args:
        robot: The simulator.
        conditions: Simulations.
        nthread: Threads, 0 for all cores.
        loaded: The hands carry the payload of the condition. Otherwise they are empty, for a
            network that is told the payload.

    Returns:
        (conditions, 8n) float32, rad. The joint varies fastest.
    """
    probed = conditions
    if not loaded:
        probed = [condition._replace(payload_mass=0.0) for condition in conditions]
    known: dict[Condition, Array] = vars(robot).setdefault("_contexts", {})
    unknown = [condition for condition in dict.fromkeys(probed) if condition not in known]
    for dt in dict.fromkeys(condition.dt for condition in unknown):
        same_rate = [condition for condition in unknown if condition.dt == dt]
        known.update(zip(same_rate, _of_simulators(robot, same_rate, nthread), strict=True))
    return np.stack([known[condition] for condition in probed])


def _of_simulators(robot: RobotSpec, conditions: list[Condition], nthread: int) -> Array:
    """Return the answers of simulations with one control period, (conditions, 8n) float32."""
    count = len(conditions)
    probes = len(robot.operated) + 1
    by_simulation = []
    for condition in conditions:
        by_simulation += [condition] * probes
    sim = BatchSim(robot, by_simulation, nthread)
    home = np.tile(robot.qpos_home, (count * probes, 1))
    moved, towards = _probe_targets(robot.qpos_home, robot.operated_index, sim.commands.range)
    target = np.tile(moved, (count, 1))
    sim.reset(slice(None), home, np.zeros_like(home), past=home[:, None])

    def step() -> tuple[Array, Array]:
        sim.step(target)
        return sim.qpos - home, sim.qvel

    return _answers(step, conditions[0].dt, robot.operated_index, towards)


def scene_context(scene: mujoco.MjModel, robot: RobotSpec, dt: float, prefix: str = "") -> Array:
    """Measure the answers of a robot in a scene, (8n) rad.

    Contacts are off, and all other bodies start as compiled.

    Args:
        scene: With a position actuator on each operated joint.
        robot: Joints and home.
        dt: Control period, s.
        prefix: Prefix of the robot's names in the scene.
    """
    model = copy.copy(scene)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    driven = {}
    for i, joint in enumerate(driven_joints(model)):
        if joint >= 0:
            driven[model.joint(joint).name] = i
    names = [name for name in robot.joint_names if prefix + name in driven]
    home = robot.qpos_home[robot.index(names)]
    operated = np.array([names.index(name) for name in robot.operated])
    address, dof = joint_addresses(model, [prefix + name for name in names])
    actuator = np.array([driven[prefix + name] for name in names])
    moved, towards = _probe_targets(home, operated, robot.qpos_range[robot.index(names)])

    batch = Batch(model, nsim=len(moved), nthread=1)
    qpos: Array = batch.bind("qpos")
    qvel: Array = batch.bind("qvel")
    ctrl: Array = batch.bind("ctrl")
    qpos[:, address] = home
    ctrl[:, actuator] = home
    steps = round(dt / model.opt.timestep)
    if model.nhistory:
        batch.bind("history")[:] = _history_at_rest(model, ctrl[0])
    ctrl[:, actuator] = moved

    def step() -> tuple[Array, Array]:
        batch.step(nstep=steps)
        return qpos[:, address] - home, qvel[:, dof]

    result: Array = _answers(step, dt, operated, towards)[0]
    return result


def _history_at_rest(model: mujoco.MjModel, ctrl: Array) -> Array:
    """Return MuJoCo's buffers of past commands of servos that always had the targets ctrl, (nu,)
    rad; (nhistory,).
    """
    data = mujoco.MjData(model)
    for i, samples in enumerate(model.actuator_history[:, 0]):
        if samples:
            mujoco.mj_initCtrlHistory(model, data, i, None, np.full(samples, ctrl[i]))
    return np.array(data.history)


def _probe_targets(home: Array, operated: Array, limits: Array) -> tuple[Array, Array]:
    """Return the targets of all probes, (1 + n, joints) rad, and the direction of each joint's
    own, (n) ±1.
    """
    towards = np.where(home + PROBE_RAD <= limits[:, 1], 1.0, -1.0)[operated]
    targets = np.tile(home, (1 + len(operated), 1))  # the first is the null probe
    for probe, joint in enumerate(operated):
        targets[1 + probe, joint] += PROBE_RAD * towards[probe]
    return targets, towards


def _answers(
    step: Callable[[], tuple[Array, Array]], dt: float, operated: Array, towards: Array
) -> Array:
    """Return the answers (simulators, 8n) float32 of simulations under all probes.

    Args:
        step: Simulates one control period, and returns positions relative to home and velocities,
            each (simulators · (1 + n), joints), rad and rad/s.
        dt: Control period, s.
        operated: Operated joints among these, (n).
        towards: Direction of each joint's own probe, (n) ±1.
    """
    read_at = [max(1, round(seconds / dt)) for seconds in READ_AFTER_S]
    values = []
    for period in range(1, read_at[-1] + 1):
        moved, speed = step()
        if period not in read_at:
            continue
        for quantity in (moved, dt * speed):
            answers = quantity[:, operated].reshape(-1, 1 + len(operated), len(operated))
            null = answers[:, 0]
            own = np.diagonal(answers[:, 1:], axis1=1, axis2=2)  # joint j under probe j
            values.append(null)
            values.append((own - null) * towards)
    joined = np.stack(values, axis=1)  # (simulators, 8, n)
    return joined.reshape(len(joined), -1).astype(np.float32)
