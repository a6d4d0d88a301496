"""One control period of the loop (nn/loop.DeltaLoop) as a function of torch tensors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from gaponet.base.errors import ModelError
from gaponet.nn.artifact import GapModel
from gaponet.nn.onnx_export import MAX_DIFFERENCE_RAD, trained_network

CHECKED = 12  # control periods


class DeltaStep(nn.Module):
    """A model as a function: state, command and past of B worlds → Δa and the new past.

    Attributes:
        depth: Frames in the past; a frame is [q | q̇ | target applied], 3n numbers.
    """

    low: Tensor
    high: Tensor

    def __init__(self, net: nn.Module, model: GapModel) -> None:
        super().__init__()
        config = model.config
        self.net = net.requires_grad_(False)
        self.n: int = len(model.card["joint_names"])
        self.depth: int = (config.history - 1) * config.stride + 1
        self.stride: int = config.stride
        self.payload_input: bool = config.payload_input
        self.payload_max: float = config.payload_max
        low, high = torch.from_numpy(model.qpos_range.T.copy()).float()
        self.register_buffer("low", low)
        self.register_buffer("high", high)

    def forward(
        self, qpos: Tensor, qvel: Tensor, ctrl: Tensor, payload_mass: Tensor, frames: Tensor, fresh: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Δa (B, n) rad, within the joint limits, and the new past; gradients do not reach earlier periods.

        Args:
            qpos, qvel, ctrl: (B, n) rad, rad/s, rad; a target that is no finite number counts as the last one applied.
            payload_mass: (B,) kg.
            frames: The past, newest first, (B, depth, 3n).
            fresh: Worlds without a past, (B,) bool: the present frame, repeated, is theirs.
        """
        last = torch.where(fresh[:, None], qpos, frames[:, 0, 2 * self.n :])
        ctrl = torch.where(torch.isfinite(ctrl), ctrl, last)  # anything else would stay in the past for ever
        state = torch.cat([qpos, qvel], dim=1)
        now = torch.cat([state, ctrl], dim=1).detach()
        frames = torch.where(fresh[:, None, None], now[:, None], frames)
        parts = [state, frames[:, :: self.stride].flatten(1)]
        if self.payload_input:
            parts.append((payload_mass / self.payload_max)[:, None])
        parts.append(ctrl)
        delta = self.net(torch.cat(parts, dim=1))
        applied = torch.minimum(torch.maximum(ctrl + delta, self.low), self.high)
        newest = torch.cat([state, applied], dim=1).detach()
        return applied - ctrl, torch.cat([newest[:, None], frames[:, :-1]], dim=1)


def delta_step(model: GapModel, run: Path) -> DeltaStep:
    """The step of a run's network, from its checkpoint.

    Raises:
        ModelError: No checkpoint, or the model holds corrections or sensors, or has an input for the recorded state.
    """
    if model.config.holds:
        raise ModelError(f"{model.path}: holds corrections or sensors, which torch exports do not; train without")
    if model.config.real_state:
        raise ModelError(f"{model.path}: real_state is an input that torch exports lack; train without")
    return DeltaStep(trained_network(run, model.config, len(model.card["joint_names"])), model)


def require_parity(module: Any, model: GapModel, what: str, path: Path) -> float:
    """The largest difference between a module and its artifact, rad; refuses one above 1e-5 rad."""
    difference = largest_difference(module, model)
    if not difference <= MAX_DIFFERENCE_RAD:
        raise ModelError(
            f"{path}: {what} and {model.path} differ by {difference:.2e} rad; not written. "
            "Write the artifact again with gaponet export RUN"
        )
    return difference


def largest_difference(module: Any, model: GapModel, num_envs: int = 3) -> float:
    """Largest |module − artifact| on random motions, one environment beginning anew half-way, rad.

    Args:
        module: A module with reset(ids) and module(qpos, qvel, ctrl, payload_mass) → Δa.
    """
    rng = np.random.default_rng(0)
    n, loop, worst = len(model.card["joint_names"]), model.loop(num_envs), 0.0
    payload = rng.uniform(0, model.config.payload_max, num_envs).astype(np.float32)
    low, high = np.clip(model.qpos_range.T, -1.0, 1.0)
    ctrl = rng.uniform(low, high, (num_envs, n))
    qpos = ctrl.copy()
    module.reset(None)
    with torch.inference_mode():
        for t in range(CHECKED):
            if t == CHECKED // 2:
                module.reset(torch.tensor([1]))
                loop.reset(np.array([1]))
            ctrl = ctrl + rng.normal(0, 0.02, ctrl.shape)
            qvel = rng.normal(0, 0.3, ctrl.shape)
            qpos = qpos + 0.3 * (ctrl - qpos)
            q, v, a = (x.astype(np.float32) for x in (qpos, qvel, ctrl))
            theirs = module(*(torch.from_numpy(x) for x in (q, v, a, payload))).numpy()
            worst = max(worst, float(np.abs(theirs - loop.delta(q, v, a, payload)).max()))
    return worst
