"""The training environment against the row convention and the replay."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from arm import recordings, write_arm

from gaponet.base.errors import UsageError
from gaponet.nn.config import ModelConfig
from gaponet.nn.networks import build_network
from gaponet.nn.training.config import PretrainingConfig, RewardConfig
from gaponet.nn.training.env import DeltaEnv, EnvOptions
from gaponet.nn.training.observations import CRITIC_PREVIEW
from gaponet.nn.training.pretraining import Pretraining
from gaponet.sim.batch import Condition
from gaponet.sim.replay import replay


@pytest.fixture
def robot(tmp_path):
    return write_arm(tmp_path)


def make(robot, sequences, num_envs=8, steps=1000, **reward):
    options = EnvOptions(num_envs, steps * robot.dt, RewardConfig(**reward), seed=0, nthread=1)
    return DeltaEnv(sequences, robot, ModelConfig(history=2), options)


def test_without_correction_the_environment_is_the_replay(robot):
    sequences = recordings(robot, 2, rows=60, kp=0.6)
    env = make(robot, sequences)
    first = env.playback.first.copy()
    env.playback.start(slice(None), first, first, env.playback.last.copy())
    recorded = env.rows
    env.sim.reset(slice(None), recorded.qpos[first], recorded.qvel[first])
    for _ in range(59):
        env.advance(np.zeros((env.num_envs, 2)))
    replays = replay(sequences, robot)
    for i in range(env.num_envs):
        simulated = replays[int(np.flatnonzero(env.rows.first == first[i])[0])]
        np.testing.assert_array_equal(env.sim.qpos[i].astype(np.float32), simulated.qpos[59])


def test_an_episode_lasts_as_many_seconds_at_every_rate(robot):
    at_50_hz, also_at_50_hz = recordings(robot, 2, rows=150)
    at_100_hz = replace(also_at_50_hz, dt=0.01)
    env = make(robot, [at_50_hz, at_100_hz], steps=20)
    first = env.playback.first.copy()
    env.playback.start(slice(None), first, first, env.playback.last.copy())
    ends = np.zeros(env.num_envs)  # control periods, (num_envs,)
    for period in range(1, 60):
        _, done = env.step(np.zeros((env.num_envs, 2), np.float32))
        ends[done & (ends == 0)] = period
    dt = np.array([condition.dt for condition in env.groups.conditions_of_envs])
    assert set(dt) == {0.02, 0.01}
    np.testing.assert_allclose(ends * dt, 0.4)


def test_the_reward_of_a_joint_compares_it_one_row_on(robot):
    env = make(robot, recordings(robot, 2, rows=60, kp=0.6), position=0.02, cap=0.1)
    row = env.playback.row.copy()
    reward, done = env.step(np.zeros((env.num_envs, 2), np.float32))
    error = np.abs(env.sim.qpos - env.rows.qpos[np.minimum(row + 1, len(env.rows.qpos) - 1)])[~done]
    assert (error > 0.002).any()
    assert (error < 0.002).any()
    np.testing.assert_allclose(reward[~done], -np.minimum(error / 0.02, 0.1), rtol=1e-4, atol=1e-6)


def test_an_unrecorded_joint_stands_still_and_has_neither_reward_nor_label(robot):
    one, other = recordings(robot, 2, rows=60, kp=0.6)
    said = replace(one.meta, notes={"posture": {robot.joint_names[1]: 0.3}})
    still = np.tile(np.float32([np.nan, 0.3]), (len(one), 1))
    stands = lambda x, at: np.where(np.isnan(still), x, at)  # noqa: E731
    one = replace(
        one,
        meta=said,
        ctrl=stands(one.ctrl, 0.3),
        qpos=stands(one.qpos, 0.3),
        qvel=stands(one.qvel, 0.0),
    )
    env = make(robot, [one, other])
    pretraining = Pretraining(
        build_network(env.config, 2),
        env,
        np.ones((120, 2), np.float32),
        PretrainingConfig(steps=3),
        0,
    )
    _, labels = pretraining.rollout(follow_labels=True)
    unknown = env.playback.first == env.rows.first[0]
    assert 0 < unknown.sum() < len(unknown)
    assert np.isnan(labels.numpy().reshape(3, -1, 2)[0][unknown, 1]).all()
    np.testing.assert_allclose(env.sim.qpos[unknown, 1], 0.3, atol=1e-4)  # whatever it carries
    reward, _ = env.step(np.zeros((env.num_envs, 2), np.float32))
    assert (reward[unknown, 1] == 0).all()
    assert (reward[:, 0] < 0).all()
    assert (reward[~unknown, 1] < 0).all()
    fit = Pretraining(
        pretraining.net, env, pretraining.labels, PretrainingConfig(steps=3, gradient_steps=2), 0
    ).round(lambda: 0.0)
    assert np.isfinite(fit["label_rmse"])


def test_the_critic_looks_ahead_of_the_simulation(robot):
    env = make(robot, recordings(robot, 2, rows=60, kp=0.6))
    seen = env.get_observations()["critic"].numpy()
    n = 2
    many = len(CRITIC_PREVIEW)
    q = env.sim.qpos
    rows = np.minimum(env.playback.row[:, None] + CRITIC_PREVIEW, env.playback.last[:, None])
    np.testing.assert_allclose(seen[:, :n], env.rows.qpos[env.playback.row] - q, atol=1e-6)
    ahead = seen[:, 2 * n : 2 * n + many * n].reshape(-1, many, n)
    np.testing.assert_allclose(ahead, env.rows.qpos[rows] - q[:, None], atol=1e-6)
    commands = seen[:, 2 * n + many * n : 2 * n + 2 * many * n].reshape(-1, many, n)
    np.testing.assert_allclose(commands, env.rows.ctrl[rows] - q[:, None], atol=1e-6)


def test_payload_of_the_log_is_the_payload_of_the_simulation(robot):
    sequences = recordings(robot, 4, rows=60)
    env = make(robot, sequences)
    masses = {env.groups.conditions[g][0] for g in env.groups.of_env}
    assert masses == {0.0, 0.2}
    for i in range(env.num_envs):
        member = np.flatnonzero(env.rows.first == env.playback.first[i])[0]
        assert env.groups.conditions[env.groups.of_env[i]] == Condition.of(sequences[member], robot)


def test_motions_are_drawn_in_proportion_to_their_length_as_numpys_choice_does(robot):
    sequences = [s for rows in (20, 40, 70) for s in recordings(robot, 4, rows=rows)]
    env = make(robot, sequences, num_envs=64)
    rng = np.random.default_rng(5)
    env.rng = np.random.default_rng(5)
    env.reset()
    length = np.array([len(s) for s in sequences])
    drawn = []
    for g, condition in enumerate(env.groups.conditions):
        mine = np.flatnonzero([Condition.of(s, robot) == condition for s in sequences])
        drawn += rng.choice(
            mine, size=(env.groups.of_env == g).sum(), p=length[mine] / length[mine].sum()
        ).tolist()
    np.testing.assert_array_equal(env.playback.first, env.rows.first[drawn])


def test_the_end_of_a_motion_is_a_time_out_and_no_step_passes_it(robot):
    env = make(robot, recordings(robot, 2, rows=5))
    seen = 0
    for _ in range(6):
        assert (env.playback.row < env.playback.last).all()
        seen += int(env.step(np.zeros((env.num_envs, 2), np.float32))[1].sum())
    assert seen >= env.num_envs


def test_the_actor_never_sees_the_recorded_state(robot):
    sequences = recordings(robot, 2, rows=60, kp=0.6)
    env = make(robot, sequences)
    before = env.get_observations()
    env.playback.rows.track[:, :4] += 1.0  # recorded q, q̇
    env.playback.recorded[:, :4] += 1.0
    after = env.get_observations()
    assert torch.equal(before["actor"], after["actor"])
    assert not torch.equal(before["critic"], after["critic"])


def test_a_motion_of_one_row_is_refused(robot):
    with pytest.raises(UsageError, match="motion0"):
        DeltaEnv(recordings(robot, 2, rows=1), robot, ModelConfig(), EnvOptions(8))
