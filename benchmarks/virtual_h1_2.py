"""The ladder on virtual H1-2 robots: what each step leaves of the gap of a unit that no step has seen.

    python benchmarks/virtual_h1_2.py WORK [--seeds 3] [--budget 2000000]

Fitted and trained on virtual-1 to virtual-3 of the fleet `hard`, measured on virtual-4 playing other motions, at every
payload, whole-motion free run:

1. nominal; delay + offset; four scalars for all joints and units (kp, damping, dry friction, delay); pooled
   identification, classic and with the terms of the servo's law that validation keeps;
2. GAPONet on that, by PPO from the untrained operator, since labels make validation worse here (docs/log.md); then
   `gaponet calibrate` with 30 s of virtual-4, training motions;
3. beside it, what four scalars and classic identification leave of the fleet `easy`.

Writes docs/results/virtual_h1_2.{md,json,csv,svg,png}. What is found in WORK is kept. Every number is
from VIRTUAL robots.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from publish import publish, say

from gaponet.arrays import Array
from gaponet.cli.main import main as gaponet
from gaponet.data.sequence import Sequence
from gaponet.data.split import split_entries
from gaponet.data.store import Dataset
from gaponet.metrics import metrics, runs, standard_error
from gaponet.model import calibration
from gaponet.model.artifact import GapModel
from gaponet.model.baselines import delay_offset
from gaponet.robot import LAW, RobotSpec, load_robot
from gaponet.robot_folder import save_robot
from gaponet.sim.free_runs import cut
from gaponet.sim.identify import DEFAULT_TERMS, identify
from gaponet.sim.joint_runs import SOFT, JointRuns
from gaponet.sim.model import build_model
from gaponet.sim.multistart import descend
from gaponet.sim.replay import Corrector, replay
from gaponet.spread import Spread, Table
from gaponet.training.config import PPOConfig, TrainConfig, WarmStartConfig
from gaponet_lab.plot.charts import bars
from gaponet_lab.plot.colours import shade
from gaponet_lab.study.found import Found, answer
from gaponet_lab.study.pool import Cell
from gaponet_lab.study.result import Result
from gaponet_lab.study.study import Study

RECIPE = Path(__file__).with_suffix(".toml")
UNIT, WORD = "virtual-4", "identified+gaponet:warm_start.rounds=0"
START = WarmStartConfig(rounds=6, num_envs=128, steps=300, gradient_steps=200)
PPO = PPOConfig(learning_rate=1e-4)  # ten times today's default, as the published runs began
CONFIG = TrainConfig(warm_start=START, ppo=PPO, validate_every=20)
SCALES = {"kp": (0.2, 0.2, 3.0), "damping": (1.0, 0.0, 10.0), "frictionloss": (2.0, 0.0, 40.0)}  # unit, low, high
ITERATIONS, WINDOWS = 15, 24  # of the four scalars; of 8 s, of every fit
STEPS = {  # → colour
    "nominal": "#8c8c8c", "delay + offset": "#d99000", "four scalars": "#3b7dd8", "identification, classic": "#2a9d6f",
    "identification": "#17543c", "identification + GAPONet": "#c8102e", "… calibrated": shade("#c8102e", -0.4),
}  # fmt: skip

Errors = list[Array]  # seed by seed: MPJAE of each test sequence, rad


@dataclass(frozen=True)
class Bench:
    """A fleet's recordings in parts, and where what is fitted on them is kept."""

    fleet: str
    data: Dataset
    nominal: RobotSpec
    work: Path
    train: list[Sequence]
    val: list[Sequence]
    test: list[Sequence]

    @classmethod
    def of(cls, fleet: str, recipe: Path, work: Path) -> Bench:
        """Collect what is not there."""
        name = Path(fleet).stem  # of a file
        run("collect", "--fleet", fleet, "--recipe", recipe, "--out", work / name)
        data = Dataset(work / name)
        parts = split_entries(data, (UNIT,))
        test = [e for e in parts["test"] if e.meta.unit_id == UNIT]
        found = (data.sequences(part) for part in (parts["train"], parts["val"], test))
        return cls(name, data, load_robot("h1_2"), work / f"{name}-fits", *found)

    def kept(self, name: str, fit: Callable[[], RobotSpec]) -> RobotSpec:
        """A fitted simulator, fitted once."""
        if not (self.work / name / "robot.toml").is_file():
            print(f"{self.fleet}: {name} …", flush=True)
            save_robot(fit(), self.work / name)
        return load_robot(self.work / name)

    def errors(self, simulator: RobotSpec, corrector: Corrector | None = None) -> Array:
        """Of every test sequence, rad."""
        twins = replay(self.test, simulator, corrector, lock_idle=True)
        return np.array([metrics([r])["mpjae"] for r in runs(self.test, [t.qpos for t in twins], self.nominal)])

    def identified(self, terms: tuple[str, ...]) -> RobotSpec:
        """Pooled identification on the training units, with these terms of the servo's law."""
        fit = lambda: identify(self.train, self.nominal, self.val, WINDOWS, terms).robot  # noqa: E731
        return self.kept("law" if terms else "classic", fit)

    def untrained(self) -> dict[str, Errors]:
        """The steps without a network; of the easy fleet without delay + offset and the servo's law."""
        hard, steps = self.fleet == "hard", {"nominal": [self.errors(self.nominal)]}
        if hard:
            late = delay_offset.DelayOffset.fit(self.train, self.nominal)
            steps["delay + offset"] = [self.errors(self.nominal, late.corrector(self.nominal))]
        four = self.kept("four", lambda: four_scalars(self.train, self.nominal))
        steps |= {"four scalars": [self.errors(four)], "identification, classic": [self.errors(self.identified(()))]}
        return steps | ({"identification": [self.errors(self.identified(DEFAULT_TERMS))]} if hard else {})


def four_scalars(sequences: list[Sequence], robot: RobotSpec) -> RobotSpec:
    """Factors of kp, damping and dry friction and one delay, the same for all joints."""
    parts, model = JointRuns(cut(sequences, WINDOWS), robot), build_model(robot)
    dof, n = np.array([model.joint(j).dofadr[0] for j in robot.operated]), len(robot.operated)
    own = {"kp": robot.kp[robot.operated_index], "damping": model.dof_damping[dof],
           "frictionloss": model.dof_frictionloss[dof]}  # fmt: skip
    still = {"armature": model.dof_armature[dof], "offset": np.zeros(n)}
    unit, low, high = np.array([*SCALES.values(), (0.01, 0.0, 0.15)]).T

    def values(x: Array) -> dict[str, Array]:
        factors = x[:, 0] * unit
        scaled = {f: factors[:, [i]] * v for i, (f, v) in enumerate(own.items())}
        fixed = {f: np.broadcast_to(v, (len(x), n)) for f, v in still.items()}
        return scaled | fixed | {"delay": np.repeat(factors[:, [3]], n, axis=1)}

    errors = lambda x: np.moveaxis(parts.errors(values(x)), 1, 0).reshape(len(x), 1, -1) / SOFT  # noqa: E731
    x, _ = descend(np.array([[[1.0, 1.0, 1.0, 0.01]]]) / unit, low / unit, high / unit, errors, ITERATIONS)
    best = values(x)
    return robot.with_servos({j: {f: float(v[0, i]) for f, v in best.items()} for i, j in enumerate(robot.operated)})


@dataclass(frozen=True)
class Ladder:
    """The question: the hard fleet's steps with those that are trained, beside the easy fleet's."""

    hard: Bench
    easy: Bench
    holdout_units: tuple[str, ...] = (UNIT,)

    def cells(self, study: Study) -> list[Cell]:
        """GAPONet in the identified simulator, every seed."""
        return study.cells((WORD,))

    def result(self, study: Study, found: Found) -> Result:
        """Tables by payload, what each step takes from the one before, and a figure."""
        cells, simulator = found.cells[WORD, ""], study.identified
        assert simulator is not None
        steps = self.hard.untrained()
        models = [GapModel.load(c.folder) for c in cells]
        steps["identification + GAPONet"] = [self.hard.errors(simulator, m.corrector(simulator)) for m in models]
        steps["… calibrated"] = [self.calibrated(c, m, simulator) for c, m in zip(cells, models, strict=True)]
        easy = self.easy.untrained()
        motions = sorted({s.meta.motion for s in self.hard.test})
        law = [f for f in LAW if getattr(simulator, f)[simulator.operated_index].any()]
        told = (
            f"MPJAE in mrad on {UNIT}, ± standard error over {len(motions)} motions; seeds: std over seeds. "
            "GAPONet: PPO from the untrained operator, the best on validation. Calibrated: with 30 s of the unit "
            "playing training motions."
        )
        tables = (table("ladder", steps, self.hard.test, told), lines(steps, self.hard.test),
                  table("easy", easy, self.easy.test, f"The fleet easy, its {UNIT}."))  # fmt: skip
        said = [
            *differences(steps, self.hard.test),
            f"Of the servo's law, validation kept {', '.join(law) or 'nothing'}.",
        ]
        figures = {"ladder": figure(steps, self.hard.test, f"VIRTUAL {UNIT} of fleet hard, never seen")}
        return found.result(study, "virtual_h1_2", "The ladder on a unit never seen", list(tables), figures, said,
                            motions=motions, fleets=["hard", "easy"])  # fmt: skip

    def calibrated(self, cell: Cell, model: GapModel, simulator: RobotSpec) -> Array:
        """After 30 s of the unit."""
        if UNIT not in calibration.Calibration.load(cell.folder, model.weights_hash()):
            run("calibrate", cell.folder, self.hard.data.path, "--unit", UNIT)
        own = calibration.Calibration.load(cell.folder, model.weights_hash())[UNIT]
        return self.hard.errors(own.robot(simulator), model.corrector(simulator))


def by_motion(errors: Errors, sequences: list[Sequence], payload: float | None = None) -> Array:
    """Mean of each motion over seeds, and over payloads if none is given, (motions,) mrad."""
    mean = np.mean(errors, axis=0) * 1e3
    own = [payload is None or s.meta.payload_mass == payload for s in sequences]
    names = np.array([s.meta.motion for s in sequences])
    return np.array([mean[(names == m) & own].mean() for m in sorted(set(names))])


def table(name: str, steps: dict[str, Errors], sequences: list[Sequence], caption: str) -> Table:
    """A row per step, a column per payload."""
    payloads: list[float | None] = [*sorted({s.meta.payload_mass for s in sequences}), None]
    nominal = by_motion(steps["nominal"], sequences).mean()
    rows = []
    for step, errors in steps.items():
        values = [by_motion(errors, sequences, p) for p in payloads]
        seeds = Spread.of([float(e.mean()) for e in errors], 1e3).std if len(errors) > 1 else None
        cells = (f"{v.mean():.2f} ± {standard_error(v):.2f}" for v in values)
        rows.append((step, *cells, values[-1].mean() / nominal, seeds))
    heads = ("mean" if p is None else f"{p:g} kg" for p in payloads)
    return Table(name, ("step", *heads, "of nominal", "seeds"), tuple(rows), caption)


def lines(steps: dict[str, Errors], sequences: list[Sequence]) -> Table:
    """Every number: a line per step, seed and sequence."""
    rows = [(step, seed, s.meta.motion, s.meta.payload_mass, float(e))
            for step, errors in steps.items() for seed, found in enumerate(errors)
            for s, e in zip(sequences, found, strict=True)]  # fmt: skip
    return Table("all", ("step", "seed", "motion", "payload kg", "MPJAE rad"), tuple(rows), shown=False)


def differences(steps: dict[str, Errors], sequences: list[Sequence]) -> list[str]:
    """What each step takes from the one before, paired by motion."""
    means, said = {step: by_motion(errors, sequences) for step, errors in steps.items()}, []
    for before, after in zip(list(means)[1:-1], list(means)[2:], strict=True):
        less = means[before] - means[after]
        said.append(f"{after}: {less.mean():+.2f} ± {standard_error(less):.2f} mrad less than the step before.")
    return said


def figure(steps: dict[str, Errors], sequences: list[Sequence], heading: str):
    """Bars by payload with standard errors over motions."""
    payloads = sorted({s.meta.payload_mass for s in sequences})
    found = {step: [by_motion(e, sequences, p) for p in payloads] for step, e in steps.items()}
    shown = {step: (STEPS[step], [Spread(float(v.mean()), standard_error(v), len(v)) for v in values])
             for step, values in found.items()}  # fmt: skip
    return bars([f"{p:g} kg" for p in payloads], shown, "MPJAE, mrad", heading)


def run(*words: object) -> None:
    """A command of gaponet."""
    if gaponet([*map(str, words)]):
        raise SystemExit(2)


def main() -> None:
    """Measure, write, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--budget", default="2000000", help="of each run, as in gaponet train")
    parser.add_argument("--recipe", type=Path, default=RECIPE)
    args = parser.parse_args()
    question = Ladder(*(Bench.of(fleet, args.recipe, args.work) for fleet in ("hard", "easy")))
    hard, out = question.hard, args.work / "virtual"  # as ppo.py's
    study = Study(hard.data, hard.nominal, out, CONFIG, args.budget, args.seeds, question.holdout_units)
    study = replace(study, identified=hard.identified(DEFAULT_TERMS))
    publish(answer(question, study, say), args.work / "results")


if __name__ == "__main__":
    main()
