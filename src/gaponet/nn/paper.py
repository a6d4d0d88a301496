"""The network of the GAPONet paper in its literal form: `gaponet train … --model paper`.

    (μ, log σ²) = f(A, Q, V, P, J),  S ~ N(μ, σ²)      (1)  sensor predictor, 128-128
    b = Branch(S)                                      (2)  branch, 256-256-256-16n, ELU after the last layer as well
    y = Trunk(A) or Trunk(P, A)                        (3)  trunk, 128-128-128-16n, linear output
    Δa_j = Σ_i b_ij y_ij,  i = 1 … p = 16              (4)  no bias

S holds the answers of the simulator to m = 20 probe targets (nn/sensor.py): positions and velocities of all n joints
after one control period, (m, 2n). S is the only input of the branch, so it carries all information about the state.
Targets A, positions Q, and velocities V are the present state and the H frames of the observation: 20 + 30 H numbers
for n = 10, one more with the payload P. The joint index J is the place in the output: one pass serves all joints.

The paper also has the recorded state, Q_real and V_real, in (1). The critic of PPO observes both (nn/training/env.py).
The predictor does not: the simulator's answers do not depend on them. With `real_state` they are inputs of the branch.

The probe targets are q + e_k, k = 1 … m. `sensor_source` is one of:

    predicted   e_k are fixed; one predictor gives the answers to all
    fixed       e_k are fixed; the simulator itself gives S, which is the limit of a perfect predictor
    learned     e_k are parameters that PPO trains, within ±probe_limit. The predictor takes one e_k beside the state
                and gives its 2n answers. It is fitted to random e_k, then frozen; gradients pass through it.

The literal form lacks two inputs of the default network. `branch_observation` adds the observation with its history,
relative to q, to the branch. `relative_action` gives A − q instead of A to the trunk.

S is sampled in training and is the mean in evaluation and export. Δ_max is a safety limit: exact clipping, in
evaluation and export; training reports the share of corrections at the limit.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import linear

from gaponet.nn.config import ModelConfig
from gaponet.nn.layers import DeltaNet, Standardise, dense
from gaponet.nn.sensor import ProbeOracle

PREDICTOR_HIDDEN, BRANCH_HIDDEN, TRUNK_HIDDEN = (128, 128), (256, 256, 256), (128, 128, 128)
REAL_STATE_SCALES = (0.05, 0.3)  # rad, rad/s, of differences between recorded and simulated state


class SensorPredictor(nn.Module):
    """Equation (1): mean and log-variance of the standardised sensor values."""

    def __init__(self, inputs: int, hidden: tuple[int, ...], sensors: int) -> None:
        super().__init__()
        self.outputs = Standardise(sensors)
        self.net = dense(inputs, hidden, 2 * sensors)

    def forward(self, observed: Tensor) -> tuple[Tensor, Tensor]:
        """(B, inputs) → mean and log-variance, (B, sensors) each."""
        return self.distribution(self.net(observed))

    @staticmethod
    def distribution(outputs: Tensor) -> tuple[Tensor, Tensor]:
        """Outputs of the net, (…, 2 sensors) → mean and log-variance, (…, sensors) each."""
        mean, log_var = outputs.chunk(2, dim=-1)
        return mean, log_var.clamp(-10.0, 4.0)

    def mean(self, observed: Tensor) -> Tensor:
        """(B, inputs) → the mean alone, (B, sensors)."""
        hidden: nn.Module = self.net[:-1]
        head: Any = self.net[-1]
        return linear(hidden(observed), head.weight.chunk(2)[0], head.bias.chunk(2)[0])


class PaperNet(DeltaNet):
    """Equations (1) to (4), on standardised absolute positions and targets.

    `features` (relative to q) are for the critic of PPO, branch_observation and relative_action.

    Attributes:
        observation, query: Columns of x for equation (1), and for the trunk: {P, A} or A.
        probes: atanh(e_k / probe_limit) of learned probes, (m, n); else None.
        extra_inputs: Number of branch inputs besides S.
    """

    def __init__(self, config: ModelConfig, n: int) -> None:
        super().__init__(config, n)
        layout, sensors, outputs = self.features.layout, config.sensor_dim(n), config.num_basis * n
        self.observation = layout.observation
        self.query = slice(
            layout.payload.start if config.payload_trunk else layout.action.start,
            layout.action.stop,
        )
        queries = self.query.stop - self.query.start
        self.observation_scale, self.query_scale = (
            Standardise(self.observation.stop),
            Standardise(queries),
        )
        self.probes: nn.Parameter | None = None
        if config.needs_simulator:
            self.sensor_scale = Standardise(sensors)
        elif config.sensor_source == "learned":
            start = (
                torch.from_numpy(ProbeOracle.probe_offsets(config, n)).float() / config.probe_limit
            )
            self.probes = nn.Parameter(start.atanh())
            self.predictor = SensorPredictor(self.observation.stop + n, PREDICTOR_HIDDEN, 2 * n)
        else:
            self.predictor = SensorPredictor(self.observation.stop, PREDICTOR_HIDDEN, sensors)
        self.real_state_scale = [*(scale for scale in REAL_STATE_SCALES for _ in range(n)), 1.0]
        observations = self.observation.stop * config.branch_observation
        self.extra_inputs = observations + len(self.real_state_scale) * config.real_state
        self.branch = nn.Sequential(
            *dense(self.extra_inputs + sensors, BRANCH_HIDDEN, outputs), nn.ELU()
        )
        self.trunk = dense(queries, TRUNK_HIDDEN, outputs, zero_output=True)

    def fit_inputs(self, x: Tensor) -> None:
        super().fit_inputs(x)
        self.observation_scale.fit(x[:, self.observation])
        self.query_scale.fit(x[:, self.query])
        if self.config.needs_simulator:
            self.sensor_scale.fit(x[:, self.features.layout.sensors], min_std=1e-6)

    def sensor_inputs(self, x: Tensor) -> Tensor:
        z = self.observation_scale(x[:, self.observation])
        return z + self.features.noise_std * torch.randn_like(z) if self.features.noise_std else z

    def sensors(self, x: Tensor, z: Tensor) -> Tensor:
        """Equation (1): S, standardised, (B, 2nm): a sample in training, else the mean, or the simulator's answers.

        PPO changes learned probes after `prepare`. For them, the result is therefore the input of `probed`:
        z = sensor_inputs(x) and, in training, the noise of the sample.
        """
        if self.config.needs_simulator:
            return self.sensor_scale(x[:, self.features.layout.sensors])
        if not self.training:
            return z if self.probes is not None else self.predictor.mean(z)
        noise = torch.randn(len(z), self.config.sensor_dim(self.n), device=z.device)
        if self.probes is not None:
            return torch.cat([z, noise], dim=1)
        mean, log_var = self.predictor(z)
        return mean + noise * (0.5 * log_var).exp()

    def probed(self, inputs: Tensor) -> Tensor:
        """Result of `sensors` with learned probes → S, (B, 2nm)."""
        assert self.probes is not None
        observations, first = self.observation.stop, self.predictor.net[0]
        state_weight, probe_weight = first.weight.split([observations, self.n], dim=1)
        state = linear(inputs[:, :observations], state_weight)
        probes = linear(self.probes.tanh(), probe_weight, first.bias)
        mean, log_var = SensorPredictor.distribution(
            self.predictor.net[1:](state.unsqueeze(1) + probes)
        )  # (B, m, 2n)
        if not self.training:
            return mean.flatten(1)
        return torch.addcmul(
            mean.flatten(1), inputs[:, observations:], (0.5 * log_var).exp().flatten(1)
        )

    def prepare(self, x: Tensor) -> Tensor:
        """x → [trunk input | extra branch inputs | S]."""
        z, config = self.sensor_inputs(x), self.config
        relative = self.features(x) if config.branch_observation or config.relative_action else x
        extra = [relative[:, self.observation]] if config.branch_observation else []
        extra += (
            [x[:, self.features.layout.real] / x.new_tensor(self.real_state_scale)]
            if config.real_state
            else []
        )
        query = (
            relative[:, self.query]
            if config.relative_action
            else self.query_scale(x[:, self.query])
        )
        return torch.cat([query, *extra, self.sensors(x, z)], dim=1)

    def correct(self, prepared: Tensor) -> Tensor:
        """Output of `prepare` → Δa, (B, n) rad."""
        shape, queries = (-1, self.config.num_basis, self.n), self.query.stop - self.query.start
        sensors = prepared[:, queries:]
        if self.probes is not None:
            extra = sensors[:, : self.extra_inputs]
            sensors = torch.cat([extra, self.probed(sensors[:, self.extra_inputs :])], dim=1)
        b = self.branch(sensors).reshape(shape)  # (2)
        y = self.trunk(prepared[:, :queries]).reshape(shape)  # (3)
        return self.bounded((b * y).sum(1))  # (4)
