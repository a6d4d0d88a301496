"""Descend the free-run error itself, through the simulator.

The simulator steps as it is; only its derivative is modelled: per joint, a linear servo with the nominal gains and the
inertia that the joint sees. Friction is left out of the derivative, so that a stuck joint still learns which way it has
to be pushed. Roll-outs go on through whole motions in states that the policy brings about; the graph is cut every few
tenths of a second (truncated backpropagation through time), the states are not.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import torch
from scipy.linalg import expm
from torch import Tensor
from torch.nn.functional import smooth_l1_loss

from gaponet.model.deeponet import DeltaMLP, OperatorNet
from gaponet.train.config import GradientConfig
from gaponet.train.env import DeltaEnv

Array = np.ndarray


class _Step(torch.autograd.Function):
    """What the simulator did, forward; the linear servo, backward."""

    @staticmethod
    def forward(ctx: Any, state: Tensor, target: Tensor, reached: Tensor, a: Tensor, b: Tensor) -> Tensor:
        """The state reached, (N, 2, n), from state and target (N, n); a (N, n, 2, 2), b (N, n, 2): its derivatives."""
        ctx.save_for_backward(a, b)
        return reached.clone()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        a, b = ctx.saved_tensors
        g = grads[0].transpose(1, 2)  # (N, n, 2)
        return torch.einsum("znij,zni->zjn", a, g), (b * g).sum(2), None, None, None


def servo_derivatives(
    model: mujoco.MjModel, joints: tuple[str, ...], kp: Array, kd: Array, dt: float
) -> tuple[Array, Array]:
    """d(q, q̇)'/d(q, q̇), (n, 2, 2), and d(q, q̇)'/du, (n, 2), of one control period; each joint alone, others held.

    Inertia is that of the model's initial posture, armature included.
    """
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    dof = [int(model.joint(j).dofadr[0]) for j in joints]
    a, b = np.zeros((len(dof), 2, 2)), np.zeros((len(dof), 2))
    for i, d in enumerate(dof):
        inertia = full[d, d]
        rate = np.zeros((3, 3))  # of (q, q̇, u)
        rate[0, 1] = 1.0
        rate[1] = np.array([-kp[i], -(kd[i] + model.dof_damping[d]), kp[i]]) / inertia
        step = expm(rate * dt)
        a[i], b[i] = step[:2, :2], step[:2, 2]
    return a, b


class GradientTrainer:
    """Holds roll-outs and optimiser; `update` is one chunk of all roll-outs and one step."""

    def __init__(self, net: OperatorNet | DeltaMLP, env: DeltaEnv, config: GradientConfig) -> None:
        """The environment's motions are followed from random rows on; the network's predictor is left alone."""
        self.net, self.env, self.config = net, env, config
        self.parameters = [p for name, p in net.named_parameters() if not name.startswith("predictor")]
        self.optimiser = torch.optim.AdamW(self.parameters, lr=config.learning_rate, weight_decay=config.weight_decay)
        robot = env.robot
        op = robot.operated_index
        gains = robot.kp[op], robot.kd[op]
        found = [servo_derivatives(env.sim.models[c], robot.operated, *gains, c[2]) for c in env.conditions]
        self.a, self.b = (torch.tensor(np.stack([f[k] for f in found])[env.group], dtype=torch.float32) for k in (0, 1))
        self.low, self.high = (torch.tensor(x, dtype=torch.float32) for x in robot.qpos_range[op].T)
        self.payload = torch.from_numpy(env.payload[:, None] / env.config.payload_max)
        # A servo that is late answers a mixture of the targets of `late` and `late` + 1 periods ago.
        delay = torch.tensor(robot.delay[op], dtype=torch.float32) / torch.tensor(
            [env.conditions[g][2] for g in env.group], dtype=torch.float32
        )[:, None]  # fmt: skip
        self.delay = delay
        env.reset()

    def update(self, progress: float) -> float:
        """Roll on by config.horizon control periods and take one step; returns the mean |error| of the chunk, rad."""
        env, c, n = self.env, self.config, self.env.num_actions
        for group in self.optimiser.param_groups:
            group["lr"] = c.learning_rate * (1.0 - 0.9 * min(progress, 1.0))
        net = self.net
        net.train()
        state, frames = self._state(), torch.from_numpy(env.history.frames.copy())
        previous: Tensor | None = None
        loss, error = torch.zeros(()), 0.0
        for _ in range(c.horizon):
            action = torch.from_numpy(env.now[:, 2 * n :].copy())
            picked = frames[:, env.history.picked].flatten(1)
            parts = [state.flatten(1), picked] + ([self.payload] if env.config.payload_input else []) + [action]
            delta = net(torch.cat(parts, dim=1))
            target = torch.minimum(torch.maximum(action + delta, self.low), self.high)
            env.advance(delta.detach().numpy())
            effective = self._effective(target, frames)
            reached = _Step.apply(state, effective, self._state(), self.a, self.b)
            frames = torch.cat([torch.cat([state.flatten(1), target], dim=1)[:, None], frames[:, :-1]], dim=1)
            state = reached
            real = torch.from_numpy(env.now[:, : 2 * n].reshape(-1, 2, n).copy())
            off = state - real
            loss = loss + smooth_l1_loss(off[:, 0], torch.zeros_like(off[:, 0]), beta=c.beta) / c.horizon
            loss = loss + c.delta * delta.square().mean() / c.horizon
            if previous is not None:
                loss = loss + c.delta_rate * (delta - previous).square().mean() / c.horizon
            previous = delta
            error += float(off[:, 0].detach().abs().mean()) / c.horizon
            ended = np.flatnonzero(env.row >= env.last)
            if ended.size:
                env.reset(ended)
                fresh = torch.zeros(env.num_envs, 1, 1, dtype=torch.bool)
                fresh[ended] = True
                state = torch.where(fresh, self._state(), state)
                frames = torch.where(fresh, torch.from_numpy(env.history.frames.copy()), frames)
                previous = torch.where(fresh[:, 0], torch.zeros_like(delta), delta)
        self.optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.parameters, c.max_grad_norm)
        self.optimiser.step()
        net.eval()
        return error

    def _state(self) -> Tensor:
        """(N, 2, n): positions and velocities of the operated joints, copied."""
        sim, op = self.env.sim, self.env.op
        return torch.from_numpy(np.stack([sim.qpos[:, op], sim.qvel[:, op]], axis=1).astype(np.float32))

    def _effective(self, target: Tensor, frames: Tensor) -> Tensor:
        """The target that reaches the servo now: this one, or earlier ones where the servo is late."""
        if not bool(self.delay.any()):
            return target
        n = self.env.num_actions
        sent = torch.cat([target[:, None], frames[:, :, 2 * n :]], dim=1)  # (N, 1 + depth, n), newest first
        whole = self.delay.floor().clamp(max=sent.shape[1] - 2)
        share = (self.delay - whole).clamp(max=1.0)
        index = whole.long()[:, None]
        return (1 - share) * sent.gather(1, index)[:, 0] + share * sent.gather(1, index + 1)[:, 0]
