"""Control tests of the paper's network without sensors, payload or PPO: docs/paper.md.

    python benchmarks/paper_adversaries.py DATASET WORK [--budget 1000000] [--unit virtual-4]

Trains the paper's network (payload as an input) in six ways and measures the test motions of the units that were
trained on and of one that was not:

    as it is          gaponet train --model paper --recipe paper
    sensors are noise S is a sample of N(0, 1) in training and its mean, 0, in evaluation
    payload permuted  the payload of each training and validation recording is that of another one, drawn at random
    no PPO            gaponet train --recipe labels that ends before PPO: supervised pre-training
    ours              gaponet train as it comes, with the payloads as they are and permuted

A folder in WORK that is complete is not trained again.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gaponet.base.result_table import ResultTable
from gaponet.cli.main import main as gaponet
from gaponet.data.split import split_entries
from gaponet.data.store import Dataset
from gaponet.nn.artifact import GapModel
from gaponet.nn.paper import PaperNet
from gaponet.robot.spec import load_robot
from gaponet.sim.metrics import metrics, runs
from gaponet.sim.replay import Corrector, replay

PAPER = ("--model", "paper", "--recipe", "paper")
START_STEPS = 3 * 256 * 400  # control steps of the three rounds of supervised pre-training
ROWS = {  # row → options of gaponet train
    "as it is": PAPER, "sensors are noise": PAPER, "payload permuted": PAPER,
    "no PPO": ("--model", "paper", "--budget", START_STEPS), "ours": (), "ours, payload permuted": (),
}  # fmt: skip


def noise(net: PaperNet, x: Tensor, z: Tensor) -> Tensor:
    """Sensor values without information: a sample of N(0, 1) in training, else its mean."""
    mean = 0 * x[:, :1].expand(-1, net.config.sensor_dim(net.n))
    return torch.randn_like(mean) if net.training else mean


def permuted(data: Dataset, unit: str, folder: Path) -> Dataset:
    """The dataset with the payloads of its training and validation recordings permuted."""
    parts, draw = split_entries(data, (unit,)), np.random.default_rng(0)
    robot = load_robot(str(data.path / "robot"))
    found = Dataset.create(folder, robot)
    with found.appending():
        for part, entries in parts.items():
            masses = np.array([e.meta.payload_mass for e in entries])
            if part != "test":
                draw.shuffle(masses)
            for sequence, mass in zip(data.sequences(entries), masses, strict=True):
                one = replace(sequence, meta=replace(sequence.meta, payload_mass=float(mass)))
                if found.find(one.content_hash()) is None:
                    found.append(one)
    return found


def main(dataset: Path, work: Path, budget: str, unit: str) -> None:
    """Train what is missing, then print the table."""
    data, sensors = Dataset(dataset), PaperNet.sensors
    robot = load_robot(str(data.path / "robot"))
    test = split_entries(data, (unit,))["test"]
    groups = [[e for e in test if (e.meta.unit_id == unit) is held] for held in (False, True)]

    def errors(corrector: Corrector | None) -> tuple[float, ...]:
        out = []
        for group in groups:
            reals = data.sequences(group)
            simulated = replay(reals, robot, corrector, lock_idle=True)
            out.append(metrics(runs(reals, [s.qpos for s in simulated], robot))["mpjae"] * 1e3)
        return tuple(out)

    nominal = errors(None)
    rows: list[tuple[object, ...]] = [("nominal", *nominal, *(1.0 for _ in groups))]
    for name, options in ROWS.items():
        folder = work / name.replace(" ", "_").replace(",", "")
        learned = permuted(data, unit, work / "permuted") if "permuted" in name else data
        PaperNet.sensors = noise if name == "sensors are noise" else sensors  # type: ignore[method-assign]
        if not (folder / "model" / "card.json").is_file():
            limit = () if "--budget" in options else ("--budget", budget)
            command = [
                "train",
                learned.path,
                "--out",
                folder,
                "--holdout-units",
                unit,
                "--threads",
                1,
                *options,
                *limit,
            ]
            if gaponet(list(map(str, [*command, *options, *limit]))):
                raise SystemExit(2)
        found = errors(GapModel.load(folder).corrector(robot))
        rows.append((name, *found, *(e / n for e, n in zip(found, nominal, strict=True))))
        columns = ("training", "units trained on, mrad", f"{unit}, mrad", "of nominal", "of nominal ")
        print(ResultTable("adversaries", columns, tuple(rows)).markdown(), flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--budget", default="1000000")
    parser.add_argument("--unit", default="virtual-4")
    given = parser.parse_args()
    main(given.dataset, given.work, given.budget, given.unit)
