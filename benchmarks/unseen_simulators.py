"""One network for simulators that it has never seen: the test, fixed before any training.

    python benchmarks/unseen_simulators.py train DATASET --out OUT [--seeds 3] [--steps 400000]
    python benchmarks/unseen_simulators.py test OUT DATASET [--motions M …] [--identified ROBOT]

Networks with equal data, steps and nearly equal numbers of weights (the table says how many):

    MLP, one simulator        the pointwise network, trained in the robot's own simulator
    GAPONet, one simulator    today's
    MLP                       pointwise, trained in many simulators
    MLP + context             also told the simulator's answers to fixed probes
    GAPONet + context         these answers are its branch input

The test has twenty simulators within the ranges of training and ten beyond. Their seed was used for nothing else, and
the motions are the dataset's test motions. Settings are chosen by the validation error of training, in other simulators
and on other motions. A number is the mean error over that of the uncorrected simulator, averaged over
simulators; ± is the standard error over simulators of the mean over seeds.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import gaponet as gp
from gaponet.base.files import write_json
from gaponet.base.result_table import ResultTable
from gaponet.data.sequence import Sequence
from gaponet.deploy.transfer import TransferCorrector
from gaponet.nn.artifact import GapModel
from gaponet.nn.loop import DeltaCorrector
from gaponet.nn.training.config import (
    MANY_SIMULATORS_MODEL,
    MANY_SIMULATORS_PRETRAINING,
    TrainConfig,
)
from gaponet.robot.simulator_change import SimulatorChange, SimulatorRanges
from gaponet.robot.spec import RobotSpec
from gaponet.share.reading import open_dataset
from gaponet.sim.batch import Condition
from gaponet.sim.context import contexts
from gaponet.sim.replay import Corrector, rollout_errors

TEST_SEED = 20_261_128
WITHIN = 20  # simulators
BEYOND = 10
MAX_RECORDINGS = 24  # of the test, evenly spaced
PIECE_S = (4.0, 16.0)  # of each: all methods in thirty simulators take ten minutes then
Array = np.ndarray


@dataclass(frozen=True)
class Row:
    """A network of the comparison.

    Attributes:
        kind: ModelConfig.kind.
        simulators: Number of simulators of training; 0 for the robot's own.
        context: The network is told the simulator's answers.
    """

    kind: str
    simulators: int
    context: bool = False


def rows(simulators: int) -> dict[str, Row]:
    """Return the networks by name."""
    return {
        "MLP, one simulator": Row("shared_mlp", 0),
        "GAPONet, one simulator": Row("gaponet", 0),
        "MLP": Row("shared_mlp", simulators),
        "MLP + context": Row("shared_mlp", simulators, context=True),
        "GAPONet + context": Row("gaponet", simulators, context=True),
    }


def test_simulators(joints: int) -> dict[str, list[SimulatorChange]]:
    """Return the simulators of the test. Those beyond have a stiffness outside the range of training."""
    ranges = SimulatorRanges()
    within = ranges.draw(joints, WITHIN, TEST_SEED)
    softer = replace(ranges, kp=(0.3 * ranges.kp[0], 0.8 * ranges.kp[0]))
    stiffer = replace(ranges, kp=(1.2 * ranges.kp[1], 2.0 * ranges.kp[1]))
    beyond = [
        *softer.draw(joints, BEYOND // 2, TEST_SEED + 1),
        *stiffer.draw(joints, BEYOND - BEYOND // 2, TEST_SEED + 2),
    ]
    return {"within": within, "beyond": beyond}


def run_folder(out: Path, name: str, seed: int) -> Path:
    """Return the folder of a training."""
    return out / f"{name.replace(' ', '_').replace(',', '')}-{seed}"


def train(arguments: argparse.Namespace) -> None:
    """Train all networks that are not there yet."""
    for seed in range(arguments.seeds):
        for name, row in rows(arguments.simulators).items():
            folder = run_folder(arguments.out, name, seed)
            if (folder / "model" / "card.json").is_file():
                continue
            config = TrainConfig(
                model=replace(MANY_SIMULATORS_MODEL, kind=row.kind),
                pretraining=MANY_SIMULATORS_PRETRAINING,
                seed=seed,
                simulators=row.simulators,
                without_context=not row.context,
                rates=tuple(arguments.rates),
                threads=1,
            )
            trained = gp.train(
                arguments.dataset,
                out=folder,
                model=row.kind,
                budget=str(arguments.steps),
                config=config,
                resume=(folder / "checkpoint.pt").is_file(),
            )
            val = trained.card["val_mpjae"]
            print(
                f"{folder.name}: validation {val['model'] / val['start']:.3f} of uncorrected",
                flush=True,
            )


def test(arguments: argparse.Namespace) -> None:
    """Measure all networks in all simulators, and print the table."""
    dataset, robot = open_dataset(arguments.dataset)
    robot = robot.before_identification
    split = json.loads((next(arguments.out.glob("*/split.json"))).read_text())
    chosen = [e for e in dataset.entries if e.id in split["test"] or arguments.all]
    chosen = [e for e in chosen if not arguments.rates or round(1 / e.dt) in arguments.rates]
    steps = np.linspace(0, len(chosen) - 1, min(MAX_RECORDINGS, len(chosen)))
    recordings = []
    for whole in dataset.sequences([chosen[round(i)] for i in steps]):
        start, end = (round(seconds / whole.dt) for seconds in PIECE_S)
        recordings.append(whole.rows(slice(start, end)))
    print(f"{len(recordings)} recordings of {len({s.meta.motion for s in recordings})} motions")
    groups = {"nominal": [None], **test_simulators(len(robot.joint_names))}
    methods = all_methods(arguments, robot)
    found: dict[str, dict[str, list[list[float]]]] = {name: {} for name in methods}
    for group, simulators in groups.items():
        for number, simulator in enumerate(simulators):
            placed = [replace(s, simulator=simulator) for s in recordings]
            uncorrected = rollout_errors(placed, robot, 1).mean()
            for name, correctors in methods.items():
                ratios = []
                for errors in correctors:
                    ratios.append(float(errors(placed) / uncorrected))
                found[name].setdefault(group, []).append(ratios)
            print(
                f"{group} {number + 1} of {len(simulators)}: {1e3 * uncorrected:.1f} mrad",
                flush=True,
            )
            write_json(arguments.out / "unseen_simulators.json", found)
    print(table(found).markdown())


def all_methods(
    arguments: argparse.Namespace, robot: RobotSpec
) -> dict[str, list[Callable[[list[Sequence]], float]]]:
    """Return method → for each training seed, recordings in a simulator → mean error, rad."""
    methods: dict[str, list[Callable[[list[Sequence]], float]]] = {}
    models: dict[str, list[GapModel]] = {}
    for name in rows(arguments.simulators):
        folders = [run_folder(arguments.out, name, seed) for seed in range(arguments.seeds)]
        models[name] = [GapModel.load(f) for f in folders if (f / "model" / "card.json").is_file()]

    def corrected(make: Callable[[], Corrector]) -> Callable[[list[Sequence]], float]:
        return lambda placed: float(rollout_errors(placed, robot, 1, make()).mean())

    for name, loaded in models.items():
        methods[name] = [
            corrected(lambda m=m: DeltaCorrector(m.infer, m.config, robot)) for m in loaded
        ]
    told = models["GAPONet + context"]
    methods["GAPONet + context of another simulator"] = [
        corrected(lambda m=m: OtherContext(m, robot)) for m in told
    ]
    methods["GAPONet, one simulator, transferred"] = [
        corrected(lambda m=m: TransferCorrector(m, robot, extrapolate=True))
        for m in models["GAPONet, one simulator"]
    ]
    if arguments.identified:
        identified = gp.load_robot(arguments.identified)
        methods["identified robot (bound)"] = [
            lambda placed: float(
                rollout_errors([replace(s, simulator=None) for s in placed], identified, 1).mean()
            )
        ]
    return {name: correctors for name, correctors in methods.items() if correctors}


class OtherContext(DeltaCorrector):
    """The network is told the answers of another simulator within the ranges of training."""

    def __init__(self, model: GapModel, robot: RobotSpec) -> None:
        super().__init__(model.infer, model.config, robot)
        self.other = SimulatorRanges().draw(len(robot.joint_names), 1, TEST_SEED + 3)[0]

    def reset(self, start: list[Sequence]) -> None:
        super().reset(start)
        assert self.loop is not None
        conditions = [Condition.of(replace(s, simulator=self.other), self.robot) for s in start]
        self.loop.set_context(contexts(self.robot, conditions))


def table(found: dict[str, dict[str, list[list[float]]]]) -> ResultTable:
    """Return the table: mean over simulators and seeds, ± over simulators, and each seed's mean."""
    lines = []
    for name, groups in found.items():
        cells = [name]
        for ratios in groups.values():
            by_simulator = np.array(ratios)  # (simulators, seeds)
            mean = by_simulator.mean(axis=1)
            text = f"{mean.mean():.3f}"
            if len(mean) > 1:
                text += f" ± {mean.std(ddof=1) / np.sqrt(len(mean)):.3f}"
            seeds = ", ".join(f"{value:.2f}" for value in by_simulator.mean(axis=0))
            cells.append(f"{text} ({seeds})")
        lines.append(cells)
    heads = ["error over uncorrected", *next(iter(found.values()))]
    return ResultTable("unseen_simulators", heads, lines)


def main() -> None:
    """Train or test."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    commands = parser.add_subparsers(required=True)
    for name, function in (("train", train), ("test", test)):
        command = commands.add_parser(name)
        command.set_defaults(run=function)
        if name == "test":
            command.add_argument("out", type=Path)
        command.add_argument("dataset")
        if name == "train":
            command.add_argument("--out", type=Path, required=True)
        command.add_argument("--seeds", type=int, default=3)
        command.add_argument("--steps", type=int, default=240_000)
        command.add_argument("--simulators", type=int, default=200)
        command.add_argument("--rates", type=float, nargs="*", default=[])
        command.add_argument("--identified")
        command.add_argument(
            "--all", action="store_true", help="all recordings of DATASET, none of training"
        )
    arguments = parser.parse_args()
    arguments.run(arguments)


if __name__ == "__main__":
    main()
