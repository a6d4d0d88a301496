"""Fit the sensor predictor to what the simulator really answers, at visited and at random states."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gaponet.model.layers import DeltaNet
from gaponet.model.sensor import ProbeOracle
from gaponet.robot import RobotSpec
from gaponet.sim.batch import Condition

Array = np.ndarray

STATES = 2048
STEPS = 600
BATCH = 256
POSITION_NOISE, VELOCITY_NOISE = 0.05, 0.3  # rad, rad/s: a third of the states is moved off the recorded ones by these


def sensor_labels(
    net: DeltaNet,
    robot: RobotSpec,
    x: Array,
    qpos: Array,
    qvel: Array,
    conditions: list[Condition],
    locked: tuple[str, ...],
    seed: int,
) -> tuple[Tensor, Tensor]:
    """Standardised features and oracle answers: a third at recorded states, a third near them, a third anywhere.

    "Anywhere" moves the whole frame, history and action included, to a random posture within the joint limits: gravity
    and inertia there are asked of the simulator, since no recorded motion needs to have been there.

    Args:
        net: Its config says the probes.
        robot: The simulator asked.
        x: [o_t | a_t] at those states, (k, dim).
        qpos, qvel: All joints that are not locked, (k, n_free).
        conditions: Payload and period of each state.
        locked: Joints clamped in the simulator.
        seed: Of the perturbations.
    """
    rng = np.random.default_rng(seed)
    third = rng.integers(0, 3, len(qpos))
    oracle, n = ProbeOracle(robot, net.config, conditions, locked=locked), net.n
    op = oracle.operated
    q, v, x = qpos.copy(), qvel.copy(), x.copy()
    near, far = np.flatnonzero(third == 1), np.flatnonzero(third == 2)
    q[np.ix_(near, op)] += rng.normal(0, POSITION_NOISE, (len(near), n))
    v[np.ix_(near, op)] += rng.normal(0, VELOCITY_NOISE, (len(near), n))
    x[near, :n], x[near, n : 2 * n] = q[np.ix_(near, op)], v[np.ix_(near, op)]
    low, high = np.clip(robot.qpos_range[robot.operated_index].T, -np.pi, np.pi)
    shift = rng.uniform(low, high, (len(far), n)) - q[np.ix_(far, op)]
    q[np.ix_(far, op)] += shift
    x[far] += shift_positions(shift, net.config.history, x.shape[1])
    answers = oracle(q, v)
    with torch.inference_mode():
        features = net.features(torch.from_numpy(x.astype(np.float32)))
    return features.clone(), torch.from_numpy(answers.reshape(len(q), -1))


def shift_positions(shift: Array, history: int, dim: int) -> Array:
    """What moving every position and target of [o_t | a_t] by shift (k, n) adds to it, (k, dim)."""
    n, out = shift.shape[1], np.zeros((len(shift), dim))
    out[:, :n] = out[:, -n:] = shift
    for frame in range(history):
        start = 2 * n + 3 * n * frame
        out[:, start : start + n] = out[:, start + 2 * n : start + 3 * n] = shift
    return out


def fit_predictor(net: DeltaNet, features: Tensor, answers: Tensor, seed: int) -> float:
    """Gaussian likelihood on three quarters of the states; returns R² on the rest, averaged over sensor values.

    The predictor is then frozen: PPO must not bend what the simulator would say into what the policy would like.
    """
    predictor = net.predictor
    assert predictor is not None
    generator = torch.Generator().manual_seed(seed)
    held = len(features) // 4
    train_x, train_s = features[held:], answers[held:]
    predictor.outputs.fit(train_s, floor=1e-6)
    target = predictor.outputs(train_s)
    parameters = list(predictor.parameters())
    for p in parameters:
        p.requires_grad_(True)
    optimiser = torch.optim.Adam(parameters, lr=1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS)
    for _ in range(STEPS):
        batch = torch.randint(0, len(train_x), (BATCH,), generator=generator)
        mean, log_var = predictor(train_x[batch])
        loss = 0.5 * ((mean - target[batch]) ** 2 * (-log_var).exp() + log_var).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    for p in parameters:
        p.requires_grad_(False)
    with torch.inference_mode():
        truth = predictor.outputs(answers[:held])
        residual = ((predictor(features[:held])[0] - truth) ** 2).mean(0)
        spread = ((truth - truth.mean(0)) ** 2).mean(0).clamp_min(1e-9)
        return float((1 - residual / spread).mean())
