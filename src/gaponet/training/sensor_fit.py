"""Fit the sensor predictor to what the simulator really answers, at visited and at random states, and say how well.

Learned points (model/points.py) have their surrogate in the predictor's place: the same, asked at random targets.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gaponet.arrays import Array
from gaponet.family.draw import Members
from gaponet.model.layers import DeltaNet
from gaponet.model.loop import Infer
from gaponet.model.observation import Layout
from gaponet.model.sensor import ProbeOracle
from gaponet.robot import RobotSpec
from gaponet.sim.batch import Condition

STEPS = 600
BATCH = 256
POSITION_NOISE, VELOCITY_NOISE = 0.05, 0.3  # rad, rad/s: a third of the states is moved off the recorded ones by these
Report = dict[str, Any]  # R² on held-out states {"mean", "by_joint": {name: …}, "by_probe": […]}


@dataclass(frozen=True)
class Answers:
    """States, and what the simulator answered there.

    Attributes:
        features: Standardised, (k, dim).
        answers: (k, 2nm), or (k, m, 2n) where offsets are given.
        offsets: Targets of each state relative to q, (k, m, n) rad, where they are not the fixed probes.
    """

    features: Tensor
    answers: Tensor
    offsets: Tensor | None

    def __getitem__(self, rows: Any) -> Answers:
        offsets = None if self.offsets is None else self.offsets[rows]
        return Answers(self.features[rows], self.answers[rows], offsets)

    def predicted(self, net: DeltaNet) -> tuple[Tensor, Tensor]:
        """Mean and log-variance, standardised."""
        return net.predictor(self.features) if self.offsets is None else net.predictor(self.features, self.offsets)


def sensor_labels(
    net: DeltaNet,
    robot: RobotSpec,
    x: Array,
    qpos: Array,
    qvel: Array,
    conditions: list[Condition],
    locked: tuple[str, ...],
    seed: int,
    nthread: int = 0,
    members: Members | None = None,
) -> Answers:
    """Standardised features and oracle answers: a third at these states, a third near them, a third anywhere.

    "Anywhere" moves the whole frame, history and action included, to a random posture within the joint limits: gravity
    and inertia there are asked of the simulator, since no recorded motion needs to have been there.

    Args:
        net: Its config says the probes.
        x: What the network was given at those states, (k, dim).
        qpos, qvel: All joints that are not locked, (k, n_free).
        members: Of a family, whose simulator is asked, one for each state.
    """
    rng = np.random.default_rng(seed)
    third = rng.integers(0, 3, len(qpos))
    oracle, n, at = (
        ProbeOracle(robot, net.config, conditions, nthread, locked, members=members),
        net.n,
        net.features.layout,
    )
    op = oracle.operated
    q, v, x = qpos.copy(), qvel.copy(), x.copy()
    near, far = np.flatnonzero(third == 1), np.flatnonzero(third == 2)
    q[np.ix_(near, op)] += rng.normal(0, POSITION_NOISE, (len(near), n))
    v[np.ix_(near, op)] += rng.normal(0, VELOCITY_NOISE, (len(near), n))
    x[near, at.q], x[near, at.v] = q[np.ix_(near, op)], v[np.ix_(near, op)]
    low, high = np.clip(robot.qpos_range[robot.operated_index].T, -np.pi, np.pi)
    shift = rng.uniform(low, high, (len(far), n)) - q[np.ix_(far, op)]
    q[np.ix_(far, op)] += shift
    x[far] += shift_positions(shift, at)
    offsets = None
    if net.config.sensors == "learned":
        limit = net.config.probe_large
        offsets = rng.uniform(-limit, limit, (len(q), net.config.num_probes, n)).astype(np.float32)
    answers = oracle(q, v, offsets)
    with torch.inference_mode():
        features = net.features(torch.from_numpy(x.astype(np.float32)))
    return Answers(
        features.clone(),
        torch.from_numpy(answers if offsets is not None else answers.reshape(len(q), -1)),
        None if offsets is None else torch.from_numpy(offsets),
    )


def shift_positions(shift: Array, at: Layout) -> Array:
    """What moving every position and target of [o_t | a_t] by shift (k, n) adds to x, (k, dim)."""
    k, n = shift.shape
    out = np.zeros((k, at.dim))
    out[:, at.q] = out[:, at.action] = shift
    frame = np.concatenate([shift, np.zeros((k, n)), shift], axis=1)
    out[:, at.past] = np.tile(frame, (1, at.history))
    return out


def fit_predictor(net: DeltaNet, asked: Answers, joints: tuple[str, ...], seed: int) -> Report:
    """Gaussian likelihood on three quarters of the states; returns R² on the rest.

    The predictor is then frozen: PPO must not bend what the simulator would say into what the policy would like.
    """
    predictor = net.predictor
    generator = torch.Generator().manual_seed(seed)
    held = len(asked.features) // 4
    train = asked[held:]
    predictor.outputs.fit(train.answers.reshape(-1, len(predictor.outputs.mean)), floor=1e-6)
    target = predictor.outputs(train.answers)
    parameters = list(predictor.parameters())
    for p in parameters:
        p.requires_grad_(True)
    optimiser = torch.optim.Adam(parameters, lr=1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS)
    for _ in range(STEPS):
        batch = torch.randint(0, len(target), (BATCH,), generator=generator)
        mean, log_var = train[batch].predicted(net)
        loss = 0.5 * ((mean - target[batch]) ** 2 * (-log_var).exp() + log_var).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    for p in parameters:
        p.requires_grad_(False)
    return explained(net, asked[:held], joints)


def explained(net: DeltaNet, asked: Answers, joints: tuple[str, ...]) -> Report:
    """R² of the predictor's mean: the share of the answers' variance over these states, averaged over sensor values."""
    with torch.inference_mode():
        truth = net.predictor.outputs(asked.answers)
        residual = ((asked.predicted(net)[0] - truth) ** 2).mean(0)
        spread = ((truth - truth.mean(0)) ** 2).mean(0).clamp_min(1e-9)
        r2 = (1 - residual / spread).reshape(-1, 2, len(joints))  # (m, positions and velocities, n)
        by_joint = dict(zip(joints, r2.mean((0, 1)).tolist(), strict=True))
        return {"mean": float(r2.mean()), "by_joint": by_joint, "by_probe": r2.mean((1, 2)).tolist()}


def points_of(net: DeltaNet) -> Infer | None:
    """x → offsets, arrays of one kind, of a network that learns where to ask; else None."""
    if not net.config.learns_points:
        return None

    def infer(x: Any) -> Any:
        with torch.inference_mode():
            offsets = net.offsets(torch.as_tensor(x))  # type: ignore[operator]
            return offsets.numpy() if isinstance(x, np.ndarray) else offsets

    return infer


def torch_infer(net: torch.nn.Module) -> Infer:
    """A network as a function of numpy arrays, for validation while training."""
    net.eval()
    device = next(net.parameters()).device

    def infer(x: Array) -> Array:
        with torch.inference_mode():
            return net(torch.from_numpy(x).to(device)).cpu().numpy()

    return infer
