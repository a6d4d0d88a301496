"""Supervised pre-training and its labels."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from arm import TOML, recordings, write_arm

from gaponet.nn.config import ModelConfig
from gaponet.nn.networks import build_network
from gaponet.nn.training.config import PretrainingConfig
from gaponet.nn.training.env import DeltaEnv, EnvOptions
from gaponet.nn.training.pretraining import Pretraining, trajectory_labels
from gaponet.robot.spec import Table
from gaponet.sim.replay import replay


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    torch.manual_seed(0)
    robot = write_arm(tmp_path_factory.mktemp("arm"))
    config = ModelConfig(
        history=2, num_probes=4, sensor_hidden=(32,), branch_hidden=(16,), trunk_hidden=(16,)
    )
    env = DeltaEnv(recordings(robot, 4), robot, config, EnvOptions(32, nthread=1))
    net = build_network(config, 2)
    settings = PretrainingConfig(num_envs=32, steps=64, gradient_steps=2)
    warm = Pretraining(net, env, np.zeros((len(env.rows.qpos), 2), np.float32), settings, seed=0)
    warm.fit_inputs()
    return warm


def test_input_statistics_stay_fixed_after_the_predictor_is_fitted(fitted):
    net = fitted.net
    before = fitted.net.features.standardise.mean.clone()
    assert before.abs().max() > 0
    fitted.round(lambda: 0.0)
    assert torch.equal(net.features.standardise.mean, before)
    assert fitted.pool.x.shape == (32 * 64, net.config.input_dim(2))


def test_a_full_pool_takes_a_part_of_the_environments_of_each_period_in_turn(fitted, monkeypatch):
    env = fitted.env
    rows = []
    fitted.config = replace(fitted.config, rounds=2, steps=6)
    for most in (10**6, 2 * 6 * 32 // 3):
        monkeypatch.setattr("gaponet.nn.training.pretraining.MAX_POOL_STATES", most)
        env.rng = np.random.default_rng(0)
        x, labels = fitted.rollout(follow_labels=True)
        rows.append(x.numpy())
        assert len(labels) == len(x)
    every, some = rows
    assert len(every) == 6 * 32
    kept = np.arange(6 * 32).reshape(6, 32)
    np.testing.assert_array_equal(
        some, every[np.concatenate([kept[t, t % 3 :: 3] for t in range(6)])]
    )


def errors(sequences, labels, robot):
    """Mean |error| of each recording under its labels, rad."""
    parts = np.split(labels, np.cumsum([len(s) for s in sequences])[:-1])
    told = [replace(s, ctrl=s.ctrl + part) for s, part in zip(sequences, parts, strict=True)]
    return np.array(
        [
            np.abs(t.qpos - s.qpos).mean()
            for s, t in zip(sequences, replay(told, robot), strict=True)
        ]
    )


def test_labels_reduce_the_error_below_a_third(tmp_path):
    robot = write_arm(tmp_path)
    sequences = recordings(robot, 4, rows=200, kp=0.5, delay=3)
    labels = trajectory_labels(sequences, robot, 0.5)
    none = errors(sequences, np.zeros_like(labels), robot)
    assert (errors(sequences, labels, robot) < 0.3 * none).all()


def test_without_an_error_the_labels_are_zero(tmp_path):
    robot = write_arm(tmp_path)
    labels = trajectory_labels(recordings(robot, 1, rows=200, kp=1.0, delay=0), robot, 0.5)
    assert np.abs(labels).max() < 1e-6


def test_an_unrecorded_joint_has_no_label(tmp_path):
    robot = write_arm(tmp_path)
    (sequence,) = recordings(robot, 1, rows=60)
    meta = replace(sequence.meta, notes={"held_at_home": [robot.operated[1]]})
    labels = trajectory_labels([replace(sequence, meta=meta)], robot, 0.5)
    assert np.isnan(labels[:, 1]).all()
    assert np.isfinite(labels[:, 0]).all()


def test_rows_with_a_tip_at_the_table_have_no_label(tmp_path):
    robot = write_arm(tmp_path, toml=TOML + '[[tip]]\nbody = "fore"\npos = [0.2, 0.0, 0.0]\n')
    sequences = recordings(robot, 2, rows=100)
    q = np.concatenate([s.qpos for s in sequences])
    tip = -0.2 * (np.sin(q[:, 0]) + np.sin(q.sum(1)))
    table = robot.with_table(Table(float(np.median(tip)) - 0.01))
    labels = trajectory_labels(sequences, table, 0.5)
    assert (np.isnan(labels).all(1) == (tip < np.median(tip))).mean() > 0.98
    assert np.isfinite(trajectory_labels(sequences, robot, 0.5)).all()
