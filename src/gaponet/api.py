"""What the commands do, as functions: `import gaponet as gp` offers them, and the commands only parse, call and print.

Datasets, runs and robots are given as paths or as what these functions return. Each shows how far it is on stderr.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gaponet.base.errors import DatasetError, NoGainError, UsageError
from gaponet.base.files import FOLDER_MARKER
from gaponet.base.progress import progress_bar, with_note
from gaponet.data.store import Dataset
from gaponet.robot.folder import MOVE_STORED_ROBOT
from gaponet.robot.spec import RobotSpec, load_robot

if TYPE_CHECKING:
    from gaponet.data.doctor import Diagnosis
    from gaponet.data.importer import ImportReport
    from gaponet.data.sequence import Sequence
    from gaponet.nn.adaptation import Adaptation
    from gaponet.nn.artifact import GapModel
    from gaponet.nn.training.config import TrainConfig
    from gaponet.report.evaluate import Evaluation
    from gaponet.sysid.fit import Covariance, Identified
    from gaponet.sysid.uncertainty import ParameterUncertainty

Place = str | Path


def import_logs(
    src: Place,
    robot: RobotSpec | Place,
    out: Place,
    unit_id: str | None = None,
    payload_mass: float | None = None,
    **options: Any,
) -> ImportReport:
    """Read logs into a dataset, with delays and static offsets of the unit; a bad log refuses them all.

    The same call again adds what is missing.

    Args:
        src: File or folder of logs; `gaponet formats` lists what is read.
        robot: The robot that was recorded.
        out: Dataset folder; appended to where it exists.
        unit_id: Which of its kind: any name, the same for all logs of one unit. Needed unless the format states it.
        payload_mass: kg in each hand, 0.0 when empty. Needed unless the format states it.
        options: payload_side, level, fmt, kp, kd, skip_bad, joint_map, logs, position_unit, time_unit, rate, cut,
            allow_pickle, strict, as data.importer.import_logs takes them.

    Raises:
        LogError, JointMismatchError, UsageError, DatasetError: The message says which file and what to do.
    """
    from gaponet.data.importer import import_logs as run
    from gaponet.sim.dynamics import gravity_of
    from gaponet.sim.model import model_hash, require_stored_robot

    spec = robot if isinstance(robot, RobotSpec) else load_robot(robot)
    if Dataset.peek(out, spec) is not None:
        require_stored_robot(Path(out), spec, DatasetError, MOVE_STORED_ROBOT)
    with progress_bar("importing") as update:
        return run(
            src, spec, unit_id, payload_mass, out,
            gravity=gravity_of(spec), simulator=model_hash(spec), progress=update, **options,
        )  # fmt: skip


def doctor(
    dataset: Dataset | Place, robot: RobotSpec | Place | None = None, executor: str | Executor = "local"
) -> Diagnosis:
    """Look through a dataset: order, sign, unit, range, rate, gaps, saturation, stuck channels, lag, sag, torque.

    Args:
        dataset: Recordings; also the address of a dataset that was pushed to a bucket.
        robot: Another robot than the one that the dataset keeps.
        executor: Where recordings are looked at that were not yet, if they are many: as for `pair`.

    Returns:
        verdict, one sentence; findings, worst first; one row of numbers per sequence and per joint.

    Raises:
        DatasetError: The folder is no dataset, or damaged.
    """
    from gaponet.data.doctor import Diagnosis
    from gaponet.sim.dynamics import gravity_of, tips_of
    from gaponet.sim.model import model_hash

    data, spec = _opened(dataset, robot)
    with progress_bar("examining") as update:
        return Diagnosis.of(data, spec, update, gravity_of(spec), tips_of(spec), model_hash(spec), executor)


def pair(dataset: Dataset | Place, robot: RobotSpec | Place | None = None, executor: str | Executor = "local") -> int:
    """Replay every sequence in the nominal simulator and keep the twin beside it; twins already there stay.

    Args:
        dataset: Recordings.
        robot: Another robot than the one that the dataset keeps.
        executor: Where they are replayed: local, ray or ray:ADDRESS (docs/scale.md), or one of concurrent.futures.

    Returns:
        How many twins were made.

    Raises:
        DatasetError, JointMismatchError: The folder is no dataset, or one of another robot.
    """
    from gaponet.sim.replay import pair_dataset

    with progress_bar("replaying") as update:
        return pair_dataset(*_opened(dataset, robot), with_note(update, "control steps"), executor=executor)


def gap(
    dataset: Dataset | Place,
    robot: RobotSpec | Place | None = None,
    motions: tuple[str, ...] = (),
    run: GapModel | Place | None = None,
) -> dict[str, Any]:
    """Measure how far the nominal simulator is from the robot, in whole-motion free run; of an identified one also why.

    Args:
        dataset: Sequences without a twin are replayed first. Also the address of one that was pushed to a bucket.
        robot: Another robot than the one that the dataset keeps. An identified one is taken as `run` is.
        motions: Only these.
        run: A robot folder that identify wrote, or a run of train: what each cause that was identified and the model
            remove, and the floor, on motions that it never saw; kept there as gap.json, .svg and .png.

    Returns:
        methods → nominal (and identified, and the model's) → metrics (mpjae rad, …), and by_joint, by_payload, by_unit,
        by_motion, by_horizon the same; dataset, sequences, hours, virtual, robot, simulator_hash. Of an identified
        robot or a run also what report.gap.gap_by_step says.
    """
    from gaponet.sim.metrics import Run, summary
    from gaponet.sim.model import model_hash

    spec = None if robot is None else robot if isinstance(robot, RobotSpec) else load_robot(robot)
    if run is not None or (spec is not None and spec.nominal is not None):
        from gaponet.report.candidate import Candidate
        from gaponet.report.gap import gap_by_step

        folder = None if run is None else _run(run)
        data, spec = _opened(dataset, spec, folder)
        one = Candidate(spec.folder, spec, None) if folder is None else Candidate.load(folder, spec)
        with progress_bar("gap") as update:
            found = gap_by_step(one, data, motions, update)
        if folder is not None or (one.folder / FOLDER_MARKER).is_file():  # a user's own folder is left as it is
            from gaponet.report.figures.gap_figure import write_gap

            write_gap(found, one.folder, one.kind)
        return found
    data, spec = _opened(dataset, spec)
    _require_commands(data)
    pair(data, spec)
    entries, simulator = data.select(motions), model_hash(spec)
    pairs = (data.pair(e, simulator) for e in entries)
    return {
        "methods": {"nominal": summary((Run.of(p.real, p.sim.qpos, spec) for p in pairs), spec)},
        "dataset": data.path.name,
        "sequences": len(entries),
        "hours": sum(e.rows * e.dt for e in entries) / 3600,
        "virtual": any(e.meta.virtual for e in entries),
        "robot": spec.name,
        "simulator_hash": simulator,
    }


@dataclass(frozen=True)
class Identification:
    """The identified robot, and its error on validation motions.

    Attributes:
        found: Robot with identified servos, window RMS before and after [rad], warnings.
        val: Mean |error| of each whole validation motion, (motions,) rad: nominal, identified.
        seconds: What the fit took.
    """

    found: Identified
    val: dict[str, np.ndarray]
    seconds: float

    @property
    def val_mpjae(self) -> dict[str, float]:
        """Means over the validation motions, rad."""
        return {name: float(errors.mean()) for name, errors in self.val.items()}


def identify(
    dataset: Dataset | Place,
    out: Place,
    windows: int = 40,
    robot: RobotSpec | Place | None = None,
    units: tuple[str, ...] = (),
    holdout_units: tuple[str, ...] = (),
    terms: tuple[str, ...] = ("stribeck", "load"),
    table: bool = True,
    shared: bool = False,
    threads: int = 0,
    budget: str | None = None,
    stops: bool = False,
) -> Identification:
    """Fit the servos of the simulator, and what the robot touches, to the training motions.

    What is written follows the validation motions better than the robot as it was given; where nothing does, nothing is
    written.

    Recordings made with several gains are fitted together, each in a simulator of its own gains.

    Args:
        dataset: Recordings: a folder, or the address of one that was pushed to a bucket.
        out: Robot folder to write; train(…, robot=out) starts from it.
        windows: Free runs of 8 s that are fitted, taken evenly from the training motions.
        robot: Where to start, if not from the one that the dataset keeps.
        units: Only these, pooled: one set of parameters for all of them; default: every unit not held out.
        holdout_units: Units to leave out, as in training.
        terms: Which terms of the servo's law; each is kept where validation motions say so.
        table: Look for a table under the robot's tips ([[tip]] in robot.toml); kept in the same way.
        shared: Give joints with one type of servo ([[servo]] in robot.toml) one law; what it costs is said.
        threads: 0 for all cores.
        budget: Time such as 60s or 4m that the searches may take, the table's apart; default as long as it takes.
        stops: Give joints that stayed behind several commands a stop there; else they are asked about.

    Raises:
        DatasetError, UsageError: A unit is not there.
        NoGainError: Nothing that was fitted does better; it names the joints and what to record.
    """
    from gaponet.base.files import lock_folder, write_json
    from gaponet.data.split import split_entries
    from gaponet.nn.training.budget import Budget
    from gaponet.robot.folder import PROVENANCE_FILE, save_robot
    from gaponet.sim.replay import whole_errors
    from gaponet.sysid.fit import BETTER
    from gaponet.sysid.identify import identify as fit

    data, spec = _opened(dataset, robot)
    data.require_robot(spec)
    _require_commands(data)
    held = {e.meta.unit_id for e in data.entries}
    if set(units) - held:
        raise UsageError(f"--units {min(set(units) - held)}: not in {data.path}")
    parts = split_entries(data, tuple(sorted((held - set(units) if units else set()) | set(holdout_units))))
    began, val = time.monotonic(), data.sequences(parts["val"])
    seconds = None if budget is None else Budget.parse(budget).seconds
    if budget is not None and seconds is None:
        raise UsageError(f"--budget {budget}: give a time such as 60s or 4m")
    with lock_folder(Path(out), "robot"), progress_bar("identifying") as update:
        found = fit(
            data.sequences(parts["train"]), spec, val, windows, terms, table, shared, threads, update, seconds, stops
        )
        given, left = (whole_errors(val, one, threads) for one in (spec, found.judged or found.robot))
        if not found.better or left.mean() > (1 - BETTER) * given.mean():
            raise NoGainError(found.no_gain(spec, given, left))
        save_robot(found.robot, Path(out))
        nominal = given if spec.nominal is None else whole_errors(val, spec.nominal, threads)
        val_errors = {"nominal": nominal, "identified": left}
        write_json(Path(out) / PROVENANCE_FILE, {
            "dataset": data.address or os.path.relpath(data.path, out),
            "parts": {part: {e.id: e.hash for e in entries} for part, entries in parts.items()},
            "motions": {part: sorted({e.meta.motion for e in entries}) for part, entries in parts.items()},
            "val_mpjae": {name: float(e.mean()) for name, e in val_errors.items()},
        })  # fmt: skip
        _keep_known(Path(out), data.sequences(parts["train"]), val, found.covariance, None, found.judged)
    return Identification(found, val_errors, time.monotonic() - began)


def _keep_known(
    folder: Path, sequences: list[Sequence], judges: list[Sequence], covariance: Covariance,
    before: ParameterUncertainty | None, judged: RobotSpec | None = None,
) -> None:  # fmt: skip
    """Write how sure a robot folder's values are."""
    from gaponet.robot.folder import OLD_UNCERTAINTY_FILE, UNCERTAINTY_FILE
    from gaponet.sysid.evidence import estimate_uncertainty

    for name in (UNCERTAINTY_FILE, OLD_UNCERTAINTY_FILE):
        (folder / name).unlink(missing_ok=True)
    estimate_uncertainty(load_robot(folder), sequences, judges, covariance, before, judged).save(folder)


def train(
    dataset: Dataset | Place,
    out: Place,
    budget: str = "10m",
    config: TrainConfig | None = None,
    model: str | None = None,
    robot: RobotSpec | Place | None = None,
    holdout_units: tuple[str, ...] = (),
    resume: bool = False,
    log: tuple[str, ...] = (),
) -> GapModel:
    """Train a delta-action model; the run keeps the one that is best on whole validation motions in free run.

    Ctrl-C ends training and leaves a usable run. Under torchrun all its processes train one model
    (nn/training/ranks.py).

    Args:
        dataset: Recordings: a folder, or the address of one that was pushed to a bucket.
        out: Run folder.
        budget: Time such as 90s, 10m or 2h, or control steps such as 2000000.
        config: Everything else (nn.training.config); default TrainConfig().
        model: gaponet, paper (the paper's literal network), or a baseline: shared_mlp, mlp, inverse;
            default that of the config.
        robot: Another robot than the one that the dataset keeps, e.g. the folder that identify wrote.
        holdout_units: Units never trained on; their test motions stay in the test part.
        resume: Go on with the run in out.
        log: tensorboard, wandb.

    Returns:
        The exported model; RUN/model holds it.

    Raises:
        ModelError: The budget bought no training step.
        DatasetError, UsageError: The recordings, the config or the folder do not fit; the message says what.
    """
    from gaponet.base.files import lock_folder
    from gaponet.nn.training import ranks
    from gaponet.nn.training.budget import Budget
    from gaponet.nn.training.config import TrainConfig
    from gaponet.nn.training.trainer import Trainer

    config = config or TrainConfig()
    config = replace(config, model=replace(config.model, kind=model)) if model else config  # type: ignore[arg-type]
    with (
        ranks.joined(config.device),
        ranks.on_first(lock_folder(Path(out), "run")),
        ranks.on_first(progress_bar(f"training {config.model.kind}")) as update,
    ):
        data, spec = _opened(dataset, robot)
        _require_commands(data)
        show = lambda status: update and update(status.fraction, 1.0, status.note)  # noqa: E731
        return Trainer(data, spec, Path(out), config, Budget.parse(budget), resume, holdout_units, show, log).run()


def evaluate(
    run: GapModel | Place,
    dataset: Dataset | Place,
    also: tuple[Place, ...] = (),
    motions: tuple[str, ...] = (),
    robot: RobotSpec | Place | None = None,
    units: tuple[str, ...] = (),
) -> Evaluation:
    """Step simulators through logs they never saw: nominal, identified, and with the shipped model on top.

    Args:
        run: Robot folder that identify wrote; or run folder, or what train returned. The result is kept in it.
        dataset: The dataset trained on (its test motions are used) or another.
        also: Further runs to compare, e.g. the MLP's.
        motions: Only these.
        robot: Another robot than the one that the dataset keeps. If it is not the simulator that the run was trained
            in, it is shown as it is, and with the run transferred into it (deploy/transfer.py).
        units: Only recordings of these, such as the one held out from training.

    Raises:
        DatasetError, ModelError: A recording is not there or was used in training, a model fits another robot, or
            transfer was never measured so far from the simulator of the run.
    """
    from gaponet.report import evaluate as measuring
    from gaponet.report.candidate import is_robot
    from gaponet.robot.folder import has_stored_robot, load_stored_robot
    from gaponet.sim.model import model_hash

    folder = _run(run)
    data, spec = _opened(dataset, robot, folder)
    target, kept = None, spec
    if robot is not None and (is_robot(folder) or has_stored_robot(folder)):
        kept = load_robot(folder) if is_robot(folder) else load_stored_robot(folder, spec.name)
    if model_hash(kept) != model_hash(spec):
        target, spec = spec, kept.nominal or kept
    with progress_bar("evaluating") as update:
        found = measuring.evaluate([folder, *map(Path, also)], data, spec, motions, update, target, units)
    found.save(folder)
    return found


def adapt_model(
    run: GapModel | Place,
    dataset: Dataset | Place,
    unit: str = "",
    motions: tuple[str, ...] = (),
    seconds: float = 30.0,
    unknown_payload: bool = False,
    robot: RobotSpec | Place | None = None,
    mixed_gains: bool = False,
) -> Adaptation:
    """Fit what is particular to one unit from a short log: gain, damping, friction, zero offset, delay of each joint.

    The trained model stays as it is; the run keeps the adaptation beside it, and evaluate shows the unit with it too.

    Args:
        run: Run folder, or what train returned.
        dataset: Recordings of the unit, perhaps among others.
        unit: Which one, where the dataset holds several.
        motions: Only these; default: those that the run was trained on, so that its test motions stay unseen, or all,
            where the unit played none of them.
        seconds: How much of the recordings to use, in windows of 8 s.
        unknown_payload: Do not believe the recordings' payload, estimate it too; all must carry the same.
        robot: Another robot than the one that the dataset keeps.
        mixed_gains: Take recordings made with different kp or kd together.

    Raises:
        UsageError, ModelError: The unit is not named, or the model fits another robot.
    """
    from gaponet.data.sequence import require_same_gains
    from gaponet.nn.adaptation import Adaptation
    from gaponet.nn.artifact import GapModel
    from gaponet.report.candidate import corrected_robot

    folder = _run(run)
    data, spec = _opened(dataset, robot, folder)
    data.require_robot(spec)
    model, simulator = GapModel.load(folder), corrected_robot(folder, spec)
    entries = Adaptation.recordings(data, model, unit, motions)
    if not mixed_gains:
        require_same_gains((e.meta for e in entries), data.joint_names, spec.operated)
    with progress_bar("adapting") as update:
        found = Adaptation.fit(
            model, simulator, data.sequences(entries), seconds, unknown_payload,
            lambda done, total, rms: update(done, total, f"window RMS {rms * 1e3:.2f} mrad"),
        )  # fmt: skip
    found.save(folder)
    return found


@dataclass(frozen=True)
class AdaptedRobot:
    """A robot folder that was fitted to one unit.

    Attributes:
        robot: The robot with the unit's servos; its nominal robot is the given one's.
        unit: The unit whose recordings they were.
        errors: Mean |error| of each whole recording, (recordings,) rad: before, after.
        payload_mass, payload_std: kg in each hand that carries, and its standard error, where it was asked for.
    """

    robot: RobotSpec
    unit: str
    errors: dict[str, np.ndarray]
    payload_mass: float | None
    payload_std: float | None


def adapt_robot(
    robot: RobotSpec | Place,
    source: Dataset | Place,
    out: Place,
    unit: str = "",
    motions: tuple[str, ...] = (),
    seconds: float = 30.0,
    unknown_payload: bool = False,
    payload_mass: float | None = None,
) -> AdaptedRobot:
    """Fit what is particular to one unit to a short log: a robot folder in, a robot folder out, no model.

    The same fit as `adapt`: what the log does not show stays as it was known.

    Args:
        robot: What is known: the folder that identify wrote, or a nominal one.
        source: A dataset, or logs that gaponet import reads.
        out: Robot folder to write.
        unit: Which one, where the dataset holds several.
        motions: Only these.
        seconds: How much of the recordings to fit, in windows of 8 s; all of them judge.
        unknown_payload: Do not believe the recordings' payload, estimate it too; all must carry the same.
        payload_mass: kg in each hand, of logs whose format does not state it.

    Raises:
        UsageError: The unit is not named.
        NoGainError: The fit does not follow the recordings, or motions that it was not given, better than the robot as
            it was known; nothing is written.
    """
    from gaponet.base.files import lock_folder, write_text
    from gaponet.robot.folder import PROVENANCE_FILE, save_robot
    from gaponet.sim.replay import whole_errors
    from gaponet.sysid.fit import BETTER
    from gaponet.sysid.refit import refit
    from gaponet.sysid.uncertainty import ParameterUncertainty

    spec = robot if isinstance(robot, RobotSpec) else load_robot(Path(robot) if "/" in str(robot) else robot)
    before_known = ParameterUncertainty.load(spec)
    with (
        lock_folder(Path(out), "robot"),
        unit_recordings(source, spec, unit, motions, payload_mass) as (unit, sequences),
    ):
        believed = all(s.meta.known_gains[1] is not None for s in sequences)
        with progress_bar("adapting") as update:
            found = refit(
                sequences, spec, seconds, unknown_payload, None,
                lambda done, total, rms: update(done, total, f"window RMS {rms * 1e3:.2f} mrad"), believed,
                judge=not unknown_payload,
            )  # fmt: skip
        if not found.kept:
            before, after = (1e3 * float(e.mean()) if len(e) else 0.0 for e in found.judged)
            told = f"leaves {after:.2f} mrad of {before:.2f}" if before else "is all there is of each joint"
            raise NoGainError(
                f"nothing is written: a motion that the fit does not see {told}, so keep {spec.name} as it is known; "
                "or give motions that ask more of each joint"
            )
        if found.payload_mass is not None:
            mass = float(found.payload_mass)
            sequences = [replace(s, meta=replace(s.meta, payload_mass=mass)) for s in sequences]
        errors = {name: whole_errors(sequences, r) for name, r in (("before", spec), ("after", found.robot))}
        before, after = (1e3 * float(e.mean()) for e in errors.values())
        if after > (1 - BETTER) * before:
            raise NoGainError(
                f"nothing is written: over all {len(sequences)} recording(s) the fit leaves {after:.2f} mrad, "
                f"{spec.name} as it is known {before:.2f}; give longer logs (--seconds), or keep the robot as it is"
            )
        save_robot(found.robot, Path(out))
        if (spec.folder / PROVENANCE_FILE).is_file():  # which motions identification saw is still to be known
            write_text(Path(out) / PROVENANCE_FILE, (spec.folder / PROVENANCE_FILE).read_text(encoding="utf-8"))
        _keep_known(Path(out), sequences, [], {}, before_known)
    return AdaptedRobot(found.robot, unit, errors, found.payload_mass, found.payload_std)


@contextmanager
def unit_recordings(
    source: Dataset | Place,
    robot: RobotSpec,
    unit: str = "",
    motions: tuple[str, ...] = (),
    payload_mass: float | None = None,
) -> Iterator[tuple[str, list[Sequence]]]:
    """One unit's recordings from a dataset, or from logs that are imported for as long as they are needed.

    Args:
        source: A dataset, or logs that gaponet import reads.
        unit: Which one, where there are several.
        motions: Only these.
        payload_mass: kg in each hand, of logs whose format does not state it.

    Yields:
        The unit's id and its recordings.

    Raises:
        UsageError: The unit is not there, or there are several and none is named.
    """
    with tempfile.TemporaryDirectory() as place:
        if isinstance(source, (str, Path)) and Path(source).exists() and not (Path(source) / "dataset.json").is_file():
            data = import_logs(source, robot, Path(place) / "data", unit or None, payload_mass).dataset
        else:
            data, _ = _opened(source, robot)
        data.require_robot(robot)
        units = sorted({e.meta.unit_id for e in data.entries})
        if unit not in units and (unit or len(units) != 1):
            raise UsageError(f"--unit {unit or '(none)'}: {source} holds units {', '.join(units)}; name one")
        unit = unit or units[0]
        yield unit, data.sequences([e for e in data.select(motions) if e.meta.unit_id == unit])


def _opened(
    dataset: Dataset | Place, robot: RobotSpec | Place | None, run: Path | None = None
) -> tuple[Dataset, RobotSpec]:
    from gaponet.share.reading import open_dataset

    return open_dataset(dataset, robot, run)


def _require_commands(data: Dataset) -> None:
    """Refuse recordings in which no position was commanded: the measured ones stand there again."""
    first = data.read(data.entries[0]) if data.entries else None
    if first is not None and np.array_equal(first.ctrl, first.qpos) and np.ptp(first.qpos):
        raise UsageError(
            f"{data.path}: no position was commanded, so there is nothing to follow; this robot is driven by torque: "
            f"gaponet torque {data.path} --out ROBOT fits its friction, inertia and delay, and says how far it is"
        )


def _run(run: GapModel | Place) -> Path:
    """The folder of a run; a model of training lies in it."""
    if isinstance(run, (str, Path)):
        return Path(run)
    return run.path.parent if run.path.name == "model" else run.path
