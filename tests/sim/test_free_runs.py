"""Jacobians of free runs, with joints on their own and in company."""

import numpy as np
import pytest
from arm import recordings, write_arm

from gaponet.robot import load_robot
from gaponet.sim.free_runs import BOUNDS, FreeRuns, limbs_of, one_per_limb
from gaponet.sim.identify import cut
from gaponet.sim.model import build_model


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    robot = write_arm(tmp_path_factory.mktemp("arm"))
    return FreeRuns(cut(recordings(robot, 2, rows=60, kp=0.6), 2), robot, 0, tuple(BOUNDS), None, 0.0, False)


def test_the_jacobian_of_a_limb_is_that_of_one_parameter_after_the_other(problem):
    x = problem.start()
    base, steps = problem.errors(x[None])[0], np.repeat([b[2] for b in BOUNDS.values()], 2)
    slow = (problem.errors(x + np.diag(steps)) - base).T / steps
    np.testing.assert_array_equal(problem.jacobian(x, base, alone=False), slow)


def test_joints_on_their_own_answer_for_themselves_nearly_as_in_company(problem):
    x = problem.start()
    base = problem.errors(x[None])[0]
    alone, company = (problem.jacobian(x, base, alone) for alone in (True, False))
    own = problem.joint[:, None] == np.tile([0, 1], len(BOUNDS))
    assert not alone[~own].any()
    gain = own & (np.arange(len(x)) < 2)
    assert np.abs(alone - company)[gain].mean() < 0.2 * np.abs(company[gain]).mean()


def test_two_arms_are_two_limbs():
    robot = load_robot("h1_2")
    model = build_model(robot)
    limb = limbs_of(model, np.array([model.joint(j).dofadr[0] for j in robot.operated]))
    assert limb.tolist() == [0] * 5 + [1] * 5
    assert one_per_limb(np.array([0, 0, 1])).tolist() == [[0, 0, 2], [1, 1, -1]]
