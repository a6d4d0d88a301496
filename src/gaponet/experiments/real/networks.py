"""Networks as methods of the benchmark: each is trained once on a question's training recordings."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial

import numpy as np

from gaponet.base.errors import UsageError
from gaponet.base.files import write_text
from gaponet.data.store import Dataset
from gaponet.experiments.real.methods import LEFT_OUT, FittedSim, Method, fit_delay_offset, identified, nominal
from gaponet.experiments.real.questions import Question, train_val
from gaponet.nn.artifact import GapModel
from gaponet.nn.config import ModelConfig
from gaponet.nn.training.budget import Budget
from gaponet.nn.training.config import PretrainingConfig, TrainConfig
from gaponet.nn.training.trainer import Trainer
from gaponet.report.verdict import NetworkGain

BASES = {"": nominal, "identification + ": identified}
TITLES = {"gaponet": "GAPONet", "shared_mlp": "shared MLP"}
FULL_RECIPE_STEPS = 600_000  # control steps from which the recipe is that of gaponet train
# Fewer steps are one round of supervised pre-training.
ONE_ROUND = PretrainingConfig(rounds=1, num_envs=256, gradient_steps=200, sensor_states=512)


def networks(steps: int) -> dict[str, tuple[str, Method]]:
    """Return methods that train a network for this number of control steps: name → title and method."""
    return {
        f"{base}{TITLES[kind]} {steps}": (base + TITLES[kind], partial(_train, base=base, kind=kind, steps=steps))
        for base in BASES for kind in ("shared_mlp", "gaponet")
    }  # fmt: skip


def _recipe(steps: int) -> TrainConfig:
    """Return the training settings for a number of control steps; a short training labels no more rows than that."""
    warm = PretrainingConfig()
    if steps < FULL_RECIPE_STEPS:
        warm = replace(ONE_ROUND, steps=max(steps // ONE_ROUND.num_envs, 1), rows=steps)
    return TrainConfig(pretraining=warm, mixed_gains=True)


def _train(question: Question, base: str, kind: str, steps: int) -> FittedSim:
    """Train a network on top of a simulator; leave it out if validation shows no gain over identification."""
    if question.work is None:
        raise UsageError(f"{question.name}: networks need a folder to be trained in")
    start = BASES[base](question)
    run = question.work / f"{base.partition(' ')[0]}{kind}-{steps}"
    training, split = run / "training", run / "parts.json"
    if not (training / "model" / "card.json").is_file():
        dataset = Dataset.create(run / "recordings", question.robot)
        parts: dict[str, dict[str, str]] = {"test": {}}
        for part, sequences in zip(("train", "val"), train_val(question), strict=True):
            hashes = {s.content_hash(): s for s in sequences}
            entries = [dataset.find(h) or dataset.append(s, content_hash=h) for h, s in hashes.items()]
            parts[part] = {e.id: e.hash for e in entries}
        write_text(split, json.dumps({"parts": parts}))
        config = replace(_recipe(steps), model=ModelConfig(kind), split=str(split))  # type: ignore[arg-type]
        resume = (training / "checkpoint.pt").is_file()
        trainer = Trainer.prepare(dataset, start.robot, training, config, Budget(steps=steps), resume=resume)
        trainer.baseline = fit_delay_offset(question)
        trainer.run()
    model = GapModel.load(training)
    val = model.card["val_mpjae"]
    gain = NetworkGain(base, val["added"], val.get("error", np.nan), val["start"])
    note = f"{100 * gain.reduction / gain.base_error:.0f} % less on validation"
    if base and not gain.helps:
        return replace(start, note=f"{LEFT_OUT}: {note}")
    return replace(start, corrector=model.corrector(start.robot), note=note)
