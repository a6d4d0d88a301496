"""The Jacobian of free runs, in which joints are on their own."""

import numpy as np
import pytest
from arm import recordings, write_arm

from gaponet.sim.free_runs import BOUNDS, FreeRuns
from gaponet.sim.refit import cut


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    robot = write_arm(tmp_path_factory.mktemp("arm"))
    return FreeRuns(cut(recordings(robot, 2, rows=60, kp=0.6), 2), robot, 0, tuple(BOUNDS), None, 0.0, False)


def test_joints_on_their_own_answer_for_themselves_nearly_as_in_company(problem):
    x = problem.start()
    base, steps = problem.errors(x[None])[0], np.repeat([b[2] for b in BOUNDS.values()], 2)
    slow = (problem.errors(x + np.diag(steps)) - base).T / steps  # one parameter after the other
    fast = problem.jacobian(x, base)
    own = problem.joint[:, None] == np.tile([0, 1], len(BOUNDS))
    assert not fast[~own].any()
    gain = own & (np.arange(len(x)) < 2)
    assert np.abs(fast - slow)[gain].mean() < 0.2 * np.abs(slow[gain]).mean()
