"""The network that gaponet train chooses on top of identification, as a method of the benchmark.

    python benchmarks/compare_methods.py --method benchmarks/chosen_network.py:network

Each candidate of `--model auto` gets two short rounds of supervised pre-training and no PPO. Seed
0.
"""

from __future__ import annotations

import json
import shutil

from real_robots.methods import FittedSim, identified
from real_robots.questions import Question, train_val

import gaponet as gp
from gaponet.data.store import Dataset
from gaponet.nn.artifact import GapModel
from gaponet.nn.training.config import PretrainingConfig, TrainConfig


def network(question: Question) -> FittedSim:
    """Train the candidates of `gaponet train` on top of identification, briefly; validation
    chooses. Seed 0.
    """
    assert question.work is not None
    robot, run = identified(question).robot, question.work / "network"
    shutil.rmtree(run, ignore_errors=True)
    data, parts = Dataset.create(run / "recordings", robot), dict[str, dict[str, str]](test={})
    for part, sequences in zip(("train", "val"), train_val(question), strict=True):
        hashes = {s.content_hash(): s for s in sequences}
        entries = [data.find(h) or data.append(s, content_hash=h) for h, s in hashes.items()]
        parts[part] = {e.id: e.hash for e in entries}
    (run / "parts.json").write_text(json.dumps({"parts": parts}))
    start = PretrainingConfig(rounds=2, num_envs=128, steps=250, gradient_steps=600, rows=30_000)
    config = TrainConfig(pretraining=start, mixed_gains=True, split=str(run / "parts.json"))
    options = gp.TrainOptions(model="auto")
    gp.train(data, robot=robot, out=run / "run", budget="64000", config=config, options=options)
    model = GapModel.load(run / "run")
    return FittedSim(robot, model.corrector(robot), note=model.card["model"]["kind"])
