"""Quick runs of experiments: part of the dataset, small networks, a short budget; their numbers mean nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from gaponet.data.split import hash_order
from gaponet.data.store import Dataset, Entry
from gaponet.nn.training.config import PPOConfig, PretrainingConfig, TrainConfig
from gaponet.report.evaluate import evenly_spaced
from gaponet.robot.spec import RobotSpec

QUICK_BUDGET, QUICK_SEEDS = "2560", 1  # control steps of a training
LABEL = "QUICK RUN, numbers mean nothing"
PRETRAINING = PretrainingConfig(
    rounds=2, num_envs=16, steps=80, gradient_steps=40, batch_size=256, sensor_states=256
)  # fmt: skip
PPO = PPOConfig(num_envs=32, num_steps=16, epochs=1, critic_warmup=1)
SENSOR_HIDDEN = (32,)  # hidden layers of the predictor, whose fit takes most of a short training
MAX_MOTIONS, MAX_PAYLOADS, MAX_UNITS = 6, 3, 2  # a split of six motions has 3 + 1 + 2
RECORDING_S = 2.0


def quick_config(config: TrainConfig) -> TrainConfig:
    """Return the settings with small networks and rounds."""
    model = replace(config.model, sensor_hidden=SENSOR_HIDDEN)
    return replace(config, model=model, pretraining=PRETRAINING, ppo=PPO)


def quick_dataset(data: Dataset, robot: RobotSpec, out: Path) -> Dataset:
    """Write the first seconds of a few recordings as a dataset; the same call again finds it."""
    part = Dataset.create(out, robot)
    for entry in _few(data):
        start = data.read(entry).rows(slice(0, round(RECORDING_S / entry.dt)))
        if part.find(start.content_hash()) is None:
            part.append(start)
    return part


def _few(data: Dataset) -> list[Entry]:
    """Return few motions, payloads and units, one repetition, all rates: every group stays represented."""
    payloads = evenly_spaced(sorted({e.meta.payload_mass for e in data.entries}), MAX_PAYLOADS)
    units = sorted({e.meta.unit_id for e in data.entries})[:MAX_UNITS]
    motions = hash_order(e.meta.motion for e in data.entries)[:MAX_MOTIONS]
    first = min(e.meta.repetition for e in data.entries)
    return [
        e for e in data.entries
        if e.meta.motion in motions and e.meta.payload_mass in payloads and e.meta.unit_id in units
        and e.meta.repetition == first
    ]  # fmt: skip
