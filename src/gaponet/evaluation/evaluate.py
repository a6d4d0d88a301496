"""Evaluation of nominal, identified and learned simulators: open-loop rollouts with the exported
artifact (ONNX).
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Iterator, Mapping
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import ModelError, UsageError
from gaponet.base.files import atomic_write, lock_folder, write_json
from gaponet.base.progress import Progress, no_progress, with_note
from gaponet.data.pair import SimulatedReplay
from gaponet.data.repeatability import MIN_MOTION_RAD
from gaponet.data.sequence import Sequence
from gaponet.data.store import Dataset, Entry
from gaponet.deploy.transfer import TransferCorrector
from gaponet.evaluation.candidate import Candidate, is_robot, select_entries
from gaponet.evaluation.methods import IDENTIFIED, title
from gaponet.evaluation.verdict import LEARNED
from gaponet.nn.adaptation import Adaptation
from gaponet.nn.artifact import GapModel
from gaponet.nn.delay_offset import DelayOffset
from gaponet.nn.loop import DeltaCorrector
from gaponet.robot.spec import RobotSpec
from gaponet.sim.metrics import Run, runs, summary
from gaponet.sim.model import model_hash
from gaponet.sim.replay import Corrector, kept_replays, replay

T = TypeVar("T")
STORED_TRAJECTORIES = 8  # for the report
# Order of the methods in tables and figures. The last three are in another simulator: as it is;
# with the network, which gets the other simulator's answers as its input; with targets that make it
# move as the candidate does.
ORDER = (
    "nominal",
    "delay_offset",
    "identified",
    *LEARNED,
    "adapted",
    "uncorrected",
    "told",
    "transfer",
)


@dataclass(frozen=True)
class Evaluation:
    """Rollouts by method, their metrics, and the corrections applied by each learned model.

    `result` holds methods → method → metrics (mpjae rad, q_dis rad·s, …; by_joint, by_motion, … the
    same); unseen is true if no recording was used in training. All lists have an item per sequence.
    """

    result: dict[str, Any]
    runs: dict[str, list[Run]]  # method → rollouts
    ctrl: list[Array]  # commands, (T, n operated) rad
    deltas: dict[str, list[Array]]  # method → corrections applied, (T, n operated) rad

    def save(self, folder: Path) -> None:
        """Write metrics.json and trajectories.npz, which the report reads, into a run or robot
        folder.
        """
        nominal = self.runs["nominal"]
        picked = evenly_spaced(list(range(len(nominal))), STORED_TRAJECTORIES)
        shown = []
        for i in picked:
            meta = nominal[i].meta
            facts = {
                "motion": meta.motion,
                "unit_id": meta.unit_id,
                "payload_mass": meta.payload_mass,
                "dt": nominal[i].dt,
            }
            shown.append(facts)
        result = self.result | {
            "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
            "shown": shown,
        }
        arrays = self._arrays_of(picked)
        with lock_folder(folder, "robot" if is_robot(folder) else "run"):
            with atomic_write(folder / "trajectories.npz") as temporary:
                np.savez_compressed(temporary, **arrays)  # type: ignore[arg-type]
            write_json(folder / "metrics.json", result)

    def _arrays_of(self, picked: list[int]) -> dict[str, Array]:
        """Return ROW/recorded, ROW/command, ROW/METHOD and ROW/delta/METHOD of some recordings by
        number, (T, n operated) rad in float32; ROW counts the picked ones.
        """
        arrays = {}
        for row, i in enumerate(picked):
            arrays[f"{row}/recorded"] = self.runs["nominal"][i].qpos_real
            arrays[f"{row}/command"] = self.ctrl[i]
            for name, rollouts in self.runs.items():
                arrays[f"{row}/{name}"] = rollouts[i].qpos_sim
            for name, delta in self.deltas.items():
                arrays[f"{row}/delta/{name}"] = delta[i]
        return {name: array.astype(np.float32) for name, array in arrays.items()}


def evaluate(
    folders: ListOf[Path],
    dataset: Dataset,
    robot: RobotSpec,
    motions: tuple[str, ...] = (),
    progress: Progress = no_progress,
    target: RobotSpec | None = None,
    units: tuple[str, ...] = (),
) -> Evaluation:
    """Roll out every method from the first recorded state under the recorded commands.

    Args:
        folders: Identified robots and training runs. Recordings that any of them was fitted to are
            not selected by default and not called unseen. The test motions and the delay + offset
            baseline are those of the first.
        robot: The dataset's robot; the folders' robots must equal it before identification.
        motions: Only these; default: the test motions of the dataset trained on; of another
            dataset, all motions that were never trained on.
        target: Another simulator, evaluated as it is and with the first folder transferred into it.
        units: Only recordings of these units.

    Raises:
        UsageError: Two runs of one method, or several identified simulators.
        ModelError, RobotError: A folder does not fit the robot, or no method can run in the target.
    """
    dataset.require_robot(robot)
    candidates = _load_candidates(folders, robot)
    entries, unseen = select_entries(list(folders), dataset, motions, units)
    rollouts = _Rollouts(dataset, entries, robot, candidates)
    for candidate in candidates.values():
        _require_control_periods(candidate, rollouts.sequences)
    nominal = rollouts.first.robot.before_identification
    methods = list(_methods(candidates, nominal, target))
    is_told = any(name == "told" for name, _, _ in methods)
    for name, _, corrector in methods:
        refusal_is_a_note = name == "transfer" and is_told  # see add_method
        if corrector is not None and not refusal_is_a_note:
            corrector.reset(rollouts.sequences[:1])  # it refuses now, not after all other methods
    for name, simulator, corrector in methods:
        rollouts.add_method(name, simulator, corrector, with_note(progress, name))
    rollouts.add_adapted(with_note(progress, "adapted"))
    command = _command(folders, os.path.normpath(dataset.path), motions)
    result = rollouts.result() | {
        "dataset": dataset.path.name,
        "unseen": unseen,
        "command": command,
    }
    return Evaluation(result, rollouts.runs, rollouts.ctrl, rollouts.deltas)


def _load_candidates(folders: ListOf[Path], robot: RobotSpec) -> dict[str, Candidate]:
    """Return method → what a folder holds, in the order of the folders.

    Raises:
        UsageError: Two runs of one method.
    """
    candidates: dict[str, Candidate] = {}
    for path in folders:
        candidate = Candidate.load(path, robot)
        if candidate.method in candidates:
            raise UsageError(
                f"{path}: a second run of {title(candidate.method)}; give runs of different methods"
            )
        candidates[candidate.method] = candidate
    return candidates


def _require_control_periods(candidate: Candidate, sequences: list[Sequence]) -> None:
    """Refuse a network that does not run at the rates of the recordings."""
    if candidate.model is None:
        return
    for dt in sorted({sequence.dt for sequence in sequences}):
        candidate.model.require(candidate.robot, dt)


class _Rollouts:
    """Rollouts of all methods in the same recordings.

    Attributes:
        sequences: The recordings.
        first: The first candidate.
        ctrl: Recorded commands, (T, n operated) rad, one for each recording.
        runs: Method → rollouts.
        deltas: Method with a network → corrections applied, (T − 1, n operated) rad.
        notes: Sentences about methods that could not be shown, or only with a reservation.
    """

    def __init__(
        self,
        dataset: Dataset,
        entries: list[Entry],
        robot: RobotSpec,
        candidates: dict[str, Candidate],
    ) -> None:
        self.sequences = dataset.sequences(entries)
        self._dataset = dataset
        self._entries = entries
        self.first = next(iter(candidates.values()))
        self.ctrl = [sequence.ctrl[:, robot.operated_index] for sequence in self.sequences]
        self.runs: dict[str, list[Run]] = {}
        self.deltas: dict[str, list[Array]] = {}
        self.notes: list[str] = []
        self._robot = robot
        self._candidates = candidates
        self._simulators: dict[str, str] = {}  # method → hash
        self._adapted_units: list[str] = []

    def add_method(
        self,
        name: str,
        simulator: RobotSpec,
        corrector: Corrector | None,
        progress: Callable[[int, int], None],
    ) -> None:
        """Roll out a method; methods come in the order of ORDER.

        A transfer that is refused ends the evaluation, unless "told" has shown the network in that
        simulator in its own way: then the refusal is a note.
        """
        try:
            if corrector is None:
                replays = kept_replays(self._dataset, self._entries, simulator, progress)
            else:
                replays = replay(
                    self.sequences, simulator, corrector, progress=progress, lock_idle=True
                )
        except ModelError as error:
            was_told = "told" in self.runs
            if name == "transfer" and was_told:
                self.notes.append(f"no transfer: {error}")
                return
            raise
        self._add(name, simulator, replays)
        if name == "told" and self.first.model is not None:
            dt = self.sequences[0].dt
            self.notes.append(_distance_note(self.first.model, simulator, dt))
        if name in self._candidates and self._candidates[name].model is not None:
            self.deltas[name] = self._corrections(replays)

    def add_adapted(self, progress: Callable[[int, int], None]) -> None:
        """Roll out the first network in the adapted simulators of the units that have one."""
        if self.first.model is None:
            return
        adapted = Adaptation.load(self.first.folder, self.first.model.weights_hash())
        self._adapted_units = sorted(set(adapted) & {s.meta.unit_id for s in self.sequences})
        if self._adapted_units:
            replays = _by_unit(self.sequences, self.first, adapted, progress)
            self._add("adapted", self.first.robot, replays)

    def result(self) -> dict[str, Any]:
        """Return everything that is measured, in the form of Evaluation.result."""
        methods = {name: summary(part, self._robot) for name, part in self.runs.items()}
        nominal_error = methods["nominal"]["mpjae"]
        ratios = {}
        for name, metrics in methods.items():
            ratios[name] = metrics["mpjae"] / nominal_error
        delta = {}
        for name, parts in self.deltas.items():
            model = self._candidates[name].model
            assert model is not None
            delta[name] = _delta_summary(parts, self.sequences, model.config.delta_max)
        return {
            "methods": methods,
            "ratio_to_nominal": ratios,
            "sequences": len(self.sequences),
            "motions": sorted({sequence.meta.motion for sequence in self.sequences}),
            "moves": self._recordings_that_move(),
            "virtual": any(sequence.meta.virtual for sequence in self.sequences),
            "robot": self._robot.name,
            "simulator_hash": model_hash(self.first.robot.before_identification),
            "simulators": self._simulators,
            "delta": delta,
            "notes": self.notes,
            "adapted_units": self._adapted_units,
            "artifacts": self._artifacts(),
        }

    def _add(self, name: str, simulator: RobotSpec, replays: list[SimulatedReplay]) -> None:
        self._simulators[name] = model_hash(simulator)
        self.runs[name] = runs(self.sequences, [replayed.qpos for replayed in replays], self._robot)

    def _corrections(self, replays: list[SimulatedReplay]) -> list[Array]:
        operated = self._robot.operated_index
        corrections = []
        for sequence, simulated in zip(self.sequences, replays, strict=True):
            delta = simulated.ctrl - sequence.ctrl
            corrections.append(delta[:-1, operated])
        return corrections

    def _recordings_that_move(self) -> dict[str, int]:
        """Return joint → number of recordings in which it is commanded to move."""
        moved = [np.ptp(ctrl, axis=0) > MIN_MOTION_RAD for ctrl in self.ctrl]
        counts = np.sum(moved, axis=0)  # (n operated)
        return dict(zip(self._robot.operated, counts.tolist(), strict=True))

    def _artifacts(self) -> dict[str, dict[str, Any]]:
        """Return method → weights and seed of its network."""
        artifacts = {}
        for name, candidate in self._candidates.items():
            model = candidate.model
            if model is not None:
                artifacts[name] = {"weights": model.weights_hash(), "seed": model.card.get("seed")}
        return artifacts


def _distance_note(model: GapModel, simulator: RobotSpec, dt: float) -> str:
    """Return whether a simulator's answers to fixed probes lie within those of a network's
    training.
    """
    known = model.known_simulators
    assert known is not None
    context = model.context_of(simulator, dt)
    distance = known.distance(context)
    if distance == 0:
        return "the other simulator's answers lie within those of training"
    note = (
        f"the other simulator's answers lie {distance:.2f} of their range outside those of training"
    )
    if known.include(context):
        return note
    return f"{note}: AlignedSim and MujocoAligner would not use the network there"


def _command(folders: ListOf[Path], dataset: str, motions: tuple[str, ...]) -> str:
    """Return the shell command that repeats an evaluation."""
    words = ["gaponet", "eval", str(folders[0]), dataset]
    if len(folders) > 1:
        words += ["--also", *map(str, folders[1:])]
    if motions:
        words += ["--motions", ",".join(motions)]
    return shlex.join(words)


def evenly_spaced(items: list[T], limit: int) -> list[T]:
    """Return at most `limit` items, evenly spaced, with the first and the last."""
    if len(items) <= limit:
        return items
    return [items[round(i)] for i in np.linspace(0, len(items) - 1, limit)]


def _methods(
    candidates: dict[str, Candidate], nominal: RobotSpec, target: RobotSpec | None
) -> Iterator[tuple[str, RobotSpec, Corrector | None]]:
    """Yield name, simulator and corrector of every method, in the order of ORDER.

    Raises:
        UsageError: The candidates start from different identified simulators.
    """
    yield "nominal", nominal, None
    first = next(iter(candidates.values()))
    if (first.folder / "delay_offset.json").is_file():
        yield "delay_offset", nominal, DelayOffset.read(first.folder).corrector(nominal)
    identified = {}
    for candidate in candidates.values():
        if candidate.robot.is_identified:
            identified[model_hash(candidate.robot)] = candidate.robot
    if len(identified) > 1:
        raise UsageError(
            "these start from different identified simulators; compare those of one identification"
        )
    for robot in identified.values():  # at most one
        yield "identified", robot, None
    for name in sorted(candidates, key=_place_in_order):
        if candidates[name].model is not None:
            yield name, candidates[name].robot, candidates[name].corrector()
    if target is not None:
        yield from _methods_in(target, first, nominal)


def _place_in_order(method: str) -> int:
    return ORDER.index(method.removeprefix(IDENTIFIED))


def _methods_in(
    target: RobotSpec, first: Candidate, nominal: RobotSpec
) -> Iterator[tuple[str, RobotSpec, Corrector | None]]:
    """Yield the methods in another simulator.

    It gets the nominal robot, so that gains which a recording states change both by as much.
    """
    simulator = replace(target, nominal=target.nominal or nominal)
    if model_hash(target) != model_hash(nominal):
        yield "uncorrected", simulator, None
    model = first.model
    if model is not None and model.config.context:
        yield "told", simulator, DeltaCorrector(model.infer, model.config, simulator)
    yield "transfer", simulator, TransferCorrector(model or first.robot, simulator)


def _by_unit(
    sequences: list[Sequence],
    candidate: Candidate,
    adapted: Mapping[str, Adaptation],
    progress: Callable[[int, int], None],
) -> list[SimulatedReplay]:
    """Roll out the model in each unit's adapted simulator, or in the common one for other units."""
    numbers_of: dict[str, list[int]] = {}  # unit → numbers of its recordings
    for number, sequence in enumerate(sequences):
        numbers_of.setdefault(sequence.meta.unit_id, []).append(number)
    replays: dict[int, SimulatedReplay] = {}  # number of the recording → its simulation
    for unit, numbers in numbers_of.items():
        simulator = candidate.robot
        if unit in adapted:
            simulator = adapted[unit].robot(candidate.robot)
        of_unit = [sequences[i] for i in numbers]
        simulated = replay(of_unit, simulator, candidate.corrector(), lock_idle=True)
        replays |= dict(zip(numbers, simulated, strict=True))
        progress(len(replays), len(sequences))
    return [replays[i] for i in range(len(sequences))]


def _delta_summary(parts: list[Array], sequences: list[Sequence], limit: float) -> dict[str, float]:
    """Return mean and largest |Δa|, rad, their mean rate, rad/s, and the share at the limit Δ_max
    (rad).
    """
    means = []
    largest = []
    shares_at_limit = []
    rates = []  # mean |difference| of a row and the next one, rad/s
    for delta, sequence in zip(parts, sequences, strict=True):
        size = np.abs(delta)
        means.append(size.mean())
        largest.append(size.max())
        shares_at_limit.append((size >= limit - 1e-6).mean())
        rates.append(np.abs(np.diff(delta, axis=0)).mean() / sequence.dt)
    return {
        "mean": float(np.mean(means)),
        "max": float(max(largest)),
        "at_limit": float(np.mean(shares_at_limit)),
        "rate": float(np.mean(rates)),
    }
