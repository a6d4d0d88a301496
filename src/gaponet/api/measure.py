"""Simulators beside recordings: pair, gap, evaluate, check, replay."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gaponet.api.logs import import_logs, unit_recordings
from gaponet.api.opening import Place, as_identified, as_run, open_dataset, require_commands
from gaponet.api.options import ImportOptions
from gaponet.api.results import CheckResult, EvalResult, GapResult, PairResult, ReplayResult
from gaponet.base.errors import UsageError
from gaponet.base.files import FOLDER_MARKER, write_text
from gaponet.base.progress import Progress, no_progress, with_note
from gaponet.data.store import Dataset
from gaponet.nn.packaged_networks import is_packaged, named_folder
from gaponet.robot.spec import RobotSpec, load_robot

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from gaponet.base.arrays import Array
    from gaponet.nn.artifact import GapModel


def pair(
    dataset: Dataset | Place,
    *,
    robot: RobotSpec | Place | None = None,
    executor: str | Executor = "local",
    progress: Progress = no_progress,
) -> PairResult:
    """Simulate the commands of every recording in the nominal simulator and store the result
    beside it.

    Recordings that have a paired simulation keep it.

    Args:
        dataset: Recordings.
        robot: Another robot than the one that the dataset keeps.
        executor: Where they are simulated: local, ray, ray:ADDRESS (docs/install.md), or one of
            concurrent.futures.

    Raises:
        DatasetError, JointMismatchError: The folder is no dataset, or one of another robot.
    """
    from gaponet.sim.replay import pair_dataset

    data, spec = open_dataset(dataset, robot)
    made = pair_dataset(data, spec, with_note(progress, "control steps"), executor=executor)
    return PairResult(dataset=data, simulated=made, present=len(data) - made)


def gap(
    dataset: Dataset | Place,
    *,
    robot: RobotSpec | Place | None = None,
    motions: tuple[str, ...] = (),
    run: GapModel | Place | None = None,
    executor: str = "local",
    progress: Progress = no_progress,
) -> GapResult:
    """Measure the error of the nominal simulator in open-loop rollouts; for an identified robot
    also by cause.

    Args:
        dataset: Recordings; those without a paired simulation are simulated first.
        robot: Another robot than the one that the dataset keeps. If the robot is identified, it is
            measured as `run` is.
        motions: Use only these motions.
        run: Robot folder of `identify`, run folder of `train`, or name of a network of the package.
            The result then says, on test motions, how much each identified cause and the network
            reduce the error, and how large the floor is. gap.json, gap.svg and gap.png in the
            folder keep it.
        executor: Where recordings are simulated: local (processes on this machine), ray or
            ray:HOST:PORT (docs/install.md).
    """
    from gaponet.evaluation.baselines import baseline_errors, command_run
    from gaponet.sim.metrics import Run, summary
    from gaponet.sim.model import model_hash

    folder = None if run is None else as_run(run)
    data, spec = open_dataset(dataset, robot, folder)
    if folder is not None or spec.is_identified:
        return _gap_by_cause(data, spec, folder, motions, progress)
    require_commands(data)
    pair(data, robot=spec, executor=executor, progress=progress)
    entries = data.select(motions)
    simulator = model_hash(spec)
    simulated = []
    commands = []
    for entry in entries:
        both = data.pair(entry, simulator)
        simulated.append(Run.of(both.real, both.sim.qpos, spec))
        commands.append(command_run(both.real, spec))
    methods = {"nominal": summary(simulated, spec)}
    return GapResult(
        methods=methods,
        table={
            "methods": methods,
            "baselines": baseline_errors(simulated, commands),
            "dataset": data.path.name,
            "sequences": len(entries),
            "hours": sum(e.rows * e.dt for e in entries) / 3600,
            "virtual": any(e.meta.virtual for e in entries),
            "robot": spec.name,
            "simulator_hash": simulator,
        },
    )


def _gap_by_cause(
    data: Dataset,
    spec: RobotSpec,
    folder: Path | None,
    motions: tuple[str, ...],
    progress: Progress,
) -> GapResult:
    from gaponet.evaluation.candidate import Candidate
    from gaponet.evaluation.gap import gap_by_step
    from gaponet.report.figures.evaluation import write_gap

    if folder is None:
        candidate = Candidate(spec.folder, spec, None)
    else:
        candidate = Candidate.load(folder, spec)
    table = gap_by_step(candidate, data, motions, progress)
    if _may_be_written(candidate.folder, given=folder is not None):
        write_gap(table, candidate.folder)
    return GapResult(methods=table["methods"], table=table)


def _may_be_written(folder: Path, *, given: bool) -> bool:
    """Return True if a result may be stored in the folder of a candidate.

    Args:
        given: The user named the folder as the candidate. Other folders are written to only if
            gaponet made them.
    """
    if is_packaged(folder):
        return False
    return given or (folder / FOLDER_MARKER).is_file()


def evaluate(
    run: GapModel | Place,
    dataset: Dataset | Place,
    *,
    also: tuple[Place, ...] = (),
    motions: tuple[str, ...] = (),
    robot: RobotSpec | Place | None = None,
    units: tuple[str, ...] = (),
    progress: Progress = no_progress,
) -> EvalResult:
    """Measure simulators on recordings that were not used in training: nominal, identified, and
    with the model.

    Args:
        run: Robot folder that `identify` wrote; run folder; network of the package by name; or a
            trained model. The result is kept in a folder of yours.
        dataset: The dataset trained on (its test motions are used) or another.
        also: Further runs to compare, e.g. the MLP's.
        motions: Use only these motions.
        robot: Another robot than the one that the dataset keeps. If it is not the simulator that
            the run was trained in, it is shown as it is, and with the run transferred into it
            (deploy/transfer.py).
        units: Only recordings of these, such as the one left out of training.

    Raises:
        DatasetError, ModelError: A recording is not there or was used in training, a model fits
            another robot, or transfer was never measured so far from the simulator of the run.
    """
    from gaponet.evaluation import evaluate as measuring
    from gaponet.evaluation.candidate import is_robot
    from gaponet.robot.folder import has_stored_robot, load_stored_robot
    from gaponet.sim.model import model_hash

    folder = as_run(run)
    data, spec = open_dataset(dataset, robot, folder)
    target = None
    own = spec
    if robot is not None and (is_robot(folder) or has_stored_robot(folder)):
        own = load_robot(folder) if is_robot(folder) else load_stored_robot(folder, spec.name)
    if model_hash(own) != model_hash(spec):
        target = spec
        spec = own.before_identification
    evaluation = measuring.evaluate(
        [folder, *map(named_folder, also)], data, spec, motions, progress, target, units
    )
    if not is_packaged(folder):
        evaluation.save(folder)
    return EvalResult(
        methods=evaluation.result["methods"],
        unseen=evaluation.result["unseen"],
        evaluation=evaluation,
    )


def check(
    robot: RobotSpec | Place,
    logs: Dataset | Place,
    *,
    unit: str = "",
    motions: tuple[str, ...] = (),
    payload_mass: float | None = None,
    threads: int = 0,
) -> CheckResult:
    """Compare new logs with an identified robot: is it unchanged, and what changed?

    Args:
        robot: Robot folder that `identify` or `adapt_robot` wrote.
        logs: A dataset, or logs that `import_logs` reads.
        unit: Unit to check, or name of the robot in the logs. Needed if the dataset holds several
            units, or if the logs state none.
        motions: Use only these motions. Default: all of the unit.
        payload_mass: Payload in each hand, kg. Needed for logs that do not state it.
        threads: Number of threads; 0 means all cores.

    Raises:
        RobotError: The robot folder holds no parameter uncertainty.
        UsageError: The recordings are too short, or move no joint.
    """
    from gaponet.sysid.evidence.drift import drift
    from gaponet.sysid.uncertainty import ParameterUncertainty

    spec = as_identified(robot)
    uncertainty = ParameterUncertainty.require(spec)
    with unit_recordings(logs, spec, unit, motions, payload_mass) as recorded:
        sequences = recorded.sequences()
        drifted = drift(spec, uncertainty, sequences, threads)
    return CheckResult(
        verdict=drifted.verdict,
        advice=drifted.advice,
        recordings=len(sequences),
        drift=drifted,
        uncertainty=uncertainty,
    )


def replay(
    logs: Place,
    *,
    robot: RobotSpec | Place,
    data: str | None = None,
    described: Place | None = None,
    payload_mass: float = 0.0,
    progress: Progress = no_progress,
) -> ReplayResult:
    """Predict what an identified robot would do in the rollouts of a policy.

    The targets of a rollout are played as they stand. A policy that observes the state would have
    answered the difference. The band holds nine tenths of every validation motion, and the
    uncertainty of the servos in this motion.

    Args:
        logs: File or folder of rollouts, in any format that `import_logs` reads: targets as
            commands, and states.
        robot: Robot folder that `identify` wrote.
        data: Dataset whose validation motions give the band. Default: that of the identification.
        described: A logs.toml that says what the rollouts' columns mean.
        payload_mass: Payload in each hand, kg.

    Raises:
        UsageError: Neither recordings nor an uncertainty of the robot exist.
    """
    from gaponet.data.describe.preview import read_first_recording
    from gaponet.data.formats import ReadOptions
    from gaponet.export.plain_servos import read_recordings
    from gaponet.export.rollout import BAND_SHARE, predict, sample_robots, summary, validation_error
    from gaponet.sysid.uncertainty import ParameterUncertainty

    spec = as_identified(robot)
    uncertainty = ParameterUncertainty.load(spec)
    recordings = read_recordings(spec.folder, data, spec)
    drawn = sample_robots(spec) if uncertainty is not None else []
    errors: Array
    if recordings is not None:
        errors = validation_error(spec, recordings[1])
    elif uncertainty is not None:
        errors = np.array([uncertainty.joints[j].residual_p90 for j in spec.operated])
    else:
        raise UsageError(
            f"{spec.folder}: nothing says how far it is from its robot; give --data, or what "
            "identify wrote"
        )
    with tempfile.TemporaryDirectory() as place:
        toml = None if described is None else Path(described)
        _, _, guessed = read_first_recording(Path(logs), spec, ReadOptions(logs=toml))
        if guessed:
            toml = Path(place) / "logs.toml"
            write_text(toml, guessed)
        report = import_logs(
            logs,
            robot=spec,
            out=Path(place) / "data",
            unit_id="rollout",
            payload_mass=payload_mass,
            options=ImportOptions(logs=toml),
            progress=progress,
        )
        rollouts = report.dataset.sequences(list(report.added))
    prediction = predict(spec, rollouts, errors, drawn)
    joints = summary(prediction, spec.operated)
    differ = sorted(
        (j for j, s in joints.items() if s["inside"] < BAND_SHARE),
        key=lambda j: joints[j]["inside"],
    )
    return ReplayResult(
        robot=spec,
        joints=joints,
        differ=tuple(differ),
        rollouts=tuple(prediction),
        share=BAND_SHARE,
        drawn=len(drawn),
        band_from_recordings=recordings is not None,
    )
