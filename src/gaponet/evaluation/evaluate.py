"""Evaluation of nominal, identified and learned simulators: open-loop rollouts with the exported artifact (ONNX)."""

from __future__ import annotations

import itertools
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
from gaponet.data.store import Dataset
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
from gaponet.sim.replay import Corrector, replay

T = TypeVar("T")
STORED_TRAJECTORIES = 8  # for the report
# Of tables and figures.
ORDER = (
    "nominal", "delay_offset", "identified", *LEARNED, "adapted", "uncorrected", "told", "transfer",
)  # fmt: skip


@dataclass(frozen=True)
class Evaluation:
    """Rollouts by method, their metrics, and the corrections applied by each learned model.

    `result` holds methods → method → metrics (mpjae rad, q_dis rad·s, …; by_joint, by_motion, … the same); unseen is
    true if no recording was used in training. All lists have an item per sequence.
    """

    result: dict[str, Any]
    runs: dict[str, list[Run]]  # method → rollouts
    ctrl: list[Array]  # commands, (T, n operated) rad
    deltas: dict[str, list[Array]]  # method → corrections applied, (T, n operated) rad

    def save(self, folder: Path) -> None:
        """Write metrics.json and trajectories.npz, which the report reads, into a run or robot folder."""
        reals = self.runs["nominal"]
        picked = evenly_spaced(list(range(len(reals))), STORED_TRAJECTORIES)
        shown = [
            {
                "motion": r.meta.motion,
                "unit_id": r.meta.unit_id,
                "payload_mass": r.meta.payload_mass,
                "dt": r.dt,
            }
            for r in (reals[i] for i in picked)
        ]
        result = self.result | {
            "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
            "shown": shown,
        }
        arrays = {}
        for row, i in enumerate(picked):
            arrays[f"{row}/recorded"] = reals[i].qpos_real
            arrays[f"{row}/command"] = self.ctrl[i]
            for name, part in self.runs.items():
                arrays[f"{row}/{name}"] = part[i].qpos_sim
            for name, delta in self.deltas.items():
                arrays[f"{row}/delta/{name}"] = delta[i]
        with lock_folder(folder, "robot" if is_robot(folder) else "run"):
            with atomic_write(folder / "trajectories.npz") as temporary:
                single = {name: array.astype(np.float32) for name, array in arrays.items()}
                np.savez_compressed(temporary, **single)  # type: ignore[arg-type]
            write_json(folder / "metrics.json", result)


def evaluate(
    folders: ListOf[Path], dataset: Dataset, robot: RobotSpec, motions: tuple[str, ...] = (),
    progress: Progress = no_progress, target: RobotSpec | None = None, units: tuple[str, ...] = (),
) -> Evaluation:  # fmt: skip
    """Roll out every method from the first recorded state under the recorded commands.

    Args:
        folders: Identified robots and training runs. Recordings that any of them was fitted to are not selected by
            default and not called unseen. The test motions and the delay + offset baseline are those of the first.
        robot: The dataset's robot; the folders' robots must equal it before identification.
        motions: Only these; default: the test motions of the dataset trained on; of another dataset, all motions that
            were never trained on.
        target: Another simulator, evaluated as it is and with the first folder transferred into it.
        units: Only recordings of these units.

    Raises:
        UsageError: Two runs of one method, or several identified simulators.
        ModelError, RobotError: A folder does not fit the robot.
    """
    dataset.require_robot(robot)
    candidates: dict[str, Candidate] = {}
    for path in folders:
        candidate = Candidate.load(path, robot)
        if candidate.method in candidates:
            raise UsageError(
                f"{path}: a second run of {title(candidate.method)}; give runs of different methods"
            )
        candidates[candidate.method] = candidate
    first = next(iter(candidates.values()))
    models = {name: c.model for name, c in candidates.items() if c.model is not None}
    nominal = first.robot.before_identification
    entries, unseen = select_entries(list(folders), dataset, motions, units)
    sequences = dataset.sequences(entries)
    for (name, model), dt in itertools.product(models.items(), sorted({s.dt for s in sequences})):
        model.require(candidates[name].robot, dt)
    done_runs: dict[str, list[Run]] = {}
    deltas: dict[str, list[Array]] = {}
    op = robot.operated_index
    ctrl = [s.ctrl[:, op] for s in sequences]
    moved = [np.ptp(c, axis=0) > MIN_MOTION_RAD for c in ctrl]
    simulators: dict[str, str] = {}
    notes: list[str] = []
    for name, simulator, corrector in _methods(candidates, nominal, target):
        try:
            replays = replay(
                sequences, simulator, corrector, progress=with_note(progress, name), lock_idle=True
            )
        except ModelError as error:
            if name != "transfer" or "told" not in done_runs:
                raise
            notes.append(f"no transfer: {error}")
            continue
        simulators[name] = model_hash(simulator)
        if name == "told" and first.model is not None:
            notes.append(_distance_note(first.model, simulator, sequences[0].dt))
        done_runs[name] = runs(sequences, [t.qpos for t in replays], robot)
        if name in models:
            deltas[name] = [
                (t.ctrl - s.ctrl)[:-1, op] for s, t in zip(sequences, replays, strict=True)
            ]
    adapted = (
        Adaptation.load(first.folder, first.model.weights_hash()) if first.model is not None else {}
    )
    if any(s.meta.unit_id in adapted for s in sequences):
        replays = _by_unit(sequences, first, adapted, with_note(progress, "adapted"))
        done_runs["adapted"] = runs(sequences, [t.qpos for t in replays], robot)
        simulators["adapted"] = simulators[first.method]
    methods = {name: summary(part, robot) for name, part in done_runs.items()}
    ratio = {name: m["mpjae"] / methods["nominal"]["mpjae"] for name, m in methods.items()}
    result = {
        "methods": methods, "ratio_to_nominal": ratio, "dataset": dataset.path.name, "sequences": len(sequences),
        "motions": sorted({s.meta.motion for s in sequences}),
        "moves": dict(zip(robot.operated, map(int, np.sum(moved, axis=0)), strict=True)),
        "unseen": unseen, "virtual": any(s.meta.virtual for s in sequences), "robot": robot.name,
        "simulator_hash": model_hash(nominal), "simulators": simulators,
        "delta": {k: _delta_summary(parts, sequences, models[k].config.delta_max) for k, parts in deltas.items()},
        "notes": notes,
        "adapted_units": sorted(set(adapted) & {s.meta.unit_id for s in sequences}),
        "artifacts": {name: {"weights": m.weights_hash(), "seed": m.card.get("seed")} for name, m in models.items()},
        "command": _command(folders, dataset.address or os.path.normpath(dataset.path), motions),
    }  # fmt: skip
    return Evaluation(result, done_runs, ctrl, deltas)


def _distance_note(model: GapModel, simulator: RobotSpec, dt: float) -> str:
    """Return whether a simulator's answers to fixed probes lie within those of a network's training."""
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
    words = [
        "gaponet",
        "eval",
        str(folders[0]),
        dataset,
        *["--also"] * (len(folders) > 1),
        *map(str, folders[1:]),
    ]
    return shlex.join(words + (["--motions", ",".join(motions)] if motions else []))


def evenly_spaced(items: list[T], limit: int) -> list[T]:
    """Return at most `limit` items, evenly spaced, with the first and the last."""
    if len(items) <= limit:
        return items
    return [items[round(i)] for i in np.linspace(0, len(items) - 1, limit)]


def _methods(
    candidates: dict[str, Candidate], nominal: RobotSpec, target: RobotSpec | None
) -> Iterator[tuple[str, RobotSpec, Corrector | None]]:
    """Yield name, simulator and corrector of every method, in the order of ORDER; then those of the simulator `target`,
    where gains of a log change it by as much as they change the nominal one."""
    yield "nominal", nominal, None
    first = next(iter(candidates.values()))
    if (first.folder / "delay_offset.json").is_file():
        yield "delay_offset", nominal, DelayOffset.read(first.folder).corrector(nominal)
    identified = {
        model_hash(c.robot): c.robot for c in candidates.values() if c.robot.nominal is not None
    }
    if len(identified) > 1:
        raise UsageError(
            "these start from different identified simulators; compare those of one identification"
        )
    for robot in identified.values():
        yield "identified", robot, None
    for name in sorted(candidates, key=lambda name: ORDER.index(name.removeprefix(IDENTIFIED))):
        if candidates[name].model is not None:
            yield name, candidates[name].robot, candidates[name].corrector()
    if target is None:
        return
    simulator = replace(target, nominal=target.nominal or nominal)
    if model_hash(target) != model_hash(nominal):
        yield "uncorrected", simulator, None
    if first.model is not None and first.model.config.context:
        yield "told", simulator, DeltaCorrector(first.model.infer, first.model.config, simulator)
    yield "transfer", simulator, TransferCorrector(first.model or first.robot, simulator)


def _by_unit(
    sequences: list[Sequence], candidate: Candidate, adapted: Mapping[str, Adaptation],
    progress: Callable[[int, int], None],
) -> list[SimulatedReplay]:  # fmt: skip
    """Roll out the model in each unit's adapted simulator, or in the common one for other units."""
    replays: dict[int, SimulatedReplay] = {}
    for unit in dict.fromkeys(s.meta.unit_id for s in sequences):
        rows = [i for i, s in enumerate(sequences) if s.meta.unit_id == unit]
        physics = adapted[unit].robot(candidate.robot) if unit in adapted else candidate.robot
        part = replay([sequences[i] for i in rows], physics, candidate.corrector(), lock_idle=True)
        replays |= dict(zip(rows, part, strict=True))
        progress(len(replays), len(sequences))
    return [replays[i] for i in range(len(sequences))]


def _delta_summary(parts: list[Array], sequences: list[Sequence], limit: float) -> dict[str, float]:
    """Return mean and largest |Δa|, rad, their mean rate, rad/s, and the share at the limit Δ_max (rad)."""
    dt = float(np.median([s.dt for s in sequences]))
    return {
        "mean": float(np.mean([np.abs(d).mean() for d in parts])),
        "max": float(max(np.abs(d).max() for d in parts)),
        "at_limit": float(np.mean([(np.abs(d) >= limit - 1e-6).mean() for d in parts])),
        "rate": float(np.mean([np.abs(np.diff(d, axis=0)).mean() for d in parts]) / dt),
    }
