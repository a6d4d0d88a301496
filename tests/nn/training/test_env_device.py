"""The training environment on Warp's CPU device: the same numbers as on C MuJoCo's, and none that
go to the host.
"""

import numpy as np
import pytest
import torch
from arm import recordings, write_arm, write_dataset
from torch.overrides import TorchFunctionMode

from gaponet.base.errors import UsageError
from gaponet.nn.config import ModelConfig
from gaponet.nn.training.config import (
    Budget,
    PPOConfig,
    PretrainingConfig,
    RewardConfig,
    TrainConfig,
)
from gaponet.nn.training.env import DeltaEnv, EnvOptions
from gaponet.nn.training.trainer import Trainer

pytest.importorskip("mujoco_warp", reason="needs pip install 'gaponet[warp]'")

STEPS = 200
CASTS = ("array", "bool", "float", "int", "index")


def make(folder, device, servo=None, **model):
    robot = write_arm(folder).with_servo(**servo or {})
    sequences = recordings(robot, 4, rows=60, kp=0.6)
    options = EnvOptions(num_envs=8, episode_s=1.8, nthread=1, device=device)
    return DeltaEnv(sequences, robot, ModelConfig(**model), options)


def test_observation_reward_and_done_are_those_of_c_mujoco(tmp_path):
    ours, theirs = (make(tmp_path, device, history=2, stride=3) for device in ("cpu", "warp-cpu"))
    rng = np.random.default_rng(0)
    ends = 0
    for _ in range(STEPS):
        seen = ours.get_observations()
        also = theirs.get_observations()
        for group in seen:
            torch.testing.assert_close(also[group], seen[group], atol=1e-5, rtol=1e-5)
        delta = rng.normal(0, 0.01, (8, 2)).astype(np.float32)
        reward, done = ours.step(delta)
        like, same = theirs.step(torch.from_numpy(delta))
        # 1e-5 rad
        np.testing.assert_allclose(like.numpy(), reward, atol=1e-5 / RewardConfig().position)
        np.testing.assert_array_equal(same.numpy(), done)
        ends += done.sum()
    assert ends > 8
    assert theirs.reward.take_mean() == pytest.approx(ours.reward.take_mean(), abs=1e-4)


class Crossings(TorchFunctionMode):
    """Notes every way from a tensor to the host, and what else a GPU is waited for: masks as
    indices, other arrays.
    """

    WAYS = ("cpu", "numpy", "item", "tolist", "nonzero", "new_tensor", *(f"__{x}__" for x in CASTS))

    def __init__(self):
        super().__init__()
        self.seen = []

    def __torch_function__(self, func, types, args=(), kwargs=None):
        name = getattr(func, "__name__", "")
        index = args[1] if name in ("__getitem__", "__setitem__") else ()
        parts = index if isinstance(index, tuple) else (index,)
        waits = [
            isinstance(i, np.ndarray) or getattr(i, "dtype", None) == torch.bool for i in parts
        ]
        if name in self.WAYS or any(waits):
            self.seen.append((name, args[0].dtype, tuple(args[0].shape)))
        return func(*args, **(kwargs or {}))


def test_a_tensor_that_goes_to_the_host_is_noted():
    with Crossings() as crossings:
        assert float(torch.zeros(1)) == 0
        np.asarray(torch.zeros(2))
        torch.zeros(2)[torch.zeros(2) > 0]
        torch.zeros(2, 2)[:, np.array([0])] = 1.0
    assert len(crossings.seen) >= 4


@pytest.mark.parametrize(
    "servo", [{}, {"stribeck": 0.05, "stribeck_speed": 0.2, "delay": [0.03, 0.0]}]
)
def test_nothing_goes_to_the_host_in_a_step(tmp_path, servo):
    env = make(tmp_path, "warp-cpu", servo, history=2, stride=2)
    delta = torch.zeros(8, 2)
    resets = 0
    for _ in range(60):
        before = env.playback.elapsed.copy()
        with Crossings() as crossings:
            env.get_observations()
            _, done = env.step(delta)
        assert crossings.seen == []
        np.testing.assert_array_equal(env.playback.elapsed, np.where(done, 0, before + 1))
        np.testing.assert_array_equal(env.playback.row_on_device, env.playback.row)
        np.testing.assert_array_equal(env.playback.last_on_device, env.playback.last)
        resets += int(done.sum())
    assert resets


def test_a_run_on_the_device_learns_resumes_and_ships_for_the_cpu(tmp_path):
    robot = write_arm(tmp_path / "arm")
    data = tmp_path / "data"
    dataset = write_dataset(data, robot, recordings(robot, 8, rows=80, kp=0.5, delay=2))
    small = TrainConfig(
        ModelConfig(
            history=2, num_probes=2, branch_hidden=(16,), trunk_hidden=(16,), sensor_hidden=(16,)
        ),
        pretraining=PretrainingConfig(
            rounds=2, num_envs=16, steps=40, gradient_steps=80, batch_size=256, sensor_states=64
        ),
        ppo=PPOConfig(num_envs=16, num_steps=8, epochs=1, critic_warmup=0, explained=-1e9),
        device="warp-cpu",
    )
    steps = 2 * 16 * 40 + 2 * 16 * 8
    Trainer(dataset, robot, tmp_path / "run", small, Budget(steps=steps)).run()
    model = Trainer(
        dataset, robot, tmp_path / "run", small, Budget(steps=steps + 256), resume=True
    ).run()
    assert model.card["stages"]["ppo_updates"] >= 4
    assert model.card["val_mpjae"]["model"] < 0.9 * model.card["val_mpjae"]["nominal"]


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_missing_gpu_is_refused_before_training():
    with pytest.raises(UsageError, match="GPU"):
        TrainConfig(device="cuda").network_device()
