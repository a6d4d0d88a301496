"""A network that inverts the operator: near its fixed point, found beside its model, and refused beside another."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from arm import commands, write_arm

from gaponet.deploy.compensator import Compensator, CompensatorConfig
from gaponet.errors import ModelError
from gaponet.model.artifact import GapModel, make_card
from gaponet.model.config import ModelConfig
from gaponet.model.deeponet import build_network
from gaponet.model.export import drawn_states, export
from gaponet.training.learned_inverse import learn_inverse, visit

CONFIG = ModelConfig(
    history=2, num_probes=4, branch_hidden=(16,), trunk_hidden=(16,), sensor_hidden=(16,), payload_max=0.4
)
LEARNED = CompensatorConfig(inverse="learned", feedback=0.0, blend=0.0)


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return write_arm(tmp_path_factory.mktemp("arm"))


@pytest.fixture
def model(robot, tmp_path):
    torch.manual_seed(0)
    net = build_network(CONFIG, 2)
    torch.nn.init.normal_(net.trunk[-1].weight, std=0.1)
    export(net, tmp_path / "model", make_card(CONFIG, robot, dt=[robot.dt]), drawn_states(net))
    return GapModel.load(tmp_path)


def sent(robot, model, config):
    compensator = Compensator(robot, model, config)
    targets = commands(100, 50)
    compensator.reset(targets[0], 0.3)
    return np.array([compensator.step(target, None) for target in targets]) - targets


def test_it_sends_what_the_fixed_point_sends(robot, model):
    facts = learn_inverse(robot, model, [commands(60, seed) for seed in range(20)], steps=250)
    assert facts["rms_missed"] < 0.2 * facts["rms_offset"]
    solved = sent(robot, model, replace(LEARNED, inverse="fixed_point", iterations=12))
    uninverted = sent(robot, model, replace(LEARNED, inverse="fixed_point", iterations=0))
    missed = np.abs(sent(robot, model, LEARNED) - solved).mean()
    assert missed < 0.25 * np.abs(solved - uninverted).mean()


def test_it_is_fitted_to_what_it_will_be_shown(robot, model):
    shown, compensator = [], Compensator(robot, model, replace(LEARNED, inverse="fixed_point", iterations=8))
    targets = commands(20, 3)
    loop = compensator.loop
    run = loop.bound.run
    loop.bound = replace(loop.bound, run=lambda: (shown.append(loop.x.copy()), run()))
    compensator.reset(targets[0], 0.3)
    for target in targets:
        compensator.step(target, None)
    x, _ = visit(robot, model, [targets], np.array([0.3]))
    action = compensator.loop.layout.action
    last = np.concatenate(shown)[7::8]  # of each period's eight questions
    np.testing.assert_allclose(x[:, 0, : action.start], last[:, : action.start], atol=1e-6)


def test_without_one_it_says_how_to_make_one(robot, model):
    with pytest.raises(ModelError, match="has no learned inverse; make one: gaponet export RUN --to inverse"):
        Compensator(robot, model, LEARNED)


def test_the_inverse_of_other_weights_is_refused(robot, model, monkeypatch):
    learn_inverse(robot, model, [commands(20, seed) for seed in range(4)], steps=2)
    monkeypatch.setattr(GapModel, "weights_hash", lambda self: "another")
    with pytest.raises(ModelError, match="was learned from other weights"):
        Compensator(robot, model, LEARNED)
