"""Fits to recordings: identify, train, adapt_robot, adapt_model."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from collections.abc import Sequence as ListOf
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gaponet.api.logs import unit_recordings
from gaponet.api.opening import (
    Place,
    as_robot,
    as_run,
    entries_of_unit,
    open_dataset,
    require_commands,
)
from gaponet.api.options import IdentifyOptions, TrainOptions
from gaponet.api.results import AdaptResult, IdentifyResult, TorqueResult, TrainResult
from gaponet.base.errors import NoGainError, UsageError
from gaponet.base.files import write_json
from gaponet.base.progress import Progress, no_progress
from gaponet.data.store import Dataset
from gaponet.nn.config import ModelKind as ModelKind
from gaponet.nn.packaged_networks import require_run_folder
from gaponet.robot.finding import abbreviate
from gaponet.robot.folder import (
    ADAPTATION_FILE,
    OLD_UNCERTAINTY_FILE,
    PROVENANCE_FILE,
    UNCERTAINTY_FILE,
    dataset_seen_from,
)
from gaponet.robot.spec import RobotSpec, load_robot

if TYPE_CHECKING:
    from gaponet.base.arrays import Array
    from gaponet.data.checks.gate import GateReport
    from gaponet.data.sequence import Sequence
    from gaponet.data.store import Entry
    from gaponet.nn.artifact import GapModel
    from gaponet.nn.training.config import Status, TrainConfig
    from gaponet.sysid.acceptance import Covariance, HeldOut, Identified
    from gaponet.sysid.adapt import Adapted
    from gaponet.sysid.uncertainty import ParameterUncertainty

# Files of an earlier robot in the same folder, which do not describe the new one.
OUTDATED_FILES = (PROVENANCE_FILE, ADAPTATION_FILE, UNCERTAINTY_FILE, OLD_UNCERTAINTY_FILE)
JUDGED_AFTER_S = 0.5  # time from a recorded state to the error that judges a torque-driven fit
MIN_MOTIONS_TO_SPLIT = 3  # with fewer motions, halves of the recordings fit and validate in turn


def identify(
    dataset: Dataset | Place,
    *,
    out: Place,
    robot: RobotSpec | Place | None = None,
    options: IdentifyOptions = IdentifyOptions(),  # noqa: B008
    progress: Progress = no_progress,
) -> IdentifyResult:
    """Fit the servos of the simulator, and the table under the robot, to the training motions.

    A robot folder is written if motions that were not fitted are followed better than by the given
    robot; otherwise nothing is. Where fewer than three motions validate a set of joints,
    cross-validation over motions decides, and the robot is then fitted to all of them. Recordings
    made with several gains are fitted together, each in a simulator with its own gains. If all
    state the same gains, the robot folder has these.

    Args:
        dataset: Recordings, a folder.
        out: Robot folder to write; `train(…, robot=out)` starts from it.
        robot: Start of the fit, if not the robot that the dataset keeps.
        options: What is fitted, to which units, and within which time.

    Raises:
        DatasetError: The doctor finds an error in the recordings of the units that are fitted.
        DatasetError, UsageError: A unit is not there, or `options.like` has no joint that
            corresponds.
        NoGainError: Nothing that was fitted does better; it names the joints and what to record.
    """
    from gaponet.base.files import lock_folder
    from gaponet.data.checks.gate import pass_gate, used_recordings
    from gaponet.data.split import split_entries
    from gaponet.robot.folder import require_other_folder
    from gaponet.sysid.identify import identify as fit
    from gaponet.sysid.servo_types import servos_like

    began = time.monotonic()
    folder = Path(out)
    data, spec = open_dataset(dataset, robot)
    data.require_robot(spec)
    data.require_sequences()
    require_commands(data)
    split = split_entries(data, _units_left_out(data, options))
    spec = _with_recorded_gains(spec, data)
    _require_gains(spec)
    start = spec
    taken_from: dict[str, str] = {}
    if options.like is not None:
        start, taken_from = servos_like(spec, as_robot(options.like))
    searches = options.searches()
    require_other_folder(folder, spec)
    train_set = data.sequences(split["train"])
    val_set = data.sequences(split["val"])
    with lock_folder(folder, "robot"):
        gate = pass_gate(
            data,
            used_recordings(data, split),
            spec,
            despite_errors=options.despite_errors,
            progress=progress,
        )
        fitted = fit(train_set, start, val_set, searches, progress)
        errors = _require_gain(fitted, spec, accepted=bool(taken_from))
        origin = _origin(folder, data, split, errors, gate, spec, fitted.findings)
        _write_identified(folder, fitted, train_set, val_set, origin)
    return IdentifyResult(
        robot=fitted.robot,
        folder=folder,
        errors=errors,
        fit=fitted,
        seconds=time.monotonic() - began,
        taken_from=taken_from,
        doctor=gate,
    )


def _units_left_out(data: Dataset, options: IdentifyOptions) -> tuple[str, ...]:
    """Return the units of a dataset that are not fitted.

    Raises:
        UsageError: A unit is not there.
    """
    present = {entry.meta.unit_id for entry in data.entries}
    wanted = set(options.units)
    unknown = wanted - present
    if unknown:
        raise UsageError(f"--units {min(unknown)}: not in {data.path}")
    left_out = set(options.holdout_units)
    if wanted:
        left_out |= present - wanted
    return tuple(sorted(left_out))


def _with_recorded_gains(robot: RobotSpec, data: Dataset) -> RobotSpec:
    """Return the robot with the gains of the recordings, if all state the same."""
    gains = {entry.meta.recorded_gains for entry in data.entries}
    if len(gains) != 1:
        return robot
    kp, kd = gains.pop()
    return robot.with_gains(kp, kd)


def _require_gains(robot: RobotSpec) -> None:
    """Refuse operated joints without a gain, whose commands move nothing."""
    without = [j for j in robot.operated if robot.servo.kp[robot.index([j])[0]] <= 0]
    if without:
        raise UsageError(
            f"{robot.folder}: kp of {abbreviate(without)} is 0, so commands move nothing: write "
            "the controller's kp in robot.toml, or operated = false"
        )


def _require_gain(fitted: Identified, given: RobotSpec, *, accepted: bool) -> dict[str, Array]:
    """Return nominal and identified → mean |error| of each motion that was not fitted, (motions,)
    rad.

    Args:
        given: The robot before the fit.
        accepted: The start of the fit counts as fitted: its servos are another robot's.

    Raises:
        NoGainError: The fitted robot is no better than the given one.
    """
    from gaponet.sim.metrics import MIN_RELATIVE_GAIN
    from gaponet.sysid.acceptance import held_out_errors

    after = held_out_errors(fitted.held_out)
    before = _errors_of_robot(fitted.held_out, given)
    least = (1 - MIN_RELATIVE_GAIN) * before.mean()
    if after.mean() > least or not (fitted.improved or accepted):
        raise NoGainError(fitted.no_gain_message(given, before, after))
    nominal = _errors_of_robot(fitted.held_out, given.before_identification)
    return {"nominal": nominal, "identified": after}


def _errors_of_robot(folds: ListOf[HeldOut], robot: RobotSpec) -> Array:
    """Return the mean |error| of each held-out motion in rollouts of one robot, (motions,) rad."""
    from gaponet.sysid.acceptance import HeldOut, held_out_errors

    return held_out_errors(HeldOut(fold.sequences, robot) for fold in folds)


def _write_identified(
    folder: Path,
    fitted: Identified,
    train_set: list[Sequence],
    val_set: list[Sequence],
    origin: dict[str, Any],
) -> None:
    """Write the robot folder of an identification, whole or not at all."""
    from gaponet.base.files import whole_folder
    from gaponet.export.plain_servos import keep_plain_servos
    from gaponet.robot.folder import save_robot
    from gaponet.sysid.uncertainty import LinkUncertainty

    fitted_to_all = fitted.held_out[0].robot is not fitted.robot
    with whole_folder(folder, "robot", "robot.toml", OUTDATED_FILES) as place:
        save_robot(fitted.robot, place)
        if fitted.without_terms is not None:
            keep_plain_servos(place, fitted.without_terms, train_set)
        write_json(place / PROVENANCE_FILE, origin)
        judges = fitted.held_out if fitted_to_all else ()
        made = _uncertainty(place, train_set, val_set, fitted.covariance, held_out=judges)
        links = LinkUncertainty.of(fitted.links, load_robot(place), made.fields)
        replace(made, links=links).save(place)


def identify_torque(
    dataset: Dataset | Place,
    *,
    out: Place,
    current: bool = False,
    robot: RobotSpec | Place | None = None,
    despite_errors: bool = False,
) -> TorqueResult:
    """Fit friction, inertia and delay of a robot that is driven by torque.

    The fit is measured on recordings that were not fitted: the error of the simulator some time
    after a recorded state, with the recorded torque as its input. A robot folder is written only if
    that error falls.

    Args:
        dataset: Recordings with the torque (tau) of every operated joint. Where no position was
            commanded, logs.toml names the position's column for ctrl too.
        out: Robot folder to write.
        current: The recorded torque is a current, or its constant is unknown: fit N·m per unit too.
        robot: Start of the fit, if not the robot that the dataset keeps.
        despite_errors: Go on although the doctor finds an error in the recordings; the result keeps
            the errors.

    Raises:
        DatasetError: The doctor finds an error in the recordings.
        UsageError: A recording lacks torque.
        NoGainError: The fit is no better than the robot as given.
    """
    from gaponet.base.files import lock_folder, whole_folder
    from gaponet.data.checks.gate import TORQUE_DRIVEN_CHECKS, pass_gate
    from gaponet.robot.folder import require_other_folder, save_robot
    from gaponet.sysid.torque_motors import fit_torque_driven

    data, spec = open_dataset(dataset, robot)
    data.require_robot(spec)
    folder = Path(out)
    split = _split_or_all(data)
    train_set = data.sequences(split["train"])
    require_other_folder(folder, spec)
    with lock_folder(folder, "robot"):
        gate = pass_gate(
            data, data.entries, spec, despite_errors=despite_errors, checks=TORQUE_DRIVEN_CHECKS
        )
        val_set = train_set if split["val"] is split["train"] else data.sequences(split["val"])
        fitted = fit_torque_driven(train_set, val_set, spec, current)
        by_joint_before, by_joint_after = fitted.angle[JUDGED_AFTER_S]
        before = float(np.mean(by_joint_before))
        after = float(np.mean(by_joint_after))
        if not after < before:
            raise NoGainError(
                f"nothing is written: half a second on, the error is {1e3 * after:.2f} mrad with "
                f"the fit and {1e3 * before:.2f} mrad with {spec.name} as given"
            )
        errors = {"nominal": np.array([before]), "identified": np.array([after])}
        origin = _origin(folder, data, split, errors, gate, spec)
        with whole_folder(folder, "robot", "robot.toml", OUTDATED_FILES) as place:
            save_robot(fitted.robot, place)
            write_json(place / PROVENANCE_FILE, origin)
    return TorqueResult(
        robot=fitted.robot,
        folder=folder,
        before=before,
        after=after,
        fit=fitted,
        virtual=any(entry.meta.virtual for entry in data.entries),
        doctor=gate,
    )


def _split_or_all(data: Dataset) -> dict[str, list[Entry]]:
    """Return the split of a dataset; with few motions all recordings both fit and validate."""
    from gaponet.data.split import split_entries

    motions = {entry.meta.motion for entry in data.entries}
    if len(motions) < MIN_MOTIONS_TO_SPLIT:
        return {"train": data.entries, "val": data.entries, "test": []}
    return dict(split_entries(data, ()))


def _origin(
    folder: Path,
    data: Dataset,
    split: Mapping[str, ListOf[Entry]],
    errors: Mapping[str, Array],
    gate: GateReport,
    start: RobotSpec,
    findings: ListOf[str] = (),
) -> dict[str, Any]:
    """Return what a robot folder was identified from: dataset, recordings and motions by split,
    mean validation errors, what the doctor found, and what the fit found.

    What `start` was identified from, if it was, counts as fitted, too.
    """
    from gaponet.evaluation.candidate import fitted_to, read_origin

    parts = {}
    motions = {}
    for name, entries in split.items():
        parts[name] = {entry.id: entry.hash for entry in entries}
        motions[name] = sorted({entry.meta.motion for entry in entries})
    earlier = read_origin(start.folder) if start.is_identified else None
    before = {} if earlier is None else {"also_fitted": fitted_to(earlier)}
    return {
        "dataset": os.path.relpath(data.path, folder),
        "parts": parts,
        "motions": motions,
        **before,
        "val_mpjae": {name: float(values.mean()) for name, values in errors.items()},
        "findings": list(findings),
        "doctor": gate.to_dict(),
    }


def _origin_of_adapted(
    source: Path, folder: Path, adapted: ListOf[Sequence]
) -> dict[str, Any] | None:
    """Return from which recordings the robot of `source` was identified, and to which the one of
    `folder` was adapted; None if the former is not stated.
    """
    from gaponet.evaluation.candidate import read_origin

    origin = read_origin(source)
    if origin is None:
        return None
    also = origin.get("also_fitted", {"hashes": (), "motions": ()})
    hashes = {*also["hashes"], *(sequence.content_hash() for sequence in adapted)}
    return dict(origin) | {
        "dataset": dataset_seen_from(folder, source, origin["dataset"]),
        "also_fitted": {"hashes": sorted(hashes), "motions": list(also["motions"])},
    }


def _uncertainty(
    folder: Path,
    sequences: list[Sequence],
    validation: list[Sequence],
    covariance: Covariance,
    before: ParameterUncertainty | None = None,
    held_out: ListOf[HeldOut] = (),
) -> ParameterUncertainty:
    """Return the parameter uncertainty of the robot in a folder, where that of an earlier robot is
    removed.
    """
    from gaponet.sysid.evidence.evidence import estimate_uncertainty

    for name in (UNCERTAINTY_FILE, OLD_UNCERTAINTY_FILE):
        (folder / name).unlink(missing_ok=True)
    robot = load_robot(folder)
    return estimate_uncertainty(robot, sequences, validation, covariance, before, held_out)


def train(
    dataset: Dataset | Place,
    *,
    out: Place,
    budget: str = "10m",
    config: TrainConfig | None = None,
    robot: RobotSpec | Place | None = None,
    options: TrainOptions = TrainOptions(),  # noqa: B008
    progress: Progress = no_progress,
) -> TrainResult:
    """Train a delta-action model; the run keeps the model with the least error in rollouts of
    validation motions.

    Ctrl-C ends training and leaves a usable run.

    Args:
        dataset: Recordings, a folder.
        out: Run folder.
        budget: Time such as 90s, 10m or 2h, or control steps such as 2000000.
        config: Numbers of the training and of the network; default `TrainConfig()`.
        robot: Another robot than the one that the dataset keeps, e.g. the folder that `identify`
            wrote.
        options: Kind of network, units that are held out, and what happens to the run.

    Returns:
        The exported model; RUN/model holds it.

    Raises:
        ModelError: The budget bought no training step.
        DatasetError: The doctor finds an error in the recordings of the units that train or
            validate.
        DatasetError, UsageError: The recordings, the config or the folder do not fit; the message
            says what.
    """
    from gaponet.base.files import lock_folder
    from gaponet.data.checks.gate import pass_gate, used_recordings
    from gaponet.nn.training.config import Budget, TrainConfig
    from gaponet.nn.training.run_folder import training_splits
    from gaponet.nn.training.selection import candidate_errors, train_best
    from gaponet.nn.training.trainer import Trainer

    config = config or TrainConfig()
    whole = Budget.parse(budget)
    folder = Path(out)
    shared: dict[str, Any] = {}  # what the trainings of several networks compute once
    with lock_folder(folder, "run"):
        data, spec = open_dataset(dataset, robot)
        require_commands(data)
        entries = used_recordings(data, training_splits(data, config, options.holdout_units))
        gate = pass_gate(data, entries, spec, despite_errors=options.despite_errors)

        def train_network(
            kind: ModelKind, run: Path, share: float, spent: float, resume: bool
        ) -> GapModel:
            """Train a network with a share of the budget, after another share was spent."""

            def show(status: Status) -> None:
                progress(spent + share * status.fraction, 1.0, f"{kind}: {status.note}")

            trainer = Trainer(
                data,
                spec,
                run,
                replace(config, model=replace(config.model, kind=kind)),
                whole.part(share),
                resume=resume,
                holdout_units=options.holdout_units,
                show=show,
                log=options.log,
                shared=shared,
                gate=gate,
            )
            return trainer.run()

        if options.model == "auto":
            trained = train_best(folder, options.resume, train_network)
        else:
            kind = options.model or config.model.kind
            trained = train_network(kind, folder, 1.0, 0.0, options.resume)
    return TrainResult(
        model=trained, card=trained.card, doctor=gate, candidates=candidate_errors(folder)
    )


def adapt_model(
    run: GapModel | Place,
    dataset: Dataset | Place,
    *,
    unit: str = "",
    motions: tuple[str, ...] = (),
    seconds: float = 30.0,
    robot: RobotSpec | Place | None = None,
    mixed_gains: bool = False,
    despite_errors: bool = False,
    progress: Progress = no_progress,
) -> AdaptResult:
    """Fit the servo parameters of one unit under a trained model, to a short log.

    Gain, damping, friction, zero offset and delay of each joint are fitted. The model stays as it
    is. The run keeps the result, and `evaluate` then shows the unit with it too.

    Args:
        run: Run folder, or a trained model.
        dataset: Recordings of the unit, perhaps among others.
        unit: Unit to adapt to. Needed if the dataset holds several.
        motions: Use only these motions. Default for a run: those that it was trained on, so that
            its test motions stay unseen, or all if the unit played none of them.
        seconds: How much of the recordings is fitted, s, in pieces of 8 s.
        robot: Another robot than the one that the dataset keeps.
        mixed_gains: For a run: fit recordings with different kp or kd together.
        despite_errors: Go on although the doctor finds an error in the recordings. The result then
            contains the error.

    Raises:
        DatasetError: The doctor finds an error in the recordings of the unit.
        UsageError, ModelError: The unit is not named, or the model fits another robot.
    """
    from gaponet.data.checks.gate import pass_gate
    from gaponet.data.sequence import require_same_gains
    from gaponet.evaluation.candidate import corrected_robot
    from gaponet.nn.adaptation import Adaptation
    from gaponet.nn.artifact import GapModel

    folder = as_run(run)
    require_run_folder(
        folder,
        "an adaptation",
        f"copy it with gaponet export {folder.name} --to onnx --out FOLDER and adapt the copy",
    )
    data, spec = open_dataset(dataset, robot, folder)
    data.require_robot(spec)
    model = GapModel.load(folder)
    simulator = corrected_robot(folder, spec)
    _, entries = entries_of_unit(data, unit, motions)
    gate = pass_gate(data, entries, spec, despite_errors=despite_errors)
    if not motions:
        trained_on = model.card["motions"]["train"]
        entries = [e for e in entries if e.meta.motion in trained_on] or entries
    if not mixed_gains:
        require_same_gains((e.meta for e in entries), data.joint_names, spec.operated)
    sequences = data.sequences(entries)
    fitted = Adaptation.fit(model, simulator, sequences, seconds, _window_rms(progress))
    fitted = replace(fitted, doctor=gate.to_dict())
    fitted.save(folder)
    servos = {}
    for joint, values in fitted.servos.items():
        servos[joint] = {str(name): value for name, value in values.items()}
    return AdaptResult(
        unit_id=fitted.unit_id,
        servos=servos,
        before=fitted.before,
        after=fitted.after,
        robot=None,
        folder=folder,
        recordings=len(entries),
        doctor=gate,
    )


def adapt_robot(
    robot: RobotSpec | Place,
    source: Dataset | Place,
    *,
    out: Place,
    unit: str = "",
    motions: tuple[str, ...] = (),
    seconds: float = 30.0,
    payload_mass: float | None = None,
    despite_errors: bool = False,
    progress: Progress = no_progress,
) -> AdaptResult:
    """Fit the servo parameters of one unit on one day to a short log: a robot folder in, a robot
    folder out.

    Parameters that the log does not determine keep their values.

    Args:
        robot: The folder that `identify` wrote, or a nominal robot.
        source: A dataset, or logs that `import_logs` reads.
        out: Robot folder to write.
        unit: Unit to adapt to, or name of the robot in the logs. Needed if the dataset holds
            several units, or if the logs state none.
        motions: Use only these motions. Default: all of the unit.
        seconds: Duration of the recordings to fit, in windows of 8 s; all of them are used for
            validation.
        payload_mass: Payload in each hand, kg. Needed for logs that do not state it.
        despite_errors: Go on although the doctor finds an error in the recordings; the result keeps
            the errors.

    Raises:
        DatasetError: The doctor finds an error in the recordings.
        UsageError: The unit is not named.
        NoGainError: The fit does not follow the recordings, or motions that it was not given,
            better than the given robot; nothing is written.
    """
    from gaponet.base.files import lock_folder
    from gaponet.data.checks.gate import pass_gate
    from gaponet.robot.folder import require_other_folder
    from gaponet.sysid.adapt import FIELDS, adapt
    from gaponet.sysid.uncertainty import ParameterUncertainty

    folder = Path(out)
    if isinstance(robot, str) and "/" in robot:
        robot = Path(robot)
    spec = as_robot(robot)
    require_other_folder(folder, spec)
    uncertainty = ParameterUncertainty.load(spec)
    with (
        lock_folder(folder, "robot"),
        unit_recordings(source, spec, unit, motions, payload_mass) as recorded,
    ):
        gate = pass_gate(
            recorded.dataset,
            recorded.entries,
            spec,
            despite_errors=despite_errors,
            place=recorded.source,
        )
        sequences = recorded.sequences()
        fitted = adapt(sequences, spec, seconds, None, _window_rms(progress), judge=True)
        before, after = _require_adaptation(fitted, spec, sequences)
        adapted = {"unit_id": recorded.unit_id, "doctor": gate.to_dict()}
        _write_adapted(folder, spec, fitted.robot, sequences, adapted, uncertainty)
    servos: dict[str, dict[str, float]] = {}
    for joint, i in zip(fitted.robot.operated, fitted.robot.operated_index, strict=True):
        servos[joint] = fitted.robot.servo.of_joint(i, FIELDS)
    return AdaptResult(
        unit_id=recorded.unit_id,
        servos=servos,
        before=before,
        after=after,
        robot=fitted.robot,
        folder=folder,
        recordings=len(sequences),
        doctor=gate,
    )


def _require_adaptation(
    fitted: Adapted, given: RobotSpec, sequences: list[Sequence]
) -> tuple[float, float]:
    """Return the mean |error| of all recordings before and after an adaptation, rad.

    Raises:
        NoGainError: The adapted robot is no better, on motions that the fit does not see or on all
            recordings.
    """
    from gaponet.sim.metrics import MIN_RELATIVE_GAIN
    from gaponet.sim.replay import rollout_errors

    if not fitted.accepted:
        why = "no joint has a motion that the fit does not see"
        before, after = map(_mean_mrad, fitted.judged)
        if before:
            why = (
                f"the error of motions that the fit does not see is {after:.2f} mrad, and "
                f"{before:.2f} without the fit"
            )
        raise NoGainError(
            f"nothing is written: {why}; keep {given.name} as it is, or record motions that move "
            "each joint more"
        )
    before = float(rollout_errors(sequences, given).mean())
    after = float(rollout_errors(sequences, fitted.robot).mean())
    if after > (1 - MIN_RELATIVE_GAIN) * before:
        raise NoGainError(
            f"nothing is written: over all {len(sequences)} recording(s) the error is "
            f"{1e3 * after:.2f} mrad with the fit and {1e3 * before:.2f} mrad with {given.name}; "
            "give longer logs (--seconds), or keep the robot"
        )
    return before, after


def _mean_mrad(errors: Array) -> float:
    """Return the mean of errors (motions,) rad, in mrad; 0 without any."""
    return 1e3 * float(errors.mean()) if len(errors) else 0.0


def _write_adapted(
    folder: Path,
    given: RobotSpec,
    adapted: RobotSpec,
    sequences: list[Sequence],
    facts: dict[str, Any],
    uncertainty: ParameterUncertainty | None,
) -> None:
    """Write the robot folder of an adaptation, whole or not at all."""
    from gaponet.base.files import whole_folder
    from gaponet.robot.folder import save_robot

    with whole_folder(folder, "robot", "robot.toml", OUTDATED_FILES) as place:
        save_robot(adapted, place)
        origin = _origin_of_adapted(given.folder, folder, sequences)
        if origin is not None:
            write_json(place / PROVENANCE_FILE, origin)
        write_json(place / ADAPTATION_FILE, facts)
        made = _uncertainty(place, sequences, [], {}, before=uncertainty)
        links = uncertainty.links if uncertainty is not None else None
        replace(made, links=links).save(place)


def _window_rms(progress: Progress) -> Callable[[int, int, float], None]:
    """Return a callback of adapt, whose third argument is the RMS error of the windows, rad."""
    return lambda done, total, rms: progress(done, total, f"window RMS {rms * 1e3:.2f} mrad")
