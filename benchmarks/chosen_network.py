"""The network that gaponet train chooses on top of identification, as a method of the benchmark.

    python benchmarks/compare_methods.py --method benchmarks/chosen_network.py:network

Each candidate of `--model auto` gets one short round of supervised pre-training and no PPO. So no
network is trained on states that it reaches itself. The seed is 0.
"""

from __future__ import annotations

import shutil
from dataclasses import replace

from real_robots.methods import FittedSim, identified, store_parts
from real_robots.questions import Question

import gaponet as gp
from gaponet.nn.artifact import GapModel
from gaponet.nn.training.config import PretrainingConfig, TrainConfig


def network(question: Question) -> FittedSim:
    """Train the candidates of `gaponet train` on top of identification, briefly."""
    assert question.work is not None
    robot = identified(question).robot
    run = question.work / "network"
    shutil.rmtree(run, ignore_errors=True)
    dataset, split = store_parts(replace(question, robot=robot), run)
    start = PretrainingConfig(rounds=1, num_envs=128, steps=250, gradient_steps=600, rows=30_000)
    config = TrainConfig(pretraining=start, mixed_gains=True, split=str(split))
    options = gp.TrainOptions(model="auto")
    gp.train(dataset, robot=robot, out=run / "run", budget="64000", config=config, options=options)
    model = GapModel.load(run / "run")
    return FittedSim(robot, model.corrector(robot), note=model.card["model"]["kind"])
