"""What a model is, as data: the fields shape the network, the docstrings under them are the command-line help."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Interval, Len

from gaponet.errors import UsageError

Kind = Literal["gaponet", "shared_mlp", "mlp", "transformer", "fno", "inverse"]
OPERATORS = ("gaponet", "shared_mlp")  # kinds that take what branch and trunk take
CONTEXT = {"none": 0, "parameters": 7, "fingerprint": 36}  # numbers per joint (family/context.py)
Layers = Annotated[tuple[Annotated[int, Interval(ge=1, le=65536)], ...], Len(0, 32)]  # widths

POSITIVE = (
    "history", "stride", "num_probes", "num_basis", "delta_max", "payload_max", "delta_hold", "sensor_hold",
    "transformer_width", "transformer_layers", "transformer_heads", "fno_width", "fno_layers", "fno_modes",
)  # fmt: skip


@dataclass(frozen=True)
class ModelConfig:
    """Shape of a delta-action model; every dimension is derived from it and the number of operated joints n."""

    kind: Kind = "gaponet"
    """gaponet: the operator. shared_mlp: one plain network with exactly the operator's inputs and as many weights as
    its branch and trunk, shared by the joints. mlp: a plain network on [observation, action], the ASAP form.
    transformer: attention over the past frames and the present. fno: Fourier neural operator over the same time axis.
    inverse: the mlp fitted once to the inverse labels on the recorded motions, without roll-outs of its own and without
    PPO."""
    history: Annotated[int, Interval(ge=1, le=1000)] = 4
    """H, past frames in the observation. A history shorter than the robot's lag cannot see it."""
    stride: Annotated[int, Interval(ge=1, le=1000)] = 1
    """Control periods between past frames."""
    payload_input: bool = True
    """Whether the payload mass is observed."""
    payload_trunk: bool = True
    """Whether the trunk is asked at the payload as well as at the action, where it is observed."""
    payload_predictor: bool = True
    """Whether the sensor predictor sees the payload, where it is observed."""
    payload_max: Annotated[float, Interval(gt=0, le=100)] = 3.0
    """Mass that counts as 1 at the input, kg."""
    delta_max: Annotated[float, Interval(gt=0, le=10)] = 0.3
    """Largest correction, rad."""
    delta_hold: Annotated[int, Interval(ge=1, le=1000)] = 1
    """Control periods that a correction is held; the reward of a decision is the mean over them."""
    num_probes: Annotated[int, Interval(ge=1, le=1000)] = 20
    """m, how many targets the simulator is asked about."""
    probe_small: Annotated[float, Interval(ge=0, le=10)] = 0.05
    """Probe that reads gains and friction, rad."""
    probe_large: Annotated[float, Interval(ge=0, le=10)] = 0.4
    """Probe that reads inertia, payload and saturation, rad."""
    sensors: Literal["predicted", "oracle", "learned", "off"] = "predicted"
    """predicted: the sensor predictor stands in for the simulator's probes. off: the branch sees o_t only. oracle: the
    simulator itself is asked at every state. learned: it is asked at targets that a network chooses. The last two need
    the simulator's whole state and m more simulations: to compare with, of no use on a robot."""
    sensor_target: Literal["delta", "absolute"] = "delta"
    """delta: a probe's answer is [q' − q, Δt·(q̇' − q̇)]. absolute: [q', Δt·q̇']."""
    sensor_hold: Annotated[int, Interval(ge=1, le=1000)] = 1
    """Control periods that the sensors are held; predicted ones stay those of the observation at the last refresh. With
    delta_hold they are refreshed at the next decision."""
    context: Literal["none", "parameters", "fingerprint"] = "none"
    """What the branch is told of the simulator it is in, where --family draws many. parameters: its numbers.
    fingerprint: its answers to a few steps, asked once. With either, a model is for simulators, not for a robot."""
    branch_history: bool = True
    """Whether the branch also sees the observation. Probe responses depend on the state alone, so without it no delay
    can be corrected (docs/log.md)."""
    coupling: Literal["joint", "full"] = "joint"
    """joint: branch and trunk are shared by the joints and take one joint at a time; postures never recorded do not
    lead them astray (docs/log.md). full: the paper's, every joint sees every joint. The mlp is always full."""
    branch: Literal["unstacked", "stacked"] = "unstacked"
    """unstacked: one branch net emits all p features. stacked: p nets of the same hidden layers emit one each."""
    num_basis: Annotated[int, Interval(ge=1, le=4096)] = 16
    """p, basis functions per joint."""
    branch_hidden: Layers = (64, 64)
    """Hidden layers of the branch net; the paper's full coupling has 256 256 256."""
    trunk_hidden: Layers = (32, 32)
    """Hidden layers of the trunk net; the paper's full coupling has 128 128 128."""
    sensor_hidden: Layers = (128, 64)
    """Hidden layers of the sensor predictor; 256 256 predict no better (docs/log.md)."""
    mlp_hidden: Layers = (512, 256, 128)
    """Hidden layers of the MLP baseline (ASAP's size)."""
    mlp_match: bool = False
    """Widen or narrow mlp_hidden, in its proportions, until the MLP has as many parameters as the operator would."""
    transformer_width: Annotated[int, Interval(ge=1, le=4096)] = 64
    """Numbers per token of the transformer."""
    transformer_layers: Annotated[int, Interval(ge=1, le=64)] = 2
    """Blocks of attention and MLP."""
    transformer_heads: Annotated[int, Interval(ge=1, le=256)] = 4
    """Attention heads; they share the width."""
    fno_width: Annotated[int, Interval(ge=1, le=4096)] = 32
    """Channels of the Fourier neural operator."""
    fno_layers: Annotated[int, Interval(ge=1, le=64)] = 3
    """Spectral layers."""
    fno_modes: Annotated[int, Interval(ge=1, le=1024)] = 4
    """Lowest frequencies kept, the mean included; at most history + 2 exist."""

    def __post_init__(self) -> None:
        for field in POSITIVE:
            if getattr(self, field) <= 0:
                raise UsageError(f"{field} is {getattr(self, field)}; it must be positive")
        if (self.mlp_match or self.kind == "shared_mlp") and not self.mlp_hidden:
            raise UsageError(
                "mlp_match or shared_mlp without mlp_hidden: give the proportions of the hidden layers, e.g. 4 2 1"
            )
        if self.kind == "shared_mlp" and self.coupling == "full":
            raise UsageError("shared_mlp takes one joint at a time; with full coupling the plain network is mlp")
        if self.context != "none" and not self.joint_wise:
            raise UsageError(
                f"context {self.context} is told one joint at a time: to gaponet or shared_mlp, not {self.kind}"
            )
        if self.transformer_width % self.transformer_heads:
            raise UsageError(
                f"transformer_width {self.transformer_width} cannot be shared by {self.transformer_heads} heads; "
                "make it a multiple of transformer_heads"
            )

    @property
    def joint_wise(self) -> bool:
        """Whether one joint at a time passes through branch and trunk."""
        return self.kind in OPERATORS and self.coupling == "joint"

    def observation_dim(self, n: int) -> int:
        """2n + 3nH (+ 1 with payload)."""
        return 2 * n + 3 * n * self.history + int(self.payload_input)

    def sensor_dim(self, n: int) -> int:
        """m probes, each answered by n positions and n velocities."""
        return self.num_probes * 2 * n

    @property
    def context_dim(self) -> int:
        """Numbers per joint that say which simulator it is."""
        return CONTEXT[self.context]

    @property
    def asks_simulator(self) -> bool:
        """Whether the sensors are the simulator's own answers, a part of x."""
        return self.kind in OPERATORS and self.sensors in ("oracle", "learned")

    @property
    def learns_points(self) -> bool:
        """Whether a network chooses where the simulator is asked."""
        return self.asks_simulator and self.sensors == "learned"

    @property
    def keeps_observation(self) -> bool:
        """Whether x carries the observation of the last refresh, for what the sensors are predicted or chosen from."""
        return self.kind in OPERATORS and self.sensors in ("predicted", "learned") and self.sensor_hold > 1

    def input_dim(self, n: int) -> int:
        """Numbers in x = [o_t | a_t | o_refresh or S_t | context, where there is one]."""
        more = self.observation_dim(n) * self.keeps_observation + self.sensor_dim(n) * self.asks_simulator
        return self.observation_dim(n) + n + more + self.context_dim * n
