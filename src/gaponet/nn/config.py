"""What a model is, as data: the fields shape the network, the docstrings under them are the command-line help."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Interval, Len

from gaponet.base.errors import UsageError

Kind = Literal["gaponet", "paper", "shared_mlp", "mlp", "inverse"]
Layers = Annotated[tuple[Annotated[int, Interval(ge=1, le=65536)], ...], Len(0, 32)]  # widths

POSITIVE = ("history", "stride", "num_probes", "num_basis", "delta_max", "payload_max")
PAPER_ONLY = (
    "payload_trunk", "delta_hold", "sensor_source", "sensor_hold", "sensor_target", "branch_observation",
    "relative_action", "real_state",
)  # fmt: skip


@dataclass(frozen=True)
class ModelConfig:
    """Shape of a delta-action model; every dimension is derived from it and the number of operated joints n."""

    kind: Kind = "gaponet"
    """gaponet: the operator. paper: the network of the paper in its literal form, with the paper's layer widths
    (nn/paper.py). shared_mlp: one plain network with exactly the operator's inputs and as many weights as
    its branch and trunk, shared by the joints. mlp: a plain network on [observation, action], the ASAP form.
    inverse: the mlp fitted once to the labels on the recorded motions, without roll-outs of its own and without PPO."""
    history: Annotated[int, Interval(ge=1, le=1000)] = 4
    """H, past frames in the observation. A history shorter than the robot's lag cannot see it."""
    stride: Annotated[int, Interval(ge=1, le=1000)] = 1
    """Control periods between past frames."""
    payload_input: bool = True
    """Whether the payload mass is observed."""
    payload_trunk: bool = True
    """paper: whether the trunk sees the observed payload beside the action."""
    payload_max: Annotated[float, Interval(gt=0, le=100)] = 3.0
    """Mass that counts as 1 at the input, kg."""
    delta_max: Annotated[float, Interval(gt=0, le=10)] = 0.3
    """Largest correction, rad."""
    delta_hold: Annotated[int, Interval(ge=1, le=1000)] = 1
    """paper: control periods that a correction is held (action duration)."""
    sensor_source: Literal["predicted", "fixed", "learned"] = "predicted"
    """paper: who gives the sensor values. predicted: the sensor predictor, for the num_probes fixed probes. fixed: the
    simulator itself, stepped once for each fixed probe; for training and gaponet eval alone, a robot has no simulator.
    learned: the sensor predictor, for probes that start at the fixed ones and that PPO trains."""
    sensor_hold: Annotated[int, Interval(ge=1, le=1000)] = 1
    """paper: control periods that the sensor values are held."""
    sensor_target: Literal["delta", "absolute"] = "delta"
    """paper: what a sensor value is. delta: the change of state, S(t+1) − S(t). absolute: the next state, S(t+1)."""
    branch_observation: bool = False
    """paper: whether the branch sees the observation, with its history and relative to the present position, beside the
    sensor values. This is not the paper's form: the sensor values of the present state hold no history."""
    relative_action: bool = False
    """paper: whether the trunk sees the action minus the present position. This is not the paper's form: a lag of
    10 mrad is hard to see in angles that span a radian."""
    real_state: bool = False
    """paper: whether the branch sees the recorded state, relative to the simulated one, beside the sensor values.
    Training hides it in half of the episodes. It is unknown in gaponet eval and wherever else no measured state is
    given (DeltaLoop.extra)."""
    num_probes: Annotated[int, Interval(ge=1, le=1000)] = 20
    """m, how many targets the simulator is asked about."""
    probe_small: Annotated[float, Interval(ge=0, le=10)] = 0.05
    """Probe that reads gains and friction, rad."""
    probe_large: Annotated[float, Interval(ge=0, le=10)] = 0.4
    """Probe that reads inertia, payload and saturation, rad."""
    sensors: Literal["off", "predicted"] = "off"
    """off: the branch sees the observation. predicted: a sensor predictor's stand-in for the simulator's probes as
    well, as in the paper; worth nothing where it was measured (docs/results/unnamed.md)."""
    num_basis: Annotated[int, Interval(ge=1, le=4096)] = 16
    """p, basis functions per joint."""
    branch_hidden: Layers = (64, 64)
    """Hidden layers of the branch net."""
    trunk_hidden: Layers = (32, 32)
    """Hidden layers of the trunk net."""
    sensor_hidden: Layers = (128, 64)
    """Hidden layers of the sensor predictor; 256 256 predict no better."""
    mlp_hidden: Layers = (512, 256, 128)
    """Hidden layers of the MLP baseline (ASAP's size)."""
    mlp_match: bool = False
    """Widen or narrow mlp_hidden, in its proportions, until the MLP has as many parameters as the operator would."""

    def __post_init__(self) -> None:
        for field in POSITIVE:
            if getattr(self, field) <= 0:
                raise UsageError(f"{field} is {getattr(self, field)}; it must be positive")
        if (self.mlp_match or self.kind == "shared_mlp") and not self.mlp_hidden:
            raise UsageError(
                "mlp_match or shared_mlp without mlp_hidden: give the proportions of the hidden layers, e.g. 4 2 1"
            )
        if self.delta_hold > 1 and self.sensor_hold > 1:
            raise UsageError(f"delta_hold {self.delta_hold} and sensor_hold {self.sensor_hold}: hold one of them")

    def require_kind(self) -> None:
        """Refuse switches of the paper's network in another. The command line sets the kind after the switches."""
        for name in PAPER_ONLY if self.kind != "paper" else ():
            if (value := getattr(self, name)) != getattr(ModelConfig, name):
                raise UsageError(f"{name} {value}: model {self.kind} has no such switch; use --model paper")

    @property
    def holds(self) -> bool:
        """True if corrections or sensor values are held for several control periods."""
        return self.delta_hold > 1 or self.sensor_hold > 1

    @property
    def asks_simulator(self) -> bool:
        """True if the simulator itself gives the sensor values; they are then a part of x."""
        return self.sensor_source == "fixed"

    def observation_dim(self, n: int) -> int:
        """2n + 3nH (+ 1 with payload)."""
        return 2 * n + 3 * n * self.history + int(self.payload_input)

    @property
    def probe_limit(self) -> float:
        """Largest offset of a learned probe, rad: twice that of the fixed probes."""
        return 2 * max(self.probe_small, self.probe_large) or 1.0

    def sensor_dim(self, n: int) -> int:
        """m probes, each answered by n positions and n velocities."""
        return self.num_probes * 2 * n

    def input_dim(self, n: int) -> int:
        """Numbers in x = [o_t | a_t], then the simulator's answers where it is asked, then real_state's 2n + 1."""
        more = self.sensor_dim(n) * self.asks_simulator + (2 * n + 1) * self.real_state
        return self.observation_dim(n) + n + more
