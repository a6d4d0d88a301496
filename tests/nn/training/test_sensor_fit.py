"""The predictor learns what the simulator answers, also where no motion has been."""

import numpy as np
import pytest
import torch
from arm import recordings, write_arm

from gaponet.nn.config import ModelConfig
from gaponet.nn.networks import build_network
from gaponet.nn.training.env import DeltaEnv, EnvOptions
from gaponet.nn.training.sensor_fit import fit_inputs


def test_the_predictor_explains_most_of_the_answers_on_held_out_states(tmp_path, monkeypatch):
    monkeypatch.setattr("gaponet.nn.training.sensor_fit.FIT_STEPS", 300)
    torch.manual_seed(0)
    robot = write_arm(tmp_path)
    config = ModelConfig(history=2, sensors="predicted", num_probes=4, sensor_hidden=(64, 64))
    env = DeltaEnv(recordings(robot, 6), robot, config, EnvOptions(64, nthread=1))
    net = build_network(config, 2)
    report = fit_inputs(net, env, env.get_observations()["actor"], 512, seed=0)
    assert report["mean"] > 0.5
    assert list(report["by_joint"]) == ["shoulder", "elbow"]
    assert np.mean(list(report["by_joint"].values())) == pytest.approx(report["mean"])
    assert np.mean(report["by_probe"]) == pytest.approx(report["mean"])
    assert len(report["by_probe"]) == 4
    assert not any(p.requires_grad for p in net.predictor.parameters())
