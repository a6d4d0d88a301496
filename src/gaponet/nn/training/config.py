"""Training options, budget and status. The docstring of an option is its command-line help."""

from __future__ import annotations

import math
import os
import re
import shlex
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from annotated_types import Interval

from gaponet.base.errors import UsageError
from gaponet.nn.config import CONTEXT_KINDS, Layers, ModelConfig
from gaponet.robot.simulator_change import SimulatorRanges

if TYPE_CHECKING:
    from gaponet.robot.spec import RobotSpec


MAX_BUDGET = 1e12  # control steps, or any unit of time
MIN_STEPS = 100  # with fewer, the unit of time is probably missing
SECONDS = {"s": 1.0, "m": 60.0, "h": 3600.0}  # per unit
DEFAULTS_PERIOD_S = 0.02  # control period for which the options that count periods were chosen
# Of the time that the defaults cover at this period, from which on an option is too short: half,
# and a measured 100 Hz is a little more.
MIN_TIME_SHARE = 0.49


@dataclass(frozen=True)
class RewardConfig:
    """Reward of a joint: r = −min(|Δq| / position, cap)."""

    position: Annotated[float, Interval(gt=0, le=1e3)] = 0.01
    """Error that costs 1, rad."""
    cap: Annotated[float, Interval(gt=0, le=1e6)] = 8.0
    """Highest cost of a joint, so that a joint with a large error does not dominate the others."""


@dataclass(frozen=True)
class PretrainingConfig:
    """Supervised pre-training: regression of labels on the states of rollouts."""

    rounds: Annotated[int, Interval(ge=0, le=100000)] = 3
    """Rounds of rollouts. The first applies the labels, later ones the network. 0: PPO starts
    untrained."""
    num_envs: Annotated[int, Interval(ge=0, le=1000000)] = 0
    """Simulations per round; 0 means 256, or 4,096 with --device cuda."""
    steps: Annotated[int, Interval(ge=1, le=10000000)] = 400
    """Control periods per round."""
    rows: Annotated[int, Interval(ge=1, le=10**12)] = 200_000
    """Largest number of recorded rows that get labels, stratified by motion, payload and unit."""
    noise: Annotated[float, Interval(ge=0, le=100)] = 0.4
    """Noise of the inputs during the fit, σ in standard deviations of each input."""
    batch_size: Annotated[int, Interval(ge=1, le=10000000)] = 1024
    """Samples per gradient step."""
    gradient_steps: Annotated[int, Interval(ge=0, le=10000000)] = 1000
    """Gradient steps per round."""
    learning_rate: Annotated[float, Interval(gt=0, le=1)] = 2e-3
    """AdamW step size; it decays to a hundredth in each round."""
    weight_decay: Annotated[float, Interval(ge=0, le=1e6)] = 1.0
    """AdamW weight decay."""
    sensor_states: Annotated[int, Interval(ge=1, le=10000000)] = 2048
    """Number of states at which the simulator answers all probes, to fit the sensor predictor."""


@dataclass(frozen=True)
class PPOConfig:
    """PPO with a reward, value, advantage and ratio per joint (nn/training/ppo.py)."""

    num_envs: Annotated[int, Interval(ge=0, le=1000000)] = 0
    """Simulations; 0 means 256, or 4,096 with --device cuda."""
    num_steps: Annotated[int, Interval(ge=1, le=100000)] = 32
    """Decisions between updates; a decision is model.delta_hold control periods."""
    epochs: Annotated[int, Interval(ge=1, le=1000)] = 5
    """Passes over each batch."""
    mini_batches: Annotated[int, Interval(ge=1, le=10000)] = 4
    """Mini-batches per pass; 2048 samples each fit into the cache."""
    learning_rate: Annotated[float, Interval(gt=0, le=1)] = 1e-5
    """Initial step size of the actor; it adapts to desired_kl. Adam's first steps have this size
    whatever the gradient is, and 1e-4 destroys a pre-trained network."""
    critic_learning_rate: Annotated[float, Interval(gt=0, le=1)] = 1e-3
    """Step size of the critic. With the actor's, it would learn too slowly."""
    desired_kl: Annotated[float, Interval(ge=0, le=1e6)] = 0.005
    """KL divergence per joint and update. The actor's step size changes by a factor of 1.5 to stay
    near it."""
    gamma: Annotated[float, Interval(gt=0, lt=1)] = 0.95
    """Discount per control period. A correction acts within the servo lag; a longer horizon only
    adds variance."""
    lam: Annotated[float, Interval(gt=0, le=1)] = 0.95
    """GAE λ."""
    clip: Annotated[float, Interval(gt=0, le=1)] = 0.2
    """PPO clip range."""
    critic_warmup: Annotated[int, Interval(ge=0, le=10000000)] = 8
    """Number of updates of the critic alone, before the actor is trained."""
    explained: Annotated[float, Interval(le=1)] = 0.5
    """Share of the variance of the returns that the critic must explain before the actor is
    trained."""
    std: Annotated[float, Interval(gt=0, le=1e6)] = 0.0025
    """Exploration σ, rad. Noise above friction/kp (0.003 rad on the SO-101) breaks the stiction of
    joints, and the best policy with noise is then not the best policy without."""
    std_half_life: Annotated[float, Interval(ge=0, le=1e9)] = 0.0
    """Number of updates in which the exploration σ halves, down to std_end; 0 keeps it constant."""
    std_end: Annotated[float, Interval(gt=0, le=1e6)] = 0.0025
    """Smallest exploration σ with std_half_life, rad."""
    noise_time: Annotated[float, Interval(ge=0, le=1e6)] = 0.2
    """Correlation time of the exploration, s; 0 means white noise."""
    noise_share: Annotated[float, Interval(gt=0, le=1)] = 0.5
    """Share of the joints that explore at a time. The other joints show the error without
    exploration."""
    critic_hidden: Layers = (256, 128)
    """Hidden layers of the critic."""
    refit_sensors: Annotated[int, Interval(ge=0, le=10000000)] = 0
    """Number of updates between new fits of the sensor predictor to visited states; 0 means
    none."""


# The paper's training: PPO from an untrained network, with a larger step size and more exploration.
PAPER_PPO = PPOConfig(
    learning_rate=3e-4,
    desired_kl=0.01,
    critic_warmup=4,
    explained=0.2,
    std=0.02,
    std_half_life=20.0,
    noise_share=1.0,
    refit_sensors=50,
)

# For many simulators: wider networks, less noise and more steps than for one.
MANY_SIMULATORS_MODEL = ModelConfig(branch_hidden=(160, 128), trunk_hidden=(64, 64), num_basis=32)
MANY_SIMULATORS_PRETRAINING = PretrainingConfig(
    num_envs=400, steps=150, noise=0.2, gradient_steps=2500
)

Options = TypeVar("Options", ModelConfig, PretrainingConfig, PPOConfig)


def _keep_changed(given: Options, recipe: Options) -> Options:
    """Return a recipe's options; those of `given` that differ from the defaults stay."""
    default = type(given)()
    changed = {}
    for field_ in fields(default):
        value = getattr(given, field_.name)
        if value != getattr(default, field_.name):
            changed[field_.name] = value
    return replace(recipe, **changed)


@dataclass(frozen=True)
class TrainConfig:
    """All options of a training run."""

    model: ModelConfig = field(default_factory=ModelConfig)
    reward: RewardConfig = field(default_factory=RewardConfig)
    pretraining: PretrainingConfig = field(default_factory=PretrainingConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    seed: Annotated[int, Interval(ge=0, le=2**63)] = 0
    """Seed of everything random."""
    episode_s: Annotated[float, Interval(gt=0, le=1e5)] = 40.0
    """Longest episode, s. Stiction accumulates errors, so short episodes underestimate them."""
    split: str = ""
    """Split file of gaponet data split; default: a fixed rule by motion."""
    holdout_payloads: tuple[float, ...] = ()
    """Payloads that are only in the test split, kg."""
    rates: tuple[float, ...] = ()
    """Control rates of the recordings that are used, Hz; default: all."""
    train_share: Annotated[float, Interval(gt=0, le=1)] = 1.0
    """Share of the training motions that is used. Validation and test motions stay the same."""
    simulators: Annotated[int, Interval(ge=0, le=100_000)] = 0
    """Number of simulators in which the network is trained; they are drawn from simulator_ranges by
    the seed. The network is told the simulator's answers to fixed probes (sim/context.py), and then
    corrects simulators that it has never seen. 0: the robot's own simulator alone."""
    simulators_per_piece: Annotated[int, Interval(ge=1, le=1000)] = 2
    """Number of these simulators in which each piece of a recording is replayed."""
    simulator_ranges: SimulatorRanges = field(default_factory=SimulatorRanges)
    without_context: bool = False
    """Do not tell the network the simulator's answers, as a baseline."""
    mixed_gains: bool = False
    """Train on recordings with different kp or kd together."""
    validate_every: Annotated[int, Interval(ge=1, le=10000000)] = 10
    """PPO updates between validations."""
    threads: Annotated[int, Interval(ge=0, le=4096)] = 0
    """Threads of the simulator and of torch, which take turns; 0 means all cores, and
    OMP_NUM_THREADS for torch."""
    device: Literal["cpu", "cuda", "warp-cpu"] = "cpu"
    """cuda: simulations and networks on a GPU (extra `warp`), by default 4,096 simulations.
    warp-cpu: the same on the CPU, slowly, for tests. Validation, identification and robots use C
    MuJoCo."""

    def network_device(self) -> str:
        """Return torch's device for the networks.

        Raises:
            UsageError: torch has no GPU.
            ModuleNotFoundError: Warp is not installed.
        """
        if self.device != "cpu":
            import gaponet.sim.warp  # noqa: F401
        if self.device != "cuda":
            return "cpu"
        import torch

        if not torch.cuda.is_available():
            raise UsageError(
                "--device cuda: torch sees no GPU, or is a build without; use --device cpu"
            )
        return "cuda"

    @property
    def learner_threads(self) -> int:
        """Threads of torch: `threads`, else OMP_NUM_THREADS, else all cores."""
        omp = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0]
        return self.threads or (int(omp) if omp.isdigit() else 0) or os.cpu_count() or 1

    def paper_recipe(self) -> TrainConfig:
        """Return this configuration with the paper's training: PPO from an untrained network.

        PPO settings that differ from the defaults stay.
        """
        ppo = _keep_changed(self.ppo, PAPER_PPO)
        return replace(self, ppo=ppo, pretraining=replace(self.pretraining, rounds=0))

    def many_simulators_recipe(self) -> TrainConfig:
        """Return this configuration with what training in many simulators needs.

        Options that differ from the defaults stay. The network is told its simulator's answers, if
        its kind can be.
        """
        model = _keep_changed(self.model, MANY_SIMULATORS_MODEL)
        if not self.without_context and self.model.kind in CONTEXT_KINDS:
            model = replace(model, context=True)
        pretraining = _keep_changed(self.pretraining, MANY_SIMULATORS_PRETRAINING)
        return replace(self, model=model, pretraining=pretraining)

    def sized(self) -> TrainConfig:
        """Return this configuration with the number of simulations where num_envs is 0, and its
        recipe.

        Raises:
            UsageError: Many simulators on a GPU.
        """
        if self.simulators and self.device != "cpu":
            raise UsageError(
                f"--simulators with --device {self.device}: many simulators step in C MuJoCo; use "
                "--device cpu"
            )
        config = self.many_simulators_recipe() if self.simulators else self
        num = max(4096 if self.device == "cuda" else 256, 2 * self.simulators)
        pretraining = replace(config.pretraining, num_envs=config.pretraining.num_envs or num)
        ppo = replace(config.ppo, num_envs=config.ppo.num_envs or num)
        return replace(config, pretraining=pretraining, ppo=ppo)

    def short_options(self, dt: float) -> list[str]:
        """Return the options that count control periods and cover too little time at a period dt,
        s.
        """
        default = TrainConfig()
        periods = self.model.history * self.model.stride
        default_periods = default.model.history * default.model.stride
        horizon = 1 / (1 - self.ppo.gamma)  # periods
        default_horizon = 1 / (1 - default.ppo.gamma)
        short = []
        if periods * dt < MIN_TIME_SHARE * default_periods * DEFAULTS_PERIOD_S:
            short.append("--model.history")
        if horizon * dt < MIN_TIME_SHARE * default_horizon * DEFAULTS_PERIOD_S:
            short.append("--ppo.gamma")
        return short

    def options(self) -> list[str]:
        """Return the options of gaponet train for this configuration."""
        return _options(asdict(self.sized()), asdict(TrainConfig().sized()), "--")


def command(
    dataset: Path | str,
    out: Path,
    budget: Budget,
    config: TrainConfig,
    robot: RobotSpec,
    holdout_units: tuple[str, ...],
) -> str:
    """Return the shell command that repeats a run."""
    limit = str(budget.steps) if budget.seconds is None else f"{budget.seconds:g}s"
    words = ["gaponet", "train", str(dataset), "--out", str(out), "--budget", limit]
    if robot.is_identified:
        words += ["--robot", str(robot.folder)]
    if holdout_units:
        words += ["--holdout-units", *holdout_units]
    if config.model.kind == "gaponet":  # the command's default is auto
        words += ["--model", "gaponet"]
    return shlex.join(words + config.options())


def _options(config: dict[str, Any], defaults: dict[str, Any], prefix: str) -> list[str]:
    words: list[str] = []
    for key, default in defaults.items():
        value = config[key]
        name = key.replace("_", "-")
        if isinstance(default, dict):
            words += _options(value, default, f"{prefix}{name}.")
        elif value == default:
            continue
        elif isinstance(value, bool):
            words.append(prefix + name if value else f"{prefix}no-{name}")
        else:
            option = "--model" if prefix + name == "--model.kind" else prefix + name
            values = value if isinstance(value, tuple) else (value,)
            words += [option, *map(str, values)]
    return words


@dataclass(frozen=True)
class Budget:
    """Seconds or control steps; one of them is set."""

    seconds: float | None = None
    steps: int | None = None

    @classmethod
    def parse(cls, text: str) -> Budget:
        """Parse "90s", "10m", "2h", or control steps such as "2000000" or "2e6".

        Raises:
            UsageError: Another text, or fewer than MIN_STEPS control steps.
        """
        match = re.fullmatch(r"\s*([0-9.]+(?:e[0-9]+)?)\s*([smh]?)\s*", text, re.IGNORECASE)
        try:
            number = float(match.group(1)) if match else 0.0
        except ValueError:
            number = 0.0
        if not match or not 0 < number <= MAX_BUDGET:
            raise UsageError(
                f"--budget {text}: give a time such as 90s, 10m or 2h, or a number of control steps"
            )
        unit = match.group(2).lower()
        if not unit and number < MIN_STEPS:
            raise UsageError(
                f"--budget {text}: {number:g} control steps teach nothing; is it {text}s or "
                f"{text}m?"
            )
        if unit:
            return cls(seconds=number * SECONDS[unit])
        return cls(steps=int(number))

    def part(self, share: float) -> Budget:
        """Return a share of this budget."""
        if self.seconds is not None:
            return Budget(seconds=share * self.seconds)
        return Budget(steps=max(round(share * (self.steps or 0)), 1))

    def spent(self, seconds: float, steps: int) -> float:
        """Return the used share of the budget; 1 or more at its end."""
        if self.seconds is not None:
            return seconds / self.seconds
        return steps / (self.steps or 1)


@dataclass(frozen=True)
class Status:
    """State of a run, for a progress bar.

    Errors are mean position errors in rad; NaN where unknown.
    """

    stage: str
    fraction: float
    steps: int
    seconds: float
    reward: float
    val_mpjae: float
    best_mpjae: float
    nominal_mpjae: float

    @property
    def note(self) -> str:
        """Stage, reward, validation error and speed as text."""
        text = self.stage
        if not math.isnan(self.reward):
            text += f", reward {self.reward:.4f}"
        if not math.isnan(self.val_mpjae):
            ratio = self.best_mpjae / self.nominal_mpjae
            text += f", validation {self.val_mpjae * 1e3:.2f} mrad (best {ratio:.2f} of nominal)"
        return f"{text}, {self.steps / max(self.seconds, 1e-9):,.0f} steps/s"
