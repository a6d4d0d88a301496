"""A self-contained TorchScript file for simulators that live in torch (Isaac Lab, mjlab): history and limits inside.

m = torch.jit.load("delta.pt").to("cuda")     # needs torch, not gaponet
m.reset(ids)                                  # int64 ids of environments that begin anew; None for all
target = action + m(qpos, qvel, action, payload_mass)   # (num_envs, n) each, payload (num_envs,); once per period
m.joint_names, m.dt, m.simulator              # order of the columns, control periods [s] and simulator trained in

torch has deprecated the format; it is for versions that do not read torch.export's (engine/program.py).
"""

# No postponed annotations here: TorchScript reads those of DeltaModule.

import io
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from gaponet.engine.step import DeltaStep, delta_step, require_parity, torch_network
from gaponet.files import whole
from gaponet.model.artifact import GapModel
from gaponet.model.export import trained_network

FILE = "delta.pt"


class DeltaModule(nn.Module):
    """DeltaStep with the past inside."""

    frames: Tensor
    fresh: Tensor

    def __init__(self, step: DeltaStep, model: GapModel) -> None:
        super().__init__()
        self.step = step
        self.joint_names = torch.jit.Attribute(list(model.card["joint_names"]), list[str])
        self.simulator = torch.jit.Attribute(str(model.card["simulator"]), str)
        self.dt = torch.jit.Attribute([float(dt) for dt in model.card.get("dt", [])], list[float])
        self.register_buffer("frames", torch.zeros(0, self.step.depth, 3 * self.step.n))
        self.register_buffer("fresh", torch.zeros(0, dtype=torch.bool))

    @torch.jit.export
    def reset(self, ids: Tensor | None = None) -> None:
        """The present frame, repeated, will be the history of these environments."""
        if ids is None:
            self.frames = self.frames[:0]
        elif self.frames.shape[0] > 0:  # before the first call all begin anew
            self.fresh = self.fresh.index_fill(0, ids.to(self.fresh.device), True)  # not in place: torch.inference_mode

    def forward(self, qpos: Tensor, qvel: Tensor, ctrl: Tensor, payload_mass: Tensor) -> Tensor:
        """Δa, (num_envs, n) rad, within the joint limits; once per control period."""
        num_envs = qpos.shape[0]
        if self.frames.shape[0] != num_envs:
            frames = [num_envs, self.step.depth, 3 * self.step.n]
            self.frames = torch.zeros(frames, dtype=qpos.dtype, device=qpos.device)
            self.fresh = torch.ones([num_envs], dtype=torch.bool, device=qpos.device)
        delta, self.frames = self.step(qpos, qvel, ctrl, payload_mass, self.frames, self.fresh)
        self.fresh = torch.zeros_like(self.fresh)
        return delta


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
        ModelError: It is above 1e-5 rad, or the model is one that DeltaStep is not for; nothing is written.
    """
    step = delta_step(model, run)
    step.net = traced(step.net, model.config.input_dim(step.n))
    content = io.BytesIO()  # torch ends the process when it meets a full disk itself
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.jit.save(torch.jit.script(DeltaModule(step, model)), content)
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole(path) as temporary:
        temporary.write_bytes(content.getvalue())
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            loaded = torch.jit.load(str(temporary))
        return require_parity(loaded, model, "TorchScript", path)


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
