"""Before all training: the statistics of the inputs, and the sensor predictor, fitted to what the simulator really
answers at visited and at random states."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gaponet.base.arrays import Array, copy_array, to_numpy
from gaponet.base.errors import UsageError
from gaponet.nn.layers import DeltaNet
from gaponet.nn.sensor import ProbeOracle
from gaponet.nn.training import ranks
from gaponet.nn.training.env import DeltaEnv
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import Condition

STEPS = 600
BATCH = 256
POSITION_NOISE, VELOCITY_NOISE = 0.05, 0.3  # rad, rad/s: a third of the states is moved off the recorded ones by these
Report = dict[str, Any]  # R² on held-out states {"mean", "by_joint": {name: …}, "by_probe": […]}


def fit_inputs(
    net: DeltaNet, env: DeltaEnv, x: torch.Tensor, states: int, seed: int, nthread: int = 0
) -> Report | None:
    """Before all training: statistics of the inputs from samples x, (N, dim), and on them the sensor predictor.

    Args:
        net: One that has no statistics yet.
        env: The environment whose simulator is asked.

    Returns:
        Its R² on held-out states; None for a network without one.
    """
    net.cpu().fit_inputs(x.cpu())  # the sensors to be predicted are C MuJoCo's answers
    ranks.pool(net)
    report = None if net.predictor is None else _fitted_sensors(net, env, states, seed, nthread)
    net.to(x.device)
    return report


def refit_sensors(net: DeltaNet, env: DeltaEnv, states: int, seed: int, nthread: int = 0) -> Report:
    """Fit the sensor predictor on, at the states where the environment stands and around them; returns held-out R²."""
    device = next(net.parameters()).device
    report = _fitted_sensors(net.cpu(), env, states, seed, nthread, again=True)
    net.to(device)
    return report


def _fitted_sensors(net: DeltaNet, env: DeltaEnv, states: int, seed: int, nthread: int, again: bool = False) -> Report:
    report = ranks.once(lambda: _fit_sensors(net, env, states, seed, nthread, again))
    net.predictor.requires_grad_(False)
    ranks.spread(net.predictor)
    return report


def _fit_sensors(net: DeltaNet, env: DeltaEnv, states: int, seed: int, nthread: int, again: bool) -> Report:
    """Fit the predictor at recorded start states and around them, or `again` at the present states of the environment
    and around them; returns held-out R²."""
    if states < 8:
        raise UsageError(f"--warm-start.sensor-states {states}: too few to fit a predictor on; give 8 or more")
    rng = np.random.default_rng(seed)
    xs: list[Array] = []
    qs: list[Array] = []
    vs: list[Array] = []
    while sum(map(len, xs)) < states:
        if not again:
            env.reset()
        xs.append(to_numpy(env.get_observations()["actor"]))
        qs.append(copy_array(to_numpy(env.sim.qpos)))
        vs.append(copy_array(to_numpy(env.sim.qvel)))
    x, q, v = (np.concatenate(part) for part in (xs, qs, vs))
    of = np.tile(np.arange(env.num_envs), len(xs))  # environment of each state
    pick = np.sort(rng.permutation(len(x))[:states])
    shuffled = rng.permutation(pick)
    third = rng.integers(0, 3, len(x))
    if again:  # the same states once more: moved, so that none is both fitted and held out
        third[env.num_envs :] = 1 + third[env.num_envs :] % 2
    asked = _sensor_labels(
        net,
        env.robot,
        x[shuffled],
        q[shuffled],
        v[shuffled],
        [env.conditions[g] for g in env.group[of[shuffled]]],
        env.locked,
        third[shuffled],
        seed,
        nthread,
    )
    return _fit_predictor(net, asked, env.robot.operated, seed, again)


@dataclass(frozen=True)
class _Answers:
    """States, and what the simulator answered there.

    Attributes:
        seen: What the predictor is given, (k, …).
        answers: (k, 2nm); where probes are learned, (k, 2n).
    """

    seen: Tensor
    answers: Tensor

    def __getitem__(self, rows: Any) -> _Answers:
        return _Answers(self.seen[rows], self.answers[rows])


def _sensor_labels(
    net: DeltaNet,
    robot: RobotSpec,
    x: Array,
    qpos: Array,
    qvel: Array,
    conditions: list[Condition],
    locked: tuple[str, ...],
    third: Array,
    seed: int,
    nthread: int = 0,
) -> _Answers:
    """Return predictor inputs and the simulator's answers: at these states, near them, or anywhere.

    "Anywhere" moves the whole frame, history and action included, to a random posture within the joint limits: gravity
    and inertia there are asked of the simulator, since no recorded motion needs to have been there.

    Where probes are learned, each state is asked at random ones, and each of these is a row of the predictor's inputs.

    Args:
        net: Its config says the probes.
        x: What the network was given at those states, (k, dim).
        qpos, qvel: All joints that are not locked, (k, n_free).
        third: 0 at the state, 1 near it, 2 anywhere, (k,).
    """
    rng = np.random.default_rng(seed)
    oracle, n, at = ProbeOracle(robot, net.config, conditions, nthread, locked), net.n, net.features.layout
    op = oracle.operated
    q, v, x = qpos.copy(), qvel.copy(), x.copy()
    near, far = np.flatnonzero(third == 1), np.flatnonzero(third == 2)
    q[np.ix_(near, op)] += rng.normal(0, POSITION_NOISE, (len(near), n))
    v[np.ix_(near, op)] += rng.normal(0, VELOCITY_NOISE, (len(near), n))
    x[:, at.q], x[:, at.v] = q[:, op], v[:, op]
    low, high = np.clip(robot.qpos_range[robot.operated_index].T, -np.pi, np.pi)
    shift = rng.uniform(low, high, (len(far), n)) - q[np.ix_(far, op)]
    q[np.ix_(far, op)] += shift
    x[far] += at.shifted(shift)
    with torch.inference_mode():
        seen = net.sensor_inputs(torch.from_numpy(x.astype(np.float32)))
    offsets, m = None, net.config.num_probes
    if net.config.sensor_source == "learned":
        probes = rng.uniform(-1, 1, (len(q), m, n)) * (rng.random((len(q), m, n)) < rng.random((len(q), m, 1)))
        offsets = net.config.probe_limit * probes
        seen = torch.cat([seen.repeat_interleave(m, 0), torch.from_numpy(probes).float().flatten(0, 1)], dim=1)
    return _Answers(seen.clone(), torch.from_numpy(oracle(q, v, offsets).reshape(len(seen), -1)))


def _fit_predictor(net: DeltaNet, asked: _Answers, joints: tuple[str, ...], seed: int, again: bool) -> Report:
    """Gaussian likelihood on three quarters of the states; returns R² on the rest.

    Fitted `again`, it keeps the units of sensor values, which the branch has learned. Between fits it is frozen: PPO
    must not bend what the simulator would say into what the policy would like.
    """
    predictor = net.predictor
    generator = torch.Generator().manual_seed(seed)
    held = len(asked.seen) // 4
    train = asked[held:]
    if not again:
        predictor.outputs.fit(train.answers, floor=1e-6)
    target = predictor.outputs(train.answers)
    parameters = list(predictor.parameters())
    for p in parameters:
        p.requires_grad_(True)
    optimiser = torch.optim.Adam(parameters, lr=1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS)
    for _ in range(STEPS):
        batch = torch.randint(0, len(target), (BATCH,), generator=generator)
        mean, log_var = predictor(train.seen[batch])
        loss = 0.5 * ((mean - target[batch]) ** 2 * (-log_var).exp() + log_var).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    for p in parameters:
        p.requires_grad_(False)
    return _explained(net, asked[:held], joints)


def _explained(net: DeltaNet, asked: _Answers, joints: tuple[str, ...]) -> Report:
    """R² of the predictor's mean: the share of the answers' variance over these states, averaged over sensor values."""
    with torch.inference_mode():
        truth = net.predictor.outputs(asked.answers)
        residual = ((net.predictor(asked.seen)[0] - truth) ** 2).mean(0)
        spread = ((truth - truth.mean(0)) ** 2).mean(0).clamp_min(1e-9)
        r2 = (1 - residual / spread).reshape(-1, 2, len(joints))  # (m, positions and velocities, n)
        by_joint = dict(zip(joints, r2.mean((0, 1)).tolist(), strict=True))
        return {"mean": float(r2.mean()), "by_joint": by_joint, "by_probe": r2.mean((1, 2)).tolist()}
