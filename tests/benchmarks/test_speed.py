"""benchmarks/speed.py and sb3.py measure what they say."""

import importlib
from pathlib import Path

import numpy as np
import pytest
from arm import write_arm

from gaponet.nn.config import ModelConfig
from gaponet.nn.training.config import PPOConfig, TrainConfig
from gaponet.sim.replay import replay

SMALL = TrainConfig(
    ModelConfig(history=1, num_probes=2, branch_hidden=(8,), trunk_hidden=(8,), sensor_hidden=(8,), mlp_hidden=(8,)),
    ppo=PPOConfig(num_steps=4, epochs=1, critic_hidden=(8,)),
    threads=1,
)


@pytest.fixture
def load(monkeypatch):
    """load(name): a script of the folder benchmarks as a module."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    return importlib.import_module


def test_each_part_and_each_other_trainer_takes_turns(arm, load):
    turns = []
    others = lambda env, config: {"idle": (lambda: turns.append(env.num_envs), 7)}  # noqa: E731
    result = load("speed").bench_train(arm, SMALL, num_envs=8, rounds=2, others=others)
    speeds = result["speeds"]
    assert turns == [8, 8, 8]  # the first round is not counted
    assert result["times_others"] == {"idle": pytest.approx(speeds["PPO"]["ratio"] / speeds["idle"]["ratio"])}
    parts = [speeds[p]["control_steps_per_s"] for p in ("bare Batch loop", "inference", "update")]
    assert result["expected"] == pytest.approx(1 / sum(1 / p for p in parts))


def test_the_gymnasium_environment_is_the_same_task(tmp_path, load):
    pytest.importorskip("gymnasium")
    pytest.importorskip("stable_baselines3")
    robot = write_arm(tmp_path)
    (motion,) = load("speed").recordings(robot, 1)
    env = load("sb3").SingleEnv(robot, [motion], SMALL.model)
    env.rng = type("First", (), {"integers": staticmethod(lambda *_: 0)})()
    start, _ = env.reset()
    assert env.observation_space.contains(start)
    seen = [env.step(np.zeros(2, np.float32))[0][:2] for _ in range(20)]
    (twin,) = replay([motion], robot, nthread=1)
    np.testing.assert_allclose(seen, twin.qpos[1:21], atol=1e-6)
