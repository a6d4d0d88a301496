"""Model options. The docstring of a field is its command-line help."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Interval, Len

from gaponet.base.errors import UsageError

ModelKind = Literal["gaponet", "paper", "shared_mlp", "mlp", "trees"]
Layers = Annotated[tuple[Annotated[int, Interval(ge=1, le=65536)], ...], Len(0, 32)]  # widths

# Refused in Python too. The intervals of all fields are checked for files and the command line
# (base/structure.py).
POSITIVE = ("history", "stride", "num_probes", "num_basis", "delta_max", "payload_max")
PAPER_ONLY = (  # options of kind "paper" alone
    "payload_trunk",
    "delta_hold",
    "sensor_source",
    "sensor_hold",
    "sensor_target",
    "branch_observation",
    "relative_action",
    "real_state",
    "predictor_inputs",
)
CONTEXT_VALUES = 8  # of a joint (sim/context.py)
CONTEXT_KINDS = ("gaponet", "shared_mlp")


@dataclass(frozen=True)
class ModelConfig:
    """Options of a delta-action model.

    They and the number of operated joints n give all dimensions.
    """

    kind: ModelKind = "gaponet"
    """gaponet: the operator. paper: the network of the paper in its literal form, with the paper's
    layer widths (nn/paper.py). shared_mlp: one plain network for all joints, with the inputs of the
    operator and as many weights as branch and trunk. mlp: a plain network on [observation, action],
    the form of ASAP. trees: gradient-boosted trees, without history and PPO (nn/trees.py); they
    need scikit-learn."""
    history: Annotated[int, Interval(ge=1, le=1000)] = 4
    """H, number of past frames in the observation. They must be longer than the robot's lag."""
    stride: Annotated[int, Interval(ge=1, le=1000)] = 1
    """Control periods between past frames."""
    payload_input: bool = True
    """The payload mass is an input."""
    payload_trunk: bool = True
    """paper: the payload mass is an input of the trunk too."""
    payload_max: Annotated[float, Interval(gt=0, le=100)] = 3.0
    """Mass for which the input is 1, kg."""
    delta_max: Annotated[float, Interval(gt=0, le=10)] = 0.3
    """Largest correction, rad."""
    delta_hold: Annotated[int, Interval(ge=1, le=1000)] = 1
    """paper: number of control periods for which a correction is held (action duration)."""
    sensor_source: Literal["predicted", "fixed", "learned", "none"] = "predicted"
    """paper: origin of the sensor values. predicted: the sensor predictor, for the num_probes fixed
    probes. fixed: the simulator, stepped once for each fixed probe; only in training and gaponet
    eval, because a robot has no simulator. learned: the sensor predictor, for probes that start at
    the fixed ones and are trained by PPO. none: there are no sensor values, and the branch sees the
    observation that the sensor predictor would see."""
    predictor_inputs: Literal["observation", "equation_1"] = "observation"
    """paper: inputs of the sensor predictor. observation: positions, velocities, past targets and
    the payload. equation_1: also the present target, the joint index and the recorded state
    relative to the simulated one, as the paper writes it. Training hides the recorded state in half
    of the episodes. gaponet eval never gives it; a control loop can (NetworkInput.extra)."""
    sensor_hold: Annotated[int, Interval(ge=1, le=1000)] = 1
    """paper: number of control periods for which the sensor values are held."""
    sensor_target: Literal["delta", "absolute"] = "delta"
    """paper: form of a sensor value. delta: the change of state, S(t+1) − S(t). absolute: the next
    state, S(t+1)."""
    branch_observation: bool = False
    """paper: the observation with its history, relative to the present position, is an input of the
    branch too. This is not the paper's form: the sensor values of the present state contain no
    history."""
    relative_action: bool = False
    """paper: the trunk input is the action minus the present position. This is not the paper's
    form: a lag of 10 mrad is hard to see in angles that span a radian."""
    real_state: bool = False
    """paper: the recorded state, relative to the simulated one, is an input of the branch too.
    Training hides it in half of the episodes. gaponet eval never gives it; a control loop can
    (NetworkInput.extra)."""
    num_probes: Annotated[int, Interval(ge=1, le=1000)] = 20
    """m, number of probes: targets for which the simulator gives its next state."""
    probe_small: Annotated[float, Interval(ge=0, le=10)] = 0.05
    """Offset of a small probe, which depends on gains and friction, rad."""
    probe_large: Annotated[float, Interval(ge=0, le=10)] = 0.4
    """Offset of a large probe, which depends on inertia, payload and saturation, rad."""
    sensors: Literal["off", "predicted"] = "off"
    """off: the branch input is the observation. predicted: predicted sensor values too, as in the
    paper; they did not reduce the error (docs/results/did-not-work.md)."""
    context: bool = False
    """gaponet, shared_mlp: the simulator's answers to fixed probes at rest are inputs
    (sim/context.py). In gaponet they are the branch input, and the trunk sees the observation and
    the action, with the widths of branch_hidden. gaponet train --simulators sets it. Without
    payload_input, simulators answer with their payload in hand."""
    num_basis: Annotated[int, Interval(ge=1, le=4096)] = 16
    """p, basis functions per joint."""
    branch_hidden: Layers = (64, 64)
    """Hidden layers of the branch net."""
    trunk_hidden: Layers = (32, 32)
    """Hidden layers of the trunk net."""
    sensor_hidden: Layers = (128, 64)
    """Hidden layers of the sensor predictor; 256 256 are not better."""
    mlp_hidden: Layers = (512, 256, 128)
    """Hidden layers of the MLP baseline (ASAP's size)."""
    mlp_match: bool = False
    """Scale mlp_hidden until the MLP has as many parameters as the operator."""

    def __post_init__(self) -> None:
        for field in POSITIVE:
            if getattr(self, field) <= 0:
                raise UsageError(f"{field} is {getattr(self, field)}; it must be positive")
        if (self.mlp_match or self.kind == "shared_mlp") and not self.mlp_hidden:
            raise UsageError(
                "mlp_match or shared_mlp without mlp_hidden: give the proportions of the hidden "
                "layers, e.g. 4 2 1"
            )
        if self.delta_hold > 1 and self.sensor_hold > 1:
            raise UsageError(
                f"delta_hold {self.delta_hold} and sensor_hold {self.sensor_hold}: hold one of them"
            )
        if self.context and self.sensors != "off":
            raise UsageError("context with predicted sensors: the network takes one of them")
        if self.sensor_source == "none":
            self._require_options_without_sensors()
        if self.predictor_inputs == "equation_1":
            self._require_options_of_equation_1()

    def _require_options_without_sensors(self) -> None:
        """Refuse options of sensor values where there are none."""
        if self.sensor_hold > 1:
            raise UsageError(
                f"sensor_source none with sensor_hold {self.sensor_hold}: there are no sensor "
                "values to hold"
            )
        if self.sensor_target != "delta":
            raise UsageError(
                f"sensor_source none with sensor_target {self.sensor_target}: there are no sensor "
                "values"
            )

    def _require_options_of_equation_1(self) -> None:
        """Refuse options under which the predictor does not have the inputs of equation 1."""
        if self.sensor_source != "predicted":
            raise UsageError(
                f"predictor_inputs equation_1 with sensor_source {self.sensor_source}: equation 1 "
                "predicts the answers to fixed probes; use sensor_source predicted"
            )
        if not self.payload_input:
            raise UsageError(
                "predictor_inputs equation_1 without payload_input: the payload is one of its "
                "inputs; leave payload_input on"
            )
        if self.sensor_hold > 1:
            raise UsageError(
                f"predictor_inputs equation_1 with sensor_hold {self.sensor_hold}: the predictor "
                "sees the present target, so its sensor values cannot be held; use delta_hold"
            )

    def require_kind(self) -> None:
        """Refuse options of the paper's network in another one.

        The command line sets the kind after these options.

        Raises:
            UsageError: An option belongs to kind "paper".
        """
        if self.context and self.kind not in CONTEXT_KINDS:
            raise UsageError(
                f"context: model {self.kind} has no such input; use {' or '.join(CONTEXT_KINDS)}"
            )
        if self.kind == "paper":
            return
        for name in PAPER_ONLY:
            value = getattr(self, name)
            if value != getattr(ModelConfig, name):
                raise UsageError(
                    f"{name} {value}: model {self.kind} has no such switch; use --model paper"
                )

    @property
    def history_depth(self) -> int:
        """Number of past frames that are stored; the network sees every stride-th."""
        return (self.history - 1) * self.stride + 1

    @property
    def holds(self) -> bool:
        """True if corrections or sensor values are held for several control periods."""
        return self.delta_hold > 1 or self.sensor_hold > 1

    @property
    def needs_simulator(self) -> bool:
        """True if the simulator gives the sensor values. They are then columns of x."""
        return self.sensor_source == "fixed"

    @property
    def context_is_loaded(self) -> bool:
        """True if simulators answer the probes with their payload in hand, because the network is
        not told it.
        """
        return self.context and not self.payload_input

    @property
    def observes_real_state(self) -> bool:
        """True if the network observes the recorded state.

        It then has columns of x, which can be zero (hidden).
        """
        return self.real_state or self.predictor_inputs == "equation_1"

    def real_state_dim(self, n: int) -> int:
        """Return the length of [q_real − q | q̇_real − q̇ | visible]: 2n + 1, or 0 if it is not
        observed.
        """
        if self.observes_real_state:
            return 2 * n + 1
        return 0

    def observation_dim(self, n: int) -> int:
        """Return the length of o_t: 2n + 3nH, and 1 more with payload."""
        return 2 * n + 3 * n * self.history + int(self.payload_input)

    @property
    def probe_limit(self) -> float:
        """Largest offset of a learned probe, rad: twice the largest fixed one, 1 if those are
        zero.
        """
        largest = max(self.probe_small, self.probe_large)
        if largest == 0:
            return 1.0
        return 2 * largest

    def sensor_dim(self, n: int) -> int:
        """Return the number of sensor values: n positions and n velocities for each of m probes."""
        return self.num_probes * 2 * n

    def input_dim(self, n: int) -> int:
        """Return the length of x = [o_t | a_t | the simulator's answers | recorded state |
        context].
        """
        inputs = self.observation_dim(n) + n + self.real_state_dim(n)
        if self.needs_simulator:
            inputs += self.sensor_dim(n)
        return inputs + self.context_dim(n)

    def context_dim(self, n: int) -> int:
        """Return the number of answers to fixed probes in x, or 0 without context."""
        if not self.context:
            return 0
        return CONTEXT_VALUES * n
