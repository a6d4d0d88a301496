"""Networks: branch, trunk and their inner product; and the one place that builds any network."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from gaponet.base.arrays import Array
from gaponet.nn.config import ModelConfig
from gaponet.nn.layers import DeltaNet, dense, size
from gaponet.nn.observation import Layout
from gaponet.nn.paper import PaperNet, SensorPredictor


class OperatorNet(DeltaNet):
    """Δa = bounded(⟨branch(o [, sensors]), trunk(a, P)⟩ + c), a DeepONet.

    One branch and one trunk, shared by all joints, take what belongs to a joint and its name; the branch is told q, q̇
    and a − q of all joints as well.
    """

    columns: Tensor

    def __init__(self, config: ModelConfig, n: int) -> None:
        super().__init__(config, n)
        if config.sensors == "predicted":
            inputs = config.observation_dim(n)
            self.predictor = SensorPredictor(inputs, config.sensor_hidden, config.sensor_dim(n))
        see, ask = self.joint_columns(config, n)
        self.register_buffer("columns", torch.from_numpy(np.hstack([see, ask]).ravel()), persistent=False)
        self.branch_inputs, self.trunk_inputs = see.shape[1], ask.shape[1]
        self.branch = dense(self.branch_inputs, config.branch_hidden, config.num_basis)
        self.trunk = dense(self.trunk_inputs, config.trunk_hidden, config.num_basis, zero=True)
        self.bias = nn.Parameter(torch.zeros(n))

    @staticmethod
    def joint_columns(config: ModelConfig, n: int) -> tuple[Array, Array]:
        """Columns of [features | sensors | 0 | 1] that branch and trunk see of each joint, (n, inputs) each."""
        at, sensors = Layout(config, n), config.sensor_dim(n) * (config.sensors != "off")
        x = np.arange(at.query.stop + sensors)
        onehot = len(x) + np.eye(n, dtype=int)

        def own(part: slice) -> Array:
            return x[part].reshape(-1, n).T

        def shared(part: slice) -> Array:
            return np.tile(x[part], (n, 1))

        see = own(slice(at.query.stop, None)), own(slice(at.past.stop)), *map(shared, (at.payload, at.state, at.action))
        return np.hstack([onehot, *see]), np.hstack([onehot, own(at.action), shared(at.payload)])

    def arrange(self, z: Tensor) -> Tensor:
        """Features of [o_t | a_t] → [what the branch sees | what the trunk is asked], (B, n, both)."""
        if self.config.sensors != "off":
            z = torch.cat([z, self.sensors(z)], dim=1)
        z = pad(pad(z, (0, 1)), (0, 1), value=1.0)
        return z.index_select(1, self.columns).reshape(-1, self.n, self.branch_inputs + self.trunk_inputs)

    def correct(self, prepared: Tensor) -> Tensor:
        """⟨branch, trunk⟩ + c → Δa, (B, n) rad."""
        rows = prepared.flatten(0, -2)  # two-dimensional, so that linear layers need no copy of a part
        see, ask = rows[:, : self.branch_inputs], rows[:, self.branch_inputs :]
        shape = (-1, self.n, self.config.num_basis)
        branch, trunk = self.branch(see).reshape(shape), self.trunk(ask).reshape(shape)
        return self.bounded((branch * trunk).sum(-1) + self.bias)

    def sensors(self, z: Tensor) -> Tensor:
        """Sensor values, standardised, (B, 2nm): all probes, each n positions and n velocities; z = features(x)."""
        return self.predictor.mean(z[:, self.features.layout.observation])


class DeltaMLP(DeltaNet):
    """x → Δa through dense layers."""

    def __init__(self, config: ModelConfig, n: int, hidden: Sequence[int] | None = None) -> None:
        """hidden: Widths, if not those of the config."""
        super().__init__(config, n)
        self.net = dense(self.features.dim, config.mlp_hidden if hidden is None else hidden, n, zero=True)

    def correct(self, prepared: Tensor) -> Tensor:
        return self.bounded(self.net(prepared))

    @staticmethod
    def matched_hidden(
        hidden: Sequence[int], parameters: int, build: Callable[[tuple[int, ...]], nn.Module]
    ) -> tuple[int, ...]:
        """The widths scaled so that what `build` makes of them has as near to `parameters` parameters as they allow."""
        largest = max(hidden)

        def scaled(width: int) -> tuple[int, ...]:
            return tuple(max(1, round(w * width / largest)) for w in hidden)

        def miss(width: int) -> int:
            with torch.device("meta"):  # shapes only
                return size(build(scaled(width))) - parameters

        low, high = 1, 1
        while miss(high) < 0:
            low, high = high, 2 * high
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if miss(middle) < 0 else (low, middle)
        return scaled(min((low, high), key=lambda width: abs(miss(width))))


class SharedMLP(OperatorNet):
    """Baseline: what branch and trunk are given, side by side into one plain network, shared by the joints.

    It has the operator's sensors and as many weights as branch and trunk: only their product is missing.
    """

    def __init__(self, config: ModelConfig, n: int) -> None:
        super().__init__(config, n)
        inputs = self.branch_inputs + self.trunk_inputs
        weights = size(self.branch) + size(self.trunk) + n
        del self.branch, self.trunk, self.bias
        width = lambda widths: dense(inputs, widths, 1)  # noqa: E731
        hidden = DeltaMLP.matched_hidden(config.mlp_hidden, weights, width)
        self.net = dense(inputs, hidden, 1, zero=True)

    def correct(self, prepared: Tensor) -> Tensor:
        """What `prepare` made of each joint → Δa, (B, n) rad."""
        return self.bounded(self.net(prepared).squeeze(-1))


def build_network(config: ModelConfig, n: int) -> DeltaNet:
    """The network a config describes, for n operated joints."""
    config.require_kind()
    if config.kind == "gaponet":
        return OperatorNet(config, n)
    if config.kind == "paper":
        return PaperNet(config, n)
    if config.kind == "shared_mlp":
        return SharedMLP(config, n)
    if not config.mlp_match:
        return DeltaMLP(config, n)
    weights = _operator_size(config, n)
    hidden = DeltaMLP.matched_hidden(config.mlp_hidden, weights, lambda widths: DeltaMLP(config, n, widths))
    return DeltaMLP(config, n, hidden)


def _operator_size(config: ModelConfig, n: int) -> int:
    """Parameters that the operator with these fields has, sensor predictor included."""
    with torch.device("meta"):  # shapes only
        return size(OperatorNet(replace(config, kind="gaponet"), n))
