"""Motions played without correction, and recorded into a dataset: what gaponet record does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gaponet.api.logs import require_robot_of_folder
from gaponet.api.opening import Place
from gaponet.api.results import RunResult
from gaponet.api.run_consent import Consent
from gaponet.api.run_report import RunReporter, StderrReporter
from gaponet.api.run_robot import RunRequest, execute, resolve_robot
from gaponet.base.errors import UsageError
from gaponet.base.files import lock_folder
from gaponet.hw.control.recording import require_file_name

if TYPE_CHECKING:
    from gaponet.data.sequence import Sequence
    from gaponet.data.store import Dataset, Entry
    from gaponet.motion.motion import Motion

RECORDINGS = "recordings"  # folder in a dataset with the full recording of every run


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """One motion that was played and added to a dataset.

    Attributes:
        id: Its name in the dataset.
        rows: Number of control periods.
        rate: Hz.
    """

    run: RunResult = field(repr=False)
    id: str
    rows: int
    rate: float


@dataclass(frozen=True, kw_only=True)
class RecordResult:
    """Motions that were added to a dataset, in the order of playing."""

    folder: Path
    recorded: tuple[Recorded, ...]

    def to_dict(self) -> dict[str, Any]:
        return {
            "dataset": str(self.folder),
            "written": [made.id for made in self.recorded],
            "tracking": [made.run.tracking() for made in self.recorded],
        }


def record_motions(
    motions: tuple[str, ...],
    request: RunRequest,
    *,
    out: Place,
    repetitions: int = 1,
    report: RunReporter | None = None,
    consent: Consent | None = None,
    on_played: Callable[[RunResult, Recorded | None], None] = lambda run, made: None,
) -> RecordResult:
    """Play motions one after the other, without correction, and add each to a dataset.

    Args:
        motions: Names or files.
        request: Robot, driver and options. `options.payload_mass` and, of a real robot,
            `options.unit_id` are stated; the seed of a virtual robot's noise rises by one with each
            recording.
        out: Dataset folder; created or appended to. Full recordings go to OUT/recordings.
        repetitions: Number of times that each motion is played.
        report: Shows plan, notes and phases; default on standard error.
        consent: As of `run_robot`.
        on_played: Called after each motion with its run, and with what was added; None if a fault
            ended it.

    Raises:
        UsageError: Unit or payload is not stated, or a run ended with a fault, which is not added.
        DatasetError: The dataset is another robot's; nothing has moved then.
        UnsavedError: The robot ran, and its recording could not be saved.
    """
    folder = Path(out)
    if repetitions < 1:
        raise UsageError(f"--repetitions {repetitions}: give 1 or more, or nothing is recorded")
    if request.options.payload_mass is None:
        raise UsageError("say what each hand carries: --payload-mass KG, 0 when empty")
    options = replace(request.options, unit_id=_unit_id(request), out=folder / RECORDINGS)
    first = replace(request, motion=motions[0], options=options)
    recorded: list[Recorded] = []
    seed = options.seed
    with lock_folder(folder, "dataset"):
        known = require_robot_of_folder(folder, resolve_robot(first))  # before anything moves
        for motion in motions:
            wanted: Motion | str = motion
            for _ in range(repetitions):
                turn = replace(first, motion=wanted, options=replace(options, seed=seed))
                run = execute(turn, report or StderrReporter(), consent)
                # A motion that had to be made smaller is repeated as it was played: from where the
                # robot is next time, another size would fit.
                wanted = run.motion or motion
                if run.recording.fault:
                    on_played(run, None)  # _add then keeps the recording, and refuses to add it
                known, entry, sequence = _add(turn, run, folder, known, len(recorded))
                made = Recorded(run=run, id=entry.id, rows=len(sequence), rate=sequence.rate)
                on_played(run, made)
                recorded.append(made)
                seed += 1
    return RecordResult(folder=folder, recorded=tuple(recorded))


def _unit_id(request: RunRequest) -> str:
    """Return the name of the recorded robot.

    Raises:
        UsageError: A real one has no name or one that no file can have, or a virtual one is called
            by another.
    """
    unit_id = request.options.unit_id
    if not request.is_virtual:
        if not unit_id:
            raise UsageError("say which unit is recorded: --unit-id NAME")
        require_file_name(unit_id, "--unit-id")
        return unit_id
    connection = request.options.connection
    if unit_id not in ("", connection.unit, connection.unit_name):
        raise UsageError(
            f"--unit-id {unit_id}: a virtual robot is chosen by --unit {connection.unit}"
        )
    return connection.unit_name


def _add(
    request: RunRequest, run: RunResult, folder: Path, dataset: Dataset | None, added: int
) -> tuple[Dataset, Entry, Sequence]:
    """Save the recording of a run, and add it to the dataset, which is created if there is none.

    Args:
        added: Number of motions that were added before, for the error.

    Raises:
        UsageError: The run ended with a fault.
    """
    from gaponet.data.importer import measure_delays
    from gaponet.data.sequence import SequenceMeta, to_sequence
    from gaponet.data.store import Dataset

    options = request.options
    recording = run.recording
    played = run.motion
    assert played is not None
    assert options.payload_mass is not None
    slot = (played.name, options.unit_id, options.payload_mass, options.payload_side)
    repetition = 0
    if dataset is not None:
        repetition = sum(entry.meta.repetition_key == slot for entry in dataset.entries)
    stem = f"{played.name}-{options.unit_id}-{options.payload_mass:g}kg-{repetition}"
    stem = recording.save(folder / RECORDINGS, stem).stem
    if recording.fault:
        raise UsageError(
            f"'{played.name}' was stopped ({recording.fault.text}); it was not added to {folder}, "
            f"its recording is {folder / RECORDINGS / stem}.*; {added} motions were added before it"
        )
    meta = SequenceMeta(
        run.robot.name,
        options.unit_id,
        played.name,
        options.payload_mass,
        options.payload_side,
        played.level,
        repetition,
        recording.virtual,
        f"{RECORDINGS}/{stem}.parquet",
        notes={"controller": recording.summary()},
    )
    sequence = to_sequence(recording.log(stem), run.robot, meta)
    if dataset is None:  # not before there is something to keep
        dataset = Dataset.create(folder, run.robot)
    return dataset, dataset.append(sequence, measure_delays(sequence)), sequence
