"""Ten times the steps, and networks of the paper's size: error against steps and seconds, real SO-101.

    python benchmarks/steps.py WORK --logs LOGS [--seeds 3] [--arms usual:1 usual:10 layers:10:1 …] [--workers 2]

An arm is a network: today's, one with the paper's layers, and the paper's own form (`--model paper`). Each is trained
by the supervised start alone, in the nominal simulator, for six rounds of 102,400 steps and for ten times as many.
Curves are of validation motions at gain 1; test motions are played once, by the best on validation.

Writes docs/results/steps.{md,json,csv,svg,png}. What is in WORK is kept.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from ppo import real
from publish import publish, say

from gaponet.data.split import split_entries, spread
from gaponet.methods import METHODS
from gaponet.metrics import metrics, runs, standard_error
from gaponet.sim.replay import replay
from gaponet.spread import Spread, Table
from gaponet.training.kept import PROGRESS
from gaponet.training.run import VALIDATION_RUNS
from gaponet_lab.kept import read_kept
from gaponet_lab.plot.charts import lines
from gaponet_lab.plot.colours import colour, shade
from gaponet_lab.study.found import baselines, train_all
from gaponet_lab.study.pool import RESULT, Cell
from gaponet_lab.study.result import Result, facts
from gaponet_lab.study.study import Study

LAYERS = "gaponet:branch_hidden=256,256,256:trunk_hidden=128,128,128:sensor_hidden=256,256"  # the paper's
ARMS = {"usual": ("today's network", "gaponet", 0.0), "layers": ("the paper's layers", LAYERS, -0.4),
        "paper": ("the paper's form", "paper", 0.5)}  # fmt: skip
ROUNDS, TIMES = 6, (1, 10)


@dataclass(frozen=True)
class Arm:
    """One network for one number of steps."""

    name: str
    study: Study
    times: int

    @cached_property
    def cells(self) -> list[Cell]:
        """A training per seed."""
        warm, network = self.study.config.warm_start, ARMS[self.name][1]
        word = f"{network}:warm_start.rounds={ROUNDS * self.times}"
        steps = ROUNDS * self.times * warm.num_envs * warm.steps
        return replace(self.study, budget=str(steps)).cells([word])

    @property
    def title(self) -> str:
        """For people."""
        return ARMS[self.name][0]

    def curves(self) -> list[list[dict[str, Any]]]:
        """Of each seed that is done: the lines of progress.jsonl."""
        files = [cell.folder / PROGRESS for cell in self.cells if cell.done]
        return [[json.loads(row) for row in f.read_text(encoding="utf-8").splitlines()] for f in files]

    def errors(self) -> list[np.ndarray]:
        """Of each test motion, mrad, seed by seed."""
        found = [read_kept(cell.folder / RESULT)["known"]["by_motion"] for cell in self.cells if cell.done]
        return [np.array([1e3 * by[m]["mpjae"] for m in sorted(by)]) for by in found]

    def series(self) -> tuple[str, list[float], list[Spread]]:
        """Best validation error so far, against million steps."""
        best = [np.minimum.accumulate([r["val_mpjae"] for r in c[1:]]) for c in self.curves()]
        at = [r["steps"] / 1e6 for r in self.curves()[0][1:]]
        return (
            shade(colour("gaponet"), ARMS[self.name][2]), at,
            [Spread.of(values, 1e3) for values in zip(*best, strict=True)],
        )  # fmt: skip


def row(arm: Arm, short: Arm) -> tuple[Any, ...]:
    """Of the table; beside the same network's short training over the seeds that both have."""
    curves, errors = arm.curves(), arm.errors()
    seconds = [c[-1]["seconds"] for c in curves]
    less = np.mean(short.errors()[: len(errors)], axis=0) - np.mean(errors, axis=0)
    paired = ("", "") if arm is short else (
        f"{less.mean():.2f} ± {standard_error(less):.2f}", f"{(less > 0).sum()} of {len(less)}"
    )  # fmt: skip
    return (
        arm.title, f"{curves[0][-1]['steps'] / 1e6:.2f}", str(len(curves)), Spread.of([s / 60 for s in seconds]),
        Spread.of([min(r["val_mpjae"] for r in c) for c in curves], 1e3), Spread.of([e.mean() for e in errors]),
        *paired,
    )  # fmt: skip


def validated(study: Study) -> float:
    """Error of the identified simulator on the validation motions, mrad."""
    val = study.data.sequences(spread(split_entries(study.data)["val"], VALIDATION_RUNS), optional=False)
    assert study.identified
    twins = replay(val, study.identified, lock_idle=True)
    return 1e3 * metrics(runs(val, [t.qpos for t in twins], study.robot))["mpjae"]


HEAD = ("network", "M steps", "seeds", "minutes", "validation", "test", "less than the short, paired", "motions better")
CAPTION = (
    "MPJAE in mrad, whole-motion free run; ± std over seeds, of the paired difference standard error over motions. "
    "Minutes of training, one core each, two trainings at a time beside other work. Validation: the best, at gain 1; "
    "test: that model with the gain that validation chose."
)


def result(found: list[Arm], study: Study, failed: list[str]) -> Result:
    """A row per network and number of steps, and one panel of curves."""
    short = {a.name: a for a in found if a.times == 1}
    levels = baselines(next(c for c in found[0].cells if c.done), study)
    levels = {word: 1e3 * levels[word]["known"]["mpjae"] for word in ("nominal", "identified")}
    table = Table("steps", HEAD, tuple(row(a, short[a.name]) for a in found), CAPTION)
    series = {a.title: a.series() for a in found if a.times > 1}
    ends = [x[0] for _, x, _ in series.values()][:1] + [x[-1] for _, x, _ in series.values()][:1]
    label, tint = METHODS["identified"][:2]
    series[f"{label}, no operator"] = tint, ends, [Spread(validated(study), float("nan"), 1)] * 2
    figure = lines(
        [("real SO-101, supervised start", series)], ("million control steps", "validation MPJAE, mrad"),
        [(x, f"{x:g}") for x in (0.1, 0.3, 1.0, 3.0)], log=True,
    )  # fmt: skip
    said = ", ".join(f"{METHODS[word][0]} {level:.2f}" for word, level in levels.items())
    notes = f"SO-101: recordings of a real robot. Without an operator, on the same test motions, mrad: {said}."
    repeat = facts(study.data, arms=[f"{a.name} × {a.times}: {len(a.curves())} seeds" for a in found])
    return Result("steps", "Ten times the steps, and wider networks", notes, repeat, (table,), {"steps": figure},
                  tuple(failed))  # fmt: skip


def main() -> None:
    """Train, measure, write, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--logs", type=Path, help="SAGE's logs of the SO-101")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--workers", type=int, default=0)
    parser.add_argument("--arms", nargs="+", default=[f"{name}:{n}" for n in TIMES for name in ARMS],
                        help="NAME:TIMES or NAME:TIMES:SEEDS")  # fmt: skip
    args = parser.parse_args()
    study = real(args)
    found = []
    for word in args.arms:
        name, times, *seeds = word.split(":")
        found.append(Arm(name, replace(study, seeds=int((seeds or [args.seeds])[0])), int(times)))
    cells = sorted((c for a in found for c in a.cells), key=lambda c: c.seed)  # what is done first can be compared
    failed = train_all(cells, study, say)
    publish(result([a for a in found if a.curves()], study, failed), args.work / "results")


if __name__ == "__main__":
    main()
