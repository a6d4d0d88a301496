"""`gaponet record`: the same loop as gaponet run, its recording appended to a dataset."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from gaponet.api.run_options import ControlOptions, RunOptions
from gaponet.api.run_robot import RunRequest, execute, resolve_robot
from gaponet.base.errors import DatasetError, UsageError
from gaponet.cli.options import Json
from gaponet.cli.out import Out, writes
from gaponet.cli.run import ControlArgs, ScreenReporter, show_result


@writes("dataset")
def record(
    motion: tuple[str, ...],
    out: Path,
    payload_mass: float,
    unit_id: str = "",
    repetitions: int = 1,
    seed: int = 0,
    args: Annotated[
        ControlArgs, tyro.conf.arg(name=""), tyro.conf.FlagCreatePairsOff
    ] = ControlArgs(),  # noqa: B008
    json: Json = False,
) -> None:
    """Play a motion without correction and record it into a dataset.

    Args:
        motion: Names or files of motions, played one after the other.
        out: Dataset folder; created or appended to. The full recording of every run goes to OUT/recordings.
        unit_id: Name of the recorded robot; the virtual driver sets it.
        payload_mass: kg in each hand that payload_side names; 0 when empty.
        repetitions: Number of times that each motion is played.
        seed: virtual: seed of the noise in the first recording; it increases by one per recording.
        args: Robot and control loop.
    """
    from gaponet.data.importer import measure_delays
    from gaponet.data.sequence import SequenceMeta, to_sequence
    from gaponet.data.store import Dataset
    from gaponet.robot.folder import MOVE_STORED_ROBOT
    from gaponet.sim.model import require_stored_robot

    side = args.payload_side
    if args.driver != "virtual" and not unit_id:
        raise UsageError("say which unit is recorded: --unit-id NAME")
    screen = Out(json)
    if repetitions < 1:
        raise UsageError(f"--repetitions {repetitions}: give 1 or more, or nothing is recorded")
    if args.driver == "virtual":
        if unit_id not in ("", args.connection.unit, args.connection.unit_name):
            raise UsageError(
                f"--unit-id {unit_id}: a virtual robot is chosen by --unit {args.connection.unit}"
            )
        unit_id = args.connection.unit_name
    shared = {field.name: getattr(args, field.name) for field in fields(ControlOptions)}
    options = RunOptions(**shared, payload_mass=payload_mass, out=out / "recordings")
    first = RunRequest(args.robot, motion[0], args.driver, options=options)
    spec = resolve_robot(first)
    known = Dataset.open_existing(out, spec)
    if known is not None:  # before anything moves
        require_stored_robot(out, spec, DatasetError, MOVE_STORED_ROBOT)
    written: list[str] = []
    errors: list[dict[str, Any]] = []
    for count, name in enumerate([name for name in motion for _ in range(repetitions)], seed):
        request = replace(first, motion=name, options=replace(options, seed=count))
        result = execute(request, ScreenReporter(screen))
        show_result(screen, result)
        recording = result.recording
        played = result.motion
        spec = result.robot
        assert played
        slot = (played.name, unit_id, payload_mass, side)
        same = [e for e in known.entries if e.meta.repetition_key == slot] if known else []
        stem = f"{played.name}-{unit_id}-{payload_mass:g}kg-{len(same)}"
        stem = recording.save(out / "recordings", stem).stem
        if recording.fault:
            raise UsageError(
                f"'{played.name}' was stopped ({recording.fault.text}); it was not added to {out}, its recording is "
                f"{out / 'recordings' / stem}.*; {len(written)} motions were added before it"
            )
        meta = SequenceMeta(
            spec.name, unit_id, played.name, payload_mass, side, played.level, len(same), recording.virtual,
            f"recordings/{stem}.parquet", notes={"controller": recording.summary()},
        )  # fmt: skip
        sequence = to_sequence(recording.log(stem), spec, meta)
        known = known or Dataset.create(out, spec)  # not before there is something to keep
        written.append(known.append(sequence, measure_delays(sequence)).id)
        errors.append(result.tracking())
        screen.say(f"added to {out}: {written[-1]}, {len(sequence)} rows at {sequence.rate:.2f} Hz")
    screen.result({"dataset": str(out), "written": written, "tracking": errors})
