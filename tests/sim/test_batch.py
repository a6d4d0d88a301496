"""Many simulations step exactly as one does."""

import mujoco
import numpy as np
from arm import write_arm

from gaponet.sim.batch import BatchSim
from gaponet.sim.model import build_model


def test_a_batch_is_bit_identical_to_mj_step(tmp_path):
    robot = write_arm(tmp_path)
    conditions = [(0.0, "both", 0.02), (0.3, "both", 0.02), (0.3, "both", 0.01)]
    sim = BatchSim(robot, conditions, nthread=2)
    start = np.array([[0.1, -0.2], [0.3, 0.0], [0.0, 0.4]])
    sim.reset(slice(None), start, 0.0)
    targets = np.random.default_rng(0).uniform(-1, 1, (20, 3, 2))
    for target in targets:
        sim.step(target)
    for i, (mass, side, dt) in enumerate(conditions):
        model = build_model(robot, mass, side, dt)
        data = mujoco.MjData(model)
        data.qpos[:] = start[i]
        for target in targets:
            data.ctrl[:] = target[i]
            mujoco.mj_step(model, data, robot.decimation)
        np.testing.assert_array_equal(sim.qpos[i], data.qpos)
        np.testing.assert_array_equal(sim.qvel[i], data.qvel)


def test_targets_beyond_the_joint_range_are_clipped(tmp_path):
    sim = BatchSim(write_arm(tmp_path), [(0.0, "both", 0.02)])
    sim.step(np.array([[9.0, -9.0]]))
    np.testing.assert_array_equal(sim.ctrl, [[1.5, -1.5]])


def test_simulations_left_out_of_a_step_stand_still(tmp_path):
    sim = BatchSim(write_arm(tmp_path), [(0.0, "both", 0.02)] * 3)
    sim.step(np.ones((3, 2)), np.array([0, 2]))
    assert (sim.qpos[1] == 0).all()
    assert (sim.qpos[[0, 2]] != 0).any(axis=1).all()
