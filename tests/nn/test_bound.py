"""Whatever a network answers, a correction is finite and within delta_max, and a failing network
is reported.
"""

import warnings

import numpy as np
import pytest
import torch
from arm import write_arm
from wild_model import TAME_RAD, WildNetwork, wild_model

from gaponet.deploy.aligned_sim import AlignedSim
from gaponet.deploy.compensator import Compensator
from gaponet.export.torch_program import DeltaStep, program
from gaponet.nn.bound import AnswerBound

TAME_TARGET = np.array([0.2, -0.2])
WILD_TARGET = np.array([1.2, -0.2])
DELTA_MAX = 0.3
PERIODS = 60


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return write_arm(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module", params=[np.nan, np.inf, -2.5], ids=["nan", "inf", "far"])
def wild(request, robot, tmp_path_factory):
    return wild_model(tmp_path_factory.mktemp("run"), robot, request.param)


@pytest.fixture(scope="module")
def nan_model(robot, tmp_path_factory):
    return wild_model(tmp_path_factory.mktemp("nan"), robot, np.nan)


@pytest.fixture(autouse=True)
def no_warnings():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        yield


def last_command(compensator):
    """The command after PERIODS at the wild target, without measured states, (2,) rad."""
    compensator.reset(WILD_TARGET, 0.0)
    for _ in range(PERIODS):
        command = compensator.step(WILD_TARGET, None)
    return command


@pytest.mark.parametrize("make", [np.array, torch.tensor], ids=["numpy", "torch"])
def test_an_answer_with_a_number_that_is_not_finite_is_no_correction_for_that_robot(make):
    bound = AnswerBound(DELTA_MAX)
    limited = bound(make([[0.1, np.nan], [0.1, -0.2], [np.inf, 0.0]]))
    np.testing.assert_allclose(limited, [[0.0, 0.0], [0.1, -0.2], [0.0, 0.0]], rtol=1e-6)
    assert bound.refused == 2


@pytest.mark.parametrize("make", [np.array, torch.tensor], ids=["numpy", "torch"])
def test_answers_are_cut_to_delta_max(make):
    limited = AnswerBound(DELTA_MAX)(make([[9.0, -9.0], [0.3, 0.1]]))
    np.testing.assert_allclose(limited, [[0.3, -0.3], [0.3, 0.1]], rtol=1e-6)


def test_the_first_answer_that_is_not_finite_warns():
    bound = AnswerBound(DELTA_MAX)
    with pytest.warns(RuntimeWarning, match="finite"):
        bound(np.array([np.nan, 0.0]))


def test_a_control_loop_never_corrects_beyond_delta_max(wild):
    loop = wild.loop()
    for _ in range(PERIODS):
        delta = loop.delta(WILD_TARGET, np.zeros(2), WILD_TARGET, 0.0)
        assert (np.abs(delta) <= DELTA_MAX + 1e-6).all()


def test_a_loop_corrects_again_when_the_network_answers_again(nan_model):
    loop = nan_model.loop()
    loop.delta(WILD_TARGET, np.zeros(2), WILD_TARGET, 0.0)
    loop.reset()
    delta = loop.delta(TAME_TARGET, np.zeros(2), TAME_TARGET, 0.0)
    np.testing.assert_allclose(delta, TAME_RAD, atol=1e-7)
    assert loop.refused_answers == 1


def test_a_compensator_gives_finite_commands_and_says_that_the_network_failed(robot, nan_model):
    compensator = Compensator(robot, nan_model)
    compensator.reset(WILD_TARGET, 0.0)
    commands = [compensator.step(WILD_TARGET, WILD_TARGET) for _ in range(PERIODS)]
    assert np.isfinite(commands).all()
    assert compensator.refused_answers >= PERIODS
    assert "not finite" in compensator.doubt


def test_without_an_answer_the_compensator_commands_the_feed_forward_alone(robot, nan_model):
    np.testing.assert_allclose(
        last_command(Compensator(robot, nan_model)), last_command(Compensator(robot)), atol=1e-6
    )


def test_a_compensator_never_leaves_delta_max_around_the_feed_forward(robot, wild):
    compensator = Compensator(robot, wild)
    alone = Compensator(robot)
    for each in (compensator, alone):
        each.reset(WILD_TARGET, 0.0)
    for _ in range(PERIODS):
        difference = compensator.step(WILD_TARGET, None) - alone.step(WILD_TARGET, None)
        assert (np.abs(difference) <= DELTA_MAX + 1e-6).all()


def test_a_simulator_with_a_failing_network_stays_finite(robot, nan_model):
    sim = AlignedSim(robot, nan_model)
    sim.reset(WILD_TARGET)
    for _ in range(PERIODS):
        sim.step(WILD_TARGET)
    assert np.isfinite(sim.qpos).all()


@pytest.mark.parametrize(("answer", "most", "refused"), [(np.nan, 0.0, 1), (9.0, DELTA_MAX, 0)])
def test_the_exported_step_bounds_as_the_loop_does(nan_model, answer, most, refused):
    step = program(DeltaStep(WildNetwork(2, answer), nan_model)).module()
    rows = torch.tensor(np.stack([TAME_TARGET, WILD_TARGET]), dtype=torch.float32)
    past = (torch.zeros(2, 2, 6), torch.ones(2, dtype=torch.bool))
    with torch.inference_mode():
        delta, _ = step(rows, torch.zeros(2, 2), rows, torch.zeros(2), *past)
    np.testing.assert_allclose(delta[0], TAME_RAD, atol=1e-6)
    np.testing.assert_allclose(delta[1].abs().max(), most, atol=1e-6)
    assert int(step.refused) == refused
