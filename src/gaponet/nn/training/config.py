"""How a model is trained, as data: the docstring under a field is its command-line help."""

from __future__ import annotations

import os
import shlex
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from annotated_types import Interval

from gaponet.base.errors import UsageError
from gaponet.nn.config import Layers, ModelConfig

if TYPE_CHECKING:
    from gaponet.nn.training.budget import Budget
    from gaponet.robot.spec import RobotSpec


@dataclass(frozen=True)
class RewardConfig:
    """The reward of each joint, r = −min(|Δq| / position, cap)."""

    position: Annotated[float, Interval(gt=0, le=1e3)] = 0.01
    """Error that costs 1, rad."""
    cap: Annotated[float, Interval(gt=0, le=1e6)] = 8.0
    """Highest cost of a joint; what has fallen far behind shall not drown the rest."""


@dataclass(frozen=True)
class PretrainingConfig:
    """Supervised start: regress the labels on states that they and the policy itself lead to."""

    rounds: Annotated[int, Interval(ge=0, le=100000)] = 3
    """Roll-outs: the first led by the labels, then by the present policy; 0 starts PPO from an untrained network."""
    num_envs: Annotated[int, Interval(ge=0, le=1000000)] = 0
    """Simulations per round; 0 for 256, with --device cuda 4,096."""
    steps: Annotated[int, Interval(ge=1, le=10000000)] = 400
    """Control periods per round."""
    rows: Annotated[int, Interval(ge=1, le=10**12)] = 200_000
    """Recorded rows that are labelled, at most, of all motions, payloads and units alike."""
    noise: Annotated[float, Interval(ge=0, le=100)] = 0.4
    """Noise on what the network is shown while it is fitted, σ in standard deviations of each input."""
    batch_size: Annotated[int, Interval(ge=1, le=10000000)] = 1024
    """Samples per gradient step."""
    gradient_steps: Annotated[int, Interval(ge=0, le=10000000)] = 1000
    """Gradient steps per round."""
    learning_rate: Annotated[float, Interval(gt=0, le=1)] = 2e-3
    """AdamW step size, decayed to a hundredth over each round."""
    weight_decay: Annotated[float, Interval(ge=0, le=1e6)] = 1.0
    """AdamW weight decay."""
    sensor_states: Annotated[int, Interval(ge=1, le=10000000)] = 2048
    """States at which the simulator is asked, once for each probe, to fit the sensor predictor."""


@dataclass(frozen=True)
class PPOConfig:
    """PPO with reward, value, advantage and ratio of each joint (nn/training/ppo.py)."""

    num_envs: Annotated[int, Interval(ge=0, le=1000000)] = 0
    """Simulations; 0 for 256, with --device cuda 4,096."""
    num_steps: Annotated[int, Interval(ge=1, le=100000)] = 32
    """Decisions between updates; a decision is model.delta_hold control periods."""
    epochs: Annotated[int, Interval(ge=1, le=1000)] = 5
    """Passes over each batch."""
    mini_batches: Annotated[int, Interval(ge=1, le=10000)] = 4
    """Mini-batches per pass; 2048 samples each stay in the cache."""
    learning_rate: Annotated[float, Interval(gt=0, le=1)] = 1e-5
    """Start value of the actor's step size; adapts to desired_kl. Adam's first steps are that large whatever the
    gradient: 1e-4 throws an operator that was fitted before."""
    critic_learning_rate: Annotated[float, Interval(gt=0, le=1)] = 1e-3
    """The critic's own; with the actor's it would learn nothing in time."""
    desired_kl: Annotated[float, Interval(ge=0, le=1e6)] = 0.005
    """The actor's step size goes up or down by half to stay near this KL per joint."""
    gamma: Annotated[float, Interval(gt=0, lt=1)] = 0.95
    """Discount per control period; a correction acts within the lag, and a longer view only adds variance."""
    lam: Annotated[float, Interval(gt=0, le=1)] = 0.95
    """GAE λ."""
    clip: Annotated[float, Interval(gt=0, le=1)] = 0.2
    """PPO clip range."""
    critic_warmup: Annotated[int, Interval(ge=0, le=10000000)] = 8
    """Updates of the critic alone, before the actor moves."""
    explained: Annotated[float, Interval(le=1)] = 0.5
    """Share of the returns' variance that the critic must explain before the actor moves."""
    std: Annotated[float, Interval(gt=0, le=1e6)] = 0.0025
    """Exploration σ, rad. Beyond friction/kp (0.003 rad on the SO-101) noise shakes joints out of stiction,
    and the best noisy policy is not the best policy."""
    std_half_life: Annotated[float, Interval(ge=0, le=1e9)] = 0.0
    """Updates in which the exploration σ falls to half, down to std_end; 0 keeps it as it is."""
    std_end: Annotated[float, Interval(gt=0, le=1e6)] = 0.0025
    """Smallest exploration σ where it falls, rad."""
    noise_time: Annotated[float, Interval(ge=0, le=1e6)] = 0.2
    """Correlation time of the exploration, s; 0 for white noise."""
    noise_share: Annotated[float, Interval(gt=0, le=1)] = 0.5
    """Share of the joints that explore at a time; a joint at rest beside them shows what it does alone."""
    critic_hidden: Layers = (256, 128)
    """Hidden layers of the critic."""
    refit_sensors: Annotated[int, Interval(ge=0, le=10000000)] = 0
    """Updates between new fits of the sensor predictor to states that the policy visits; 0 for none."""


# The paper's training: PPO from an untrained network. Step size and exploration suit a start from nothing.
PAPER_PPO = PPOConfig(
    learning_rate=3e-4, desired_kl=0.01, critic_warmup=4, explained=0.2, std=0.02, std_half_life=20.0, noise_share=1.0,
    refit_sensors=50,
)  # fmt: skip


@dataclass(frozen=True)
class TrainConfig:
    """Everything a run needs to be repeated, beside the dataset."""

    model: ModelConfig = field(default_factory=ModelConfig)
    reward: RewardConfig = field(default_factory=RewardConfig)
    warm_start: PretrainingConfig = field(default_factory=PretrainingConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    seed: Annotated[int, Interval(ge=0, le=2**63)] = 0
    """Seed of everything random."""
    episode_s: Annotated[float, Interval(gt=0, le=1e5)] = 40.0
    """Longest episode, s; stiction makes errors accumulate, so short episodes flatter."""
    split: str = ""
    """Split file of gaponet data split; default: by motion, a fixed rule."""
    holdout_payloads: tuple[float, ...] = ()
    """Payloads never trained on, kg; their test motions stay in the test part."""
    rates: tuple[float, ...] = ()
    """Only recordings at these control rates, Hz, in all parts; all by default."""
    train_share: Annotated[float, Interval(gt=0, le=1)] = 1.0
    """Share of the training motions that is used; validation and test motions stay the same."""
    mixed_gains: bool = False
    """Take recordings made with different kp or kd together."""
    validate_every: Annotated[int, Interval(ge=1, le=10000000)] = 10
    """PPO updates between free runs over the validation motions."""
    threads: Annotated[int, Interval(ge=0, le=4096)] = 0
    """Threads of the simulator, and in turn of the learner; 0 for all cores, of the learner for OMP_NUM_THREADS."""
    device: Literal["cpu", "cuda", "warp-cpu"] = "cpu"
    """cuda: simulations and networks on a GPU (pip install 'gaponet[warp]'), 4,096 simulations unless you say how many;
    warp-cpu: the same on the CPU, slowly, to test it. Scores, identification and robots stay on C MuJoCo."""

    def network_device(self) -> str:
        """Where networks are trained, in torch's words; refuses a GPU that is not there, or what it takes."""
        if self.device != "cpu":
            import gaponet.sim.warp  # noqa: F401
        if self.device != "cuda":
            return "cpu"
        import torch

        if not torch.cuda.is_available():
            raise UsageError("--device cuda: torch sees no GPU, or is a build without; use --device cpu")
        return "cuda"

    @property
    def learner_threads(self) -> int:
        """Threads as torch counts them: as asked, as OMP_NUM_THREADS says, or all cores."""
        said = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0]
        return self.threads or (int(said) if said.isdigit() else 0) or os.cpu_count() or 1

    def fast(self) -> TrainConfig:
        """Return the settings with one PPO pass over each batch and a smaller critic."""
        return replace(self, ppo=replace(self.ppo, epochs=1, critic_hidden=(128,)))

    def paper_recipe(self) -> TrainConfig:
        """Return this configuration with the paper's training, PPO from an untrained network.

        PPO settings that differ from the defaults stay.
        """
        usual = PPOConfig()
        mine = {f.name: value for f in fields(usual) if (value := getattr(self.ppo, f.name)) != getattr(usual, f.name)}
        return replace(self, ppo=replace(PAPER_PPO, **mine), warm_start=replace(self.warm_start, rounds=0))

    def sized(self) -> TrainConfig:
        """The same with as many simulations as suit the device, where none were asked for."""
        num, warm, ppo = 4096 if self.device == "cuda" else 256, self.warm_start, self.ppo
        warm, ppo = replace(warm, num_envs=warm.num_envs or num), replace(ppo, num_envs=ppo.num_envs or num)
        return replace(self, warm_start=warm, ppo=ppo)

    def options(self) -> list[str]:
        """The options of gaponet train that say this configuration."""
        return _options(asdict(self.sized()), asdict(TrainConfig().sized()), "--")


def command(
    dataset: Path | str, out: Path, budget: Budget, config: TrainConfig, robot: RobotSpec,
    holdout_units: tuple[str, ...], processes: int,
) -> str:  # fmt: skip
    """What a shell needs to train the same again."""
    limit = str(budget.steps) if budget.seconds is None else f"{budget.seconds:g}s"
    several = ["torchrun", "--nproc-per-node", str(processes), "-m"] if processes > 1 else []
    words = [*several, "gaponet", "train", str(dataset), "--out", str(out), "--budget", limit]
    words += ["--robot", str(robot.folder)] if robot.nominal is not None else []
    words += ["--holdout-units", *holdout_units] if holdout_units else []
    return shlex.join(words + config.options())


def _options(config: dict[str, Any], default: dict[str, Any], prefix: str) -> list[str]:
    words: list[str] = []
    for key, usual in default.items():
        value, name = config[key], key.replace("_", "-")
        if isinstance(usual, dict):
            words += _options(value, usual, f"{prefix}{name}.")
        elif isinstance(value, bool):
            words += [] if value == usual else [prefix + ("" if value else "no-") + name]
        elif value != usual:
            option = "--model" if prefix + name == "--model.kind" else prefix + name
            words += [option, *map(str, value if isinstance(value, tuple) else [value])]
    return words
