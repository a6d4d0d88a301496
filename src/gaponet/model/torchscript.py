"""A self-contained TorchScript file for simulators that live in torch (Isaac Lab, mjlab): history and limits inside.

m = torch.jit.load("delta.pt").to("cuda")     # needs torch, not gaponet
m.reset(ids)                                  # int64 ids of environments that begin anew; None for all
target = action + m(qpos, qvel, action, payload_mass)   # (num_envs, n) each, payload (num_envs,); once per period
m.joint_names, m.dt, m.simulator              # order of the columns, control periods [s] and simulator trained in
"""

# No postponed annotations here: TorchScript reads those of DeltaModule.

import io
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from gaponet.errors import ModelError
from gaponet.files import whole
from gaponet.model.artifact import CARD, GapModel
from gaponet.model.export import PARITY, trained_network
from gaponet.model.fuse import FusedNet
from gaponet.model.fused import FILE as NUMPY
from gaponet.model.fused import read_weights

FILE = "delta.pt"
CHECKED = 12  # control periods


class DeltaModule(nn.Module):
    """model/loop.DeltaLoop for models that hold nothing, in TorchScript; the export compares them."""

    frames: Tensor
    fresh: Tensor
    low: Tensor
    high: Tensor

    def __init__(self, net: nn.Module, model: GapModel) -> None:
        super().__init__()
        config = model.config
        self.net = net
        self.n: int = len(model.card["joint_names"])
        self.depth: int = (config.history - 1) * config.stride + 1
        self.stride: int = config.stride
        self.payload_input: bool = config.payload_input
        self.payload_max: float = config.payload_max
        self.joint_names = torch.jit.Attribute(list(model.card["joint_names"]), list[str])
        self.simulator = torch.jit.Attribute(str(model.card["simulator"]), str)
        self.dt = torch.jit.Attribute([float(dt) for dt in model.card.get("dt", [])], list[float])
        low, high = torch.from_numpy(model.qpos_range.T.copy()).float()
        self.register_buffer("low", low)
        self.register_buffer("high", high)
        self.register_buffer("frames", torch.zeros(0, self.depth, 3 * self.n))
        self.register_buffer("fresh", torch.zeros(0, dtype=torch.bool))

    @torch.jit.export
    def reset(self, ids: Tensor | None = None) -> None:
        """The present frame, repeated, will be the history of these environments."""
        if ids is None:
            self.frames = self.frames[:0]
        else:
            self.fresh[ids] = True

    def forward(self, qpos: Tensor, qvel: Tensor, ctrl: Tensor, payload_mass: Tensor) -> Tensor:
        """Δa, (num_envs, n) rad, within the joint limits; once per control period."""
        state = torch.cat([qpos, qvel], dim=1)
        if self.frames.shape[0] != qpos.shape[0]:
            self.frames = torch.zeros([qpos.shape[0], self.depth, 3 * self.n], dtype=qpos.dtype, device=qpos.device)
            self.fresh = torch.ones([qpos.shape[0]], dtype=torch.bool, device=qpos.device)
        now = torch.cat([state, ctrl], dim=1)
        self.frames = torch.where(self.fresh[:, None, None], now[:, None], self.frames)
        self.fresh = torch.zeros_like(self.fresh)
        parts = [state, self.frames[:, :: self.stride].flatten(1)]
        if self.payload_input:
            parts.append((payload_mass / self.payload_max)[:, None])
        parts.append(ctrl)
        delta = self.net(torch.cat(parts, dim=1))
        applied = torch.minimum(torch.maximum(ctrl + delta, self.low), self.high)
        self.frames = torch.cat([torch.cat([state, applied], dim=1)[:, None], self.frames[:, :-1]], dim=1)
        return applied - ctrl


def torch_network(model: GapModel, run: Path) -> nn.Module:
    """The network of an artifact in torch: from its weights.npz, or the run's checkpoint where there is none."""
    weights = model.path / NUMPY
    if weights.is_file():
        return FusedNet(read_weights(weights)).eval()
    return trained_network(run, model.config, len(model.card["joint_names"]))


def traced(net: nn.Module, dim: int) -> Any:
    """The network as TorchScript; dim of [o_t | a_t]."""
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        return torch.jit.trace(net, torch.zeros(3, dim)).eval()


def export_torchscript(model: GapModel, run: Path, path: Path) -> float:
    """Write a DeltaModule, load it back and compare it with the artifact over some control periods.

    Returns:
        Largest difference, rad.

    Raises:
        ModelError: It is above 1e-5 rad; nothing is written.
    """
    n, config = len(model.card["joint_names"]), model.config
    if config.asks_simulator or config.keeps_observation or config.delta_hold > 1 or config.context_dim:
        raise ModelError(
            f"{model.path}: holds sensors or corrections, or asks the simulator, or is told which it is, which "
            "TorchScript does not; train with sensors predicted or off, sensor_hold 1, delta_hold 1 and context none"
        )
    net = traced(torch_network(model, run), model.config.observation_dim(n) + n)
    content = io.BytesIO()  # torch ends the process when it meets a full disk itself
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # TorchScript is what these simulators load today
        torch.jit.save(torch.jit.script(DeltaModule(net, model)), content)
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole(path) as temporary:
        temporary.write_bytes(content.getvalue())
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            difference = largest_difference(torch.jit.load(str(temporary)), model)
        if not difference <= PARITY:
            raise ModelError(
                f"{path}: TorchScript and {model.path / CARD} differ by {difference:.2e} rad; not written. "
                "Write the artifact again with gaponet export RUN"
            )
    return difference


def largest_difference(module: Any, model: GapModel, num_envs: int = 3) -> float:
    """Largest |TorchScript − artifact| on random motions, one environment beginning anew half-way, rad."""
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


def network_calls(model: GapModel, run: Path) -> dict[str, Callable[[], object]]:
    """One step of the network as trained (or as fused, without a checkpoint) and as TorchScript, to be timed."""
    torch.set_num_threads(1)
    n = len(model.card["joint_names"])
    dim = model.config.input_dim(n)
    as_trained = (run / "checkpoint.pt").is_file()
    net = trained_network(run, model.config, n) if as_trained else torch_network(model, run)
    script = torch.jit.freeze(traced(torch_network(model, run), dim))
    x = torch.zeros(1, dim)

    def call(f: Any) -> Callable[[], object]:
        def step() -> object:
            with torch.inference_mode():
                return f(x)

        return step

    return {"network, torch": call(net), "network, TorchScript": call(script)}
