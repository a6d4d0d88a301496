"""The loop around a network: what it is given and what is made of its answer, the same in training
and in rollouts.
"""

import numpy as np
import pytest
import torch
from arm import recordings, write_arm

from gaponet.nn.config import ModelConfig
from gaponet.nn.loop import DeltaCorrector, DeltaLoop
from gaponet.nn.observation import Layout
from gaponet.nn.training.env import DeltaEnv, EnvOptions
from gaponet.sim.replay import replay

LIMITS = np.array([[-10.0, 10.0]] * 2)


@pytest.mark.parametrize(
    "config",
    [
        ModelConfig(),
        ModelConfig(payload_input=False),
        ModelConfig(kind="paper", sensor_source="fixed", real_state=True),
        ModelConfig(kind="paper", predictor_inputs="equation_1"),
    ],
)
def test_the_parts_of_x_touch_and_fill_it(config):
    layout = Layout(config, 3)
    parts = [
        layout.q,
        layout.v,
        layout.past,
        layout.payload,
        layout.action,
        layout.sensors,
        layout.real,
    ]
    assert np.concatenate([np.arange(layout.dim)[part] for part in parts]).tolist() == list(
        range(layout.dim)
    )


class FirstRow:
    """In a generator's place: every environment starts at its motion's first row."""

    def random(self, size):
        return np.zeros(size)

    def integers(self, low, high):
        return low


@pytest.mark.parametrize(
    "how",
    [
        {"stride": 2},
        {"kind": "paper", "sensor_hold": 3},
        {"kind": "paper", "sensor_source": "fixed"},
        {"kind": "paper", "sensor_source": "fixed", "sensor_hold": 2},
    ],
    ids=["stride", "held sensors", "fixed probes", "held probes"],
)
def test_training_and_rollout_give_the_network_the_same_inputs(tmp_path, how):
    robot = write_arm(tmp_path)
    config = ModelConfig(history=2, num_probes=3, **how)
    sequence = recordings(robot, 2, rows=14, kp=0.6)[1:]
    free: list = []

    def infer(x):
        free.append(x.copy())
        return np.full((1, 2), 0.01, np.float32)

    replay(sequence, robot, DeltaCorrector(infer, config, robot), nthread=1)
    env = DeltaEnv(sequence, robot, config, EnvOptions(1, nthread=1))
    env.rng = FirstRow()
    env.reset()
    trained = []
    while env.playback.row[0] < env.playback.last[0]:
        trained.append(env.get_observations()["actor"].numpy())
        env.advance(np.full((1, 2), 0.01, np.float32))
    assert len(trained) == 13
    np.testing.assert_allclose(
        np.concatenate(trained), np.concatenate(free[: len(trained)]), atol=1e-6
    )


def looped(config, limits, num_envs, tensors):
    """A loop around a rule that looks at all of x, on torch's or numpy's arrays."""
    weights = np.random.default_rng(0).normal(0, 0.1, (config.input_dim(2), 2)).astype(np.float32)
    if not tensors:
        return DeltaLoop(config, limits, num_envs, lambda x: x @ weights)
    return DeltaLoop(
        config, limits, num_envs, lambda x: x @ torch.from_numpy(weights), like=torch.zeros(0)
    )


@pytest.mark.parametrize(
    ("bad", "when", "tensors"), [(np.nan, 0, False), (np.inf, 5, False), (np.nan, 5, True)]
)
def test_a_target_that_is_not_finite_affects_one_robot_for_one_period(bad, when, tensors):
    config = ModelConfig(history=3)
    limits = np.array([[-0.3, 0.3], [-10.0, 10.0]])
    rng = np.random.default_rng(1)
    kind = torch.from_numpy if tensors else np.asarray
    hit, clean = (looped(config, limits, 3, tensors) for _ in range(2))
    for t in range(10):
        q, v, a = rng.normal(0, 0.3, (3, 3, 2)).astype(np.float32)
        held = a.copy()
        payload = np.zeros(3, np.float32)
        if t == when:
            held[1, 0] = np.asarray(clean.applied)[1, 0] if t else q[1, 0]
            a[1, 0] = bad
        told = [
            loop.delta(*map(kind, (q, v, ctrl, payload)))
            for loop, ctrl in ((hit, a), (clean, held))
        ]
        np.testing.assert_array_equal(*map(np.asarray, told))
        np.testing.assert_array_equal(*(np.asarray(loop.applied) for loop in (hit, clean)))


@pytest.mark.parametrize("change", [{}, {"stride": 3, "payload_input": False}])
def test_torch_and_numpy_arrays_give_the_same_corrections(change):
    config = ModelConfig(**{"history": 3} | change)
    rng = np.random.default_rng(1)
    limits = np.array([[-0.3, 0.3], [-10.0, 10.0]])
    host, tensors = (looped(config, limits, 4, kind) for kind in (False, True))
    for t in range(25):
        q, v, a = rng.normal(0, 0.3, (3, 4, 2)).astype(np.float32)
        payload = rng.uniform(0, 3, 4).astype(np.float32)
        if t == 9:
            host.reset(np.array([1, 3]))
            tensors.reset(np.array([1, 3]))
        theirs = tensors.delta(*(torch.from_numpy(values) for values in (q, v, a, payload)))
        np.testing.assert_allclose(theirs.numpy(), host.delta(q, v, a, payload), atol=1e-6)
        np.testing.assert_allclose(tensors.network_input.x.numpy(), host.network_input.x, atol=1e-6)
