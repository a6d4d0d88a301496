"""`gaponet record`: the same loop as gaponet run, its recording appended to a dataset."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

import tyro

from gaponet.api.record import Recorded, record_motions
from gaponet.api.results import RunResult
from gaponet.api.run_options import ControlOptions, RunOptions
from gaponet.api.run_robot import RunRequest
from gaponet.cli.options import Json
from gaponet.cli.out import Out, writes
from gaponet.cli.run import ControlArgs, ScreenReporter, show_result


@dataclass(frozen=True)
class RecordArgs(ControlArgs):
    """Options of a recording: those of ControlArgs, and a seed."""

    seed: int = 0
    """virtual: seed of the noise in the first recording; it increases by one per recording."""


@writes("dataset")
def record(
    motion: tuple[str, ...],
    out: Path,
    payload_mass: float,
    unit_id: str = "",
    repetitions: int = 1,
    args: Annotated[
        RecordArgs, tyro.conf.arg(name=""), tyro.conf.FlagCreatePairsOff
    ] = RecordArgs(),
    json: Json = False,
) -> None:
    """Play a motion without correction and record it into a dataset.

    Args:
        motion: Names or files of motions, played one after the other.
        out: Dataset folder; created or appended to. The full recording of every run goes to
            OUT/recordings.
        unit_id: Name of the recorded robot; the virtual driver sets it.
        payload_mass: Payload in each hand that --payload-side names, kg; 0 if the hands are empty.
        repetitions: Number of times that each motion is played.
        args: Robot and control loop.
    """
    screen = Out(json)

    def show(run: RunResult, made: Recorded | None) -> None:
        show_result(screen, run)
        if made is not None:
            screen.say(f"added to {out}: {made.id}, {made.rows} rows at {made.rate:.2f} Hz")

    shared = {field.name: getattr(args, field.name) for field in fields(ControlOptions)}
    options = RunOptions(**shared, payload_mass=payload_mass, unit_id=unit_id, seed=args.seed)
    made = record_motions(
        motion,
        RunRequest(args.robot, driver=args.driver, options=options),
        out=out,
        repetitions=repetitions,
        report=ScreenReporter(screen),
        on_played=show,
    )
    screen.result(made.to_dict())
