"""How a model is trained, as data: the docstring under a field is its command-line help."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace

from gaponet.model.config import ModelConfig


@dataclass(frozen=True)
class RewardConfig:
    """r = −position·mean(Δq²) − velocity·mean(Δq̇²) − delta·mean(Δa²) − delta_rate·mean((Δa_t − Δa_{t−1})²)."""

    position: float = 32.83
    """κ of the paper, 1/rad²."""
    velocity: float = 0.3283
    """0.01 κ, s²/rad²."""
    delta: float = 0.01
    """Price of a large correction, 1/rad²."""
    delta_rate: float = 0.1
    """Price of a jerky correction, 1/rad²."""


@dataclass(frozen=True)
class WarmStartConfig:
    """Supervised start: regress the inverse labels on states that the policy visits itself."""

    rounds: int = 10
    """Roll-outs of the present policy; 0 starts PPO from an untrained network."""
    num_envs: int = 256
    """Simulations per round."""
    steps: int = 400
    """Control periods per round."""
    disturbance: float = 0.003
    """Noise on the applied corrections, white and slow, σ in rad."""
    batch_size: int = 1024
    """Samples per gradient step."""
    gradient_steps: int = 300
    """Gradient steps per round."""
    learning_rate: float = 1e-3
    """AdamW step size, decayed to a tenth over the rounds."""
    weight_decay: float = 0.01
    """AdamW weight decay."""
    sensor_states: int = 2048
    """States at which the simulator is asked, once for each probe, to fit the sensor predictor."""
    sensor_refresh: float | None = None
    """Ask after each round how well the sensor predictor explains the states that the policy visits, and fit it again
    when its R² has fallen by more than this since the fit; None never asks."""


@dataclass(frozen=True)
class PPOConfig:
    """PPO of rsl_rl, start values of the method."""

    num_envs: int = 512
    """Simulations."""
    num_steps: int = 32
    """Decisions between updates; a decision is model.delta_hold control periods."""
    epochs: int = 2
    """Passes over each batch."""
    mini_batches: int = 8
    """Mini-batches per pass; 2048 samples each stay in the cache."""
    learning_rate: float = 1e-5
    """Start value; adapts to desired_kl, not below 1e-5."""
    desired_kl: float = 0.008
    """Step size is halved or doubled to stay near this KL."""
    gamma: float = 0.95
    """Discount per control period; a correction acts within the lag, and a longer view only adds variance."""
    lam: float = 0.95
    """GAE λ."""
    clip: float = 0.2
    """PPO clip range."""
    critic_warmup: int = 10
    """Updates of the critic alone, before a warm-started actor moves."""
    init_std: float = 0.003
    """Exploration σ at start, rad. Beyond friction/kp (0.003 rad on the SO-101) noise shakes joints out of stiction,
    and the best noisy policy is not the best policy."""
    critic_hidden: tuple[int, ...] = (256, 128)
    """Hidden layers of the critic."""


@dataclass(frozen=True)
class TrainConfig:
    """Everything a run needs to be repeated, beside the dataset."""

    model: ModelConfig = field(default_factory=ModelConfig)
    reward: RewardConfig = field(default_factory=RewardConfig)
    warm_start: WarmStartConfig = field(default_factory=WarmStartConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    seed: int = 0
    """Seed of everything random."""
    episode_s: float = 10.0
    """Longest episode, s; stiction makes errors accumulate, so short episodes flatter."""
    split: str = ""
    """Split file of gaponet data split; default: by motion, a fixed rule."""
    holdout_payloads: tuple[float, ...] = ()
    """Payloads never trained on, kg; their test motions stay in the test part."""
    rates: tuple[float, ...] = ()
    """Only recordings at these control rates, Hz, in all parts; all by default."""
    train_share: float = 1.0
    """Share of the training motions that is used; validation and test motions stay the same."""
    mixed_gains: bool = False
    """Take recordings made with different kp or kd together."""
    validate_every: int = 10
    """PPO updates between free runs over the validation motions."""
    threads: int = 0
    """Threads of the simulator, and in turn of the learner; 0 for all cores."""

    @property
    def learner_threads(self) -> int:
        """Threads as torch counts them."""
        return self.threads or os.cpu_count() or 1


def fast(config: TrainConfig) -> TrainConfig:
    """The fast preset: PPO with one pass over each batch and a smaller critic; gaponet bench train shows the gain."""
    return replace(config, ppo=replace(config.ppo, epochs=1, critic_hidden=(128,)))
