"""From a robot, real or virtual, to a dataset: excite, collect, import_logs, doctor."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gaponet.api.opening import Place, as_robot, entries_of_unit, open_dataset
from gaponet.api.options import CollectOptions, ExciteOptions, ImportOptions
from gaponet.api.results import ExciteResult, Prediction
from gaponet.base.errors import DatasetError, UsageError
from gaponet.base.progress import Progress, no_progress
from gaponet.data.store import Dataset, Entry
from gaponet.robot.folder import MOVE_STORED_ROBOT
from gaponet.robot.spec import RobotSpec

if TYPE_CHECKING:
    from gaponet.data.doctor import DoctorResult
    from gaponet.data.importer import ImportResult
    from gaponet.data.sequence import Sequence
    from gaponet.motion.motion import Motion
    from gaponet.motion.plan import Plan
    from gaponet.sysid.uncertainty import ParameterUncertainty
    from gaponet.virtual.collect import CollectResult

DEFAULT_MINUTES = 10.0  # of motions for a new robot
DEFAULT_FURTHER_MINUTES = 0.5  # of further motions for an identified robot


def import_logs(
    src: Place,
    *,
    robot: RobotSpec | Place,
    out: Place,
    unit_id: str | None = None,
    payload_mass: float | None = None,
    options: ImportOptions = ImportOptions(),  # noqa: B008
    progress: Progress = no_progress,
) -> ImportResult:
    """Read logs into a dataset, with delays and static offsets of the unit; a bad log refuses them
    all.

    The same call again adds what is missing.

    Args:
        src: File or folder of logs, or hf://USER/DATASET; `gaponet import --formats` lists what is
            read.
        robot: The robot that was recorded.
        out: Dataset folder to write. If it exists, new recordings are added to it.
        unit_id: Name that you choose for the recorded robot, the same in all its logs. Needed if
            the logs do not state it.
        payload_mass: Payload in each hand, kg; 0.0 for empty hands. Needed if the logs do not state
            it.
        options: How the logs are read: names, units, clocks, gains, what to do with bad rows.

    Raises:
        LogError, JointMismatchError, UsageError, DatasetError: The message says which file and what
            to do.
        RemoteError: The address cannot be reached.
    """
    from gaponet.data.importer import ImportRequest
    from gaponet.data.importer import import_logs as read_logs
    from gaponet.share.hub_logs import logs_folder
    from gaponet.sim.dynamics import gravity_of
    from gaponet.sim.model import model_hash

    spec = as_robot(robot)
    require_robot_of_folder(Path(out), spec)
    request = ImportRequest(unit_id=unit_id, payload_mass=payload_mass, **vars(options))
    return read_logs(
        logs_folder(src),
        spec,
        out,
        request,
        gravity=gravity_of(spec),
        simulator=model_hash(spec),
        progress=progress,
    )


def require_robot_of_folder(folder: Path, robot: RobotSpec) -> Dataset | None:
    """Return the dataset in a folder, which must be of this robot; None if there is none.

    Raises:
        DatasetError: It is another robot's.
    """
    from gaponet.sim.model import require_stored_robot

    dataset = Dataset.open_existing(folder, robot)
    if dataset is not None:
        require_stored_robot(folder, robot, DatasetError, MOVE_STORED_ROBOT)
    return dataset


@dataclass(frozen=True)
class LogFormat:
    """A format that import_logs reads.

    Attributes:
        about: What it is.
        extra: Extra of the package that it needs; "" for none.
    """

    name: str
    about: str
    extra: str


def log_formats() -> list[LogFormat]:
    """Return the formats that import_logs reads, those of installed extensions too."""
    from gaponet.data.formats import about, extra_of, formats

    found = []
    for name in formats():
        extra = extra_of(name)
        if extra is not None:
            found.append(LogFormat(name, about(name), extra))
    return found


def guess_description(
    src: Place,
    *,
    robot: RobotSpec | Place,
    options: ImportOptions = ImportOptions(),  # noqa: B008
) -> str:
    """Return a logs.toml for logs, filled in as far as they show what they are.

    Raises:
        LogError: The logs cannot be read.
    """
    from gaponet.data.describe.guess import guess_logs
    from gaponet.data.formats import look
    from gaponet.share.hub_logs import logs_folder

    kind, facts, recordings = look(logs_folder(src), options)
    return guess_logs(recordings, as_robot(robot), kind, dict(facts))


def doctor(
    dataset: Dataset | Place,
    *,
    robot: RobotSpec | Place | None = None,
    executor: str | Executor = "local",
    progress: Progress = no_progress,
) -> DoctorResult:
    """Check a dataset: order, sign, unit, range, rate, gaps, saturation, stuck channels, lag, sag,
    torque.

    Args:
        dataset: Recordings.
        robot: Another robot than the one that the dataset keeps.
        executor: Where many unchecked recordings are read: local, ray, ray:ADDRESS, or one of
            concurrent.futures.

    Raises:
        DatasetError: The folder is no dataset, or damaged.
    """
    from gaponet.data.doctor import DoctorResult
    from gaponet.sim.dynamics import dynamics_of, gravity_of

    data, spec = open_dataset(dataset, robot)
    return DoctorResult.of(
        data,
        spec,
        gravity_model=gravity_of(spec),
        dynamics_model=dynamics_of(spec),
        progress=progress,
        executor=executor,
    )


def draw_findings(
    dataset: Dataset | Place,
    diagnosis: DoctorResult,
    *,
    out: Place,
    robot: RobotSpec | Place | None = None,
) -> list[Path]:
    """Draw what the doctor found in a dataset: an SVG and a PNG for each finding. Return the files.

    Raises:
        FolderError: The folder holds something else.
    """
    from gaponet.base.files import lock_folder
    from gaponet.report.figures import dataset_figures

    data, spec = open_dataset(dataset, robot)
    with lock_folder(Path(out), "figures"):
        return dataset_figures.draw_findings(data, spec, list(diagnosis.findings), Path(out))


def collect(
    *,
    out: Place,
    robot: RobotSpec | Place = "h1_2",
    options: CollectOptions = CollectOptions(),  # noqa: B008
    executor: str | Executor = "local",
    progress: Progress = no_progress,
) -> CollectResult:
    """Record motions of virtual robots into a dataset; the same call again records what is missing.

    Args:
        out: Dataset folder.
        robot: A robot of the package, or a folder with robot.toml.
        options: Fleet, recipe, payloads, units, seed, and number of processes.
        executor: Where robots are simulated: local (processes on this machine), ray or
            ray:HOST:PORT (docs/install.md).

    Raises:
        UsageError: The recipe names a motion, unit or file that does not exist.
        DatasetError, FolderError: `out` is another robot's, or holds something else.
    """
    from dataclasses import replace

    from gaponet.virtual import collect as recording
    from gaponet.virtual.fleet import load_fleet

    spec = as_robot(robot)
    plan = recording.load_recipe(options.recipe)
    plan = replace(
        plan,
        payloads=options.payloads or plan.payloads,
        units=options.units or plan.units,
    )
    return recording.collect(
        spec,
        load_fleet(options.fleet, spec),
        plan,
        out,
        options.seed,
        options.nproc,
        progress,
        executor=executor,
    )


def excite(
    robot: RobotSpec | Place,
    *,
    out: Place,
    further: bool = False,
    options: ExciteOptions = ExciteOptions(),  # noqa: B008
    progress: Progress = no_progress,
) -> ExciteResult:
    """Write motions to play on a robot, and instructions to print.

    Args:
        robot: Robot whose range, torque and payload limits bound the motions; an identified one for
            `further`.
        out: Folder for the motion files and sheet.md.
        further: Choose the motions that reduce an identified robot's standard errors most, as
            --for of the command.
        options: Duration, payloads, rate and file format.

    Raises:
        UsageError: No motion fits, the robot folder holds no parameter uncertainty, or `out` holds
            motions of another call.
    """
    from gaponet.base.files import lock_folder, write_text
    from gaponet.base.structure import require_choice
    from gaponet.motion.files import SUFFIXES, write_motion
    from gaponet.motion.plan import make_plan, sheet

    suffixes = tuple(suffix.removeprefix(".") for suffix in SUFFIXES)
    require_choice("format", options.format, suffixes)
    spec = as_robot(robot)
    masses = tuple(sorted(set(options.payloads)))
    minutes = options.minutes
    if minutes is None:
        minutes = DEFAULT_FURTHER_MINUTES if further else DEFAULT_MINUTES
    folder = Path(out)
    prediction = None
    with lock_folder(folder, "motions"):
        if further:
            plan, prediction = _further_motions(spec, 60 * minutes, masses, options.seed, progress)
        else:
            plan = make_plan(spec, minutes, masses, options.seed)
        files = {}
        for i, motion in enumerate(plan.motions, 1):
            files[motion.name] = f"{i:02d}_{motion.name}.{options.format}"
        _refuse_other_motions(folder, set(files.values()))
        for motion in plan.motions:
            write_motion(folder / files[motion.name], motion, spec, options.rate)
        identified = spec.folder if further else None
        write_text(folder / "sheet.md", sheet(spec, plan, files, options.rate, identified))
    return ExciteResult(
        folder=folder,
        motions=tuple(files.values()),
        minutes=plan.minutes,
        payloads=tuple(plan.payloads),
        sheet=folder / "sheet.md",
        prediction=prediction,
    )


def _refuse_other_motions(folder: Path, names: set[str]) -> None:
    """Refuse a folder with motions that are not among `names`: a robot that plays all files of the
    folder would play them too.
    """
    from gaponet.motion.files import SUFFIXES

    others = []
    for path in sorted(folder.glob("[0-9][0-9]_*")):
        if path.suffix in SUFFIXES and path.name not in names:
            others.append(path.name)
    if others:
        raise UsageError(
            f"{folder}: holds motions of another call: {', '.join(others[:4])}"
            f"{', …' if len(others) > 4 else ''}; delete them, or choose another folder"
        )


def _further_motions(
    spec: RobotSpec, seconds: float, payloads: tuple[float, ...], seed: int, progress: Progress
) -> tuple[Plan, Prediction]:
    """Choose the motions that reduce the standard errors most."""
    from gaponet.motion.library import Library
    from gaponet.motion.plan import Plan
    from gaponet.sysid.evidence.experiment_design import (
        ExperimentDesign,
        candidate_motions,
        simulated_recordings,
        undetermined_gains,
    )
    from gaponet.sysid.uncertainty import ParameterUncertainty

    uncertainty = ParameterUncertainty.require(spec)
    heaviest = payloads[-1]
    if payloads[0] < 0 or (heaviest > 0 and not spec.payload_mounts):
        raise UsageError(
            f"--payloads {payloads}: give kg ≥ 0; {spec.name} has {len(spec.payload_mounts)} mounts"
        )
    motions = candidate_motions(Library(spec, seed, heaviest), progress)
    candidates: list[tuple[float, Motion]] = []  # payload, kg, and motion
    recordings: list[Sequence] = []  # of the candidates, simulated
    for mass in payloads:
        candidates += [(mass, motion) for motion in motions]
        recordings += simulated_recordings(spec, motions, mass)
    design = ExperimentDesign.from_recordings(spec, uncertainty, recordings)
    picks = sorted(design.choose(seconds), key=lambda number: candidates[number][0])
    if not picks:
        raise UsageError(
            f"--minutes {seconds / 60:g}: no motion is so short; give "
            f"{design.seconds.min() / 60:.2f}"
        )
    chosen = tuple(candidates[number] for number in picks)
    prediction = Prediction(
        before=_standard_errors(uncertainty, design.after([])),
        after=_standard_errors(uncertainty, design.after(picks)),
        useful_seconds=design.worth(),
        undetermined=undetermined_gains(uncertainty, design),
        played=tuple((mass, motion.name) for mass, motion in chosen),
    )
    return Plan(chosen), prediction


def _standard_errors(
    uncertainty: ParameterUncertainty, covariance: np.ndarray
) -> dict[str, dict[str, float]]:
    """Return joint → field → standard error in SI units, of covariances (n, P, P) on the axes."""
    errors = {}
    for joint, of_joint in zip(uncertainty.joints, covariance, strict=True):
        _, in_si = uncertainty.si(joint, of_joint)
        std = np.sqrt(np.diag(in_si)).tolist()
        errors[joint] = dict(zip(uncertainty.fields, std, strict=True))
    return errors


@dataclass(frozen=True)
class UnitRecordings:
    """Recordings of one unit.

    Attributes:
        source: What a person calls them: the dataset, or the logs that were imported.
    """

    source: str
    unit_id: str
    dataset: Dataset
    entries: list[Entry]

    def sequences(self) -> list[Sequence]:
        """Read the recordings."""
        return self.dataset.sequences(self.entries)


@contextmanager
def unit_recordings(
    source: Dataset | Place,
    robot: RobotSpec,
    unit: str = "",
    motions: tuple[str, ...] = (),
    payload_mass: float | None = None,
) -> Iterator[UnitRecordings]:
    """Yield the recordings of one unit, from a dataset or from logs; arguments as of `check`.

    Logs are imported into a temporary folder.

    Raises:
        UsageError: The unit is not there, or there are several and none is named.
    """
    with tempfile.TemporaryDirectory() as place:
        name = str(source.path) if isinstance(source, Dataset) else str(source)
        if not isinstance(source, Dataset) and _holds_logs(Path(source)):
            data = import_logs(
                source,
                robot=robot,
                out=Path(place) / "data",
                unit_id=unit or None,
                payload_mass=payload_mass,
            ).dataset
        else:
            data, _ = open_dataset(source, robot)
        data.require_robot(robot)
        unit, entries = entries_of_unit(data, unit, motions)
        if payload_mass is not None:
            _require_payload(entries, payload_mass, name)
        yield UnitRecordings(name, unit, data, entries)


def _holds_logs(place: Path) -> bool:
    """Return True for a file or folder that is there and is no dataset."""
    return place.exists() and not (place / "dataset.json").is_file()


def _require_payload(entries: list[Entry], payload_mass: float, source: str) -> None:
    """Refuse a payload, kg, that recordings state otherwise."""
    others = [e.meta.payload_mass for e in entries if e.meta.payload_mass != payload_mass]
    if others:
        raise UsageError(
            f"--payload-mass {payload_mass:g}: {source} states {max(others):g} kg; leave it out"
        )
