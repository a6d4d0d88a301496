"""Energy and torque add up in a virtual robot with mechanical effects switched on."""

import mujoco
import numpy as np
import pytest

from gaponet.sim.batch import OneByOne
from gaponet.virtual.fleet import load_fleet
from gaponet.virtual.virtual_robot import VirtualRobot

MECHANICAL = [
    "gain",
    "torque_constant",
    "friction",
    "load_friction",
    "damping",
    "cable",
    "mass",
    "tilt",
    "cogging",
]


@pytest.fixture
def moving(arm):
    """A unit swinging for one second; every millisecond its state and the forces of that step."""
    physics = load_fleet("shifted", arm).unit("virtual-1").only(MECHANICAL)
    robots = VirtualRobot(arm, [physics], [(0.2, "both")], dt=0.001, timestep=0.00025)
    if isinstance(robots.batch, OneByOne):
        pytest.skip("needs mujoco.batch's get_model: MuJoCo 3.17")
    model = robots.batch.get_model(0)
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    time = np.arange(1000) * 0.001
    ctrl = np.stack([0.3 + 0.4 * np.sin(5 * time), 0.2 + 0.5 * np.sin(7 * time)], axis=1)
    robots.reset(ctrl[:1], [0])
    force = robots.batch.bind("actuator_force")
    friction = robots.batch.bind("qfrc_constraint")
    rows = []
    for row in ctrl:
        robots.step(row[None])
        data = robots.batch.get_data(0)
        mujoco.mj_forward(model, data)
        rows.append(
            (
                data.energy.sum(),
                data.qpos.copy(),
                data.qvel.copy(),
                force[0].copy(),
                friction[0].copy(),
            )
        )
    return robots, model, [np.array(x) for x in zip(*rows, strict=True)]


def test_work_becomes_energy_and_heat_and_torques_add_up_to_what_moves_the_links(moving):
    robots, model, (energy, qpos, qvel, force, friction) = moving
    h = 0.001
    cogging = robots.motors.physics.cogging * np.sin(
        robots.motors.physics.cogging_count * qpos + robots.motors.physics.cogging_phase
    )
    middle = lambda x: (x[1:] + x[:-1]) / 2  # noqa: E731
    work = (middle(force + friction + cogging) * middle(qvel)).sum() * h
    heat = (model.dof_damping * middle(qvel) ** 2).sum() * h
    turned_over = (np.abs(middle(force) * middle(qvel))).sum() * h
    # Within 2 % of the motor's work.
    assert energy[-1] - energy[0] == pytest.approx(work - heat, abs=0.02 * turned_over)
    assert (middle(friction) * middle(qvel)).sum() < 0  # friction only takes
    data = mujoco.MjData(model)
    acceleration = np.gradient(qvel, 0.001, axis=0)
    needed = []
    given = []
    flags = model.opt.disableflags
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    for t in range(100, 900):
        data.qpos = qpos[t]
        data.qvel = qvel[t]
        data.qacc = acceleration[t]
        mujoco.mj_inverse(model, data)
        needed.append(data.qfrc_inverse.copy())
        given.append(force[t] + friction[t] + cogging[t])
    model.opt.disableflags = flags
    error = np.abs(np.array(needed) - np.array(given))
    # Within 1 % of the largest torque; turning points are noisier.
    assert np.median(error) < 0.01 * np.abs(needed).max()
