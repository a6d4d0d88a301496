"""One control period of a model (nn/loop.DeltaLoop) as a torch.export program (.pt2).

Plain torch loads it:

    step = torch.export.load("delta.pt2").module()
    delta, frames = step(qpos, qvel, ctrl, payload_mass, frames, fresh)  # as DeltaStep.forward
"""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from gaponet.base.errors import ModelError
from gaponet.base.files import atomic_write
from gaponet.data.sequence import is_same_rate
from gaponet.deploy.transfer import own_context
from gaponet.export.onnx_to_torch import OnnxModule
from gaponet.export.shipped.gaponet_action import PROGRAM, Past
from gaponet.export.simulator_facts import control_period
from gaponet.nn.artifact import WEIGHTS, GapModel
from gaponet.nn.onnx_export import MAX_DIFFERENCE_RAD, trained_network
from gaponet.nn.packaged_networks import is_packaged_network
from gaponet.sim.batch import Condition

CHECK_PERIODS = 12  # control periods
CHECK_WORLDS = 3


class DeltaStep(nn.Module):
    """A model as a function: state, command and past of B worlds → Δa and the new past.

    Attributes:
        depth: Frames in the past; a frame is [q | q̇ | applied target], 3n numbers.
        told: The network is told the simulator's answers to fixed probes (sim/context.py).
        context: If so, these answers, (8n) rad: of the robot's own simulator, until others are
            written into it. Of a network that is not told the payload, with the payload of the
            export in hand.
        refused: Number of answers of the network that were not finite, () int64; there Δa is zero,
            as in nn/bound.py.
    """

    context: Tensor
    low: Tensor
    high: Tensor
    refused: Tensor

    def __init__(self, net: nn.Module, model: GapModel, payload_mass: float = 0.0) -> None:
        super().__init__()
        config = model.config
        self.net = net.requires_grad_(False)
        self.n: int = len(model.card["joint_names"])
        self.depth: int = (config.history - 1) * config.stride + 1
        self.stride: int = config.stride
        self.payload_input: bool = config.payload_input
        self.told: bool = config.context
        self.payload_max: float = config.payload_max
        self.delta_max: float = config.delta_max
        low, high = torch.from_numpy(model.qpos_range.T.copy()).float()
        if config.context:
            context = _context(model, payload_mass)
            self.register_buffer("context", torch.from_numpy(context.copy()))
        self.register_buffer("low", low)
        self.register_buffer("high", high)
        self.register_buffer("refused", torch.zeros((), dtype=torch.int64))

    def forward(
        self,
        qpos: Tensor,
        qvel: Tensor,
        ctrl: Tensor,
        payload_mass: Tensor,
        frames: Tensor,
        fresh: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Return Δa, (B, n) rad, within ±delta_max and the joint limits, and the new past.

        Gradients do not reach earlier periods.

        Args:
            qpos, qvel, ctrl: (B, n) rad, rad/s, rad; a target that is not finite counts as the last
                applied one.
            payload_mass: (B,) kg.
            frames: The past, newest first, (B, depth, 3n).
            fresh: Worlds without a past, (B,) bool; their past is the present frame, repeated.
        """
        last = torch.where(fresh[:, None], qpos, frames[:, 0, 2 * self.n :])
        ctrl = torch.where(torch.isfinite(ctrl), ctrl, last)  # otherwise NaN would stay in the past
        state = torch.cat([qpos, qvel], dim=1)
        now = torch.cat([state, ctrl], dim=1).detach()
        frames = torch.where(fresh[:, None, None], now[:, None], frames)
        inputs = [state, frames[:, :: self.stride].flatten(1)]
        if self.payload_input:
            inputs.append((payload_mass / self.payload_max)[:, None])
        inputs.append(ctrl)
        if self.told:
            inputs.append(self.context.expand(qpos.shape[0], -1))
        delta = self._bounded(self.net(torch.cat(inputs, dim=1)))
        applied = torch.minimum(torch.maximum(ctrl + delta, self.low), self.high)
        newest = torch.cat([state, applied], dim=1).detach()
        return applied - ctrl, torch.cat([newest[:, None], frames[:, :-1]], dim=1)

    def _bounded(self, delta: Tensor) -> Tensor:
        """Return answers (B, n) rad within ±delta_max, and zero where one is not finite.

        Count these.
        """
        finite = torch.isfinite(delta).all(dim=1)
        self.refused.add_((~finite).sum())  # in place: torch 2.7 exports no assignment
        limited = delta.clamp(-self.delta_max, self.delta_max)
        return torch.where(finite[:, None], limited, torch.zeros_like(limited))


def _context(model: GapModel, payload_mass: float) -> np.ndarray:
    """Return the answers of the robot's simulator, (8n) rad, with a payload in each hand, kg, at
    the control period of the export.
    """
    robot = model.simulator()
    trained = model.card.get("dt") or [robot.dt]
    exported = control_period(robot, trained)
    near = [period for period in trained if is_same_rate(period, exported)]
    measured = own_context(model, robot, [Condition(payload_mass, "both", near[0])])
    return np.asarray(model.nominal_context if measured is None else measured[0], np.float32)


def delta_step(model: GapModel, run: Path, payload_mass: float = 0.0) -> DeltaStep:
    """Load the step of a run's network, or of a network of the package.

    The first is in a checkpoint, the second in an ONNX file.

    Args:
        payload_mass: In each hand, kg, of a network that is not told it.

    Raises:
        ModelError: There is no checkpoint, or the model holds corrections, has sensors or reads the
            recorded state.
    """
    if model.config.holds:
        raise ModelError(
            f"{model.path}: holds corrections or sensors, which torch exports do not; train without"
        )
    if model.config.needs_simulator:
        raise ModelError(
            f"{model.path}: the simulator's answers are an input that torch exports lack; "
            "train without sensor_source fixed"
        )
    if model.config.observes_real_state:
        raise ModelError(
            f"{model.path}: the recorded state is an input that torch exports lack; train without "
            "real_state, and with predictor_inputs observation"
        )
    net: nn.Module
    if is_packaged_network(model.path):
        net = OnnxModule(model.path / WEIGHTS)
    else:
        net = trained_network(run, model.config, len(model.card["joint_names"]))
    return DeltaStep(net, model, payload_mass)


def program(step: DeltaStep) -> torch.export.ExportedProgram:
    """Return the program of a step for any number of worlds, B ≥ 1."""
    worlds = torch.export.Dim("worlds", min=1, max=2**31)  # torch 2.7 needs a maximum
    rows = [torch.zeros(2, step.n) for _ in range(3)]
    past = [torch.zeros(2, step.depth, 3 * step.n), torch.ones(2, dtype=torch.bool)]
    with torch.no_grad():
        return torch.export.export(
            step, (*rows, torch.zeros(2), *past), dynamic_shapes=({0: worlds},) * 6
        )


def export_program(model: GapModel, run: Path, folder: Path, payload_mass: float = 0.0) -> float:
    """Write delta.pt2, load it again and compare it with the artifact over some control periods.

    Args:
        payload_mass: In each hand, kg, of a network that is not told it.

    Returns:
        Largest difference, rad.

    Raises:
        ModelError: The difference is above 1e-5 rad, or `delta_step` refuses the model; nothing is
            written.
    """
    step = delta_step(model, run, payload_mass)
    path = folder / PROGRAM
    content = io.BytesIO()  # torch ends the process if it writes to a full disk itself
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of torch about its own storages
        torch.export.save(program(step), content)
    with atomic_write(path) as temporary:
        temporary.write_bytes(content.getvalue())
        content.seek(0)
        difference = _largest_difference(torch.export.load(content).module(), step, model)
        if not difference <= MAX_DIFFERENCE_RAD:
            raise ModelError(
                f"{path}: torch.export and {model.path} differ by {difference:.2e} rad; not "
                "written. Write the artifact again with gaponet export RUN"
            )
    return difference


def _largest_difference(program: Any, step: DeltaStep, model: GapModel) -> float:
    """Return the largest |program − artifact| on random motions, rad.

    One world restarts half-way.
    """
    rng = np.random.default_rng(0)
    loop = model.loop(CHECK_WORLDS, step.context.numpy() if step.told else None)
    past = Past(program, CHECK_WORLDS, step.depth, step.n, "cpu")
    payload = rng.uniform(0, model.config.payload_max, CHECK_WORLDS).astype(np.float32)
    low, high = np.clip(model.qpos_range.T, -1.0, 1.0)
    ctrl = rng.uniform(low, high, (CHECK_WORLDS, step.n))
    qpos = ctrl.copy()
    largest = 0.0
    with torch.inference_mode():
        for t in range(CHECK_PERIODS):
            if t == CHECK_PERIODS // 2:
                past.reset(torch.tensor([1]))
                loop.reset(np.array([1]))
            ctrl = ctrl + rng.normal(0, 0.02, ctrl.shape)
            qvel = rng.normal(0, 0.3, ctrl.shape)
            qpos = qpos + 0.3 * (ctrl - qpos)
            q = qpos.astype(np.float32)
            v = qvel.astype(np.float32)
            a = ctrl.astype(np.float32)
            inputs = [torch.from_numpy(values) for values in (q, v, a, payload)]
            delta = past.delta(*inputs).numpy()
            largest = max(largest, float(np.abs(delta - loop.delta(q, v, a, payload)).max()))
    return largest
