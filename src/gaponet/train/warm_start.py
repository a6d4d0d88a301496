"""Supervised start: regress the inverse labels on states that the policy visits itself (DAgger, Ross et al. 2011).

Fitted on recorded states alone, a policy meets other states as soon as it errs and errs more. So each round rolls the
present policy out, labels every visited state with u* − a of its row (train/inverse.py: right wherever the state is,
the plant being stable about u*), adds it to the pool and fits on the whole pool. The pool of the first round is driven
by the labels themselves and only seeds the second; the inverse-label baseline stops after it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from gaponet.model.layers import DeltaNet
from gaponet.robot import RobotSpec
from gaponet.train.config import TrainConfig, WarmStartConfig
from gaponet.train.env import DeltaEnv
from gaponet.train.sensor_fit import STATES, fit_predictor, sensor_labels

Array = np.ndarray


def recipe(config: TrainConfig) -> WarmStartConfig:
    """The warm start of a kind of model.

    The inverse-label baseline has one round, on recorded motions that the labels lead along, undisturbed, with the
    gradient steps of all rounds together.
    """
    warm = config.warm_start
    if config.model.kind != "inverse" or not warm.rounds:
        return warm
    return replace(warm, rounds=1, gradient_steps=warm.rounds * warm.gradient_steps, disturbance=0.0)


class WarmStart:
    """The pool of visited states and the optimiser; `round` collects and fits once."""

    def __init__(self, net: DeltaNet, env: DeltaEnv, labels: Array, config: WarmStartConfig, seed: int) -> None:
        """labels: Δa* of every row of the environment's data, (N, n)."""
        self.net, self.env, self.labels, self.config = net, env, labels, config
        self.generator = torch.Generator().manual_seed(seed)
        self.pool_x: list[torch.Tensor] = []
        self.pool_y: list[torch.Tensor] = []
        trained = [p for name, p in net.named_parameters() if not name.startswith("predictor")]
        self.optimiser = torch.optim.AdamW(trained, lr=config.learning_rate, weight_decay=config.weight_decay)
        self.done = 0

    def collect(self, follow_labels: bool) -> None:
        """Roll out for config.steps, motions restarting where they end."""
        env, net = self.env, self.net
        env.reset()
        net.eval()
        xs, ys = [], []
        disturbance = np.zeros((env.num_envs, env.num_actions), np.float32)
        for _ in range(self.config.steps):
            x = env.get_observations()["actor"]
            y = self.labels[env.row]
            xs.append(x)
            ys.append(torch.from_numpy(y))
            if follow_labels:
                delta = y
            else:
                with torch.inference_mode():
                    delta = net(x).numpy()
            env.advance(delta + self._disturb(disturbance))
            ended = np.flatnonzero(env.row >= env.last)
            if ended.size:
                env.reset(ended)
        self.pool_x.append(torch.cat(xs))
        self.pool_y.append(torch.cat(ys))

    def _disturb(self, slow: Array) -> Array:
        """Noise on the applied correction, white plus slow steps (updated in place); a quarter of the robots has none.

        A policy that sees its own past targets can learn to lean on them; disturbed, it learns what the label is
        whatever they were, and does not amplify its own noise on poses that it has not seen.
        """
        sigma, rng, shape = self.config.disturbance, self.env.rng, slow.shape
        change = rng.random(shape) < 0.02
        slow[change] = rng.normal(0, sigma, change.sum())
        noise = slow + rng.normal(0, sigma, shape).astype(np.float32)
        noise[: len(noise) // 4] = 0.0
        return noise

    def round(self, tick: Callable[[], float]) -> float:
        """Collect with the present policy, fit on the pool; returns the fit's RMSE, rad.

        tick is called after every gradient step and returns the share of the budget spent: whichever is further, rounds
        or budget, lowers the step size.
        """
        self.collect(follow_labels=self.done == 0)
        if self.done == 0:
            self.net.fit_inputs(self.pool_x[0])
        x, y = torch.cat(self.pool_x), torch.cat(self.pool_y)
        config, net, total = self.config, self.net, 0.0
        net.train()
        net.sample_sensors = True
        spent = 0.0
        for step in range(config.gradient_steps):
            progress = min(max((self.done + step / config.gradient_steps) / config.rounds, spent), 1.0)
            for group in self.optimiser.param_groups:
                group["lr"] = config.learning_rate * 0.1**progress
            batch = torch.randint(0, len(x), (config.batch_size,), generator=self.generator)
            loss = ((net(x[batch]) - y[batch]) ** 2).mean()
            self.optimiser.zero_grad()
            loss.backward()
            self.optimiser.step()
            total += loss.item()
            spent = tick()
        net.sample_sensors = False
        net.eval()
        self.done += 1
        return float(np.sqrt(total / config.gradient_steps))


def fit_sensors(net: DeltaNet, env: DeltaEnv, robot: RobotSpec, seed: int) -> float:
    """Standardise on the environment's recorded start states, fit the predictor there; returns held-out R²."""
    rng = np.random.default_rng(seed)
    xs: list[Array] = []
    qs: list[Array] = []
    vs: list[Array] = []
    groups: list[Array] = []
    while sum(map(len, xs)) < STATES:
        env.reset()
        xs.append(env.get_observations()["actor"].numpy())
        qs.append(env.sim.qpos.copy())
        vs.append(env.sim.qvel.copy())
        groups.append(env.group)
    x, q, v, group = (np.concatenate(part) for part in (xs, qs, vs, groups))
    pick = np.sort(rng.permutation(len(x))[:STATES])
    net.features.standardise.fit(net.features.relative(torch.from_numpy(x)))
    shuffled = rng.permutation(pick)
    features, answers = sensor_labels(
        net,
        robot,
        x[shuffled],
        q[shuffled],
        v[shuffled],
        [env.conditions[g] for g in group[shuffled]],
        env.locked,
        seed,
    )
    return fit_predictor(net, features, answers, seed)
