"""`gaponet record`: the same loop as gaponet run, its recording appended to a dataset."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import tyro

from gaponet.cli.out import Out, writes
from gaponet.cli.run import Reach, Request, asked_robot, perform, tracking
from gaponet.deploy.phases import ControlConfig
from gaponet.deploy.safety import SafetyConfig
from gaponet.errors import DatasetError, UsageError


@writes("dataset")
def record(
    motion: str,
    out: Path,
    payload_mass: float,
    unit_id: str = "",
    driver: Literal["virtual", "unitree", "so101"] = "virtual",
    robot: str | None = None,
    payload_side: str = "both",
    max_payload: float | None = None,
    repetitions: int = 1,
    seed: int = 0,
    reach: tyro.conf.OmitArgPrefixes[Reach] = Reach(),  # noqa: B008
    control: tyro.conf.OmitArgPrefixes[ControlConfig] = ControlConfig(),  # noqa: B008
    safety: SafetyConfig = SafetyConfig(),  # noqa: B008
    yes: tyro.conf.FlagCreatePairsOff[bool] = False,
    json: tyro.conf.FlagCreatePairsOff[bool] = False,
) -> None:
    """Play a motion uncorrected and add what the robot did to a dataset, with unit, payload and gains.

    Args:
        motion: A motion's name or file; several, separated by commas, are played one after the other.
        out: Dataset folder; made, or appended to. Every run's full recording goes to OUT/recordings.
        unit_id: Which of its kind was recorded; the virtual driver knows it and sets it.
        payload_mass: kg in each hand named by payload_side; 0 when empty.
        driver: virtual (in this process), unitree (DDS: a real H1-2, or gaponet virtual serve), so101 (serial).
        robot: Name or folder; default h1_2, or so101 with that driver.
        payload_side: both, or one hand.
        max_payload: kg that the motion must be possible with; default 3 for named motions, so that all payloads play
            the same one, and payload_mass for files.
        repetitions: Of each motion.
        seed: virtual: of the first recording's noise; later ones count on.
        reach: How to reach the robot.
        control: Timing.
        safety: Limits and watchdogs.
        yes: Do not ask before a robot moves.
        json: One JSON object on stdout.
    """
    from gaponet.data.importer import findings
    from gaponet.data.sequence import SequenceMeta, to_sequence
    from gaponet.data.store import Dataset
    from gaponet.robot_folder import MOVE_KEPT
    from gaponet.sim.kept import require_kept

    if driver != "virtual" and not unit_id:
        raise UsageError("say which unit is recorded: --unit-id NAME")
    screen = Out(json)
    if driver == "virtual":
        unit_id = f"virtual-{reach.unit}" if reach.unit.isdigit() else reach.unit
    asked = Request("", driver, robot, None, payload_mass, payload_side, max_payload, reach, control, safety, yes)
    spec = asked_robot(asked)
    if Dataset.peek(out, spec) is not None:  # before anything moves
        require_kept(out, spec, DatasetError, MOVE_KEPT)
    written: list[str] = []
    errors: list[dict[str, Any]] = []
    for count, name in enumerate([m.strip() for m in motion.split(",") for _ in range(repetitions)], seed):
        recording, played, spec = perform(screen, replace(asked, motion=name, seed=count))
        known = Dataset.create(out, spec)
        same = [
            e for e in known.entries
            if (e.meta.motion, e.meta.unit_id, e.meta.payload_mass, e.meta.payload_side)
            == (played.name, unit_id, payload_mass, payload_side)
        ]  # fmt: skip
        stem = f"{played.name}-{unit_id}-{payload_mass:g}kg-{len(same)}"
        stem = recording.save(out / "recordings", stem).stem
        if recording.fault:
            raise UsageError(
                f"'{played.name}' was stopped ({recording.fault.text}); it was not added to {out}, its recording is "
                f"{out / 'recordings' / stem}.*; {len(written)} motions were added before it"
            )
        meta = SequenceMeta(
            spec.name, unit_id, played.name, payload_mass, payload_side, played.level, len(same), recording.virtual,
            f"recordings/{stem}.parquet", notes={"controller": recording.summary()},
        )  # fmt: skip
        sequence = to_sequence(recording.log(stem), spec, meta)
        written.append(known.append(sequence, findings(sequence)).id)
        errors.append(tracking(recording))
        screen.say(f"added to {out}: {written[-1]}, {len(sequence)} rows at {sequence.rate:.2f} Hz")
    screen.result({"dataset": str(out), "written": written, "tracking": errors})
