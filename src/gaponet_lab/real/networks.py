"""Networks among the benchmark's methods: each is trained on a question's own recordings, briefly, and kept."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

from gaponet.data.sequence import Sequence
from gaponet.data.store import Dataset
from gaponet.files import write_text
from gaponet.model.artifact import GapModel
from gaponet.model.config import ModelConfig
from gaponet.training.budget import Budget
from gaponet.training.config import TrainConfig, WarmStartConfig
from gaponet.training.run import Trainer
from gaponet_lab.real.questions import Question
from gaponet_lab.real.rivals import Answer, Method, identified, nominal

RECIPE = TrainConfig(warm_start=WarmStartConfig(rounds=3), mixed_gains=True)
BASES = {"": nominal, "identification + ": identified}
TITLES = {"gaponet": "GAPONet", "shared_mlp": "shared MLP"}
TRAINED = (("", "shared_mlp"), ("", "gaponet"), ("identification + ", "gaponet"))


def networks(steps: int, work: Path) -> dict[str, tuple[str, Method]]:
    """Methods that train for so many control steps, three rounds of supervision first; runs lie below `work`."""
    made: dict[str, tuple[str, Method]] = {}
    for base, kind in TRAINED if steps else ():
        title = base + TITLES[kind]
        made[title] = title, partial(_trained, base=base, kind=kind, steps=steps, work=work)
    return made


def _trained(question: Question, base: str, kind: str, steps: int, work: Path) -> Answer:
    start = BASES[base](question)
    run = work / f"{question.split}-{base.partition(' ')[0]}{kind}"
    training, split = run / "training", run / "parts.json"
    if not (training / "model" / "card.json").is_file():
        dataset = Dataset.create(run / "recordings", question.robot)
        parts: dict[str, dict[str, str]] = {"test": {}}
        for part in ("train", "val"):
            mine: list[Sequence] = getattr(question, part)
            hashes = {s.content_hash(): s for s in mine}
            found = [dataset.find(h) or dataset.append(s, content_hash=h) for h, s in hashes.items()]
            parts[part] = {e.id: e.hash for e in found}
        write_text(split, json.dumps({"parts": parts}))
        config = replace(RECIPE, model=ModelConfig(kind), split=str(split))  # type: ignore[arg-type]
        half_way = (training / "checkpoint.pt").is_file()
        Trainer(dataset, start.robot, training, config, Budget(steps=steps), half_way).run()
    return replace(start, corrector=GapModel.load(training).corrector(start.robot))
