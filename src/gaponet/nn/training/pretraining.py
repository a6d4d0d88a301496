"""Supervised pre-training: regression of labels on visited states (DAgger, Ross et al. 2011).

In the first round, rollouts apply the label corrections. In later rounds they apply the present
network. Each visited state gets the label of its recorded row (`trajectory_labels`). The servos are
stable, so that label also holds for a state that has drifted. Each round adds the visited states to
a pool and fits the network to the whole pool.

Inputs are noisy during the fit. Past corrections are visible in the states that followed. Without
noise, a network reads the label from them, and its own rollouts are worse than without correction
(docs/results/unnamed.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from torch import Tensor
from torch.nn.functional import huber_loss

from gaponet.base.arrays import Array, array_module
from gaponet.data.sequence import Sequence
from gaponet.nn.layers import DeltaNet
from gaponet.nn.training.config import PretrainingConfig
from gaponet.nn.training.env import DeltaEnv
from gaponet.nn.training.sensor_fit import SensorReport, fit_inputs
from gaponet.nn.trees import TreesNet
from gaponet.robot.spec import RobotSpec
from gaponet.sim.replay import replay
from gaponet.sysid.table_contact import tip_heights

ITERATIONS = 3
LEARNING_GAIN = 0.8
LEAD_S = 0.12  # after this time a correction shows in the position
SMOOTHING_S = 0.06  # σ of the filter
HUBER_DELTA = 0.5  # in units of the RMS of the labels
# If more are visited, the pool takes a part of the environments of each period, in turn.
MAX_POOL_STATES = 2_000_000
TABLE_CLEARANCE_M = 0.01  # below it, a tip is taken to touch the table


def trajectory_labels(
    sequences: ListOf[Sequence],
    robot: RobotSpec,
    limit: float,
    nthread: int = 0,
    tick: Callable[[], object] = bool,
) -> Array:
    """Return Δa* of the operated joints within ±limit rad, (rows of all recordings, n), by
    iterative learning control.

    Each iteration simulates a whole recording under a + Δa. The error a little later, because a
    servo responds late, is smoothed and added to Δa (Arimoto, Kawamura & Miyazaki 1984; Bristow,
    Tharayil & Alleyne 2006). The labels of a recording are therefore consistent with each other. An
    inverse model of single rows is only valid at the recorded states, and a network that is fitted
    to it has a larger error (docs/results/unnamed.md).

    Each recording has the labels of its best iteration. Rows are NaN where a joint was not
    recorded, and where a tip touches the robot's table: no correction explains a contact force.

    Args:
        tick: Called in each iteration.
    """
    op = robot.operated_index
    searches = [_LabelSearch(sequence, op) for sequence in sequences]
    for iteration in range(ITERATIONS + 1):
        tick()
        commanded = [search.commanded() for search in searches]
        rollouts = replay(commanded, robot, nthread=nthread, lock_idle=True)
        for search, rollout in zip(searches, rollouts, strict=True):
            search.note(rollout.qpos)
            if iteration < ITERATIONS:
                search.improve(limit)
    labels = np.concatenate([search.best_delta for search in searches]).astype(np.float32)
    return np.where(_unlabelled(sequences, robot), np.nan, labels).astype(np.float32)


class _LabelSearch:
    """Iterative learning control of one recording.

    Attributes:
        best_delta: Corrections of the best iteration so far, (T, n) rad.
    """

    def __init__(self, sequence: Sequence, op: Array) -> None:
        """op: Joints that are corrected."""
        self._sequence = sequence
        self._op = op
        self._delta = np.zeros((len(sequence), len(op)))  # of this iteration, rad
        self._error = np.zeros_like(self._delta)  # of this iteration, rad
        self._best_cost = np.inf
        self.best_delta = self._delta

    def commanded(self) -> Sequence:
        """Return the recording with corrected targets."""
        ctrl = self._sequence.ctrl.copy()
        ctrl[:, self._op] += self._delta.astype(ctrl.dtype)
        return replace(self._sequence, ctrl=ctrl)

    def note(self, simulated: Array) -> None:
        """Note the positions that the corrections lead to, (T, n_all) rad."""
        difference = self._sequence.qpos - simulated
        self._error = difference[:, self._op].astype(float)
        cost = float(np.nan_to_num(np.abs(self._error), nan=np.pi).mean())
        if cost < self._best_cost:
            self._best_cost = cost
            self.best_delta = self._delta

    def improve(self, limit: float) -> None:
        """Correct the next iteration by the error a little later, within ±limit rad."""
        dt = self._sequence.dt
        rows = len(self._error)
        later = np.minimum(np.arange(rows) + round(LEAD_S / dt), rows - 1)
        raised = self._delta + LEARNING_GAIN * np.nan_to_num(self._error)[later]
        smooth = gaussian_filter1d(raised, SMOOTHING_S / dt, axis=0, mode="nearest")
        self._delta = np.clip(smooth, -limit, limit)


def _unlabelled(sequences: ListOf[Sequence], robot: RobotSpec) -> Array:
    """Return the rows and joints without a label, (rows of all recordings, n) bool."""
    parts = []
    for sequence in sequences:
        unrecorded = [joint in sequence.meta.unrecorded for joint in robot.operated]
        parts.append(np.tile(unrecorded, (len(sequence), 1)))
    unlabelled = np.concatenate(parts)
    if robot.scene.table is not None:
        heights = np.concatenate(tip_heights(sequences, robot))
        unlabelled[heights < robot.scene.table.height + TABLE_CLEARANCE_M] = True
    return unlabelled


class VisitedStates(NamedTuple):
    """States of rollouts, with their labels.

    Attributes:
        x: Inputs of the network, (states, dim).
        labels: Δa*, (states, n) rad; NaN where there is none.
    """

    x: Tensor
    labels: Tensor

    def followed_by(self, later: VisitedStates) -> VisitedStates:
        """Return these and later states."""
        return VisitedStates(torch.cat([self.x, later.x]), torch.cat([self.labels, later.labels]))


class Pretraining:
    """Pool of visited states, and the optimiser.

    `round` extends the pool and fits the network to it.

    Attributes:
        labels: Δa* of each row of the environment's recordings, (rows, n) rad, on its device.
        label_rms: Their root mean square, rad.
        pool: States that the rollouts of all rounds visited; None before round 1.
        rollout_states: Network and random numbers before the rollouts of each round.
    """

    def __init__(
        self,
        net: DeltaNet,
        env: DeltaEnv,
        labels: Array,
        config: PretrainingConfig,
        seed: int,
        nthread: int = 0,
    ) -> None:
        """labels: Δa* of each row of the environment's recordings, (rows, n) rad."""
        self.net = net
        self.env = env
        self.config = config
        self.seed = seed
        self.nthread = nthread
        labels = _mean_over_hold(labels, env.config.delta_hold)
        self.labels: Any = env.sim.array(labels)
        self.label_rms = float(np.sqrt(np.nanmean(np.square(labels)))) or 1.0
        self.generator = torch.Generator().manual_seed(seed)
        self.pool: VisitedStates | None = None
        fitted = []
        for name, parameter in net.named_parameters():
            if not name.startswith(("predictor", "probes")):
                fitted.append(parameter)
        self.optimiser = torch.optim.AdamW(
            fitted, lr=config.learning_rate, weight_decay=config.weight_decay
        )
        self.rollout_states: list[dict[str, Any]] = []

    @property
    def rounds_done(self) -> int:
        """Number of completed rounds."""
        return len(self.rollout_states)

    def fit_inputs(self) -> SensorReport | None:
        """Fit input statistics and the sensor predictor on a rollout with label corrections.

        Call before round 1.
        """
        visited = self.rollout(follow_labels=True)
        self.net.bounded.scale.fill_(self.label_rms)
        x = visited.x
        return fit_inputs(self.net, self.env, x, self.config.sensor_states, self.seed, self.nthread)

    def rollout(self, follow_labels: bool) -> VisitedStates:
        """Simulate config.steps control periods; environments restart where their recording ends.

        follow_labels: Apply the labels instead of the network's corrections.
        """
        env = self.env
        net = self.net
        hold = self.env.config.delta_hold
        steps = max(self.config.steps // hold, 1)
        env.reset()
        net.eval()
        xs: list[Tensor] = []
        ys: list[Tensor] = []
        every = math.ceil(self.config.rounds * steps * env.num_envs / MAX_POOL_STATES) or 1
        for t in range(steps):
            subset = slice(t % every, None, every)
            x = env.get_observations()["actor"]
            labels = self.labels[env.playback.row_on_device] + env.reward.nan_where_unobserved
            xs.append(x[subset].contiguous())
            ys.append(torch.as_tensor(labels[subset], device=x.device))
            if follow_labels:
                delta = array_module(labels).nan_to_num(labels)
            else:
                with torch.inference_mode():
                    delta = net(x)
            for _ in range(hold):
                env.advance(delta)
            env.restart()
        return VisitedStates(torch.cat(xs), torch.cat(ys))

    def round(self, tick: Callable[[], object]) -> dict[str, float]:
        """Extend the pool by rollouts, and fit the network to the pool.

        Args:
            tick: Called after each gradient step.

        Returns:
            RMSE of the labels, rad, in the last quarter of the gradient steps and in the quarter
            before. The fit has converged if both are equal.
        """
        before = {
            "net": {k: x.clone() for k, x in self.net.state_dict().items()},
            "rng": self.env.rng_state(),
        }
        pool = self._extend_pool(follow_labels=self.rounds_done == 0)
        self.rollout_states.append(before)
        if isinstance(self.net, TreesNet):
            squares = self.net.fit(pool.x, pool.labels, self.seed)
        else:
            squares = self._fit(pool, tick)
        quarter = max(len(squares) // 4, 1)
        last = squares[-quarter:]
        earlier = squares[-2 * quarter : -quarter]
        return {"label_rmse": _rms(last), "label_rmse_before": _rms(earlier)}

    def _extend_pool(self, follow_labels: bool) -> VisitedStates:
        """Add the states of a rollout to the pool, and return the pool."""
        visited = self.rollout(follow_labels)
        self.pool = visited if self.pool is None else self.pool.followed_by(visited)
        return self.pool

    def _fit(self, pool: VisitedStates, tick: Callable[[], object]) -> Array:
        """Fit the network to the pool.

        Return the mean squared label error of each gradient step, rad².
        """
        config = self.config
        net = self.net
        x = pool.x
        labels = pool.labels
        # On the device until the last step: reading it in each step would wait.
        squares = torch.zeros(config.gradient_steps, dtype=torch.double, device=x.device)
        net.train()
        net.features.noise_std = config.noise
        for step in range(config.gradient_steps):
            cosine = 0.5 + 0.5 * math.cos(math.pi * step / config.gradient_steps)
            for group in self.optimiser.param_groups:
                group["lr"] = config.learning_rate * (0.01 + 0.99 * cosine)
            batch = torch.randint(0, len(x), (config.batch_size,), generator=self.generator)
            batch = batch.to(x.device, non_blocking=True)
            error = torch.nan_to_num(net(x[batch]) - labels[batch])
            loss = huber_loss(error / self.label_rms, torch.zeros_like(error), delta=HUBER_DELTA)
            self.optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            self.optimiser.step()
            squares[step] = error.detach().square().mean()
            tick()
        net.features.noise_std = 0.0
        net.eval()
        return squares.cpu().numpy()

    def state_dict(self) -> dict[str, Any]:
        """Return the state between rounds, for a checkpoint.

        The pool has hundreds of megabytes. It is not stored: the networks of all rounds are, and
        roll out again.
        """
        return {
            "rounds": list(self.rollout_states),
            "optimiser": self.optimiser.state_dict(),
            "generator": self.generator.get_state(),
            "env_rng": self.env.rng_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state, and the pool by new rollouts. The network stays as it is."""
        present = {name: x.clone() for name, x in self.net.state_dict().items()}
        for i, before in enumerate(state["rounds"]):
            self.net.load_state_dict(before["net"])
            self.env.set_rng_state(before["rng"])
            self._extend_pool(follow_labels=i == 0)
        self.net.load_state_dict(present)
        self.optimiser.load_state_dict(state["optimiser"])
        self.generator.set_state(state["generator"])
        self.env.set_rng_state(state["env_rng"])
        self.rollout_states = list(state["rounds"])


def _mean_over_hold(labels: Array, hold: int) -> Array:
    """Average labels over the control periods that a correction is held: (N, n) → (N − hold + 1,
    n).

    Averages across the end of a recording are not used.
    """
    if hold == 1:
        return labels
    rows = len(labels) - hold + 1
    result: Array = np.mean([labels[i : i + rows] for i in range(hold)], axis=0)
    return result


def _rms(squares: Array) -> float:
    return float(np.sqrt(squares.mean())) if len(squares) else float("nan")
