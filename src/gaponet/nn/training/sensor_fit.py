"""Fit of the input statistics and of the sensor predictor, before the other training.

The predictor learns the simulator's answers to probes at visited and at random states.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gaponet.base.arrays import Array, copy_array, to_numpy
from gaponet.base.errors import UsageError
from gaponet.nn.layers import DeltaNet
from gaponet.nn.sensor import ProbeOracle
from gaponet.nn.training.env import DeltaEnv
from gaponet.robot.spec import RobotSpec

FIT_STEPS = 600  # gradient steps
BATCH_SIZE = 256
LEARNING_RATE = 1e-3
MIN_STATES = 8
# σ of the states near recorded ones
POSITION_NOISE_RAD = 0.05
VELOCITY_NOISE_RAD_S = 0.3
# R² on held-out states {"mean", "by_joint": {name: …}, "by_probe": […]}
SensorReport = dict[str, Any]

# Origin of a state; 0 for one that was visited.
NEAR = 1
RANDOM = 2


def fit_inputs(
    net: DeltaNet, env: DeltaEnv, x: Tensor, states: int, seed: int, nthread: int = 0
) -> SensorReport | None:
    """Fit input statistics to samples x, (N, dim), and then the sensor predictor.

    Args:
        net: A network without statistics.
        env: Its simulator answers the probes, at recorded start states and around them.
        states: Number of probed states.

    Returns:
        R² of the sensor predictor on held-out states; None for a network without one.
    """
    net.cpu().fit_inputs(x.cpu())
    net.to(x.device)
    return fit_sensors(net, env, states, seed, nthread)


def fit_sensors(
    net: DeltaNet,
    env: DeltaEnv,
    states: int,
    seed: int,
    nthread: int = 0,
    refit: bool = False,
    steps: int = FIT_STEPS,
) -> SensorReport | None:
    """Fit the sensor predictor; on `refit`, continue its fit at the environment's present states.

    Further arguments and the result are as above.

    Args:
        steps: Number of gradient steps. In a simulator that the predictor has not seen, 600 are
            too few; the report says so.
    """
    if net.predictor is None:
        return None
    device = next(net.parameters()).device
    net.cpu()  # C MuJoCo answers the probes
    probed = probe_states(net, env, states, seed, nthread, refit)
    report = _fit_predictor(net, *probed, env.robot.operated, seed, refit, steps)
    net.predictor.requires_grad_(False)
    net.to(device)
    return report


def probe_states(
    net: DeltaNet, env: DeltaEnv, states: int, seed: int, nthread: int, refit: bool
) -> tuple[Tensor, Tensor]:
    """Probe the simulator at recorded start states, or on `refit` at the environment's present
    states.

    A third of the states stays there. A third is moved by noise, away from its recorded state. A
    third is moved to a random posture within the joint limits, with history, action and recorded
    state. So the predictor also learns gravity and inertia where no motion was recorded.

    Returns:
        Inputs of the predictor, (k, …), and the simulator's answers, (k, 2nm), or (k, 2n) for
        learned probes: each is one row of the inputs.
    """
    if states < MIN_STATES:
        raise UsageError(
            f"--pretraining.sensor-states {states}: too few to fit a predictor on; give "
            f"{MIN_STATES} or more"
        )
    visited = _visited_states(env, states, reset=not refit)
    count = len(visited.x)
    rng = np.random.default_rng(seed)
    chosen = rng.permutation(np.sort(rng.permutation(count)[:states]))
    origin = rng.integers(0, 3, count)
    if refit:
        # The same states repeat: the copies are moved, so that none is both fitted and held out.
        origin[env.num_envs :] = NEAR + origin[env.num_envs :] % 2
    origin = origin[chosen]
    groups = env.groups.of_env[visited.env[chosen]]
    conditions = [env.groups.conditions[group] for group in groups]
    oracle = ProbeOracle(env.robot, net.config, conditions, nthread, env.rows.locked)
    sample = visited.rows(chosen)

    rng = np.random.default_rng(seed)
    near = np.flatnonzero(origin == NEAR)
    far = np.flatnonzero(origin == RANDOM)
    _add_noise(sample, near, net, oracle.operated, rng)
    _move_to_random_postures(sample, far, net, env.robot, oracle.operated, rng)
    with torch.inference_mode():
        inputs = net.sensor_inputs(torch.from_numpy(sample.x.astype(np.float32)))
    offsets = None
    if net.config.sensor_source == "learned":
        probes = _random_probes(len(sample.x), net.config.num_probes, net.n, rng)
        offsets = net.config.probe_limit * probes
        repeated = inputs.repeat_interleave(net.config.num_probes, 0)
        inputs = torch.cat([repeated, torch.from_numpy(probes).float().flatten(0, 1)], dim=1)
    answers = oracle(sample.qpos, sample.qvel, offsets)
    return inputs.clone(), torch.from_numpy(answers.reshape(len(inputs), -1))


class _States(NamedTuple):
    """States of an environment's simulations, k rows.

    Attributes:
        x: Inputs of the network, (k, dim).
        qpos, qvel: Joints that are not locked, (k, n_free) rad, rad/s.
        env: Simulation that each row was in, (k,).
    """

    x: Array
    qpos: Array
    qvel: Array
    env: Array

    def rows(self, chosen: Array) -> _States:
        """Return a copy of some rows."""
        return _States(*(values[chosen] for values in self))


def _visited_states(env: DeltaEnv, count: int, reset: bool) -> _States:
    """Return at least `count` states; reset: each time at other recorded rows."""
    x: list[Array] = []
    qpos: list[Array] = []
    qvel: list[Array] = []
    while len(x) * env.num_envs < count:
        if reset:
            env.reset()
        x.append(to_numpy(env.get_observations()["actor"]))
        qpos.append(copy_array(to_numpy(env.sim.qpos)))
        qvel.append(copy_array(to_numpy(env.sim.qvel)))
    env_of_state = np.tile(np.arange(env.num_envs), len(x))
    return _States(np.concatenate(x), np.concatenate(qpos), np.concatenate(qvel), env_of_state)


def _add_noise(
    sample: _States, near: Array, net: DeltaNet, op: Array, rng: np.random.Generator
) -> None:
    """Move states away from their recorded ones by noise.

    Args:
        near: Rows to move.
        op: Operated joints in qpos.
    """
    layout = net.features.layout
    position_noise = rng.normal(0, POSITION_NOISE_RAD, (len(near), net.n))
    velocity_noise = rng.normal(0, VELOCITY_NOISE_RAD_S, (len(near), net.n))
    sample.qpos[np.ix_(near, op)] += position_noise
    sample.qvel[np.ix_(near, op)] += velocity_noise
    if net.config.observes_real_state:
        # These columns are relative to q and v. They stay zero where the recorded state is hidden.
        real = sample.x[near, layout.real]
        visible = real[:, -1:]
        real[:, :-1] -= visible * np.hstack([position_noise, velocity_noise])
        sample.x[near, layout.real] = real
    sample.x[:, layout.q] = sample.qpos[:, op]
    sample.x[:, layout.v] = sample.qvel[:, op]


def _move_to_random_postures(
    sample: _States,
    far: Array,
    net: DeltaNet,
    robot: RobotSpec,
    op: Array,
    rng: np.random.Generator,
) -> None:
    """Move states to random postures within the joint limits, with history and targets.

    Args:
        far: Rows to move.
        op: Operated joints in qpos.
    """
    low, high = np.clip(robot.qpos_range[robot.operated_index].T, -np.pi, np.pi)
    shift = rng.uniform(low, high, (len(far), net.n)) - sample.qpos[np.ix_(far, op)]
    sample.qpos[np.ix_(far, op)] += shift
    sample.x[far] += net.features.layout.shifted(shift)


def _random_probes(states: int, probes: int, n: int, rng: np.random.Generator) -> Array:
    """Return probes that each move a random subset of the joints, (states, probes, n) in ±1."""
    sizes = rng.uniform(-1, 1, (states, probes, n))
    moves = rng.random((states, probes, n)) < rng.random((states, probes, 1))
    return sizes * moves


def _fit_predictor(
    net: DeltaNet,
    inputs: Tensor,
    answers: Tensor,
    joints: tuple[str, ...],
    seed: int,
    refit: bool,
    steps: int,
) -> SensorReport:
    """Maximise the Gaussian likelihood on three quarters of the samples; return R² on the rest.

    `refit` keeps the scale of the sensor values, because the branch net has learned it. PPO does
    not train the predictor: it would change the predicted answers in favour of the policy.
    """
    predictor = net.predictor
    held_out = len(inputs) // 4
    generator = torch.Generator().manual_seed(seed)
    if not refit:
        predictor.outputs.fit(answers[held_out:], min_std=1e-6)
    target = predictor.outputs(answers[held_out:])
    train = inputs[held_out:]
    predictor.requires_grad_(True)
    optimiser = torch.optim.Adam(predictor.parameters(), lr=LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(steps):
        batch = torch.randint(0, len(target), (BATCH_SIZE,), generator=generator)
        mean, log_var = predictor(train[batch])
        loss = 0.5 * ((mean - target[batch]) ** 2 * (-log_var).exp() + log_var).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    with torch.inference_mode():
        truth = predictor.outputs(answers[:held_out])
        residual = ((predictor(inputs[:held_out])[0] - truth) ** 2).mean(0)
        variance = ((truth - truth.mean(0)) ** 2).mean(0).clamp_min(1e-9)
        # (m, positions and velocities, n)
        r2 = (1 - residual / variance).reshape(-1, 2, len(joints))
        by_joint = dict(zip(joints, r2.mean((0, 1)).tolist(), strict=True))
        return {
            "mean": float(r2.mean()),
            "by_joint": by_joint,
            "by_probe": r2.mean((1, 2)).tolist(),
        }
