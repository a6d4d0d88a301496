"""The Jacobian of free runs, in which joints are on their own."""

from dataclasses import replace

import numpy as np
import pytest
from arm import recordings, write_arm

from gaponet.sim.free_runs import BOUNDS, FreeRuns
from gaponet.sim.refit import cut

FIELDS = ("kp", "damping", "frictionloss", "armature", "offset", "delay")


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    robot = write_arm(tmp_path_factory.mktemp("arm"))
    return FreeRuns(cut(recordings(robot, 2, rows=60, kp=0.6), 2), robot, 0, FIELDS)


def test_joints_on_their_own_answer_for_themselves_nearly_as_in_company(problem):
    x = problem.start()
    base, steps = problem.errors(x[None])[0], np.repeat([BOUNDS[f][2] for f in FIELDS], 2)
    fast = problem.jacobian(x, base)
    for joint in range(2):
        gain = np.eye(len(x))[joint] * steps  # kp of this joint alone
        slow = (problem.errors((x + gain)[None])[0, joint] - base[joint]) / steps[joint]
        assert np.abs(fast[joint, :, 0] - slow).mean() < 0.2 * np.abs(slow).mean()


def test_damping_below_zero_is_taken_from_the_servo(problem):
    robot = problem.robot.with_gains(None, (0.4, 0.4))
    less = replace(robot.nominal or robot, kd=np.array([0.4, 0.4]))
    runs = FreeRuns(problem.parts, less, 0, FIELDS, believed=False)
    values = {f: x[None] for f, x in runs.values(runs.start()).items()}
    softer = runs.run(values | {"damping": np.full((1, 2), -0.3)})
    np.testing.assert_allclose(
        softer, FreeRuns(problem.parts, replace(less, kd=np.array([0.1, 0.1])), 0, FIELDS).run(
            values | {"damping": np.zeros((1, 2))}), atol=1e-6
    )  # fmt: skip
    written = less.with_servos({"elbow": {"damping": -0.3}})
    assert written.kd.tolist() == pytest.approx([0.4, 0.1])
    assert (written.damping[1], written.nominal.kd[1]) == (0.0, 0.4)
