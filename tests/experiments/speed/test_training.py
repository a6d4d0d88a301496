"""The benchmark measures what it says; how fast it is, is not for a test."""

import importlib
from pathlib import Path

import numpy as np
import pytest
from arm import write_arm

from gaponet.experiments.speed import training as bench
from gaponet.experiments.speed import turns
from gaponet.nn.config import ModelConfig
from gaponet.nn.training.config import PPOConfig, TrainConfig
from gaponet.sim.replay import replay

SMALL = TrainConfig(
    ModelConfig(history=1, num_probes=2, branch_hidden=(8,), trunk_hidden=(8,), sensor_hidden=(8,), mlp_hidden=(8,)),
    ppo=PPOConfig(num_steps=4, epochs=1, critic_hidden=(8,)),
    threads=1,
)


def test_the_fastest_turn_counts_and_the_first_does_not(monkeypatch):
    seconds = [0.0, 1.0, 1.0, 6.0, 6.0, 9.0]  # of 1, 5 and 3 s
    clock = iter(2 * seconds)
    monkeypatch.setattr(turns.time, "perf_counter", lambda: next(clock))
    assert turns.take_turns({"a": lambda: None}, 2) == {"a": 3.0}
    assert turns.take_turns({"a": lambda: None}, 2, bench.median) == {"a": 4.0}


def test_every_part_of_training_takes_its_turn(arm):
    found = bench.bench_train(arm, SMALL, num_envs=8, rounds=1)
    assert list(found["speeds"]) == [
        "bare Batch loop", "environment step", "inference", "collection", "update", "PPO", "PPO, fast preset"
    ]  # fmt: skip
    parts = [found["speeds"][p]["control_steps_per_s"] for p in ("bare Batch loop", "inference", "update")]
    assert found["expected"] == pytest.approx(1 / sum(1 / p for p in parts))
    assert found["speeds"]["bare Batch loop"]["ratio"] == 1
    assert found["peak_memory_bytes"] > 1e8


def test_only_operated_jointswander(so101):
    motion = bench.slow_sines(so101, 50, 0)
    moved = {j for j, x in zip(so101.joint_names, motion.ctrl.T, strict=True) if x.std() > 0}
    assert moved == set(so101.operated)


def test_another_trainer_takes_its_turn_and_is_compared_by_its_own_number_of_steps(arm):
    turns = []

    def others(env, config):
        return {"idle": (lambda: turns.append(env.num_envs), 7)}

    found = bench.bench_train(arm, SMALL, num_envs=8, rounds=2, others=others)
    assert turns == [8, 8, 8]  # one that does not count, and two rounds
    speeds = found["speeds"]
    assert found["times_others"] == {"idle": pytest.approx(speeds["PPO"]["ratio"] / speeds["idle"]["ratio"])}


def test_one_simulation_per_process_is_the_same_task(tmp_path, monkeypatch):
    pytest.importorskip("gymnasium")
    pytest.importorskip("stable_baselines3")
    monkeypatch.syspath_prepend(str(Path(__file__).parents[3] / "benchmarks"))
    SingleEnv = importlib.import_module("sb3").SingleEnv
    robot = write_arm(tmp_path)
    (motion,) = bench.recordings(robot, 1)
    env = SingleEnv(robot, [motion], SMALL.model)
    env.rng = type("First", (), {"integers": staticmethod(lambda *_: 0)})()
    start, _ = env.reset()
    assert env.observation_space.contains(start)
    seen = [env.step(np.zeros(2, np.float32))[0][:2] for _ in range(20)]
    (twin,) = replay([motion], robot, nthread=1)
    np.testing.assert_allclose(seen, twin.qpos[1:21], atol=1e-6)
