"""The cheap baseline finds what it is made to find."""

import numpy as np
from arm import commands, record, write_arm

from gaponet.nn.delay_offset import DelayOffset
from gaponet.sim.replay import replay


def test_a_delay_of_three_periods_is_estimated(tmp_path):
    robot = write_arm(tmp_path)
    found = DelayOffset.fit(
        [record(robot, commands(400, s), f"m{s}", delay=3) for s in range(3)], robot
    )
    assert found.delay == {"shoulder": 0.06, "elbow": 0.06}
    assert max(map(abs, found.offset.values())) < 0.002


def test_with_the_true_delay_the_simulator_follows_exactly(tmp_path):
    robot = write_arm(tmp_path)
    sequence = record(robot, np.round(commands(80, 1) * 256) / 256, "m", delay=2)
    values = DelayOffset({"shoulder": 0.04, "elbow": 0.04}, {"shoulder": 0.0, "elbow": 0.0})
    simulated = replay([sequence], robot, values.corrector(robot))[0]
    np.testing.assert_allclose(simulated.qpos, sequence.qpos, atol=1e-6)
