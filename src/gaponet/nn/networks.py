"""Networks: the operator (branch and trunk), its baselines, and `build_network` for any
configuration.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from gaponet.base.arrays import Array
from gaponet.nn.config import ModelConfig, ModelKind
from gaponet.nn.layers import DeltaNet, Standardise, dense, num_parameters
from gaponet.nn.observation import Layout
from gaponet.nn.paper import PaperNet, SensorPredictor
from gaponet.nn.trees import TreesNet

MIN_CONTEXT_STD_RAD = 1e-6
MAX_CONTEXT = 3.0  # standard deviations; a product of two networks extrapolates badly


class OperatorNet(DeltaNet):
    """DeepONet: Δa_j = bounded(⟨branch(inputs of joint j), trunk(a_j − q_j, P)⟩ + c_j).

    All joints share one branch and one trunk net. The branch input of joint j is its one-hot index,
    its sensor values, its state and history, the payload P, and q, q̇ and a − q of all joints. The
    trunk input is the one-hot index, a_j − q_j and the payload.

    With a context (sim/context.py), the branch input is the one-hot index and the context of joint
    j, and the trunk has all other inputs.
    """

    columns: Tensor

    def __init__(self, config: ModelConfig, n: int) -> None:
        super().__init__(config, n)
        if config.sensors == "predicted":
            inputs = config.observation_dim(n)
            self.predictor = SensorPredictor(inputs, config.sensor_hidden, config.sensor_dim(n))
        branch, trunk = self.joint_columns(config, n)
        columns = torch.from_numpy(np.hstack([branch, trunk]).ravel())
        self.register_buffer("columns", columns, persistent=False)
        self.branch_inputs = branch.shape[1]
        self.trunk_inputs = trunk.shape[1]
        branch_hidden = config.branch_hidden
        trunk_hidden = config.trunk_hidden
        if config.context:  # the trunk has the many inputs
            branch_hidden, trunk_hidden = trunk_hidden, branch_hidden
            self.context_scale = Standardise(config.context_dim(n))
        self.branch = dense(self.branch_inputs, branch_hidden, config.num_basis)
        self.trunk = dense(self.trunk_inputs, trunk_hidden, config.num_basis, zero_output=True)
        self.bias = nn.Parameter(torch.zeros(n))

    @staticmethod
    def joint_columns(config: ModelConfig, n: int) -> tuple[Array, Array]:
        """Return the inputs of branch and trunk, (n, inputs) each.

        They are columns of [features | sensors or context | 0 | 1].
        """
        layout = Layout(config, n)
        further = config.context_dim(n)
        if config.sensors != "off":
            further = config.sensor_dim(n)
        columns = np.arange(layout.query.stop + further)
        column_of_0 = len(columns)
        joint_onehot = column_of_0 + np.eye(n, dtype=int)  # the column of 1 follows that of 0

        def per_joint(part: slice) -> Array:
            """Columns of joint j in row j; in each quantity of a part, the joint varies fastest."""
            return columns[part].reshape(-1, n).T

        def all_joints(part: slice) -> Array:
            """All columns of a part in every row."""
            return np.tile(columns[part], (n, 1))

        if config.context:
            branch = [joint_onehot, per_joint(slice(layout.query.stop, None))]
            trunk = [
                joint_onehot,
                per_joint(slice(layout.past.stop)),
                all_joints(layout.payload),
                all_joints(layout.state),
                all_joints(layout.action),
                per_joint(layout.action),
            ]
            return np.hstack(branch), np.hstack(trunk)
        branch = [
            joint_onehot,
            per_joint(slice(layout.query.stop, None)),
            per_joint(slice(layout.past.stop)),
            all_joints(layout.payload),
            all_joints(layout.state),
            all_joints(layout.action),
        ]
        trunk = [joint_onehot, per_joint(layout.action), all_joints(layout.payload)]
        return np.hstack(branch), np.hstack(trunk)

    def fit_inputs(self, x: Tensor) -> None:
        super().fit_inputs(x)
        if self.config.context:
            self.context_scale.fit(x[:, self.features.layout.context], min_std=MIN_CONTEXT_STD_RAD)

    def prepare(self, x: Tensor) -> Tensor:
        z = self.features(x)
        if self.config.context:
            z = torch.cat([z, self.context(x)], dim=1)
        return self.arrange(z)

    def context(self, x: Tensor) -> Tensor:
        """x → standardised answers of the simulator, (B, 8n), within the range in which they were
        trained.
        """
        z = self.context_scale(x[:, self.features.layout.context]).clamp(-MAX_CONTEXT, MAX_CONTEXT)
        if self.features.noise_std:
            z = z + self.features.noise_std * torch.randn_like(z)
        result: Tensor = z
        return result

    def arrange(self, z: Tensor) -> Tensor:
        """Features, and the context if there is one → [branch inputs | trunk inputs] of each
        joint, (B, n, both).
        """
        if self.config.sensors != "off":
            z = torch.cat([z, self.sensors(z)], dim=1)
        z = pad(pad(z, (0, 1)), (0, 1), value=1.0)  # [… | 0 | 1], for the one-hot index
        inputs = self.branch_inputs + self.trunk_inputs  # of a joint
        return z.index_select(1, self.columns).reshape(-1, self.n, inputs)

    def correct(self, prepared: Tensor) -> Tensor:
        """⟨branch, trunk⟩ + c → Δa, (B, n) rad."""
        rows = prepared.flatten(0, -2)  # two-dimensional, so that linear layers copy nothing
        branch_rows = rows[:, : self.branch_inputs]
        trunk_rows = rows[:, self.branch_inputs :]
        shape = (-1, self.n, self.config.num_basis)
        branch = self.branch(branch_rows).reshape(shape)
        trunk = self.trunk(trunk_rows).reshape(shape)
        result: Tensor = self.bounded((branch * trunk).sum(-1) + self.bias)
        return result

    def sensors(self, z: Tensor) -> Tensor:
        """Features → predicted sensor values, standardised, (B, 2nm): n positions and n velocities
        per probe.
        """
        result: Tensor = self.predictor.mean(z[:, self.features.layout.observation])
        return result


class DeltaMLP(DeltaNet):
    """Baseline: a plain network on all features, the form of ASAP."""

    def __init__(self, config: ModelConfig, n: int, hidden: Sequence[int] | None = None) -> None:
        """hidden: Widths of the hidden layers; default config.mlp_hidden."""
        super().__init__(config, n)
        if hidden is None:
            hidden = config.mlp_hidden
        self.net = dense(self.features.dim, hidden, n, zero_output=True)

    def correct(self, prepared: Tensor) -> Tensor:
        result: Tensor = self.bounded(self.net(prepared))
        return result

    @staticmethod
    def matched_hidden(
        hidden: Sequence[int], parameters: int, build: Callable[[tuple[int, ...]], nn.Module]
    ) -> tuple[int, ...]:
        """Scale widths so that the network of `build` has nearly this number of parameters."""
        largest = max(hidden)

        def scaled(width: int) -> tuple[int, ...]:
            return tuple(max(1, round(w * width / largest)) for w in hidden)

        def excess(width: int) -> int:
            with torch.device("meta"):  # shapes only
                return num_parameters(build(scaled(width))) - parameters

        low = 1
        high = 1
        while excess(high) < 0:
            low = high
            high = 2 * high
        while high - low > 1:
            middle = (low + high) // 2
            if excess(middle) < 0:
                low = middle
            else:
                high = middle
        return scaled(min((low, high), key=lambda width: abs(excess(width))))


class SharedMLP(OperatorNet):
    """Baseline: one plain network with the inputs and sensors of the operator, shared by the
    joints.

    It has as many weights as branch and trunk together. The only difference to the operator is the
    missing product.
    """

    def __init__(self, config: ModelConfig, n: int) -> None:
        super().__init__(config, n)
        inputs = self.branch_inputs + self.trunk_inputs
        weights = num_parameters(self.branch) + num_parameters(self.trunk) + n
        del self.branch, self.trunk, self.bias
        hidden = DeltaMLP.matched_hidden(
            config.mlp_hidden, weights, lambda widths: dense(inputs, widths, 1)
        )
        self.net = dense(inputs, hidden, 1, zero_output=True)

    def correct(self, prepared: Tensor) -> Tensor:
        result: Tensor = self.bounded(self.net(prepared).squeeze(-1))
        return result


NETWORKS: dict[ModelKind, Callable[[ModelConfig, int], DeltaNet]] = {
    "gaponet": OperatorNet,
    "paper": PaperNet,
    "shared_mlp": SharedMLP,
    "mlp": DeltaMLP,
    "trees": TreesNet,
}


def build_network(config: ModelConfig, n: int) -> DeltaNet:
    """Return an untrained network for n operated joints.

    Raises:
        UsageError: An option belongs to another kind of network.
    """
    config.require_kind()
    if not config.mlp_match or config.kind != "mlp":
        return NETWORKS[config.kind](config, n)
    with torch.device("meta"):  # shapes only
        parameters = num_parameters(OperatorNet(replace(config, kind="gaponet"), n))
    hidden = DeltaMLP.matched_hidden(
        config.mlp_hidden, parameters, lambda widths: DeltaMLP(config, n, widths)
    )
    return DeltaMLP(config, n, hidden)
