"""Nominal, delay + offset and learned models side by side: free runs with the shipped artifact (ONNX, not torch)."""

from __future__ import annotations

import itertools
import shlex
from collections.abc import Callable, Iterator
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from gaponet.arrays import Array
from gaponet.data.json_file import write_json
from gaponet.data.pair import Twin
from gaponet.data.repeatability import MOVED
from gaponet.data.sequence import Sequence
from gaponet.data.split import RunSplit
from gaponet.data.store import Dataset, Entry
from gaponet.deploy.transfer import TransferCorrector
from gaponet.errors import DatasetError, ModelError, UsageError
from gaponet.files import whole, writing
from gaponet.metrics import Run, runs, summary
from gaponet.model import calibration
from gaponet.model.artifact import GapModel
from gaponet.model.baselines.delay_offset import DelayOffset
from gaponet.plot.methods import IDENTIFIED, method, title
from gaponet.progress import Progress, noted, silent
from gaponet.robot import RobotSpec
from gaponet.sim.kept import nominal_of, require_kept
from gaponet.sim.model import model_hash
from gaponet.sim.replay import Corrector, replay
from gaponet.structure import read_json

T = TypeVar("T")
SHOWN = 8  # sequences whose trajectories are kept for the report
LEARNED = ("inverse", "mlp", "shared_mlp", "transformer", "fno", "gaponet")  # kinds of model
ORDER = (
    "nominal",
    "delay_offset",
    "identified",
    *LEARNED,
    "calibrated",
    "uncorrected",
    "member",
    "transfer",
)  # of tables and figures


@dataclass(frozen=True)
class Evaluation:
    """Free runs by method, their metrics, and the corrections applied by each learned model.

    Attributes:
        result: methods → method → metrics (mpjae rad, q_dis rad·s, …), and by_joint, by_motion, … the same; unseen says
            whether no recording was used in training.
        runs: Method → free runs, one per sequence.
        ctrl: Commands, (T, n operated) rad, one array per sequence.
        deltas: Method → corrections applied, (T, n operated) rad, one array per sequence.
    """

    result: dict[str, Any]
    runs: dict[str, list[Run]]
    ctrl: list[Array]
    deltas: dict[str, list[Array]]


def evaluate(
    runs_dirs: ListOf[Path],
    dataset: Dataset,
    robot: RobotSpec,
    motions: tuple[str, ...] = (),
    progress: Progress = silent,
    target: RobotSpec | None = None,
) -> Evaluation:
    """Step every method through the chosen sequences, from the recorded start, the recording not looked at again.

    Args:
        runs_dirs: Training runs; nothing that one of them was trained or chosen on is chosen or called unseen. The
            first one's test motions and delay + offset baseline apply.
        robot: The dataset's, which must be the one that the runs keep: the baseline is theirs.
        motions: Only these; default: the test motions of the dataset trained on; of another, all that was never
            trained on.
        target: Another simulator, to be shown as it is and with the first run transferred into it.
    """
    dataset.require_robot(robot)
    models: dict[str, GapModel] = {}
    robots: dict[str, RobotSpec] = {}
    for path in runs_dirs:
        model, corrected = GapModel.load(path), corrected_robot(path, robot)
        name = method(model.config.kind, corrected)
        if name in models:
            raise UsageError(f"{path}: a second run of {title(name)}; give runs of different methods")
        models[name], robots[name] = model, corrected
    nominal = nominal_of(next(iter(robots.values())))
    entries, unseen = choose(runs_dirs, dataset, motions)
    sequences = dataset.sequences(entries)
    for (name, model), dt in itertools.product(models.items(), sorted({s.dt for s in sequences})):
        model.require(robots[name], dt)
    done_runs: dict[str, list[Run]] = {}
    deltas: dict[str, list[Array]] = {}
    op = robot.operated_index
    ctrl = [s.ctrl[:, op] for s in sequences]
    moved = [np.ptp(c, axis=0) > MOVED for c in ctrl]
    simulators: dict[str, str] = {}
    ways = _methods(runs_dirs[0], models, nominal, robots)
    for name, simulator, corrector in itertools.chain(ways, _transferred(target, next(iter(models.values())), nominal)):
        simulators[name] = model_hash(simulator)
        twins = replay(sequences, simulator, corrector, progress=noted(progress, name), lock_idle=True)
        done_runs[name] = runs(sequences, [t.qpos for t in twins], robot)
        if name in models:
            deltas[name] = [(t.ctrl - s.ctrl)[:-1, op] for s, t in zip(sequences, twins, strict=True)]
    calibrated = calibration.load(runs_dirs[0], next(iter(models.values())).weights_hash())
    if any(s.meta.unit_id in calibrated for s in sequences):
        name = next(iter(models))
        twins = _by_unit(sequences, models[name], robots[name], calibrated, noted(progress, "calibrated"))
        done_runs["calibrated"] = runs(sequences, [t.qpos for t in twins], robot)
        simulators["calibrated"] = simulators[name]
    methods = {name: summary(part, robot) for name, part in done_runs.items()}
    result = {
        "methods": methods,
        "ratio_to_nominal": {name: m["mpjae"] / methods["nominal"]["mpjae"] for name, m in methods.items()},
        "dataset": dataset.path.name,
        "sequences": len(sequences),
        "motions": sorted({s.meta.motion for s in sequences}),
        "moves": dict(zip(robot.operated, map(int, np.sum(moved, axis=0)), strict=True)),
        "unseen": unseen,
        "virtual": any(s.meta.virtual for s in sequences),
        "robot": robot.name,
        "simulator_hash": model_hash(nominal),
        "simulators": simulators,
        "delta": {name: _delta_summary(parts, sequences) for name, parts in deltas.items()},
        "calibrated_units": sorted(set(calibrated) & {s.meta.unit_id for s in sequences}),
        "artifacts": {name: {"weights": m.weights_hash(), "seed": m.card.get("seed")} for name, m in models.items()},
        "command": _command(runs_dirs, dataset.address or dataset.path, motions),
    }
    return Evaluation(result, done_runs, ctrl, deltas)


def _command(runs_dirs: ListOf[Path], dataset: Path | str, motions: tuple[str, ...]) -> str:
    """What a shell needs to repeat an evaluation."""
    words = ["gaponet", "eval", str(runs_dirs[0]), str(dataset)]
    words += ["--also", *map(str, runs_dirs[1:])] if len(runs_dirs) > 1 else []
    return shlex.join(words + (["--motions", ",".join(motions)] if motions else []))


def choose(runs_dirs: ListOf[Path], dataset: Dataset, motions: tuple[str, ...] = ()) -> tuple[list[Entry], bool]:
    """Entries to evaluate, and whether none of them was seen by any of the runs.

    By default the first run's test part, or else everything, each without what any run has seen; where all motions
    were seen, recordings that were not.
    """
    seen = [Seen.by(run) for run in runs_dirs]
    fresh = [e for e in dataset.entries if not any(e in s for s in seen)]
    if motions:
        entries = dataset.select(motions)
    else:
        entries = [e for e in fresh if e.hash in seen[0].test] or fresh
        entries = entries or [e for e in dataset.entries if not any(e.hash in s.hashes for s in seen)]
    if not entries:
        raise DatasetError(
            f"{dataset.path}: every sequence was used in training; give logs the runs never saw, or --motions"
        )
    return entries, {e.hash for e in entries} <= {e.hash for e in fresh}


@dataclass(frozen=True)
class Seen:
    """What a run was trained, chosen or calibrated on: recordings, and their motions, whoever played them.

    Its own test part is unseen, whatever it was held out by: a split by unit or payload tests motions trained on.
    """

    hashes: frozenset[str]
    motions: frozenset[str]
    test: frozenset[str]

    @classmethod
    def by(cls, run: Path) -> Seen:
        """What this run has seen."""
        model, split = GapModel.load(run), split_of_run(run)
        used = ("train", "val")
        hashes = {h for part in used for h in split[part].values()}
        hashes |= {h for c in calibration.load(run, model.weights_hash()).values() for h in c.logs}
        motions = {m for part in used for m in model.card.get("motions", {}).get(part, ())}
        return cls(frozenset(hashes), frozenset(motions), frozenset(split["test"].values()) - hashes)

    def __contains__(self, entry: Entry) -> bool:
        return entry.hash in self.hashes or (entry.hash not in self.test and entry.meta.motion in self.motions)


def split_of_run(run: Path) -> dict[str, dict[str, str]]:
    """{part: {sequence id: content hash}} of a run."""
    hint = "give a run folder of gaponet train"
    return dict(read_json(RunSplit, run / "split.json", ModelError, hint))  # type: ignore[arg-type]


def evenly(items: list[T], most: int) -> list[T]:
    """All, or so many of them evenly spaced, the first and the last among them."""
    if len(items) <= most:
        return items
    return [items[round(i)] for i in np.linspace(0, len(items) - 1, most)]


def save(evaluation: Evaluation, run: Path) -> None:
    """metrics.json and trajectories.npz in the run folder: the newest evaluation, all that the report needs."""
    reals = evaluation.runs["nominal"]
    picked = evenly(list(range(len(reals))), SHOWN)
    shown = [reals[i].meta for i in picked]
    result = evaluation.result | {
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "shown": [
            {"motion": m.motion, "unit_id": m.unit_id, "payload_mass": m.payload_mass, "dt": reals[i].dt}
            for i, m in zip(picked, shown, strict=True)
        ],
    }
    arrays = {}
    for row, i in enumerate(picked):
        arrays[f"{row}/recorded"] = reals[i].qpos_real
        arrays[f"{row}/command"] = evaluation.ctrl[i]
        for name, part in evaluation.runs.items():
            arrays[f"{row}/{name}"] = part[i].qpos_sim
        for name, delta in evaluation.deltas.items():
            arrays[f"{row}/delta/{name}"] = delta[i]
    with writing(run, "run"):
        with whole(run / "trajectories.npz") as temporary:
            np.savez_compressed(temporary, **{k: v.astype(np.float32) for k, v in arrays.items()})  # type: ignore[arg-type]
        write_json(run / "metrics.json", result)


def corrected_robot(run: Path, robot: RobotSpec) -> RobotSpec:
    """The simulator that a run's model corrects, as the run keeps it: the nominal one, or an identified one.

    Raises:
        ModelError: They differ before identification: errors would be told against another baseline.
    """
    return require_kept(run, robot, ModelError, "data of the robot that the run was trained for")


def _methods(
    run: Path, models: dict[str, GapModel], nominal: RobotSpec, robots: dict[str, RobotSpec]
) -> Iterator[tuple[str, RobotSpec, Corrector | None]]:
    """Name, simulator and corrector of everything compared, in the order of ORDER."""
    yield "nominal", nominal, None
    file = run / "delay_offset.json"
    if file.is_file():
        yield "delay_offset", nominal, DelayOffset.read(run).corrector(nominal)
    identified = {model_hash(r): r for r in robots.values() if r.nominal is not None}
    if len(identified) > 1:
        raise UsageError("the runs start from different identified simulators; compare those of one identification")
    for robot in identified.values():
        yield "identified", robot, None
    for name in sorted(models, key=lambda name: ORDER.index(name.removeprefix(IDENTIFIED))):
        yield name, robots[name], models[name].corrector(robots[name])


def _transferred(
    target: RobotSpec | None, model: GapModel, nominal: RobotSpec
) -> Iterator[tuple[str, RobotSpec, Corrector | None]]:
    """The same of another simulator, whose gains, where a log says others, change by as much as the nominal ones."""
    if target is None:
        return
    simulator = replace(target, nominal=target.nominal or nominal)
    if model_hash(target) != model_hash(nominal):
        yield "uncorrected", simulator, None
    if model.family is not None:
        yield "member", simulator, model.corrector(simulator)
    yield "transfer", simulator, TransferCorrector(model, simulator)


def _by_unit(
    sequences: list[Sequence],
    model: GapModel,
    simulator: RobotSpec,
    calibrated: dict[str, calibration.Calibration],
    progress: Callable[[int, int], None],
) -> list[Twin]:
    """The model in each unit's own simulator; in the common one where a unit is not calibrated."""
    twins: dict[int, Twin] = {}
    for unit in dict.fromkeys(s.meta.unit_id for s in sequences):
        rows = [i for i, s in enumerate(sequences) if s.meta.unit_id == unit]
        physics = calibrated[unit].robot(simulator) if unit in calibrated else simulator
        part = replay([sequences[i] for i in rows], physics, model.corrector(simulator), lock_idle=True)
        twins |= dict(zip(rows, part, strict=True))
        progress(len(twins), len(sequences))
    return [twins[i] for i in range(len(sequences))]


def _delta_summary(parts: list[Array], sequences: list[Sequence]) -> dict[str, float]:
    """Size of the corrections: mean and largest |Δa| rad, mean rate rad/s."""
    dt = float(np.median([s.dt for s in sequences]))
    return {
        "mean": float(np.mean([np.abs(d).mean() for d in parts])),
        "max": float(max(np.abs(d).max() for d in parts)),
        "rate": float(np.mean([np.abs(np.diff(d, axis=0)).mean() for d in parts]) / dt),
    }
