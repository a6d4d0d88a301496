"""What a network is given, the same in training and in free run."""

import numpy as np
import pytest
import torch
from arm import recordings, write_arm

from gaponet.errors import ModelError
from gaponet.model.config import ModelConfig
from gaponet.model.corrector import DeltaCorrector
from gaponet.model.inputs import Inputs
from gaponet.model.observation import Layout
from gaponet.model.sensor import ProbeOracle
from gaponet.sim.replay import replay
from gaponet.train.config import RewardConfig
from gaponet.train.env import DeltaEnv

OP = np.array([0, 2])  # of three joints


class Asked:
    """An oracle that writes down who was asked and answers with the position."""

    def __init__(self, probes):
        self.probes, self.calls, self.offsets = probes, [], None

    def __call__(self, qpos, qvel, offsets=None, ids=None):
        self.calls.append(ids.tolist())
        self.offsets = offsets
        return np.repeat(qpos[:, :1], self.probes * 4, axis=1).reshape(len(qpos), self.probes, 4)


def started(config, num_envs=2, **more):
    inputs = Inputs(config, num_envs, OP, **more)
    frames = np.zeros((num_envs, inputs.history.depth, 3))
    inputs.reset(slice(None), frames, frames, frames)
    return inputs


def at(inputs, q):
    state = np.full((2, 3), float(q))
    return inputs.x(state, 0 * state, state[:, OP], np.zeros(2))


def step(inputs, q):
    state = np.full((2, 3), float(q))
    inputs.push(state, 0 * state, state)


@pytest.mark.parametrize(
    "config",
    [ModelConfig(), ModelConfig(payload_input=False), ModelConfig(sensor_hold=2), ModelConfig(sensors="oracle"),
     ModelConfig(sensors="learned", sensor_hold=2), ModelConfig(kind="mlp", sensor_hold=2, sensors="oracle")],
)  # fmt: skip
def test_the_parts_of_x_touch_and_fill_it(config):
    layout = Layout(config, 3)
    parts = [layout.q, layout.v, layout.past, layout.payload, layout.action, layout.refresh, layout.answers]
    assert np.concatenate([np.arange(layout.dim)[part] for part in parts]).tolist() == list(range(layout.dim))


def test_the_observation_of_the_last_refresh_stays_until_the_next():
    config = ModelConfig(history=1, payload_input=False, sensor_hold=2)
    inputs, refresh = started(config), Layout(config, 2).refresh
    seen = []
    for q in range(5):
        x = at(inputs, q)
        assert x[0, 0] == q
        seen.append(x[0, refresh][0])
        step(inputs, q)
    assert seen == [0, 0, 2, 2, 4]


def test_a_restarted_simulation_alone_is_asked_anew():
    oracle = Asked(3)
    inputs = started(ModelConfig(history=1, sensors="oracle", num_probes=3, sensor_hold=4), oracle=oracle)
    at(inputs, 1)
    at(inputs, 1)  # asked for twice, the simulator is asked once
    step(inputs, 1)
    frames = np.zeros((1, 1, 3))
    inputs.reset(np.array([1]), frames, frames, frames)
    x = at(inputs, 2)
    assert oracle.calls == [[0, 1], [1]]
    assert x[:, -1].tolist() == [1.0, 2.0]


def test_learned_points_are_chosen_from_the_present_observation():
    oracle = Asked(3)
    config = ModelConfig(history=1, payload_input=False, sensors="learned", num_probes=3)
    inputs = started(config, oracle=oracle, points=lambda x: np.repeat(x[:, :1], 6, axis=1).reshape(-1, 3, 2))
    at(inputs, 0.25)
    assert (oracle.offsets == 0.25).all()


class FirstRow:
    """In a generator's place: every environment starts at its motion's first row."""

    def choice(self, members, size, p):
        return np.full(size, members[0])

    def integers(self, low, high):
        return low


@pytest.mark.parametrize(
    "change",
    [{}, {"delta_hold": 3}, {"sensor_hold": 2}, {"sensors": "oracle"}, {"sensors": "learned", "sensor_hold": 2}],
    ids=["plain", "delta held", "sensors held", "oracle", "learned"],
)
def test_training_and_free_run_give_the_network_the_same_numbers(change, tmp_path):
    robot = write_arm(tmp_path)
    config = ModelConfig(history=2, stride=2, num_probes=3, **change)
    sequence = recordings(robot, 2, rows=14, kp=0.6)[1:]
    lean = 0.02 * np.arange(6).reshape(1, 3, 2)

    def points(x):
        return lean + x[:, :1, None]

    free: list = []

    def infer(x):
        free.append(x)
        return np.full((1, 2), 0.01, np.float32)

    learned = points if config.learns_points else None
    replay(sequence, robot, DeltaCorrector(infer, config, robot, learned), nthread=1)
    env = DeltaEnv(sequence, robot, config, 1, 1000, RewardConfig(), nthread=1)
    env.rng, env.inputs.points = FirstRow(), learned
    env.reset()
    trained = []
    while not env.ended()[0]:
        trained.append(env.get_observations()["actor"].numpy())
        for _ in range(config.delta_hold):
            env.advance(np.full((1, 2), 0.01, np.float32))
    assert len(trained) == 13 // config.delta_hold
    np.testing.assert_allclose(np.concatenate(trained), np.concatenate(free[: len(trained)]), atol=1e-6)


def test_the_simulator_is_asked_only_while_a_motion_lasts(tmp_path, monkeypatch):
    robot = write_arm(tmp_path)
    config = ModelConfig(sensors="oracle", num_probes=3)
    short, long = recordings(robot, 2, rows=8)[0], recordings(robot, 2, rows=14)[1]
    asked: list = []
    answer = ProbeOracle.__call__

    def noted(self, qpos, qvel, offsets=None, ids=None):
        asked.append(len(ids))
        return answer(self, qpos, qvel, offsets, ids)

    monkeypatch.setattr(ProbeOracle, "__call__", noted)
    together = replay([short, long], robot, DeltaCorrector(lambda x: x[:, -2:] * 0.01, config, robot), nthread=1)
    assert asked == [2] * 7 + [1] * 6
    for sequence, twin in zip((short, long), together, strict=True):
        alone = replay([sequence], robot, DeltaCorrector(lambda x: x[:, -2:] * 0.01, config, robot), nthread=1)[0]
        np.testing.assert_allclose(twin.qpos, alone.qpos, atol=1e-9)


def test_a_correction_is_held(tmp_path):
    robot = write_arm(tmp_path)
    answers = iter(np.arange(1, 100) / 1000)
    corrector = DeltaCorrector(lambda x: np.full((1, 2), next(answers)), ModelConfig(delta_hold=3), robot)
    sequence = recordings(robot, 1, rows=9)
    twin = replay(sequence, robot, corrector, nthread=1)[0]
    added = np.round((twin.ctrl - sequence[0].ctrl)[:8, 0] * 1000)
    assert added.tolist() == [1, 1, 1, 2, 2, 2, 3, 3]


def test_a_model_that_asks_the_simulator_is_refused_outside_of_one(tmp_path):
    robot = write_arm(tmp_path)
    corrector = DeltaCorrector(lambda x: np.zeros((1, 2)), ModelConfig(sensors="oracle"), robot)
    state = np.zeros((1, 2))
    with pytest.raises(ModelError, match="of no use outside a simulator; train with --model"):
        corrector.begin(state, state, state, np.zeros(1))
    corrector.begin(state, state, state, np.zeros(1), [(0.0, "both", 0.02)])
    assert torch.isfinite(torch.from_numpy(corrector.correct(0, state, state, state))).all()
