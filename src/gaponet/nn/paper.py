"""The network of the GAPONet paper in its literal form: `gaponet train … --model paper`.

    (μ, log σ²) = f(A, Q, V, P, J, Q_real, V_real),  S ~ N(μ, σ²)   (1)
    b = Branch(S)                                                   (2)
    y = Trunk(A) or Trunk(P, A)                                     (3)
    Δa_j = Σ_i b_ij y_ij,  i = 1 … p = 16                           (4)

    (1) sensor predictor, hidden layers 128-128
    (2) branch, 256-256-256-16n, ELU after each layer
    (3) trunk, 128-128-128-16n, linear output
    (4) no bias

A is the target, Q and V are positions and velocities, P is the payload, J is the joint index.
Q_real and V_real are the recorded state.

S holds the answers of the simulator to m = 20 probe targets (nn/sensor.py): positions and
velocities of all n joints after one control period, (m, 2n). S is the only input of the branch, so
it carries all information about the state. S is sampled in training and is the mean in evaluation
and export.

`predictor_inputs` says what the predictor of (1) sees:

    observation   Q, V, P, and the H past frames of Q, V, A: 20 + 30 H numbers for n = 10, one
                  more with P. J is the place in the output: one pass gives the sensor values of
                  all joints.
    equation_1    Also the present A, J, Q_real − Q, V_real − V, and 1 where the recorded state is
                  visible. One network is shared by the joints: with the input J, it gives the 2m
                  sensor values of joint J.

The predictor is fitted to the simulator's answers at the present state. They depend on Q, V and P.
They do not depend on A, because a probe takes the place of the target, and they do not depend on
Q_real and V_real. A good fit therefore ignores A, Q_real and V_real, and PPO does not train the
predictor. `equation_1` exists because the paper has it, not because it can give the branch more
information.

`sensor_source` says where S comes from. The probe targets are q + e_k, k = 1 … m:

    predicted   e_k are fixed; one predictor gives the answers to all.
    fixed       e_k are fixed; the simulator itself gives S, the limit of a perfect predictor.
    learned     e_k are parameters that PPO trains, within ±probe_limit. The predictor takes one
                e_k beside the state and gives its 2n answers. It is fitted to random e_k, then
                frozen; gradients pass through it.
    none        There is no S. The branch sees the observation, as the predictor would see it.
                Compare with `predicted` to learn what the predictor costs and brings.

Three switches add inputs that the paper's branch and trunk do not have. `branch_observation` adds
the observation with its history, relative to q, to the branch. `relative_action` gives A − q
instead of A to the trunk. `real_state` adds Q_real − Q and V_real − V to the branch. The critic of
PPO always observes the recorded state (nn/training/env.py).

Δ_max is a safety limit: exact clipping in evaluation and export. Training reports how many
corrections are at the limit.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import linear

from gaponet.nn.config import ModelConfig
from gaponet.nn.layers import DeltaNet, Standardise, dense
from gaponet.nn.sensor import ProbeOracle

PREDICTOR_HIDDEN = (128, 128)
BRANCH_HIDDEN = (256, 256, 256)
TRUNK_HIDDEN = (128, 128, 128)
MIN_LOG_VARIANCE = -10.0  # of standardised sensor values, so that the likelihood stays finite
MAX_LOG_VARIANCE = 4.0
REAL_POSITION_SCALE_RAD = 0.05  # of recorded minus simulated positions
REAL_VELOCITY_SCALE_RAD_S = 0.3  # of recorded minus simulated velocities


class SensorPredictor(nn.Module):
    """Equation (1): mean and log-variance of the standardised sensor values.

    Attributes:
        outputs: Scale of the sensor values.
        net: Inputs → [mean | log-variance].
    """

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
        return mean, log_var.clamp(MIN_LOG_VARIANCE, MAX_LOG_VARIANCE)

    def mean(self, observed: Tensor) -> Tensor:
        """(B, inputs) → the mean alone, (B, sensors)."""
        hidden: nn.Module = self.net[:-1]
        return self.mean_of(hidden(observed))

    def mean_of(self, hidden: Tensor) -> Tensor:
        """Last hidden layer, (…, width) → the mean alone, (…, sensors).

        The log-variance is not computed.
        """
        head: Any = self.net[-1]
        weight, _ = head.weight.chunk(2)
        bias, _ = head.bias.chunk(2)
        return linear(hidden, weight, bias)

    def hidden_of_pairs(self, observed: Tensor, chosen: Tensor) -> Tensor:
        """Return the last hidden layer for all pairs [row of observed | row of chosen], (B, k,
        width).

        The first layer is linear, so it is evaluated once for each row instead of once for each
        pair.

        Args:
            observed: The first inputs, (B, inputs − c).
            chosen: The last inputs, (k, c): probes or joint indices.
        """
        first: Any = self.net[0]
        rest: nn.Module = self.net[1:-1]
        sizes = [observed.shape[1], chosen.shape[1]]
        observed_weight, chosen_weight = first.weight.split(sizes, dim=1)
        from_observed = linear(observed, observed_weight)
        from_chosen = linear(chosen, chosen_weight, first.bias)
        result: Tensor = rest(from_observed.unsqueeze(1) + from_chosen)
        return result


class JointSensorPredictor(SensorPredictor):
    """Equation (1) as written: one network for all joints, with the joint index J as its last
    input.

    Given the state of the whole robot and J, one-hot, the net gives mean and log-variance of the 2m
    sensor values of joint J. Results have the sensor values of all joints in the order of S, (m,
    2n).
    """

    joint_index: Tensor

    def __init__(self, inputs: int, hidden: tuple[int, ...], num_probes: int, n: int) -> None:
        """inputs: Number of inputs besides J."""
        super().__init__(inputs + n, hidden, 2 * num_probes)
        self.outputs = Standardise(2 * num_probes * n)  # each joint has its own scale
        self.register_buffer("joint_index", torch.eye(n), persistent=False)

    def forward(self, observed: Tensor) -> tuple[Tensor, Tensor]:
        """(B, inputs) → mean and log-variance, (B, 2nm) each."""
        head: nn.Module = self.net[-1]
        hidden = self.hidden_of_pairs(observed, self.joint_index)
        mean, log_var = self.distribution(head(hidden))
        return self._in_order_of_sensors(mean), self._in_order_of_sensors(log_var)

    def mean(self, observed: Tensor) -> Tensor:
        """(B, inputs) → the mean alone, (B, 2nm)."""
        hidden = self.hidden_of_pairs(observed, self.joint_index)
        return self._in_order_of_sensors(self.mean_of(hidden))

    @staticmethod
    def _in_order_of_sensors(by_joint: Tensor) -> Tensor:
        """(B, n, 2m) → (B, 2nm): the joint varies fastest."""
        return by_joint.transpose(1, 2).flatten(1)


class PaperNet(DeltaNet):
    """Equations (1) to (4), on standardised absolute positions and targets.

    `features` (relative to q) are for the critic of PPO, branch_observation and relative_action.

    Attributes:
        predictor_columns: Columns of x for equation (1), the recorded state aside: o_t or [o_t |
            a_t].
        query: Columns of x for the trunk: {P, A} or A.
        probes: atanh(e_k / probe_limit) of learned probes, (m, n); else None.
        extra_inputs: Number of branch inputs besides S.
        real_state_scale: Scales of [q_real − q | q̇_real − q̇ | visible], (2n + 1,).
    """

    real_state_scale: Tensor

    def __init__(self, config: ModelConfig, n: int) -> None:
        super().__init__(config, n)
        layout = self.features.layout
        outputs = config.num_basis * n
        self.predictor_columns = layout.observation
        if config.predictor_inputs == "equation_1":
            self.predictor_columns = layout.query
        self.query = layout.action
        if config.payload_trunk:
            self.query = slice(layout.payload.start, layout.action.stop)
        self.observation_scale = Standardise(self.predictor_columns.stop)
        self.query_scale = Standardise(self.queries)
        scales = [REAL_POSITION_SCALE_RAD] * n + [REAL_VELOCITY_SCALE_RAD_S] * n + [1.0]
        self.register_buffer("real_state_scale", torch.tensor(scales), persistent=False)
        self.probes: nn.Parameter | None = None
        sensors = self._add_sensors()
        self.extra_inputs = 0
        if config.branch_observation:
            self.extra_inputs += layout.observation.stop
        if config.real_state:
            self.extra_inputs += len(scales)
        branch = dense(self.extra_inputs + sensors, BRANCH_HIDDEN, outputs)
        self.branch = nn.Sequential(*branch, nn.ELU())
        self.trunk = dense(self.queries, TRUNK_HIDDEN, outputs, zero_output=True)

    @property
    def queries(self) -> int:
        """Number of trunk inputs."""
        return int(self.query.stop - self.query.start)

    def _add_sensors(self) -> int:
        """Create what gives the sensor values.

        Return the number of values that the branch sees in their place.
        """
        config = self.config
        n = self.n
        observed: int = self.predictor_columns.stop
        sensors = config.sensor_dim(n)
        if config.sensor_source == "none":
            return observed
        if config.sensor_source == "fixed":
            self.sensor_scale = Standardise(sensors)
        elif config.sensor_source == "learned":
            offsets = torch.from_numpy(ProbeOracle.probe_offsets(config, n)).float()
            self.probes = nn.Parameter((offsets / config.probe_limit).atanh())
            self.predictor = SensorPredictor(observed + n, PREDICTOR_HIDDEN, 2 * n)
        elif config.predictor_inputs == "equation_1":
            observed += config.real_state_dim(n)
            self.predictor = JointSensorPredictor(observed, PREDICTOR_HIDDEN, config.num_probes, n)
        else:
            self.predictor = SensorPredictor(observed, PREDICTOR_HIDDEN, sensors)
        return sensors

    def fit_inputs(self, x: Tensor) -> None:
        super().fit_inputs(x)
        self.observation_scale.fit(x[:, self.predictor_columns])
        self.query_scale.fit(x[:, self.query])
        if self.config.needs_simulator:
            self.sensor_scale.fit(x[:, self.features.layout.sensors], min_std=1e-6)

    # ---- inputs, which PPO evaluates once per sample

    def prepare(self, x: Tensor) -> Tensor:
        """x → [trunk input | extra branch inputs | result of `sensors`]."""
        config = self.config
        z = self.sensor_inputs(x)
        relative = x
        if config.branch_observation or config.relative_action:
            relative = self.features(x)
        query = self.query_scale(x[:, self.query])
        if config.relative_action:
            query = relative[:, self.query]
        parts = [query]
        if config.branch_observation:
            parts.append(relative[:, self.features.layout.observation])
        if config.real_state:
            parts.append(self.real_state(x))
        parts.append(self.sensors(x, z))
        return torch.cat(parts, dim=1)

    def sensor_inputs(self, x: Tensor) -> Tensor:
        """x → inputs of equation (1), without J: standardised o_t, or [o_t | a_t | recorded
        state].
        """
        z = self.observation_scale(x[:, self.predictor_columns])
        if self.features.noise_std:
            z = z + self.features.noise_std * torch.randn_like(z)
        if self.config.predictor_inputs == "equation_1":
            z = torch.cat([z, self.real_state(x)], dim=1)
        result: Tensor = z
        return result

    def real_state(self, x: Tensor) -> Tensor:
        """x → scaled [q_real − q | q̇_real − q̇ | 1], (B, 2n + 1), or zeros where the recorded
        state is hidden.
        """
        return x[:, self.features.layout.real] / self.real_state_scale

    def sensors(self, x: Tensor, z: Tensor) -> Tensor:
        """Equation (1): S, standardised, (B, 2nm): a sample in training, else the mean, or the
        simulator's answers.

        Without sensors, the result is z = sensor_inputs(x).

        PPO changes learned probes after `prepare`. For them, the result is therefore the input of
        `probed`: z and, in training, the noise of the sample.
        """
        source = self.config.sensor_source
        if source == "none":
            return z
        if source == "fixed":
            scaled: Tensor = self.sensor_scale(x[:, self.features.layout.sensors])
            return scaled
        if not self.training:
            return z if source == "learned" else self.predictor.mean(z)
        noise = torch.randn(len(z), self.config.sensor_dim(self.n), device=z.device)
        if source == "learned":
            return torch.cat([z, noise], dim=1)
        mean, log_var = self.predictor(z)
        sample: Tensor = mean + noise * (0.5 * log_var).exp()
        return sample

    # ---- the operator, which PPO trains

    def correct(self, prepared: Tensor) -> Tensor:
        """Output of `prepare` → Δa, (B, n) rad."""
        query = prepared[:, : self.queries]
        seen_by_branch = prepared[:, self.queries :]
        if self.probes is not None:
            extra = seen_by_branch[:, : self.extra_inputs]
            sensors = self.probed(seen_by_branch[:, self.extra_inputs :])
            seen_by_branch = torch.cat([extra, sensors], dim=1)
        shape = (-1, self.config.num_basis, self.n)
        b = self.branch(seen_by_branch).reshape(shape)  # (2)
        y = self.trunk(query).reshape(shape)  # (3)
        result: Tensor = self.bounded((b * y).sum(1))  # (4)
        return result

    def probed(self, inputs: Tensor) -> Tensor:
        """Result of `sensors` with learned probes → S, (B, 2nm)."""
        assert self.probes is not None
        head: nn.Module = self.predictor.net[-1]
        z = inputs[:, : self.predictor_columns.stop]
        noise = inputs[:, self.predictor_columns.stop :]
        hidden = self.predictor.hidden_of_pairs(z, self.probes.tanh())  # (B, m, width)
        mean, log_var = SensorPredictor.distribution(head(hidden))  # (B, m, 2n)
        if not self.training:
            return mean.flatten(1)
        std = (0.5 * log_var).exp()
        return torch.addcmul(mean.flatten(1), noise, std.flatten(1))
