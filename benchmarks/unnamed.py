"""What a network, and its rivals, add to identification where causes have no name: docs/results/unnamed.md.

    python benchmarks/unnamed.py WORK [--seeds 3] [--budget 600000] [--fleet unnamed] [--shuffled]

The fleet `unnamed`, recipe of virtual_h1_2.py: identified and trained on virtual-1 to virtual-3, measured on virtual-4
playing other motions, whole-motion free run. Rivals on the same labels: a shared MLP with the operator's inputs, and
gradient-boosted trees, one per joint, on position, speed and a − q of all joints and the payload (needs scikit-learn).
With --shuffled every recording has another one's labels. What is found in WORK is kept. Every number is from VIRTUAL
robots.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence as ListOf
from dataclasses import replace
from pathlib import Path

import numpy as np
from virtual_h1_2 import RECIPE, UNIT, Bench, Errors, by_motion, run, table

from gaponet.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.metrics import standard_error
from gaponet.model.artifact import GapModel
from gaponet.robot import RobotSpec
from gaponet.sim.identify import DEFAULT_TERMS
from gaponet.sim.replay import replay
from gaponet.training.labels import trajectory_labels

LIMIT, ROUNDS, TREES, LEAF, MOST = 0.3, 1, 120, 60, 60_000  # rad, rounds of DAgger, of each joint, rows, rows fitted
KINDS = ("gaponet", "shared_mlp")


class Trees:
    """Gradient-boosted trees, one ensemble per joint, in the loop. Implements sim.replay.Corrector."""

    def __init__(self, robot: RobotSpec) -> None:
        self.robot, self.op, self.models = robot, robot.operated_index, []

    def fit(self, x: Array, y: Array, seed: int) -> None:
        """Inputs (N, 3n + 1), labels (N, n) rad."""
        from sklearn.ensemble import HistGradientBoostingRegressor

        rows = np.random.default_rng(seed).permutation(len(x))[:MOST]
        self.models = [
            HistGradientBoostingRegressor(max_iter=TREES, min_samples_leaf=LEAF, early_stopping=False).fit(
                x[rows], column
            )
            for column in y[rows].T
        ]

    @staticmethod
    def inputs(qpos: Array, qvel: Array, ctrl: Array, payload: Array) -> Array:
        """(k, 3n + 1) of operated joints."""
        return np.concatenate([qpos, qvel, ctrl - qpos, payload[:, None]], axis=1)

    def reset(self, start: ListOf[Sequence]) -> None:
        self.payload = np.array([s.meta.payload_mass for s in start])

    def correct(self, t: int, target: Array, qpos: Array, qvel: Array) -> Array:
        x, out = self.inputs(qpos[:, self.op], qvel[:, self.op], target[:, self.op], self.payload), np.array(target)
        out[:, self.op] += np.stack([m.predict(x) for m in self.models], axis=1)
        return np.clip(out, *self.robot.qpos_range.T)


def trees(bench: Bench, robot: RobotSpec, labels: Array, seed: int) -> Trees:
    """Fitted on the states that the labels lead to, then on those that the trees lead to as well."""
    op, model = robot.operated_index, Trees(robot)
    deltas = np.split(labels, np.cumsum([len(s) for s in bench.train])[:-1])
    told = [s.ctrl.copy() for s in bench.train]
    for ctrl, delta in zip(told, deltas, strict=True):
        ctrl[:, op] += delta
    led = [replace(s, ctrl=ctrl) for s, ctrl in zip(bench.train, told, strict=True)]
    runs, x = replay(led, robot, lock_idle=True), []
    for again in range(ROUNDS + 1):
        x += [
            Trees.inputs(t.qpos[:, op], t.qvel[:, op], s.ctrl[:, op], np.full(len(s), s.meta.payload_mass))
            for s, t in zip(bench.train, runs, strict=True)
        ]
        model.fit(np.concatenate(x), np.concatenate([labels] * (again + 1)), seed)
        if again < ROUNDS:
            runs = replay(bench.train, robot, model, lock_idle=True)
    return model


def trained(bench: Bench, robot: RobotSpec, folder: Path, kind: str, seed: int, budget: str) -> Array:
    """Errors of a run on the test motions, rad."""
    if not (folder / "model" / "card.json").is_file():
        run("train", bench.data.path, "--robot", robot.folder, "--out", folder, "--model", kind,
            "--budget", budget, "--seed", seed, "--holdout-units", UNIT,
            *(["--resume"] if (folder / "checkpoint.pt").is_file() else []))  # fmt: skip
    return bench.errors(robot, GapModel.load(folder).corrector(robot))


def steps(bench: Bench, seeds: int, budget: str, shuffled: bool) -> dict[str, Errors]:
    """Row by row."""
    robot = bench.identified(DEFAULT_TERMS)
    found: dict[str, Errors] = {"nominal": [bench.errors(bench.nominal)], "identified": [bench.errors(robot)]}
    labels = trajectory_labels(bench.train, robot, LIMIT)
    if shuffled:
        parts = np.split(labels, np.cumsum([len(s) for s in bench.train])[:-1])
        other = np.roll(np.random.default_rng(0).permutation(len(parts)), 1)
        labels = np.concatenate([np.resize(parts[o], p.shape) for o, p in zip(other, parts, strict=True)])
    found["… + trees"] = [bench.errors(robot, trees(bench, robot, labels, s)) for s in range(seeds)]
    for kind in () if shuffled else KINDS:
        found[f"… + {kind}"] = [
            trained(bench, robot, bench.work / f"{kind}-{s}", kind, s, budget) for s in range(seeds)
        ]
    return found


def main() -> None:
    """Measure, and print the table and paired differences."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--budget", default="600000", help="of each run, as in gaponet train")
    parser.add_argument("--fleet", default="unnamed")
    parser.add_argument("--recipe", type=Path, default=RECIPE)
    parser.add_argument("--shuffled", action="store_true", help="every recording has another one's labels")
    args = parser.parse_args()
    bench = Bench.of(args.fleet, args.recipe, args.work)
    found = steps(bench, args.seeds, args.budget, args.shuffled)
    print(table(args.fleet, found, bench.test, f"MPJAE in mrad on VIRTUAL {UNIT}, ± over motions").markdown())
    base = by_motion(found["identified"], bench.test)
    for name, errors in list(found.items())[2:]:
        less = base - by_motion(errors, bench.test)
        ratio = 1 - less.mean() / base.mean()
        print(f"{name}: {less.mean():+.2f} ± {standard_error(less):.2f} mrad less, {ratio:.3f} of identified")


if __name__ == "__main__":
    main()
