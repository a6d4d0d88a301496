"""PPO over 2 M control steps: error against steps, from the warm start and from nothing, real SO-101 and virtual H1-2.

    python benchmarks/ppo.py WORK --logs LOGS [--seeds 3] [--steps 2000000] [--arms real-warm virtual-identified:1 …]

An arm trains three seeds: warm, in the nominal simulator from six rounds of the supervised start on; identified, in
the identified simulator from the untrained operator on. Virtual: the fleet `hard` of virtual_h1_2.py, tested on a unit
never seen. Curves are of validation motions at gain 1; test motions are played once, by the best on validation.

Writes docs/results/ppo.{md,json,csv,svg,png}; arms of another time have a --page of their own. What is in WORK is kept.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from publish import publish, say
from virtual_h1_2 import CONFIG, PPO, RECIPE, UNIT, WORD, Bench, run

from gaponet.data.json_file import write_json
from gaponet.data.store import Dataset
from gaponet.methods import METHODS
from gaponet.metrics import standard_error
from gaponet.robot import load_robot
from gaponet.sim.identify import DEFAULT_TERMS
from gaponet.spread import Spread, Table
from gaponet.training.config import TrainConfig, WarmStartConfig
from gaponet.training.kept import PROGRESS
from gaponet_lab.kept import read_kept
from gaponet_lab.plot.charts import lines
from gaponet_lab.plot.colours import colour
from gaponet_lab.study.compare import identified
from gaponet_lab.study.found import Found, train_all
from gaponet_lab.study.pool import RESULT, SETUP, Cell
from gaponet_lab.study.result import Result, facts
from gaponet_lab.study.study import Study

ARMS = ("real-warm", "real-identified", "virtual-warm", "virtual-identified")
WARM, FURTHER = "gaponet", WORD
VALIDATE = CONFIG.validate_every  # updates between validations


@dataclass(frozen=True)
class Arm:
    """One way to begin, on one robot."""

    name: str
    study: Study
    steps: int
    """Of PPO."""

    @property
    def warm(self) -> bool:
        """Whether it begins with the supervised start."""
        return self.name.endswith("warm")

    @property
    def title(self) -> str:
        """For people."""
        start = "warm start, nominal simulator" if self.warm else "from nothing, identified simulator"
        return f"{'SO-101' if self.name.startswith('real') else 'virtual H1-2'}, {start}"

    @cached_property
    def start(self) -> list[Cell]:
        """The supervised start on its own."""
        warm = self.study.config.warm_start
        short = replace(self.study, budget=str(warm.rounds * warm.num_envs * warm.steps), out=self.study.out / "start")
        return short.cells([WARM])

    @cached_property
    def cells(self) -> list[Cell]:
        """With PPO."""
        before = int(self.start[0].budget) if self.warm else 0
        return replace(self.study, budget=str(before + self.steps)).cells([WARM if self.warm else FURTHER])

    def train(self) -> list[str]:
        """What is not there yet; the warm arm goes on from copies of its start. Returns what failed."""
        failed = train_all(self.start, self.study, say) if self.warm else []
        for short, long in zip(self.start, self.cells, strict=True) if self.warm else ():
            if short.done and not long.folder.exists():
                part = long.folder.with_name(f".{long.folder.name}")
                shutil.rmtree(part, ignore_errors=True)
                shutil.copytree(short.folder, part, ignore=shutil.ignore_patterns(RESULT, "model"))
                write_json(part / SETUP, long.setup(self.study.data))
                part.rename(long.folder)
        return failed + train_all(self.cells, self.study, say)

    def errors(self, found: dict[str, Any]) -> np.ndarray:
        """Of each test motion, mrad, from what was measured of a model or a baseline."""
        group = found["new" if self.study.holdout_units else "known"]["by_motion"]
        return np.array([1e3 * group[m]["mpjae"] for m in sorted(group)])

    def before(self) -> np.ndarray:
        """Test errors without PPO, by motion: the start at the gain that validation chose, or identification alone."""
        if self.warm:
            return np.mean([self.errors(read_kept(c.folder / RESULT)) for c in self.start if c.done], axis=0)
        return self.errors(Found.of(self.cells, self.study).baselines((FURTHER, ""))["identified"])

    def curves(self) -> list[list[dict[str, Any]]]:
        """Of each seed: the lines of progress.jsonl from the one on that PPO began with."""
        out = []
        for cell in self.cells:
            rows = [json.loads(row) for row in (cell.folder / PROGRESS).read_text(encoding="utf-8").splitlines()]
            ppo = [r for r in rows if r["stage"] == "ppo"]
            fitted = [r for r in rows if r["stage"] == "warm start"] or rows[:1]
            start = min(fitted, key=lambda r: r["val_mpjae"])
            out.append([start | {"steps": ppo[0]["steps"] - VALIDATE * self._update}, *ppo])
        return out

    @property
    def _update(self) -> int:
        ppo = self.study.config.sized().ppo
        return ppo.num_envs * ppo.num_steps

    def panel(self) -> tuple[str, dict[str, tuple[str, list[float], list[Spread]]]]:
        """Validation error against steps of PPO, and what it was before."""
        curves = [c[: min(map(len, self.curves()))] for c in self.curves()]
        at = [(r["steps"] - curves[0][0]["steps"]) / 1e6 for r in curves[0]]
        values = [Spread.of([r["val_mpjae"] for r in rows], 1e3) for rows in zip(*curves, strict=True)]
        ends = [at[0], at[-1]]
        word = WARM if self.warm else FURTHER
        still = "supervised start" if self.warm else METHODS["identified"][0]
        dark = METHODS["inverse" if self.warm else "identified"][1]
        level = Spread(values[0].mean, float("nan"), 1)
        return self.title, {
            still: (dark, ends, [level, level]),
            f"PPO, {'nominal' if self.warm else 'identified'} simulator": (colour(word), at, values),
        }

    def row(self) -> tuple[Any, ...]:
        """Of the table."""
        curves, before = self.curves(), self.before()
        best = [min(c, key=lambda r: r["val_mpjae"]) for c in curves]
        seeds = [self.errors(read_kept(c.folder / RESULT)) for c in self.cells]
        less = before - np.mean(seeds, axis=0)
        return (
            self.title, Spread.of([c[0]["val_mpjae"] for c in curves], 1e3),
            Spread.of([b["val_mpjae"] for b in best], 1e3),
            Spread.of([(b["steps"] - c[0]["steps"]) / 1e6 for b, c in zip(best, curves, strict=True)]),
            Spread.of([c[-1]["val_mpjae"] for c in curves], 1e3),
            Spread.of([c[1]["explained_variance"] for c in curves]),
            Spread.of([c[-1]["explained_variance"] for c in curves]), f"{before.mean():.2f}",
            Spread.of([s.mean() for s in seeds]), f"{less.mean():.2f} ± {standard_error(less):.2f}",
            f"{(less > 0).sum()} of {len(less)}",
        )  # fmt: skip


HEAD = ("arm", "validation at the start", "best", "after M steps", "at the end", "explained at first", "at the end ",
        "test without PPO", "test", "less, paired", "motions better")  # fmt: skip
CAPTION = (
    "MPJAE in mrad, whole-motion free run; ± std over seeds, of the paired difference standard error over motions. "
    "Validation at gain 1; test: the best on validation, beside the supervised start with the gain that validation "
    "chose, or beside identification. Explained: share of the returns' variance that the critic explains, after "
    f"{VALIDATE} updates and in the end."
)


def arms(args: argparse.Namespace) -> list[Arm]:
    """Those asked for, with their data."""
    out, known = [], {}
    for word in args.arms:
        name, _, seeds = word.partition(":")
        if name not in ARMS:
            raise SystemExit(f"--arms {word}: one of {', '.join(ARMS)}, with :SEEDS behind it if not {args.seeds}")
        kind = name.split("-")[0]
        if kind not in known:
            known[kind] = real(args) if kind == "real" else virtual(args)
        out.append(Arm(name, replace(known[kind], seeds=int(seeds or args.seeds)), args.steps))
    return out


def real(args: argparse.Namespace) -> Study:
    """The SO-101's logs."""
    data = args.work / "so101"
    if not data.exists():
        run("import", args.logs, "--robot", "so101", "--unit-id", "lab", "--payload-mass", 0, "--out", data)
    config = TrainConfig(warm_start=WarmStartConfig(rounds=6), ppo=PPO, validate_every=VALIDATE)
    study = Study(Dataset(data), load_robot("so101"), args.work / "real", config, "0", args.seeds, workers=args.workers)
    return identified(study, lambda done, total, note: None)


def virtual(args: argparse.Namespace) -> Study:
    """The hard fleet's recordings."""
    bench = Bench.of("hard", RECIPE, args.work)
    study = Study(bench.data, bench.nominal, args.work / "virtual", CONFIG, "0", args.seeds, (UNIT,), args.workers)
    return replace(study, identified=bench.identified(DEFAULT_TERMS))


def result(found: ListOf[Arm], failed: ListOf[str], name: str) -> Result:
    """A row and a panel per arm."""
    table = Table(name, HEAD, tuple(a.row() for a in found), CAPTION)
    figure = lines([a.panel() for a in found], ("million control steps of PPO", "validation MPJAE, mrad"))
    said = [f"{a.name}: {a.study.data.path.name}, {a.study.seeds} seeds" for a in found]
    repeat = facts(found[0].study.data, steps=found[0].steps, arms=said)
    whose = "SO-101: recordings of a real robot. H1-2: VIRTUAL, which says nothing about real hardware."
    return Result(name, "PPO by joint: error against steps", whose, repeat, (table,), {name: figure}, tuple(failed))


def main() -> None:
    """Train, measure, write, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--logs", type=Path, help="SAGE's logs of the SO-101, for the arms that are real")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=2_000_000)
    parser.add_argument("--workers", type=int, default=0)
    parser.add_argument("--arms", nargs="+", default=ARMS, help="ARM or ARM:SEEDS")
    parser.add_argument("--page", default="ppo", help="name of the results page")
    args = parser.parse_args()
    found = arms(args)
    failed = [sentence for arm in found for sentence in arm.train()]
    publish(result(found, failed, args.page), args.work / "results")


if __name__ == "__main__":
    main()
