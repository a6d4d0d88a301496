"""Supervised start: regress the labels on states that they and the policy itself lead to (DAgger, Ross et al. 2011).

The first round is led by the labels; each later one rolls the present policy out. Every visited state gets the label of
its row (nn/training/labels.py: the plant is stable about it, so it holds where the state has drifted), joins the pool,
and the whole pool is fitted under noise on the inputs. What the labels did shows in the states that they led to: a
network that is shown them exactly reads the answer there, and is worse than none when it leads itself
(docs/results/unnamed.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch.nn.functional import huber_loss

from gaponet.base.arrays import Array, array_module
from gaponet.nn.layers import DeltaNet
from gaponet.nn.training import ranks
from gaponet.nn.training.config import PretrainingConfig, TrainConfig
from gaponet.nn.training.env import DeltaEnv
from gaponet.nn.training.sensor_fit import Report, fit_inputs

HUBER = 0.5  # of what labels usually are: beyond it a label counts as its distance, not its square
MOST = 2_000_000  # states in the pool; where more are visited, some environments' are kept of each period, in turn


def recipe(config: TrainConfig) -> PretrainingConfig:
    """The warm start of a kind of model.

    The label baseline has one round, on recorded motions that the labels lead along, with the gradient steps of all
    rounds together.
    """
    warm = config.warm_start
    if config.model.kind != "inverse" or not warm.rounds:
        return warm
    return replace(warm, rounds=1, gradient_steps=warm.rounds * warm.gradient_steps)


class Pretraining:
    """The pool of visited states and the optimiser; `round` collects and fits once."""

    report: Report | None = None
    """How well the sensor predictor explains the simulator, where there is one."""

    def __init__(
        self,
        net: DeltaNet,
        env: DeltaEnv,
        labels: Array,
        config: PretrainingConfig,
        seed: int,
        nthread: int = 0,
    ) -> None:
        """labels: Δa* of every row of the environment's data, (N, n); a held correction has their mean."""
        self.net, self.env, self.config = net, env, config
        labels = _held(labels, env.config.delta_hold)
        self.labels: Any = env.sim.array(labels)
        self.unit = float(np.sqrt(np.nanmean(np.square(labels)))) or 1.0
        self.seed, self.nthread = seed, nthread
        self.generator = torch.Generator().manual_seed(seed)
        self.pool_x: list[torch.Tensor] = []
        self.pool_y: list[torch.Tensor] = []
        self.trained = [p for name, p in net.named_parameters() if not name.startswith(("predictor", "probes"))]
        self.optimiser = torch.optim.AdamW(self.trained, lr=config.learning_rate, weight_decay=config.weight_decay)
        self.done = 0
        self.rounds: list[dict[str, Any]] = []  # what the roll-outs of each round so far followed from

    def begin(self) -> None:
        """Before the first round: statistics of inputs, and on them the sensor predictor, where labels lead along."""
        self.collect(follow_labels=True)
        self.pool_y.clear()
        self.net.bounded.unit.fill_(self.unit)
        states = self.config.sensor_states
        self.report = fit_inputs(self.net, self.env, self.pool_x.pop(), states, self.seed, self.nthread)

    def collect(self, follow_labels: bool) -> None:
        """Roll out for config.steps, motions restarting where they end."""
        env, net, hold = self.env, self.net, self.env.config.delta_hold
        steps = max(self.config.steps // hold, 1)
        env.reset()
        net.eval()
        xs, ys, every = [], [], math.ceil(self.config.rounds * steps * env.num_envs / MOST) or 1
        for t in range(steps):
            some = slice(t % every, None, every)
            x = env.get_observations()["actor"]
            y = self.labels[env.here] + env.unsaid
            xs.append(x[some].contiguous())
            ys.append(torch.as_tensor(y[some], device=x.device))
            if follow_labels:
                delta = array_module(y).nan_to_num(y)
            else:
                with torch.inference_mode():
                    delta = net(x)
            for _ in range(hold):
                env.advance(delta)
            env.restart()
        self.pool_x.append(torch.cat(xs))
        self.pool_y.append(torch.cat(ys))

    def round(self, tick: Callable[[], object]) -> dict[str, float]:
        """Collect with the present policy, fit on the pool.

        Returns:
            RMSE of the labels, rad, over the last quarter of the gradient steps and over the quarter before it: a fit
            that is done has both alike.

        tick is called after every gradient step.
        """
        before = {"net": {k: x.clone() for k, x in self.net.state_dict().items()}, "rng": self.env.rng_state}
        self.collect(follow_labels=self.done == 0)
        self.pool_x, self.pool_y = [torch.cat(self.pool_x)], [torch.cat(self.pool_y)]  # once in memory
        x, y, config, net = self.pool_x[0], self.pool_y[0], self.config, self.net
        fits = torch.zeros(config.gradient_steps, dtype=torch.double, device=x.device)  # read when all are done
        net.train()
        net.features.noise = config.noise
        for step in range(config.gradient_steps):
            done = step / config.gradient_steps
            for group in self.optimiser.param_groups:
                group["lr"] = config.learning_rate * (0.01 + 0.99 * (0.5 + 0.5 * math.cos(math.pi * done)))
            batch = torch.randint(0, len(x), (config.batch_size,), generator=self.generator)
            batch = batch.to(x.device, non_blocking=True)
            missed = torch.nan_to_num(net(x[batch]) - y[batch])
            loss = huber_loss(missed / self.unit, torch.zeros_like(missed), delta=HUBER)
            self.optimiser.zero_grad()
            loss.backward()
            ranks.average(*(p.grad for p in self.trained if p.grad is not None))
            self.optimiser.step()
            fits[step] = missed.detach().square().mean()
            tick()
        net.features.noise = 0.0
        net.eval()
        self.done += 1
        self.rounds.append(before)
        losses = fits.cpu().numpy()
        quarter = max(len(losses) // 4, 1)
        last, earlier = losses[-quarter:], losses[-2 * quarter : -quarter]
        return {"label_rmse": _rms(last), "label_rmse_before": _rms(earlier)}

    def state(self) -> dict[str, Any]:
        """A warm start between rounds. Its pool is hundreds of megabytes and follows from the networks that collected
        it, so those are kept and roll out again."""
        return {
            "rounds": list(self.rounds),
            "optimiser": self.optimiser.state_dict(),
            "generator": self.generator.get_state(),
            "env_rng": self.env.rng_state,
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Roll the past rounds out again, then undo `state`; the network is left as it is."""
        present = {name: x.clone() for name, x in self.net.state_dict().items()}
        for i, before in enumerate(state["rounds"]):
            self.net.load_state_dict(before["net"])
            self.env.rng_state = before["rng"]
            self.collect(follow_labels=i == 0)
        self.net.load_state_dict(present)
        self.optimiser.load_state_dict(state["optimiser"])
        self.generator.set_state(state["generator"])
        self.env.rng_state = state["env_rng"]
        self.rounds, self.done = list(state["rounds"]), len(state["rounds"])


def _held(labels: Array, hold: int) -> Array:
    """Mean of the labels of rows t … t + hold − 1, (N, n) → (N − hold + 1, n); across motions it is never used."""
    return np.mean([labels[i : len(labels) - hold + 1 + i] for i in range(hold)], axis=0) if hold > 1 else labels


def _rms(losses: Array) -> float:
    return float(np.sqrt(ranks.mean(losses.mean())[0])) if len(losses) else float("nan")
