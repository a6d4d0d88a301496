"""Fits to recordings: identify, train, adapt_robot, adapt_model."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from collections.abc import Sequence as ListOf
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from gaponet.api.logs import unit_recordings
from gaponet.api.opening import (
    Place,
    as_dataset,
    as_robot,
    as_run,
    entries_of_unit,
    require_commands,
)
from gaponet.api.results import AdaptResult, IdentifyResult, TorqueResult, TrainResult
from gaponet.base.errors import NoGainError, UsageError
from gaponet.base.files import write_json, write_text
from gaponet.base.progress import Progress, no_progress
from gaponet.data.store import Dataset
from gaponet.nn.packaged_networks import require_run_folder
from gaponet.robot.folder import (
    ADAPTATION_FILE,
    OLD_UNCERTAINTY_FILE,
    PROVENANCE_FILE,
    UNCERTAINTY_FILE,
)
from gaponet.robot.servo_fields import Term
from gaponet.robot.spec import RobotSpec, load_robot

if TYPE_CHECKING:
    from gaponet.data.checks.gate import GateReport
    from gaponet.data.sequence import Sequence
    from gaponet.data.store import Entry
    from gaponet.nn.artifact import GapModel
    from gaponet.nn.config import ModelKind
    from gaponet.nn.training.config import Status, TrainConfig
    from gaponet.sim.links import LinkResult
    from gaponet.sysid.acceptance import Covariance, HeldOut
    from gaponet.sysid.uncertainty import ParameterUncertainty

# Files of an earlier robot in the same folder, which do not describe the new one.
OUTDATED_FILES = (PROVENANCE_FILE, ADAPTATION_FILE, UNCERTAINTY_FILE, OLD_UNCERTAINTY_FILE)
MIN_MOTIONS_TO_SPLIT = 3  # with fewer motions, halves of the recordings fit and validate in turn


def identify(
    dataset: Dataset | Place,
    *,
    out: Place,
    windows: int = 40,
    robot: RobotSpec | Place | None = None,
    like: RobotSpec | Place | None = None,
    units: tuple[str, ...] = (),
    holdout_units: tuple[str, ...] = (),
    terms: tuple[Term, ...] | None = None,
    table: bool = True,
    threads: int = 0,
    budget: str | None = None,
    stops: bool = False,
    masses: bool = False,
    despite_errors: bool = False,
    progress: Progress = no_progress,
) -> IdentifyResult:
    """Fit the servos of the simulator, and the table under the robot, to the training motions.

    A robot folder is written if motions that were not fitted are followed better than by the given robot; otherwise
    nothing is. Where fewer than three motions validate a set of joints, cross-validation over motions decides, and the
    robot is then fitted to all of them.
    Recordings made with several gains are fitted together, each in a simulator with its own gains. If all state
    the same gains, the robot folder has these.

    Args:
        dataset: Recordings, a folder.
        out: Robot folder to write; `train(…, robot=out)` starts from it.
        windows: Number of 8 s rollouts that are fitted, taken evenly from the training motions.
        robot: Start of the fit, if not the robot that the dataset keeps.
        like: Identified robot whose servos are the start and the prior, by joint name, mirrored name (left, right)
            or type of servo: another arm, another unit, another robot.
        units: Only these, pooled: one set of parameters for all of them; default: all others than --holdout-units.
        holdout_units: Units to leave out, as in training.
        terms: Terms of the servo model to try; each is accepted only if validation motions improve. Default: stribeck
            and load, after limit if a joint reaches its stated torque limit; then backlash where a gap makes the
            rollouts better at otherwise equal values; then temperature where it varies at equal gains and payload.
        table: Look for a table under the robot's tips ([[tip]] in robot.toml).
        threads: 0 for all cores.
        budget: Time such as 60s or 4m that the fit may take, the table included; default no limit. What does not fit
            into it is left out and named in a warning. Results are the same on every machine only without a limit.
        stops: Add an end stop to joints that stayed behind several commands; otherwise they are reported.
        masses: Fit masses, centres of mass and inertias of the links too; accepted as a term is.
        despite_errors: Go on although the doctor finds an error in the recordings; the result keeps the errors.

    Raises:
        DatasetError: The doctor finds an error in the recordings of the units that are fitted.
        DatasetError, UsageError: A unit is not there, or `like` has no joint that corresponds.
        NoGainError: Nothing that was fitted does better; it names the joints and what to record.
    """
    from gaponet.base.files import lock_folder, whole_folder
    from gaponet.data.checks.gate import pass_gate, used_recordings
    from gaponet.data.split import split_entries
    from gaponet.export.plain_servos import keep_plain_servos
    from gaponet.nn.training.config import Budget
    from gaponet.robot.folder import require_other_folder, save_robot
    from gaponet.sim.metrics import MIN_RELATIVE_GAIN
    from gaponet.sysid.acceptance import HeldOut, held_out_errors
    from gaponet.sysid.identify import identify as fit
    from gaponet.sysid.options import IdentifyOptions
    from gaponet.sysid.servo_types import servos_like

    data, spec = as_dataset(dataset, robot)
    data.require_robot(spec)
    data.require_sequences()
    require_commands(data)
    all_units = {e.meta.unit_id for e in data.entries}
    if set(units) - all_units:
        raise UsageError(f"--units {min(set(units) - all_units)}: not in {data.path}")
    left_out = (all_units - set(units) if units else set()) | set(holdout_units)
    split = split_entries(data, tuple(sorted(left_out)))
    began, val, folder = time.monotonic(), data.sequences(split["val"]), Path(out)
    if len(gains := {e.meta.recorded_gains for e in data.entries}) == 1:
        spec = spec.with_gains(*gains.pop())
    start, taken = (spec, {}) if like is None else servos_like(spec, as_robot(like))
    seconds = None if budget is None else Budget.parse(budget).seconds
    if budget is not None and seconds is None:
        raise UsageError(f"--budget {budget}: give a time such as 60s or 4m")
    require_other_folder(folder, spec)
    train_set = data.sequences(split["train"])
    with lock_folder(folder, "robot"):
        gate = pass_gate(
            data,
            used_recordings(data, split),
            spec,
            despite_errors=despite_errors,
            progress=progress,
        )
        options = IdentifyOptions(
            windows=windows,
            terms=terms,
            table=table,
            stops=stops,
            masses=masses,
            seconds=seconds,
            nthread=threads,
        )
        fitted = fit(train_set, start, val, options, progress)
        after, given, nominal = (
            held_out_errors(HeldOut(s, one or own) for s, own in fitted.held_out)
            for one in (None, spec, spec.nominal or spec)
        )
        if not (fitted.improved or taken) or after.mean() > (1 - MIN_RELATIVE_GAIN) * given.mean():
            raise NoGainError(fitted.no_gain_message(spec, given, after))
        errors = {"nominal": nominal, "identified": after}
        means = {name: float(e.mean()) for name, e in errors.items()}
        judges = [] if fitted.held_out[0].robot is fitted.robot else fitted.held_out
        with whole_folder(folder, "robot", "robot.toml", OUTDATED_FILES) as place:
            save_robot(fitted.robot, place)
            if fitted.without_terms is not None:
                keep_plain_servos(place, fitted.without_terms, train_set)
            write_json(
                place / PROVENANCE_FILE, _origin(folder, data, split, means, gate, fitted.findings)
            )
            _save_uncertainty(place, train_set, val, fitted.covariance, None, judges, fitted.links)
    return IdentifyResult(
        robot=fitted.robot, folder=folder, errors=errors, fit=fitted, seconds=time.monotonic() - began,
        taken_from=taken, doctor=gate,
    )  # fmt: skip


def identify_torque(
    dataset: Dataset | Place,
    *,
    out: Place,
    current: bool = False,
    robot: RobotSpec | Place | None = None,
    despite_errors: bool = False,
) -> TorqueResult:
    """Fit friction, inertia and delay of a robot that is driven by torque.

    The fit is measured on recordings that were not fitted: the error of the simulator some time after a recorded state,
    with the recorded torque as its input. A robot folder is written only if that error falls.

    Args:
        dataset: Recordings with the torque (tau) of every operated joint. Where no position was commanded, logs.toml
            names the position's column for ctrl too.
        out: Robot folder to write.
        current: The recorded torque is a current, or its constant is unknown: fit N·m per unit too.
        robot: Start of the fit, if not the robot that the dataset keeps.
        despite_errors: Go on although the doctor finds an error in the recordings; the result keeps the errors.

    Raises:
        DatasetError: The doctor finds an error in the recordings.
        UsageError: A recording lacks torque.
        NoGainError: The fit is no better than the robot as given.
    """
    from gaponet.base.files import lock_folder, whole_folder
    from gaponet.data.checks.gate import TORQUE_DRIVEN_CHECKS, pass_gate
    from gaponet.data.split import split_entries
    from gaponet.robot.folder import require_other_folder, save_robot
    from gaponet.sysid.torque_motors import fit_torque_driven

    data, spec = as_dataset(dataset, robot)
    data.require_robot(spec)
    few = len({e.meta.motion for e in data.entries}) < MIN_MOTIONS_TO_SPLIT
    split = (
        {"train": data.entries, "val": data.entries, "test": []} if few else split_entries(data, ())
    )
    folder, train_set = Path(out), data.sequences(split["train"])
    require_other_folder(folder, spec)
    with lock_folder(folder, "robot"):
        gate = pass_gate(
            data, data.entries, spec, despite_errors=despite_errors, checks=TORQUE_DRIVEN_CHECKS
        )
        fitted = fit_torque_driven(
            train_set, train_set if few else data.sequences(split["val"]), spec, current
        )
        before, after = (float(np.mean(x)) for x in fitted.angle[0.5])
        if not after < before:
            raise NoGainError(
                f"nothing is written: half a second on, the error is {1e3 * after:.2f} mrad with the fit and "
                f"{1e3 * before:.2f} mrad with {spec.name} as given"
            )
        means = {"nominal": before, "identified": after}
        with whole_folder(folder, "robot", "robot.toml", OUTDATED_FILES) as place:
            save_robot(fitted.robot, place)
            write_json(place / PROVENANCE_FILE, _origin(folder, data, split, means, gate))
    return TorqueResult(
        robot=fitted.robot, folder=folder, before=before, after=after, fit=fitted,
        virtual=any(e.meta.virtual for e in data.entries), doctor=gate,
    )  # fmt: skip


def _origin(
    folder: Path, data: Dataset, split: Mapping[str, ListOf[Entry]], val_mpjae: Mapping[str, float],
    gate: GateReport, findings: ListOf[str] = (),
) -> dict[str, Any]:  # fmt: skip
    """Return what a robot folder was identified from: dataset, recordings and motions by split, validation errors, what
    the doctor found, and what the fit found."""
    return {
        "dataset": os.path.relpath(data.path, folder),
        "parts": {name: {e.id: e.hash for e in entries} for name, entries in split.items()},
        "motions": {name: sorted({e.meta.motion for e in entries}) for name, entries in split.items()},
        "val_mpjae": dict(val_mpjae), "findings": list(findings), "doctor": gate.to_dict(),
    }  # fmt: skip


def _copy_origin(source: Path, folder: Path) -> None:
    """Keep on record from which motions the robot of `source` was identified, if that is stated."""
    if (source / PROVENANCE_FILE).is_file():
        text = (source / PROVENANCE_FILE).read_text(encoding="utf-8")
        write_text(folder / PROVENANCE_FILE, text)


def _save_uncertainty(
    folder: Path, sequences: list[Sequence], validation: list[Sequence], covariance: Covariance,
    before: ParameterUncertainty | None, held_out: ListOf[HeldOut] = (), links: LinkResult | None = None,
) -> None:  # fmt: skip
    """Write the parameter uncertainty of a robot folder."""
    from gaponet.sysid.evidence.evidence import estimate_uncertainty
    from gaponet.sysid.uncertainty import LinkUncertainty

    for name in (UNCERTAINTY_FILE, OLD_UNCERTAINTY_FILE):
        (folder / name).unlink(missing_ok=True)  # of the robot as it was before this fit
    robot = load_robot(folder)
    made = estimate_uncertainty(robot, sequences, validation, covariance, before, held_out)
    replace(
        made, links=before.links if before else LinkUncertainty.of(links, robot, made.fields)
    ).save(folder)


def train(
    dataset: Dataset | Place,
    *,
    out: Place,
    budget: str = "10m",
    config: TrainConfig | None = None,
    model: ModelKind | Literal["auto"] | None = None,
    robot: RobotSpec | Place | None = None,
    holdout_units: tuple[str, ...] = (),
    resume: bool = False,
    log: tuple[str, ...] = (),
    despite_errors: bool = False,
    progress: Progress = no_progress,
) -> TrainResult:
    """Train a delta-action model; the run keeps the model with the least error in rollouts of validation motions.

    Ctrl-C ends training and leaves a usable run.

    Args:
        dataset: Recordings, a folder.
        out: Run folder.
        budget: Time such as 90s, 10m or 2h, or control steps such as 2000000.
        config: Everything else; default `TrainConfig()`.
        model: gaponet, paper (the paper's literal network), or a baseline: shared_mlp, mlp, trees. auto: gaponet,
            shared_mlp, mlp and, with scikit-learn, trees get a fifth of the budget each. The best network on validation
            gets the rest, and trees are chosen if they are still better. Default: that of the config.
        robot: Another robot than the one that the dataset keeps, e.g. the folder that `identify` wrote.
        holdout_units: Units never trained on; their test motions stay in the test split.
        resume: Continue the run in `out`.
        log: tensorboard, wandb.
        despite_errors: Go on although the doctor finds an error in the recordings; the result keeps the errors.

    Returns:
        The exported model; RUN/model holds it.

    Raises:
        ModelError: The budget bought no training step.
        DatasetError: The doctor finds an error in the recordings of the units that train or validate.
        DatasetError, UsageError: The recordings, the config or the folder do not fit; the message says what.
    """
    from gaponet.base.files import lock_folder
    from gaponet.data.checks.gate import pass_gate, used_recordings
    from gaponet.nn.training.config import Budget, TrainConfig
    from gaponet.nn.training.run_folder import training_splits
    from gaponet.nn.training.selection import candidate_errors, train_best
    from gaponet.nn.training.trainer import Trainer

    config, whole, folder = config or TrainConfig(), Budget.parse(budget), Path(out)
    shared: dict[str, Any] = {}
    with lock_folder(folder, "run"):
        data, spec = as_dataset(dataset, robot)
        require_commands(data)
        entries = used_recordings(data, training_splits(data, config, holdout_units))
        gate = pass_gate(data, entries, spec, despite_errors=despite_errors)

        def one(kind: ModelKind, run: Path, share: float, spent: float, resume: bool) -> GapModel:
            def show(status: Status) -> None:
                progress(spent + share * status.fraction, 1.0, f"{kind}: {status.note}")

            return Trainer(
                data, spec, run, replace(config, model=replace(config.model, kind=kind)), whole.part(share),
                resume=resume, holdout_units=holdout_units, show=show, log=log, shared=shared, gate=gate,
            ).run()  # fmt: skip

        if model == "auto":
            trained = train_best(folder, resume, one)
        else:
            trained = one(model or config.model.kind, folder, 1.0, 0.0, resume)
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

    Gain, damping, friction, zero offset and delay of each joint are fitted. The model stays as it is. The run keeps the
    result, and `evaluate` then shows the unit with it too.

    Args:
        run: Run folder, or a trained model.
        dataset: Recordings of the unit, perhaps among others.
        unit: Unit to adapt to, where the dataset holds several.
        motions: Only these; default: those that the run was trained on, so that its test motions stay unseen, or all
            where the unit played none of them.
        seconds: Duration of the recordings to use, in windows of 8 s.
        robot: Another robot than the one that the dataset keeps.
        mixed_gains: Accept recordings made with different kp or kd together.
        despite_errors: Go on although the doctor finds an error in the recordings; the result keeps the errors.

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
    data, spec = as_dataset(dataset, robot, folder)
    data.require_robot(spec)
    model, simulator = GapModel.load(folder), corrected_robot(folder, spec)
    _, entries = entries_of_unit(data, unit, motions)
    gate = pass_gate(data, entries, spec, despite_errors=despite_errors)
    if not motions:
        entries = [e for e in entries if e.meta.motion in model.card["motions"]["train"]] or entries
    if not mixed_gains:
        require_same_gains((e.meta for e in entries), data.joint_names, spec.operated)
    fitted = Adaptation.fit(
        model, simulator, data.sequences(entries), seconds, _window_rms(progress)
    )
    fitted = replace(fitted, doctor=gate.to_dict())
    fitted.save(folder)
    return AdaptResult(
        unit_id=fitted.unit_id, servos={j: {str(f): v for f, v in s.items()} for j, s in fitted.servos.items()},
        before=fitted.before, after=fitted.after, robot=None, folder=folder, recordings=len(entries),
        doctor=gate,
    )  # fmt: skip


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
    """Fit the servo parameters of one unit on one day to a short log: a robot folder in, a robot folder out.

    Parameters that the log does not determine keep their values.

    Args:
        robot: The folder that `identify` wrote, or a nominal robot.
        source: A dataset, or logs that `import_logs` reads.
        out: Robot folder to write.
        unit: Unit to adapt to, where the dataset holds several.
        motions: Only these.
        seconds: Duration of the recordings to fit, in windows of 8 s; all of them are used for validation.
        payload_mass: kg in each hand, of logs whose format does not state it.
        despite_errors: Go on although the doctor finds an error in the recordings; the result keeps the errors.

    Raises:
        DatasetError: The doctor finds an error in the recordings.
        UsageError: The unit is not named.
        NoGainError: The fit does not follow the recordings, or motions that it was not given, better than the given
            robot; nothing is written.
    """
    from gaponet.base.files import lock_folder, whole_folder
    from gaponet.data.checks.gate import pass_gate
    from gaponet.robot.folder import require_other_folder, save_robot
    from gaponet.sim.metrics import MIN_RELATIVE_GAIN
    from gaponet.sim.replay import rollout_errors
    from gaponet.sysid.adapt import FIELDS, adapt
    from gaponet.sysid.uncertainty import ParameterUncertainty

    folder, spec = (
        Path(out),
        as_robot(Path(robot) if isinstance(robot, str) and "/" in robot else robot),
    )
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
        if not fitted.accepted:
            before, after = (1e3 * float(e.mean()) if len(e) else 0.0 for e in fitted.judged)
            why = (
                f"the error of motions that the fit does not see is {after:.2f} mrad, and {before:.2f} without the fit"
                if before
                else "no joint has a motion that the fit does not see"
            )
            raise NoGainError(
                f"nothing is written: {why}; keep {spec.name} as it is, or record motions that move each joint more"
            )
        before, after = (float(rollout_errors(sequences, r).mean()) for r in (spec, fitted.robot))
        if after > (1 - MIN_RELATIVE_GAIN) * before:
            raise NoGainError(
                f"nothing is written: over all {len(sequences)} recording(s) the error is {1e3 * after:.2f} mrad with "
                f"the fit and {1e3 * before:.2f} mrad with {spec.name}; give longer logs (--seconds), or keep the robot"
            )
        adapted = {"unit_id": recorded.unit_id, "doctor": gate.to_dict()}
        with whole_folder(folder, "robot", "robot.toml", OUTDATED_FILES) as place:
            save_robot(fitted.robot, place)
            _copy_origin(spec.folder, place)
            write_json(place / ADAPTATION_FILE, adapted)
            _save_uncertainty(place, sequences, [], {}, uncertainty)
    robot, joints = (
        fitted.robot,
        zip(fitted.robot.operated, fitted.robot.operated_index, strict=True),
    )
    return AdaptResult(
        unit_id=recorded.unit_id, servos={j: {f: float(getattr(robot, f)[i]) for f in FIELDS} for j, i in joints},
        before=before, after=after, robot=robot, folder=folder, recordings=len(sequences), doctor=gate,
    )  # fmt: skip


def _window_rms(progress: Progress) -> Callable[[int, int, float], None]:
    """Return a callback of adapt, whose third argument is the RMS error of the windows, rad."""
    return lambda done, total, rms: progress(done, total, f"window RMS {rms * 1e3:.2f} mrad")
