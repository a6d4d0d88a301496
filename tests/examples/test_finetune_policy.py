"""The fine-tuning example on a two-joint arm."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from arm import commands, write_arm

from gaponet.deploy.aligned_sim import AlignedSim, AlignedSimOptions
from gaponet.virtual.physics import neutral

FILE = Path(__file__).parents[2] / "examples" / "finetune_policy.py"
SPEC = importlib.util.spec_from_file_location("finetune_policy", FILE)
ONE_THREAD = AlignedSimOptions(nthread=1)
example = importlib.util.module_from_spec(SPEC)
sys.modules[SPEC.name] = example  # its dataclass looks itself up there
SPEC.loader.exec_module(example)


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return write_arm(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def task(robot):
    return example.Task(robot, [commands(120, seed) for seed in range(2)], 0.4)


class Reader:
    """A policy that sends what the nominal model says the reference takes."""

    def __init__(self, task):
        self.n = task.n

    def get_inference_policy(self):
        return lambda obs: obs["policy"][:, 3 * self.n : 4 * self.n]


def test_the_feed_forward_it_is_told_is_right_for_the_nominal_simulator(robot, task):
    sim = AlignedSim(robot, None, np.array([0.0, 0.4]), num_envs=2, options=ONE_THREAD)
    alone = example.follow(task, sim, None)
    fed = example.follow(task, sim, Reader(task))
    assert (fed < 0.35 * alone).all()


def test_it_is_as_good_on_a_robot_that_is_like_the_simulator(robot, task):
    unit = example.Unit(robot, task, neutral(2), np.array([0.0, 0.4]))
    sim = AlignedSim(robot, None, np.array([0.0, 0.4]), num_envs=2, options=ONE_THREAD)
    on_unit, in_sim = (example.follow(task, plant, Reader(task)) for plant in (unit, sim))
    np.testing.assert_allclose(on_unit, in_sim, atol=2e-3)


def test_ppo_learns_to_hold_the_arm_up_and_hands_its_policy_on(robot, task):
    torch.manual_seed(0)
    mass = np.full(32, 0.4)
    env = example.TrackingEnv(
        task, AlignedSim(robot, None, mass, num_envs=32, options=ONE_THREAD), seed=0
    )
    policy = example.train("nominal", example.make_runner(env), env, 20)
    sim = AlignedSim(robot, None, np.array([0.4, 0.4]), num_envs=2, options=ONE_THREAD)
    learnt = example.follow(task, sim, policy)
    assert learnt.mean() < 0.9 * example.follow(task, sim, None).mean()
    weaker = AlignedSim(
        robot.with_servo(kp=0.8 * robot.servo.kp), None, mass, num_envs=32, options=ONE_THREAD
    )
    on = example.make_runner(example.TrackingEnv(task, weaker, seed=0), policy)
    np.testing.assert_array_equal(example.follow(task, sim, on), learnt)


def test_half_of_the_simulations_receive_their_targets_a_control_period_later(robot, task):
    def environment(late):
        sim = AlignedSim(robot, None, np.zeros(2), num_envs=2, options=ONE_THREAD)
        return example.TrackingEnv(task, sim, 0, np.array(late))

    still = torch.zeros(2, task.n)
    punctual = environment([False, False])
    mixed = environment([False, True])
    positions = []
    for env in (punctual, mixed):
        for _ in range(10):
            env.step(still)
        positions.append(env.sim.qpos)
    np.testing.assert_array_equal(positions[1][0], positions[0][0])
    assert np.abs(positions[1][1] - positions[0][1]).max() > 1e-3


def test_a_fast_swing_is_an_oscillation_and_a_slow_error_is_none():
    time = 0.02 * np.arange(300)
    slow = np.sin(2 * np.pi * 0.4 * time)
    fast = np.sin(2 * np.pi * 7.0 * time)
    errors = np.stack([slow, fast, slow + fast], axis=1)[:, :, None]
    errors[250:, 0] = np.nan  # a motion that has ended
    shares = example.oscillating_share(errors, 0.02)
    np.testing.assert_allclose(shares, [0.0, 1.0, 0.5], atol=0.03)
