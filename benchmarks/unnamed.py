"""What a network, and its rivals, add to identification where causes have no name: docs/results/unnamed.md.

    python benchmarks/unnamed.py WORK [--seeds 3] [--budget 600000] [--fleet unnamed|FILE] [--data DATASET]

Collects the fleet (recipe of virtual_h1_2.py), runs `gaponet identify` and `gaponet train` on virtual-1 to virtual-3 as
a user would, and measures virtual-4 playing other motions, whole-motion free run. Rivals: a shared MLP trained as the
operator is, and gradient-boosted trees (trees.py), with every recording's own labels and with another one's. With
--data all learn from these recordings, and are asked the motions of the fleet that are not among them, if there are
such (postures left out); else (other units) the same motions as always. What is found in WORK is kept. Every number is
from VIRTUAL robots.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from trees import LIMIT, Trees
from virtual_h1_2 import RECIPE, UNIT, Bench, Errors, by_motion, run

from gaponet.base.arrays import Array
from gaponet.base.result_table import MeanStd, ResultTable
from gaponet.cli.main import main as gaponet
from gaponet.data.sequence import Sequence
from gaponet.data.split import split_entries
from gaponet.data.store import Dataset
from gaponet.nn.adaptation import Adaptation
from gaponet.nn.artifact import GapModel
from gaponet.nn.training.labels import trajectory_labels
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.metrics import standard_error
from gaponet.sim.replay import Corrector

SHUFFLED = "trees-shuffled"


def of_others(bench: Bench, labels: Array) -> Array:
    """Every recording with another one's labels, repeated or cut to its length."""
    parts = np.split(labels, np.cumsum([len(s) for s in bench.train])[:-1])
    other = np.roll(np.random.default_rng(0).permutation(len(parts)), 1)
    return np.concatenate([np.resize(parts[o], p.shape) for o, p in zip(other, parts, strict=True)])


class Rows:
    """The rows of the table: what is fitted, and its errors on validation and test, each found once."""

    def __init__(self, bench: Bench, budget: str) -> None:
        self.bench, self.budget = bench, budget

    def errors(self, name: str, simulator: RobotSpec, corrector: Callable[[], Corrector] | None = None) -> Array:
        """Of validation and then of test recordings, rad."""
        file = self.bench.work / "errors" / f"{name}.npy"
        if not file.is_file():
            both = replace(self.bench, test=[*self.bench.val, *self.bench.test])
            found = both.errors(simulator, corrector() if corrector else None)
            file.parent.mkdir(parents=True, exist_ok=True)
            np.save(file, found)
        return np.load(file)

    def identified(self) -> RobotSpec:
        """gaponet identify, as it comes."""
        out = self.bench.work / "identified"
        if not (out / "robot.toml").is_file():
            run("identify", self.bench.data.path, "--out", out, *self.held_out())
        return load_robot(out)

    def held_out(self) -> list[str]:
        """The unit that is measured, where it is among those to learn from."""
        return ["--holdout-units", UNIT] if UNIT in {e.meta.unit_id for e in self.bench.data.entries} else []

    def labels(self, robot: RobotSpec) -> Array:
        """Of the training recordings."""
        file = self.bench.work / "labels.npy"
        if not file.is_file():
            np.save(file, trajectory_labels(self.bench.train, robot, LIMIT))
        return np.load(file)

    def corrector(self, kind: str, robot: RobotSpec, seed: int) -> Corrector:
        """Trees, or gaponet train as it comes."""
        if kind == "trees":
            return Trees.trained(self.bench.train, robot, self.labels(robot), seed)
        if kind == SHUFFLED:
            return Trees.trained(self.bench.train, robot, of_others(self.bench, self.labels(robot)), seed)
        return GapModel.load(self.trained(kind, robot, seed)).corrector(robot)

    def trained(self, kind: str, robot: RobotSpec, seed: int) -> Path:
        """The folder of gaponet train as it comes, or with an option: gaponet:model.sensors=off."""
        folder, (model, *more) = self.bench.work / f"{kind}-{seed}", kind.split(":")
        if not (folder / "model" / "card.json").is_file():
            run("train", self.bench.data.path, "--robot", robot.folder, "--out", folder, "--model", model,
                "--budget", self.budget, "--seed", seed, *self.held_out(),
                *[word for option in more for word in f"--{option}".replace("=", " ").split()],
                *(["--resume"] if (folder / "checkpoint.pt").is_file() else []))  # fmt: skip
        return folder

    def adapted(self, robot: RobotSpec, kinds: ListOf[str]) -> dict[str, Errors]:
        """With 30 s of the unit, motions trained on: the robot folder, and under the first network."""
        out, motions = self.bench.work / "adapted", sorted({s.meta.motion for s in self.bench.train})
        if not (out / "robot.toml").is_file():
            words = (
                "adapt",
                robot.folder,
                self.bench.data.path,
                "--unit",
                UNIT,
                "--out",
                out,
                "--motions",
                *motions,
            )
            gaponet([*map(str, words)])  # may refuse: then the robot stays as it was identified
        own = load_robot(out) if (out / "robot.toml").is_file() else robot
        found = {"adapted": [self.errors("adapted", own)]}
        for kind in kinds:
            folder = self.trained(kind, robot, 0)
            model = GapModel.load(folder)
            if UNIT not in Adaptation.load(folder, model.weights_hash()):
                run("adapt", folder, self.bench.data.path, "--unit", UNIT)
            own = Adaptation.load(folder, model.weights_hash())[UNIT].robot(robot)
            name = f"{kind}, adapted"
            found[name] = [self.errors(name, own, partial(model.corrector, robot))]
        return found

    def all(self, kinds: ListOf[str], seeds: int) -> dict[str, Errors]:
        """Row by row, seed by seed."""
        robot = self.identified()
        found = {
            "nominal": [self.errors("nominal", self.bench.nominal)],
            "identified": [self.errors("identified", robot)],
        }
        for kind in kinds:
            found[kind] = [
                self.errors(f"{kind}-{seed}", robot, partial(self.corrector, kind, robot, seed))
                for seed in range(1 if kind == SHUFFLED else seeds)
            ]
        return found


def table(found: dict[str, Errors], sequences: list[Sequence], name: str) -> ResultTable:
    """What each row leaves, by payload in parts of what identification leaves, and paired differences over motions."""
    payloads = sorted({s.meta.payload_mass for s in sequences})
    base = {p: by_motion(found["identified"], sequences, p).mean() for p in (*payloads, None)}
    best, rows = by_motion(found["gaponet"], sequences) if "gaponet" in found else None, []
    for row, errors in found.items():
        mean = by_motion(errors, sequences)
        less, apart = by_motion(found["identified"], sequences) - mean, None if best is None else mean - best
        seeds = (
            MeanStd.from_values([float(by_motion([e], sequences).mean()) for e in errors]).std
            if len(errors) > 1
            else None
        )
        by_payload = (by_motion(errors, sequences, p).mean() / base[p] for p in payloads)
        over = "" if apart is None else f"{apart.mean():+.2f} ± {standard_error(apart):.2f}"
        told = f"{less.mean():+.2f} ± {standard_error(less):.2f}"
        rows.append((row, mean.mean(), seeds, mean.mean() / base[None], *by_payload, told, over))
    heads = ("row", "mrad", "± seeds", "of identified", *(f"{p:g} kg" for p in payloads), "less", "above gaponet")
    return ResultTable(name, heads, tuple(rows), f"{name}: {len(sequences)} free runs of VIRTUAL robots")


def learning_from(bench: Bench, data: Dataset) -> Bench:
    """The bench with other recordings to learn from."""
    parts = split_entries(data, (UNIT,) if UNIT in {e.meta.unit_id for e in data.entries} else ())
    held = {e.meta.motion for e in data.entries}
    strange = [e for e in bench.data.entries if e.meta.unit_id == UNIT and e.meta.motion not in held]
    train, val = (data.sequences(parts[part]) for part in ("train", "val"))
    test = bench.data.sequences(strange) if strange else bench.test
    return replace(bench, data=data, train=train, val=val, test=test, work=bench.work / data.path.name)


def main() -> None:
    """Measure, and print a table of validation and one of test motions."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--budget", default="600000", help="of each run, as in gaponet train")
    parser.add_argument("--fleet", default="unnamed", help="name, or a file")
    parser.add_argument("--recipe", type=Path, default=RECIPE)
    parser.add_argument("--data", type=Path, help="learn from these recordings, not from the fleet's")
    parser.add_argument("--rows", nargs="*", default=["gaponet", "shared_mlp", "trees", SHUFFLED])
    parser.add_argument("--adapt", action="store_true", help="also with 30 s of the unit, seed 0")
    args = parser.parse_args()
    bench = Bench.of(args.fleet, args.recipe, args.work)
    bench = learning_from(bench, Dataset(args.data)) if args.data else bench
    rows = Rows(bench, args.budget)
    found = rows.all(args.rows, args.seeds)
    found |= rows.adapted(rows.identified(), [k for k in args.rows if k == "gaponet"]) if args.adapt else {}
    ends = len(bench.val)
    for name, part, own in (("validation", bench.val, slice(0, ends)), ("test", bench.test, slice(ends, None))):
        print(table({k: [e[own] for e in v] for k, v in found.items()}, part, name).markdown(), "\n")


if __name__ == "__main__":
    main()
