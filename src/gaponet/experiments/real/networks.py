"""Networks among the benchmark's methods: each is trained on a question's own recordings, briefly, and kept."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial

import numpy as np

from gaponet.base.errors import UsageError
from gaponet.base.files import write_text
from gaponet.data.store import Dataset
from gaponet.experiments.real.questions import Question, rehearsal
from gaponet.experiments.real.rivals import LEFT_OUT, Answer, Method, fitted, identified, nominal
from gaponet.nn.artifact import GapModel
from gaponet.nn.config import ModelConfig
from gaponet.nn.training.budget import Budget
from gaponet.nn.training.config import PretrainingConfig, TrainConfig
from gaponet.nn.training.trainer import Trainer
from gaponet.report.verdict import Added

BASES = {"": nominal, "identification + ": identified}
TITLES = {"gaponet": "GAPONet", "shared_mlp": "shared MLP"}
TRAINED = tuple((base, kind) for base in BASES for kind in ("shared_mlp", "gaponet"))
WHOLE = 600_000  # control steps from which training is that of gaponet train
# Fewer are one round of its supervised start.
BRIEF = PretrainingConfig(rounds=1, num_envs=256, gradient_steps=200, sensor_states=512)


def networks(steps: int) -> dict[str, tuple[str, Method]]:
    """Methods that train for so many control steps."""
    made: dict[str, tuple[str, Method]] = {}
    for base, kind in TRAINED if steps else ():
        title = base + TITLES[kind]
        made[f"{title} {steps}"] = title, partial(_trained, base=base, kind=kind, steps=steps)
    return made


def _recipe(steps: int) -> TrainConfig:
    """How a network is trained for so many control steps; a brief training labels no more rows than that."""
    warm = PretrainingConfig()
    if steps < WHOLE:
        warm = replace(BRIEF, steps=max(steps // BRIEF.num_envs, 1), rows=steps)
    return TrainConfig(warm_start=warm, mixed_gains=True)


def _trained(question: Question, base: str, kind: str, steps: int) -> Answer:
    """The simulator with its network; the identified one without where `gaponet train` says that it adds nothing."""
    if question.work is None:
        raise UsageError(f"{question.name}: networks need a folder to be trained in")
    start = BASES[base](question)
    run = question.work / f"{base.partition(' ')[0]}{kind}-{steps}"
    training, split = run / "training", run / "parts.json"
    if not (training / "model" / "card.json").is_file():
        dataset = Dataset.create(run / "recordings", question.robot)
        parts: dict[str, dict[str, str]] = {"test": {}}
        for part, mine in zip(("train", "val"), rehearsal(question), strict=True):
            hashes = {s.content_hash(): s for s in mine}
            found = [dataset.find(h) or dataset.append(s, content_hash=h) for h, s in hashes.items()]
            parts[part] = {e.id: e.hash for e in found}
        write_text(split, json.dumps({"parts": parts}))
        config = replace(_recipe(steps), model=ModelConfig(kind), split=str(split))  # type: ignore[arg-type]
        half_way = (training / "checkpoint.pt").is_file()
        trainer = Trainer(dataset, start.robot, training, config, Budget(steps=steps), half_way)
        trainer.baseline = fitted(question)
        trainer.run()
    model = GapModel.load(training)
    val = model.card["val_mpjae"]
    worth = Added(base, val["added"], val.get("error", np.nan), val["start"])
    told = f"{100 * worth.less / worth.left:.0f} % less on validation"
    if base and not worth.helps:
        return replace(start, note=f"{LEFT_OUT}: {told}")
    return replace(start, corrector=model.corrector(start.robot), note=told)
