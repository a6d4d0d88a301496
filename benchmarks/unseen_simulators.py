"""One network for simulators that it has never seen: the test, fixed before any training.

    python benchmarks/unseen_simulators.py train DATASET --out OUT [--seeds 3] [--steps 400000]
    python benchmarks/unseen_simulators.py test OUT DATASET [--recordings 24] [--identified ROBOT]

Networks with equal data, steps and nearly equal numbers of weights (the table says how many):

    MLP, one simulator        the pointwise network, trained in the robot's own simulator
    GAPONet, one simulator    today's
    MLP                       pointwise, trained in many simulators
    MLP + context             also told the simulator's answers to fixed probes
    GAPONet + context         these answers are its branch input

With --payload-unknown, the networks for many simulators are also trained without the payload as an
input; the answers are then those of simulators that carry it. So is the paper's network, which is
told nothing of its simulator. With --literal, the paper's network is trained in one simulator. Then
its sensor predictor alone is fitted again in the simulators of training; or it is told the true
answers of the simulator of the test, as by the best predictor that is fitted there. These are the
two means that the authors name.

The exact transfer runs with extrapolate=True: also in simulators for which gaponet would refuse it,
as where servos respond more than 5 ms later than in training.

The test has twenty simulators within the ranges of training and ten beyond. Their seed was used for
nothing else, and the motions are the test motions of training. Settings are chosen by the
validation error of training, in other simulators and on other motions. A number is the mean error
over that of the uncorrected simulator, averaged over simulators; ± is the standard error over
simulators of the mean over seeds. Two networks with the same inputs are also compared motion by
motion: ± is there the jackknife's standard error over motions.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
from collections.abc import Callable, Iterator
from collections.abc import Sequence as ListOf
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch

import gaponet as gp
from gaponet.base.files import write_json
from gaponet.base.result_table import ResultTable
from gaponet.data.sequence import Sequence
from gaponet.data.store import Dataset, Entry
from gaponet.deploy.transfer import TransferCorrector
from gaponet.nn.artifact import GapModel
from gaponet.nn.config import ModelKind
from gaponet.nn.loop import DeltaCorrector
from gaponet.nn.onnx_export import trained_network
from gaponet.nn.onnx_network import Network
from gaponet.nn.sensor import ProbeOracle
from gaponet.nn.training.config import (
    MANY_SIMULATORS_MODEL,
    MANY_SIMULATORS_PRETRAINING,
    TrainConfig,
)
from gaponet.nn.training.env import DeltaEnv, EnvOptions
from gaponet.nn.training.sensor_fit import fit_sensors
from gaponet.nn.training.simulators import pieces
from gaponet.robot.simulator_change import SimulatorChange, SimulatorRanges
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import Condition
from gaponet.sim.context import contexts
from gaponet.sim.dataset_robot import open_dataset
from gaponet.sim.metrics import standard_error
from gaponet.sim.replay import Corrector, rollout_errors

TEST_SEED = 20_261_128
WITHIN = 20  # simulators; --tests says how many of these
BEYOND = 10
MAX_RECORDINGS = 24  # of the test, evenly spaced
PIECE_S = (4.0, 16.0)  # of each longer one: all methods in thirty simulators take ten minutes then
LITERAL = "literal, one simulator"
LITERAL_IN_MANY = "literal, many simulators, payload unknown"
# Of the predictor that is fitted again: states at which simulators answer the probes, and gradient
# steps. With a tenth of the steps it does not learn other simulators.
REFIT_STATES = 2048
REFIT_STEPS = 6000
Array = np.ndarray
Errors = Callable[[list[Sequence]], Array]  # recordings in a simulator → errors, (recordings,) rad
UNCORRECTED = "uncorrected"
# Networks with the same inputs and training.
PAIRS = (
    ("GAPONet, one simulator", "MLP, one simulator"),
    ("GAPONet + context", "MLP + context"),
    ("GAPONet + context, payload unknown", "MLP + context, payload unknown"),
)


@dataclass(frozen=True)
class Row:
    """A network of the comparison.

    Attributes:
        kind: ModelConfig.kind.
        simulators: Number of simulators of training; 0 for the robot's own.
        context: The network is told the simulator's answers.
        payload: The network is told the payload.
    """

    kind: ModelKind
    simulators: int
    context: bool = False
    payload: bool = True


def rows(arguments: argparse.Namespace) -> dict[str, Row]:
    """Return the networks by name."""
    simulators = arguments.simulators
    chosen = {
        "MLP, one simulator": Row("shared_mlp", 0),
        "GAPONet, one simulator": Row("gaponet", 0),
        "MLP": Row("shared_mlp", simulators),
        "MLP + context": Row("shared_mlp", simulators, context=True),
        "GAPONet + context": Row("gaponet", simulators, context=True),
    }
    if arguments.payload_unknown:
        for name in ("MLP", "MLP + context", "GAPONet + context"):
            chosen[f"{name}, payload unknown"] = replace(chosen[name], payload=False)
        chosen[LITERAL_IN_MANY] = Row("paper", simulators, payload=False)
    if arguments.literal:
        chosen[LITERAL] = Row("paper", 0)
    return chosen


def test_simulators(joints: int, most: int) -> dict[str, list[SimulatorChange]]:
    """Return the simulators of the test. Those beyond have a stiffness outside the range of
    training.

    Args:
        most: Largest number of simulators in each group.
    """
    ranges = SimulatorRanges()
    within = ranges.draw(joints, WITHIN, TEST_SEED)
    softer = replace(ranges, kp=(0.3 * ranges.kp[0], 0.8 * ranges.kp[0]))
    stiffer = replace(ranges, kp=(1.2 * ranges.kp[1], 2.0 * ranges.kp[1]))
    beyond = [
        *softer.draw(joints, BEYOND // 2, TEST_SEED + 1),
        *stiffer.draw(joints, BEYOND - BEYOND // 2, TEST_SEED + 2),
    ]
    return {"within": within[:most], "beyond": beyond[:most]}


def run_folder(out: Path, name: str, seed: int) -> Path:
    """Return the folder of a training."""
    return out / f"{name.replace(' ', '_').replace(',', '')}-{seed}"


def train(arguments: argparse.Namespace) -> None:
    """Train all networks that are not there yet."""
    for seed in range(arguments.seeds):
        for name, row in rows(arguments).items():
            folder = run_folder(arguments.out, name, seed)
            if (folder / "model" / "card.json").is_file():
                continue
            config = TrainConfig(
                model=replace(MANY_SIMULATORS_MODEL, kind=row.kind, payload_input=row.payload),
                pretraining=MANY_SIMULATORS_PRETRAINING,
                seed=seed,
                simulators=row.simulators,
                without_context=not row.context,
                rates=tuple(arguments.rates),
                train_share=arguments.share,
                threads=1,
            )
            trained = gp.train(
                arguments.dataset,
                out=folder,
                budget=str(arguments.steps),
                config=config,
                options=gp.TrainOptions(resume=(folder / "checkpoint.pt").is_file()),
            )
            val = trained.card["val_mpjae"]
            print(
                f"{folder.name}: validation {val['model'] / val['start']:.3f} of uncorrected",
                flush=True,
            )


@dataclass(frozen=True)
class Place:
    """Recordings with one payload, in one simulator.

    Attributes:
        column: Of the table.
        number: Of the simulator in its group, for the progress.
    """

    column: str
    number: int
    recordings: list[Sequence]


def test(arguments: argparse.Namespace) -> None:
    """Measure all networks in all simulators, on all cores, and print the table."""
    dataset, robot = open_dataset(arguments.dataset)
    by_payload = test_recordings(dataset, arguments)
    groups: dict[str, ListOf[SimulatorChange | None]] = {"nominal": [None]}
    groups.update(test_simulators(len(robot.joint_names), arguments.tests))
    places = []
    for group, simulators in groups.items():
        for number, simulator in enumerate(simulators):
            for kg, recordings in by_payload.items():
                column = group if len(by_payload) == 1 else f"{group}, {kg:g} kg"
                placed = [replace(s, simulator=simulator) for s in recordings]
                places.append(Place(column, number, placed))
    ratios: dict[str, dict[str, list[list[float]]]] = {}
    errors: dict[str, dict[str, list[Array]]] = {}
    measured = map_on_all_cores(arguments, robot.before_identification, places)
    for place, by_method in zip(places, measured, strict=True):
        uncorrected = by_method.pop(UNCORRECTED)
        errors.setdefault(UNCORRECTED, {}).setdefault(place.column, []).append(uncorrected)
        mean = float(uncorrected.mean())
        for name, of_seeds in by_method.items():
            of_place = [float(row.mean()) / mean for row in of_seeds]
            ratios.setdefault(name, {}).setdefault(place.column, []).append(of_place)
            errors.setdefault(name, {}).setdefault(place.column, []).append(of_seeds)
        print(f"{place.column}, {place.number + 1}: {1e3 * mean:.1f} mrad", flush=True)
    write_json(arguments.out / f"{arguments.result}.json", ratios)
    print(table(ratios).markdown())
    print(table_by_motion(errors).markdown())


class Measurement:
    """All methods, loaded once in each process."""

    def __init__(self, arguments: argparse.Namespace, robot: RobotSpec) -> None:
        self.robot = robot
        self.methods = all_methods(arguments, robot)

    def errors(self, place: Place) -> dict[str, Array]:
        """Return the errors of each method, (seeds, recordings) rad, and without any, (1,
        recordings) rad.
        """
        found = {UNCORRECTED: rollout_errors(place.recordings, self.robot, 1)[None]}
        for name, of_seeds in self.methods.items():
            found[name] = np.stack([errors(place.recordings) for errors in of_seeds])
        return found


_measurement: Measurement | None = None  # of this process


def _load_methods(arguments: argparse.Namespace, robot: RobotSpec) -> None:
    global _measurement
    _measurement = Measurement(arguments, robot)


def _errors_at(place: Place) -> dict[str, Array]:
    assert _measurement is not None
    return _measurement.errors(place)


def map_on_all_cores(
    arguments: argparse.Namespace, robot: RobotSpec, places: list[Place]
) -> Iterator[dict[str, Array]]:
    """Yield the errors of all methods at each place, in the order of the places."""
    with ProcessPoolExecutor(
        os.cpu_count(), get_context("spawn"), _load_methods, (arguments, robot)
    ) as pool:
        yield from pool.map(_errors_at, places)


def test_recordings(dataset: Dataset, arguments: argparse.Namespace) -> dict[float, list[Sequence]]:
    """Return payload, kg → pieces of the test recordings, at most `recordings` of each."""
    card = next(arguments.out.glob("*/model/card.json"))
    test_motions = json.loads(card.read_text())["motions"]["test"]
    entries: dict[float, list[Entry]] = {}
    for entry in _at_rates(dataset.entries, arguments.rates):
        if arguments.all or entry.meta.motion in test_motions:
            entries.setdefault(entry.meta.payload_mass, []).append(entry)
    by_payload: dict[float, list[Sequence]] = {}
    for kg, same in sorted(entries.items()):
        recordings = dataset.sequences(_evenly_spaced(same, arguments.recordings))
        by_payload[kg] = [_piece(whole) for whole in recordings]
        motions = {recording.meta.motion for recording in recordings}
        print(f"{kg:g} kg: {len(recordings)} recordings of {len(motions)} motions")
    return by_payload


def _at_rates(entries: ListOf[Entry], rates: list[float]) -> list[Entry]:
    """Return the recordings at one of the rates, Hz; all without any."""
    if not rates:
        return list(entries)
    return [entry for entry in entries if round(1 / entry.dt) in rates]


def _evenly_spaced(entries: list[Entry], most: int) -> list[Entry]:
    steps = np.linspace(0, len(entries) - 1, min(most, len(entries)))
    return [entries[round(step)] for step in steps]


def _piece(whole: Sequence) -> Sequence:
    """Return the piece of a long recording that is tested, or a short one as it is."""
    first, last = (round(seconds / whole.dt) for seconds in PIECE_S)
    if len(whole) <= last:
        return whole
    return whole.rows(slice(first, last))


def all_methods(arguments: argparse.Namespace, robot: RobotSpec) -> dict[str, list[Errors]]:
    """Return method → for each training seed, its errors."""
    models = trained_models(arguments)

    def corrected(
        models: list[GapModel], corrector: Callable[[GapModel], Corrector]
    ) -> list[Errors]:
        return [functools.partial(_error, robot, corrector, model) for model in models]

    def as_trained(model: GapModel) -> Corrector:
        return DeltaCorrector(model.infer, model.config, robot)

    def told_another(model: GapModel) -> Corrector:
        return OtherContext(model, robot)

    def told_the_truth(model: GapModel) -> Corrector:
        return TrueAnswers(model, robot)

    def transferred(model: GapModel) -> Corrector:
        return TransferCorrector(model, robot, extrapolate=True)

    methods = {name: corrected(loaded, as_trained) for name, loaded in models.items()}
    methods["GAPONet + context of another simulator"] = corrected(
        models["GAPONet + context"], told_another
    )
    methods["GAPONet, one simulator, transferred"] = corrected(
        models["GAPONet, one simulator"], transferred
    )
    if arguments.literal:
        refits = literal_refits(arguments, robot, models[LITERAL])
        methods["literal, predictor fitted in many simulators"] = [r.error for r in refits]
        methods["literal, told the simulator's true answers"] = corrected(
            models[LITERAL], told_the_truth
        )
    if arguments.identified:
        identified = gp.load_robot(arguments.identified)
        methods["identified robot (bound)"] = [functools.partial(_error_without_change, identified)]
    return {name: correctors for name, correctors in methods.items() if correctors}


def trained_models(arguments: argparse.Namespace) -> dict[str, list[GapModel]]:
    """Return the trained networks of each name, by seed."""
    models: dict[str, list[GapModel]] = {}
    for name in rows(arguments):
        models[name] = []
        for seed in range(arguments.seeds):
            folder = run_folder(arguments.out, name, seed)
            if (folder / "model" / "card.json").is_file():
                models[name].append(GapModel.load(folder))
    return models


def _error(
    robot: RobotSpec,
    corrector: Callable[[GapModel], Corrector],
    model: GapModel,
    placed: list[Sequence],
) -> Array:
    """Return the errors with a network, (recordings,) rad."""
    return rollout_errors(placed, robot, 1, corrector(model))


def _error_without_change(robot: RobotSpec, placed: list[Sequence]) -> Array:
    """Return the errors of a robot in its own simulator, (recordings,) rad."""
    own = [replace(recording, simulator=None) for recording in placed]
    return rollout_errors(own, robot, 1)


def literal_refits(
    arguments: argparse.Namespace, robot: RobotSpec, models: list[GapModel]
) -> list[PredictorRefit]:
    """Return the literal networks with the pieces of recordings at which their predictor is fitted
    again.
    """
    dataset, _ = open_dataset(arguments.trained_on or arguments.dataset)
    motions = models[0].card["motions"]["train"]
    at_rates = _at_rates(dataset.entries, arguments.rates)
    entries = [entry for entry in at_rates if entry.meta.motion in motions]
    cut: list[Sequence] = []
    for whole in dataset.sequences(_evenly_spaced(entries, MAX_RECORDINGS)):
        cut += pieces(whole)
    return [PredictorRefit(model, robot, cut, arguments.simulators) for model in models]


class PredictorRefit:
    """The literal network with its sensor predictor fitted again to the stepped probes of many
    simulators, which it is not told apart; all else is frozen.

    Attributes:
        model: The trained network.
        recordings: Pieces of its training recordings, whose states are probed.
        simulators: Number of simulators.
    """

    def __init__(
        self, model: GapModel, robot: RobotSpec, recordings: list[Sequence], simulators: int
    ) -> None:
        self.model = model
        self.robot = robot
        self.recordings = recordings
        self.simulators = simulators
        self._fitted: Network | None = None

    def error(self, placed: list[Sequence]) -> Array:
        """Return the errors, (recordings,) rad."""
        if self._fitted is None:
            self._fitted = self._fit()
        corrector = DeltaCorrector(self._fitted, self.model.config, self.robot)
        return rollout_errors(placed, self.robot, 1, corrector)

    def _fit(self) -> Network:
        joints = len(self.robot.joint_names)
        drawn = SimulatorRanges().draw(joints, self.simulators, TEST_SEED + 4)
        sequences = []
        for i, piece in enumerate(self.recordings):
            sequences.append(replace(piece, simulator=drawn[i % len(drawn)]))
        config = self.model.config
        net = trained_network(self.model.path.parent, config, len(self.robot.operated))
        groups = len({Condition.of(s, self.robot) for s in sequences})
        num_envs = max(256, 2 * groups)
        env = DeltaEnv(sequences, self.robot, config, EnvOptions(num_envs, nthread=1))
        # As after training, the scale of the sensor values stays: the branch net has learned it.
        report = fit_sensors(
            net, env, REFIT_STATES, seed=0, nthread=1, refit=True, steps=REFIT_STEPS
        )
        assert report is not None
        print(f"predictor fitted in many simulators: R² {report['mean']:.2f} on other states")

        @torch.inference_mode()
        def answer(x: Array) -> Array:
            corrections: Array = net.eval()(torch.from_numpy(x)).numpy()
            return corrections

        return answer


class TrueAnswers(DeltaCorrector):
    """The literal network with the true answers of the simulator of the test to its probes: what
    the best predictor, fitted there, would give it.
    """

    def __init__(self, model: GapModel, robot: RobotSpec) -> None:
        self.net = trained_network(model.path.parent, model.config, len(robot.operated)).eval()
        self.oracle: ProbeOracle | None = None
        self.answers = torch.empty(0)
        super().__init__(self._answer, model.config, robot)

    def reset(self, start: ListOf[Sequence]) -> None:
        super().reset(start)
        conditions = [Condition.of(sequence, self.robot) for sequence in start]
        self.oracle = ProbeOracle(self.robot, self.config, conditions, nthread=1)

    def correct(self, t: int, target: Array, qpos: Array, qvel: Array) -> Array:
        assert self.oracle is not None
        answers = self.oracle(qpos, qvel).reshape(len(qpos), -1)
        self.answers = torch.from_numpy(answers).float()
        return super().correct(t, target, qpos, qvel)

    @torch.inference_mode()
    def _answer(self, x: Array) -> Array:
        told = self.net.predictor.outputs(self.answers)
        with patch.object(self.net, "sensors", lambda x, z: told):
            corrections: Array = self.net(torch.from_numpy(x)).numpy()
        return corrections


class OtherContext(DeltaCorrector):
    """The network is told the answers of another simulator within the ranges of training."""

    def __init__(self, model: GapModel, robot: RobotSpec) -> None:
        super().__init__(model.infer, model.config, robot)
        self.other = SimulatorRanges().draw(len(robot.joint_names), 1, TEST_SEED + 3)[0]

    def reset(self, start: ListOf[Sequence]) -> None:
        super().reset(start)
        assert self.loop is not None
        conditions = [Condition.of(replace(s, simulator=self.other), self.robot) for s in start]
        self.loop.network_input.set_context(contexts(self.robot, conditions))


def table(found: dict[str, dict[str, list[list[float]]]]) -> ResultTable:
    """Return the table: mean over simulators and seeds, ± over simulators, and each seed's mean."""
    heads = ["error over uncorrected", *next(iter(found.values()))]
    lines = []
    for name, groups in found.items():
        lines.append((name, *map(_cell, groups.values())))
    return ResultTable("unseen_simulators", tuple(heads), tuple(lines))


def table_by_motion(errors: dict[str, dict[str, list[Array]]]) -> ResultTable:
    """Return the table of differences between networks with the same inputs, ± over motions, by
    group of simulators.

    Args:
        errors: Method → column → at each place (seeds, recordings) rad; a test recording is a
            motion.
    """
    columns = errors[UNCORRECTED]
    groups: dict[str, list[str]] = {}
    for column in columns:
        groups.setdefault(column.split(",")[0], []).append(column)
    motions = {of_column[0].shape[1] for of_column in columns.values()}
    heads = ("difference of error over uncorrected", *groups)
    lines = []
    for ours, other in PAIRS:
        if ours not in errors or other not in errors:
            continue
        cells = [f"{ours} − {other}, {max(motions)} motions"]
        for of_group in groups.values():
            differences = []
            for column in of_group:
                both = zip(errors[ours][column], errors[other][column], strict=True)
                differences += [a.mean(axis=0) - b.mean(axis=0) for a, b in both]
            uncorrected = np.concatenate([np.stack(columns[column])[:, 0] for column in of_group])
            cells.append("{:.3f} ± {:.3f}".format(*_jackknife(np.stack(differences), uncorrected)))
        lines.append(tuple(cells))
    return ResultTable("unseen_simulators_by_motion", heads, tuple(lines))


def _jackknife(differences: Array, uncorrected: Array) -> tuple[float, float]:
    """Return the mean over places of a difference over the uncorrected error, and its standard
    error over recordings, by the jackknife.

    Args:
        differences, uncorrected: (places, recordings) rad.
    """

    def ratio(recordings: Array) -> float:
        below = uncorrected[:, recordings].sum(axis=1)
        return float((differences[:, recordings].sum(axis=1) / below).mean())

    count = differences.shape[1]
    every = np.arange(count)
    without_one = np.array([ratio(np.delete(every, one)) for one in every])
    spread = np.square(without_one - without_one.mean()).sum()
    return ratio(every), float(np.sqrt((count - 1) / count * spread))


def _cell(ratios: list[list[float]]) -> str:
    """Return the cell of ratios, (simulators, seeds)."""
    values = np.array(ratios)
    by_simulator = values.mean(axis=1)
    text = f"{by_simulator.mean():.3f}"
    if len(by_simulator) > 1:
        text += f" ± {standard_error(by_simulator):.3f}"
    seeds = ", ".join(f"{value:.2f}" for value in values.mean(axis=0))
    return f"{text} ({seeds})"


def main() -> None:
    """Train or test."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    commands = parser.add_subparsers(required=True)
    train_command = commands.add_parser("train")
    train_command.set_defaults(run=train)
    train_command.add_argument("dataset")
    train_command.add_argument("--out", type=Path, required=True)
    test_command = commands.add_parser("test")
    test_command.set_defaults(run=test)
    test_command.add_argument("out", type=Path)
    test_command.add_argument("dataset")
    for command in (train_command, test_command):
        add_options(command)
    arguments = parser.parse_args()
    arguments.run(arguments)


def add_options(command: argparse.ArgumentParser) -> None:
    """Add the options that training and test have in common."""
    command.add_argument("--seeds", type=int, default=3)
    command.add_argument("--steps", type=int, default=240_000)
    command.add_argument("--simulators", type=int, default=200)
    command.add_argument(
        "--share", type=float, default=1.0, help="of the training motions that are used"
    )
    command.add_argument(
        "--recordings", type=int, default=MAX_RECORDINGS, help="of the test, by payload"
    )
    command.add_argument(
        "--tests", type=int, default=WITHIN, help="largest number of test simulators in a group"
    )
    command.add_argument("--rates", type=float, nargs="*", default=[])
    command.add_argument("--identified")
    command.add_argument("--payload-unknown", action="store_true")
    command.add_argument("--literal", action="store_true")
    command.add_argument("--trained-on", help="the dataset of training, if DATASET is another")
    command.add_argument("--result", default="unseen_simulators", help="name of the result file")
    command.add_argument(
        "--all", action="store_true", help="all recordings of DATASET, none of training"
    )


if __name__ == "__main__":
    main()
