"""What every experiment may be told, as data: the docstrings are the command-line help."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from gaponet.base.executor import LOCAL
from gaponet.nn.training.config import PPOConfig, PretrainingConfig, TrainConfig

# Small rounds, fitted until labels are (progress.jsonl: label_rmse); of 200 gradient steps a product has the advantage.
TRAINING = TrainConfig(warm_start=PretrainingConfig(rounds=2, num_envs=128, steps=300, gradient_steps=800))
MODELS = ("gaponet", "shared_mlp", "mlp:mlp_match=on")  # what a question compares where nothing is said
BUDGET, SEEDS = "76800", 3  # control steps: 2 rounds
# With --quick: teaches next to nothing, in seconds.
QUICK_WARM_START = PretrainingConfig(
    rounds=2, num_envs=16, steps=80, gradient_steps=40, batch_size=256, sensor_states=256
)
QUICK_PPO = PPOConfig(num_envs=32, num_steps=16, epochs=1, critic_warmup=1)
QUICK_SENSORS = (32,)  # hidden layers of the predictor, whose fit is most of a short training
QUICK_BUDGET, QUICK_SEEDS = "2560", 1


@dataclass(frozen=True)
class Options:
    """Options of all experiments that train."""

    seeds: int | None = None
    """How many seeds, counted from --seed; 3, with --quick 1."""
    budget: str | None = None
    """How long each training takes: time such as 90s or 10m, or control steps; 76800, with --quick 2560."""
    workers: int = 0
    """Trainings at a time, each on --threads (here 1 by default) threads; 0 for as many as there are cores."""
    executor: str = LOCAL
    """Where they run: local, ray or ray:ADDRESS (docs/scale.md)."""
    quick: tyro.conf.FlagCreatePairsOff[bool] = False
    """A rehearsal in minutes: a slice of the dataset, a budget that teaches nothing, numbers that mean nothing."""
    robot: str | None = None
    """Robot name or folder, if not the one that the dataset keeps; all models correct it."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print one JSON object on stdout."""
    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = TRAINING
    """Settings of all models; rows of a table change one thing in them."""
