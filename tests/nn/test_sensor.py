"""Probes: what the simulator answers."""

import mujoco
import numpy as np
from arm import write_arm

from gaponet.nn.config import ModelConfig
from gaponet.nn.sensor import ProbeOracle
from gaponet.sim.batch import Condition
from gaponet.sim.model import build_model


def test_every_joint_is_probed_both_ways_and_with_both_amplitudes():
    offsets = ProbeOracle.probe_offsets(ModelConfig(num_probes=20), 5)
    assert offsets.shape == (20, 5)
    assert ((offsets != 0).sum(axis=1) == 1).all()
    for joint in range(5):
        assert sorted(offsets[offsets[:, joint] != 0, joint]) == [-0.4, -0.05, 0.05, 0.4]


def test_the_oracle_is_one_control_period_of_the_simulator(tmp_path):
    robot = write_arm(tmp_path)
    config = ModelConfig(num_probes=4)
    q = np.array([[0.2, -0.1]])
    v = np.array([[0.5, -0.3]])
    answer = ProbeOracle(robot, config, [Condition(0.3, "both", 0.02)])(q, v)
    assert answer.shape == (1, 4, 4)
    model = build_model(robot, 0.3)
    for k, offset in enumerate(ProbeOracle.probe_offsets(config, 2)):
        data = mujoco.MjData(model)
        data.qpos[:] = q[0]
        data.qvel[:] = v[0]
        data.ctrl[:] = q[0] + offset
        mujoco.mj_step(model, data, robot.decimation)
        expected = np.concatenate([data.qpos - q[0], 0.02 * (data.qvel - v[0])])
        np.testing.assert_allclose(answer[0, k], expected, atol=1e-7)
