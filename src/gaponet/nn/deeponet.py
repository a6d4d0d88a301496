"""Networks: branch, trunk and their inner product; and the one place that builds any network."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

from gaponet.nn.baselines.mlp import DeltaMLP
from gaponet.nn.baselines.transformer import DeltaTransformer
from gaponet.nn.config import ModelConfig
from gaponet.nn.layers import DeltaNet, dense, size
from gaponet.nn.paper import PaperNet, SensorPredictor


class OperatorNet(DeltaNet):
    """Δa = bounded(⟨branch(o [, sensors]), trunk(a, P)⟩ + c), a DeepONet.

    One branch and one trunk, shared by all joints, take what belongs to a joint and its name; the branch is told q, q̇
    and a − q of all joints as well.
    """

    which: Tensor

    def __init__(self, config: ModelConfig, n: int) -> None:
        super().__init__(config, n)
        if config.sensors == "predicted":
            inputs = config.observation_dim(n)
            self.predictor = SensorPredictor(inputs, config.sensor_hidden, config.sensor_dim(n))
        self.register_buffer("which", torch.eye(n), persistent=False)
        sensed, seen, asked = self.input_dims(config, n)
        self.branch_inputs = sensed * (config.sensors != "off") + seen + n
        self.branch = dense(self.branch_inputs, config.branch_hidden, config.num_basis)
        self.trunk = dense(asked + n, config.trunk_hidden, config.num_basis, zero=True)
        self.bias = nn.Parameter(torch.zeros(n))

    @staticmethod
    def input_dims(config: ModelConfig, n: int) -> tuple[int, int, int]:
        """Numbers of sensors, observation and query that one pass of branch and trunk sees, joint names aside."""
        payload = int(config.payload_input)
        return 2 * config.num_probes, 2 + 3 * config.history + payload + 3 * n, 1 + payload

    def prepare(self, x: Tensor) -> Tensor:
        """x = [o_t | a_t], (B, input_dim) → [what the branch sees | what the trunk is asked], (B, …, both)."""
        z = self.features(x)
        sensors = self.sensors(z) if self.config.sensors != "off" else None
        see, ask = self._joint_inputs(z, sensors)
        return torch.cat([see, ask], dim=-1)

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

    def _joint_inputs(self, z: Tensor, sensors: Tensor | None) -> tuple[Tensor, Tensor]:
        n, at = self.n, self.features.layout
        which = self.which.expand(z.shape[0], n, n)
        payload = [z[:, at.payload].unsqueeze(1).expand(-1, n, 1)] if self.config.payload_input else []
        see = [which]
        if sensors is not None:
            see.append(sensors.reshape(-1, 2 * self.config.num_probes, n).transpose(1, 2))
        all_joints = torch.cat([z[:, at.state], z[:, at.action]], dim=1)
        see += [self.features.joint_wise(z), *payload, all_joints.unsqueeze(1).expand(-1, n, 3 * n)]
        ask = [which, z[:, at.action].unsqueeze(2), *payload]
        return torch.cat(see, dim=2), torch.cat(ask, dim=2)


class SharedMLP(OperatorNet):
    """Baseline: what branch and trunk are given, side by side into one plain network, shared by the joints.

    It has the operator's sensors and as many weights as branch and trunk: only their product is missing.
    """

    def __init__(self, config: ModelConfig, n: int) -> None:
        super().__init__(config, n)
        asked = self.input_dims(config, n)[2] + n
        weights = size(self.branch) + size(self.trunk) + n
        del self.branch, self.trunk, self.bias
        width = lambda widths: dense(self.branch_inputs + asked, widths, 1)  # noqa: E731
        hidden = DeltaMLP.matched_hidden(config.mlp_hidden, weights, width)
        self.net = dense(self.branch_inputs + asked, hidden, 1, zero=True)

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
    if config.kind == "transformer":
        return DeltaTransformer(config, n)
    if not config.mlp_match:
        return DeltaMLP(config, n)
    weights = _operator_size(config, n)
    hidden = DeltaMLP.matched_hidden(config.mlp_hidden, weights, lambda widths: DeltaMLP(config, n, widths))
    return DeltaMLP(config, n, hidden)


def _operator_size(config: ModelConfig, n: int) -> int:
    """Parameters that the operator with these fields has, sensor predictor included."""
    with torch.device("meta"):  # shapes only
        return size(OperatorNet(replace(config, kind="gaponet"), n))
