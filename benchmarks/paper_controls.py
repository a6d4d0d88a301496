"""Controls of the paper's experiment: what a network is credited with that cannot know.

    python benchmarks/paper_controls.py EXPERIMENT DATASET [--steps 200000] [--seed 0]

EXPERIMENT is the folder of `gaponet experiment paper DATASET`. Each control is trained and measured
as its networks are:

    untrained          the correction is zero
    literal            as the experiment trains it
    sensors are noise  the literal network; in training its sensor values are drawn at random,
                       afterwards they are zero
    payload permuted   GAPONet and literal; the payload that the network is told is that of
                       another simulation

It prints the reduction of Q_dis over the nominal simulator, %, without wrists, on the motions and
the unit of Figure 3; and by how much the error with a permuted payload differs, for each payload.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor

from gaponet.experiments.paper.jobs import Job, train
from gaponet.experiments.paper.measure import measure_alignment
from gaponet.experiments.paper.options import PaperOptions
from gaponet.experiments.paper.results import WRIST
from gaponet.experiments.paper.statistics import reduction
from gaponet.experiments.paper.study import Study
from gaponet.experiments.paper.trainings import method_trainings
from gaponet.nn.artifact import GapModel
from gaponet.nn.paper import PaperNet
from gaponet.nn.training.env import DeltaEnv
from gaponet.sim.dataset_robot import open_dataset

TRAINER_ENV = "gaponet.nn.training.trainer.DeltaEnv"


class PermutedPayloadEnv(DeltaEnv):
    """The simulations carry their payload; the network is told that of another one."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        rng = np.random.default_rng(0)
        told = self.observations
        told.payload = rng.permutation(told.payload)


def noise_instead_of_sensors(net: PaperNet, x: Tensor, z: Tensor) -> Tensor:
    """Return noise in training, and its mean afterwards, (B, 2nm)."""
    values = net.config.sensor_dim(net.n)
    if net.training:
        return torch.randn(len(x), values, device=x.device)
    return x[:, :1] @ torch.zeros(
        1, values
    )  # of x, because the exported network takes any number of rows


def main() -> None:
    """Train and measure all controls."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("experiment", type=Path)
    parser.add_argument("dataset")
    parser.add_argument("--steps", type=int, default=200_000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    _, robot = open_dataset(arguments.dataset)
    options = PaperOptions(steps=arguments.steps)
    dataset = str(Path(arguments.dataset).resolve())
    study = Study(dataset, robot.before_identification, arguments.experiment, options)
    recorded = study.recorded()
    joints = [i for i, name in enumerate(study.robot.operated) if WRIST not in name]

    def q_dis(model: GapModel | None) -> np.ndarray:
        """Return the error of each recording, (recordings,) rad·s."""
        measured = measure_alignment(recorded, study.robot, model)
        error: np.ndarray = np.array(measured["q_dis"])[:, joints].mean(axis=1)
        return error

    nominal = q_dis(None)
    trainings = {
        training.name: training
        for training in method_trainings(options, "labels", arguments.seed, study.rates[:1])
    }
    controls: dict[str, tuple[str, Any]] = {
        "literal": ("literal", None),
        "GAPONet": ("GAPONet", None),
        "sensors are noise": (
            "literal",
            patch.object(PaperNet, "sensors", noise_instead_of_sensors),
        ),
        "payload permuted, literal": ("literal", patch(TRAINER_ENV, PermutedPayloadEnv)),
        "payload permuted, GAPONet": ("GAPONet", patch(TRAINER_ENV, PermutedPayloadEnv)),
    }
    if len(study.payloads) == 1:
        controls = {name: of for name, of in controls.items() if "payload" not in name}
    errors: dict[str, np.ndarray] = {}
    print("untrained: 0 % (its correction is zero)")
    for name, (network, change) in controls.items():
        training = replace(trainings[network], name=f"control {name}")
        job = Job(study, training)
        if change is None:
            train(job, training)
        else:
            with change:
                train(job, training)
        errors[name] = q_dis(GapModel.load(job.run_folder))
        removed = reduction([errors[name]], [nominal], recorded.motions)
        print(f"{name}: {removed} %", flush=True)
    payloads = np.array([sequence.meta.payload_mass for sequence in recorded.sequences])
    for network in ("literal", "GAPONet"):
        permuted = errors.get(f"payload permuted, {network}")
        if permuted is None:
            continue
        for mass in study.payloads:
            change = permuted[payloads == mass].sum() / errors[network][payloads == mass].sum() - 1
            print(f"{network}, {mass:g} kg: error changes by {100 * change:+.1f} %")


if __name__ == "__main__":
    main()
