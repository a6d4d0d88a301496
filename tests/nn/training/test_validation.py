from dataclasses import replace

import pytest
import torch
from arm import recordings, write_arm

from gaponet.nn.config import ModelConfig
from gaponet.nn.networks import build_network
from gaponet.nn.training.validation import Validator, choose_gain
from gaponet.sim.metrics import runs, summary
from gaponet.sim.replay import replay


def test_the_error_is_that_of_an_evaluation_where_joints_are_not_recorded(tmp_path):
    robot = write_arm(tmp_path / "arm")
    whole, part = recordings(robot, 2, rows=60, kp=0.5)
    part = replace(part, meta=replace(part.meta, notes={"held_at_home": ["shoulder"]}))
    evaluated = summary(
        runs([whole, part], [r.qpos for r in replay([whole, part], robot)], robot), robot
    )
    config = ModelConfig(history=2)
    errors = Validator([whole, part], robot, config, 1).errors(build_network(config, 2))
    assert errors.mean() == pytest.approx(evaluated["mpjae"], rel=1e-5)


@pytest.mark.parametrize(("ideal", "chosen"), [(1.3, 1.0), (0.8, 0.75), (0.55, 0.5), (0.0, 0.25)])
def test_the_gain_with_the_least_error_is_chosen(ideal, chosen):
    net = build_network(ModelConfig(), 3)
    assert choose_gain(net, lambda: abs(net.bounded.gain.item() - ideal), abs(1 - ideal)) == chosen
    assert net.bounded.gain.item() == chosen


def test_the_gain_scales_a_small_correction():
    net = build_network(ModelConfig(kind="mlp"), 2)
    torch.nn.init.constant_(net.net[-1].bias, 0.01)
    net.bounded.gain.fill_(0.5)
    x = torch.zeros(1, net.features.dim)
    assert net(x)[0].tolist() == pytest.approx([0.005, 0.005], rel=1e-3)
