"""A network that was trained at several rates is told its simulator's answers at the loop's rate."""

import numpy as np
import pytest
from arm import write_arm
from runs import random_run

import gaponet as gp
from gaponet.deploy.transfer import own_context
from gaponet.export.torch_program import delta_step
from gaponet.sim.batch import Condition


@pytest.fixture
def robot(tmp_path):
    return write_arm(tmp_path / "arm")


@pytest.fixture
def model(robot, tmp_path):
    """A run at 200 Hz and 100 Hz whose stored answers are those at the robot's 50 Hz."""
    made = random_run(tmp_path / "run", robot, periods=(0.005, 0.01), context=True)
    assert np.abs(made.context_of(robot, 0.01) - made.nominal_context).max() > 1e-3
    return made


def told(loop):
    """Answers that a loop gives to its network, (1, 8n)."""
    network_input = loop.network_input
    return np.array(network_input.x[:, network_input.layout.context])


def test_a_simulator_tells_them_at_its_own_rate(robot, model):
    sim = gp.AlignedSim(robot, model, dt=0.01)
    expected = told(model.loop(context=model.context_of(robot, 0.01)))
    np.testing.assert_array_equal(told(sim.loop), expected)


def test_a_compensator_tells_them_at_the_rate_of_its_loop(robot, model):
    compensator = gp.Compensator(robot, model, dt=0.01)
    compensator.reset(robot.qpos_home, 0.0)
    expected = told(model.loop(context=model.context_of(robot, 0.01)))
    np.testing.assert_array_equal(told(compensator.inverse.loop), expected)


def test_a_torch_program_tells_them_at_the_rate_of_its_export(robot, model):
    step = delta_step(model, model.path.parent)
    np.testing.assert_array_equal(step.context, model.context_of(robot, 0.005))


def test_a_correction_that_is_held_has_those_of_the_rate_of_training(robot, model):
    (context,) = own_context(model, robot, [Condition(0.0, "both", 0.0025)])
    np.testing.assert_array_equal(context, model.context_of(robot, 0.005))


def test_at_one_rate_the_stored_ones_hold(robot, tmp_path):
    model = random_run(tmp_path / "one", robot, periods=(0.02, 0.02006), context=True)
    assert own_context(model, robot, [Condition(0.0, "both", 0.02)]) is None
