"""benchmarks/speed.py measures what it says."""

import pytest

from gaponet.nn.config import ModelConfig
from gaponet.nn.training.config import PPOConfig, TrainConfig

SMALL = TrainConfig(
    ModelConfig(history=1, num_probes=2, branch_hidden=(8,), trunk_hidden=(8,), sensor_hidden=(8,), mlp_hidden=(8,)),
    ppo=PPOConfig(num_steps=4, epochs=1, critic_hidden=(8,)),
    threads=1,
)


def test_the_speed_without_overhead_follows_from_the_speeds_of_the_parts(arm, load):
    result = load("speed").bench_train(arm, SMALL, num_envs=8, rounds=2)
    parts = [result["speeds"][p]["control_steps_per_s"] for p in ("bare Batch loop", "inference", "update")]
    assert result["expected"] == pytest.approx(1 / sum(1 / p for p in parts))
