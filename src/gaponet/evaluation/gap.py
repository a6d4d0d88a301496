"""Sources of the gap: the error after each step from the nominal to the identified simulator and
to a model on top of it, and the error floor.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.progress import Progress, no_progress, with_note
from gaponet.data.repeatability import Repetitions, repetition_difference
from gaponet.data.sequence import Sequence, SequenceMeta, whole_rate
from gaponet.data.signals import encoder_step
from gaponet.data.store import Dataset, Entry
from gaponet.evaluation.baselines import baseline_errors, command_run
from gaponet.evaluation.candidate import Candidate, select_entries
from gaponet.nn.delay_offset import DelayOffset
from gaponet.robot.servo_fields import SERVO_FIELDS
from gaponet.robot.spec import RobotSpec
from gaponet.sim.metrics import Run, mean_reduction, metrics, runs
from gaponet.sim.metrics import summary as errors_of
from gaponet.sim.model import model_hash
from gaponet.sim.replay import Corrector, kept_replays, replay

MAX_COMPARED = 60  # recordings that are searched for equal commands


@dataclass(frozen=True)
class GapStep:
    """A simulator on the way from the nominal one to the model.

    Attributes:
        name: Of the step, a key of evaluation.methods.METHODS.
        simulator: Robot that is simulated.
        corrector: Corrects its targets; None if nothing does.
    """

    name: str
    simulator: RobotSpec
    corrector: Corrector | None = None


def gap_by_step(
    candidate: Candidate,
    dataset: Dataset,
    motions: tuple[str, ...] = (),
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Return the mean |error| after each step from the nominal simulator to the candidate.

    Errors are of open-loop rollouts. The steps, in this order:

    - "nominal": the simulator before identification.
    - of a run, "delay" and "offset": nominal, with the delay (and the offset) of each joint that
      fit the training motions best.
    - of an identified simulator, its CAUSES, one after the other. Friction is two steps. After
      "friction" joints creep as MuJoCo's do under a constant load; after "creep" they hold.
    - of a run, its model.

    The reduction by a cause depends on the order of the causes.

    Args:
        candidate: An identified robot, or a run; its recordings, baseline, simulator and model are
            used.
        dataset: The recordings.
        motions: Only these; default: those that the candidate was not fitted to.
        progress: Called while recordings are simulated.

    Returns:
        A dictionary with these entries, and facts about dataset, robot and simulators. Errors are
        in rad; what is unknown is None.

        - methods: nominal, identified, … → `metrics.summary`.
        - baselines: delay_offset, command → error.
        - left: step → error after it.
        - removed: step → [reduction, its standard error over independent motions].
        - floor: encoder, repeatability, both → error that no simulator can remove.
        - unexplained: error of the last step above the floor.
        - by_joint: joint → left, removed, floor and unexplained.
        - by_payload: kg → step → error.
    """
    robot = candidate.robot
    dataset.require_robot(robot)
    nominal = robot.before_identification
    entries, unseen = select_entries([candidate.folder], dataset, motions)
    sequences = dataset.sequences(entries)
    causes = cause_steps(robot)
    steps = _steps(candidate, causes)
    runs_after = _simulate(steps, dataset, entries, sequences, robot, progress)
    floors = _floors(sequences, dataset, robot)
    simulators = {"nominal": model_hash(nominal)}
    if causes:
        simulators["identified"] = model_hash(robot)
    commands = [command_run(sequence, robot) for sequence in sequences]
    return {
        "methods": _methods(candidate, causes, runs_after),
        "baselines": baseline_errors(runs_after["nominal"], commands),
        **_sources(runs_after, floors["all"]),
        "by_joint": _by_joint(runs_after, floors, robot),
        "by_payload": _by_payload(runs_after, sequences),
        "virtual": any(sequence.meta.virtual for sequence in sequences),
        "unseen": unseen,
        "sequences": len(sequences),
        "hours": sum(entry.rows * entry.dt for entry in entries) / 3600,
        "simulator_hash": simulators["nominal"],
        "simulators": simulators,
        "dataset": dataset.path.name,
        "robot": robot.name,
    }


def _simulate(
    steps: ListOf[GapStep],
    dataset: Dataset,
    entries: list[Entry],
    sequences: list[Sequence],
    robot: RobotSpec,
    progress: Progress,
) -> dict[str, list[Run]]:
    """Return step → the runs of all recordings after it."""
    runs_after = {}
    for step in steps:
        report = with_note(progress, step.name)
        if step.corrector is None:
            creeps = step.name == "friction"  # "creep" is the next step: it ends the creeping
            replays = kept_replays(dataset, entries, step.simulator, report, creeps=creeps)
        else:
            replays = replay(
                sequences, step.simulator, step.corrector, lock_idle=True, progress=report
            )
        runs_after[step.name] = runs(sequences, [one.qpos for one in replays], robot)
    return runs_after


def _methods(
    candidate: Candidate, causes: ListOf[GapStep], runs_after: dict[str, list[Run]]
) -> dict[str, Any]:
    """Return the errors of the methods that some steps are: nominal, identified, …"""
    step_of = {"nominal": "nominal"}
    if "offset" in runs_after:
        step_of["delay_offset"] = "offset"
    if causes:
        step_of["identified"] = causes[-1].name
    if candidate.model is not None:
        step_of[candidate.method] = list(runs_after)[-1]
    errors = {}
    for name, step in step_of.items():
        errors[name] = errors_of(runs_after[step], candidate.robot)
    return errors


def _floors(
    sequences: list[Sequence], dataset: Dataset, robot: RobotSpec
) -> dict[str, dict[str, float | None]]:
    """Return the floor of each joint, and under "all" that of their mean, rad.

    Without repetitions among the recordings, all recordings of their units are searched for some.
    """
    searched: Iterable[Sequence] = sequences
    if not any(sequence.meta.repetition for sequence in sequences):
        units = {sequence.meta.unit_id for sequence in sequences}
        entries = [entry for entry in dataset.entries if entry.meta.unit_id in units]
        searched = (dataset.sequences([entry])[0] for entry in entries)
    floors = error_floor(searched, robot)
    of_all = {}
    for kind in ("encoder", "repeatability", "both"):
        of_all[kind] = _mean([floor[kind] for floor in floors.values()])
    return floors | {"all": of_all}


def _by_joint(
    runs_after: dict[str, list[Run]], floors: dict[str, dict[str, float | None]], robot: RobotSpec
) -> dict[str, Any]:
    """Return the sources of the gap of each joint that was recorded."""
    last = list(runs_after)[-1]
    sources = {}
    for column, joint in enumerate(robot.operated):
        if metrics(runs_after[last], [column]):
            sources[joint] = _sources(runs_after, floors[joint], [column])
    return sources


def _by_payload(
    runs_after: dict[str, list[Run]], sequences: list[Sequence]
) -> dict[str, dict[str, float]]:
    """Return payload, kg → step → error, rad."""
    errors: dict[str, dict[str, float]] = {}
    for payload in sorted({sequence.meta.payload_mass for sequence in sequences}):
        left = {}
        for step, runs_of_step in runs_after.items():
            same = [run for run in runs_of_step if run.meta.payload_mass == payload]
            left[step] = metrics(same)["mpjae"]
        errors[f"{payload:g}"] = left
    return errors


def _steps(candidate: Candidate, causes: list[GapStep]) -> list[GapStep]:
    """Return the steps from the nominal simulator over the causes to the model.

    Without causes, delay and offset of the recordings come first; among the causes, the robot has
    its own.
    """
    nominal = candidate.robot.before_identification
    start = [GapStep("nominal", nominal)]
    if candidate.model is None:
        return start + causes
    if not causes:
        fitted = DelayOffset.read(candidate.folder)
        only_delay = DelayOffset(fitted.delay, dict.fromkeys(fitted.offset, 0.0))
        start.append(GapStep("delay", nominal, only_delay.corrector(nominal)))
        start.append(GapStep("offset", nominal, fitted.corrector(nominal)))
    corrected = GapStep(candidate.method, candidate.robot, candidate.corrector())
    return [*start, *causes, corrected]


def _sources(
    runs_after: dict[str, list[Run]],
    floor: dict[str, float | None],
    columns: list[int] | None = None,
) -> dict[str, Any]:
    """Return the error after each step, its reductions, the floor, and the error above it, rad.

    Args:
        columns: Only these operated joints, by number; default: all.
    """
    left = {}
    for step, part in runs_after.items():
        left[step] = metrics(part, columns)["mpjae"]
    least = floor["both"]
    unexplained = None
    if least is not None:
        last = list(left.values())[-1]
        unexplained = max(last - least, 0.0)
    return {
        "left": left,
        "removed": reductions(runs_after, columns),
        "unexplained": unexplained,
        "floor": floor,
    }


def _fields_by_cause() -> dict[str, list[str]]:
    """Return cause → fields of servos; none for causes that are no servo's."""
    fields: dict[str, list[str]] = {}
    for field in SERVO_FIELDS.values():
        fields.setdefault(field.cause, []).append(field.name)
    return fields | {"hand": [], "links": []}


# Fields in which an identified simulator differs from the nominal one, in the order of the steps.
CAUSES = _fields_by_cause()


def cause_steps(simulator: RobotSpec) -> list[GapStep]:
    """Return the simulators from the first cause on; the last one is the identified simulator."""
    if not simulator.is_identified:
        return []
    robot = simulator.before_identification
    steps = []
    for cause, fields in CAUSES.items():
        changed = _with_cause(robot, simulator, cause, fields)
        if model_hash(changed) != model_hash(robot):
            steps.append(GapStep(cause, changed))
            if cause == "friction":
                steps.append(GapStep("creep", changed))
        robot = changed
    return steps


def _with_cause(
    robot: RobotSpec, identified: RobotSpec, cause: str, fields: list[str]
) -> RobotSpec:
    """Return a robot that takes what a cause changes from the identified one."""
    servos: dict[str, dict[str, float]] = {}
    for row, joint in enumerate(identified.joint_names):
        servos[joint] = identified.servo.finite_of_joint(row, fields)
    changed = robot.with_identified(servos)
    if cause == "contact":
        return changed.with_table(identified.scene.table)
    if cause == "hand":
        return replace(changed, payload_mounts=identified.payload_mounts)
    if cause == "links":
        return replace(changed, links=identified.links)
    return changed


def reductions(
    runs_after: dict[str, list[Run]], columns: list[int] | None = None
) -> dict[str, list[float]]:
    """Return the reduction of the error by each step and its standard error over independent
    motions, rad.
    """
    errors = {}  # step → mean |error| of each recording, (recordings,) rad
    metas: list[SequenceMeta] = []
    for step, part in runs_after.items():
        held = [run for run in part if run.holds(columns)]
        errors[step] = np.array([run.mean_error(columns) for run in held])
        metas = [run.meta for run in held]  # the same after every step
    removed = {}
    for before, after in pairwise(errors):
        removed[after] = list(mean_reduction(metas, errors[before], errors[after]))
    return removed


def error_floor(
    sequences: Iterable[Sequence], robot: RobotSpec
) -> dict[str, dict[str, float | None]]:
    """Return the mean |error| that no simulator can remove: joint → encoder, repeatability, and
    both together, rad; None if unknown.

    An encoder of step s reads wrong by s/4 on average. A robot that differs from itself by σ from
    one repetition, or from one period of a motion, to the next differs from its own mean by
    √(2/π)·σ on average, encoder included.
    """
    # What is compared, by motion, unit, payload and rate: whole recordings, and periods.
    groups: dict[Any, Repetitions] = defaultdict(Repetitions)
    angles: list[Array] = []  # (T, n operated) rad of each recording
    first_sequences: list[Sequence] = []
    for sequence in sequences:
        if len(first_sequences) < MAX_COMPARED:
            first_sequences.append(sequence)
        angles.append(sequence.qpos[:, robot.operated_index])
        key = (*sequence.meta.repetition_key, whole_rate(sequence.dt))
        groups[key, "whole"].add(sequence)
        for period in Repetitions.periods(sequence):
            groups[key, "period"].add(period)
    std = _std_of_repetitions(groups.values(), robot)
    if not std:
        std = _std_of_equal_commands(first_sequences, robot)
    floors = {}
    for column, joint in enumerate(robot.operated):
        step = encoder_step([angle[:, column] for angle in angles])
        floors[joint] = _floor(step, std.get(joint))
    return floors


def _floor(encoder_step: float, std: float | None) -> dict[str, float | None]:
    """Return the error that no simulator can remove, rad; None if unknown.

    Args:
        encoder_step: rad; 0 if unknown.
        std: Standard deviation among repetitions, rad; None if unknown.
    """
    encoder = encoder_step / 4 if encoder_step else None
    repeatability = None if std is None else std * np.sqrt(2 / np.pi)
    known = [part for part in (encoder, repeatability) if part]
    return {"encoder": encoder, "repeatability": repeatability, "both": max(known, default=None)}


def _std_of_repetitions(groups: Iterable[Repetitions], robot: RobotSpec) -> dict[str, float]:
    """Return joint → standard deviation among repetitions, rad; empty if nothing was repeated."""
    repeated = [group.result() for group in groups if group.count > 1]
    if not repeated:
        return {}
    summary = Repetitions.summary(repeated, robot.joint_names)
    return dict(summary["channels"]["qpos"]["joints"])


def _std_of_equal_commands(sequences: list[Sequence], robot: RobotSpec) -> dict[str, float]:
    """Return joint → standard deviation among recordings of one command under several names, rad;
    without joints for which there are none.

    The difference of two recordings has √2 times the standard deviation of one.
    """
    std = {}
    differences = repetition_difference(sequences, robot.operated).tolist()
    for joint, difference in zip(robot.operated, differences, strict=True):
        if difference:
            std[joint] = difference / np.sqrt(2)
    return std


def _mean(values: ListOf[float | None]) -> float | None:
    """Return the mean of numbers; None if one is unknown."""
    if None in values:
        return None
    return float(np.mean(np.asarray(values, float)))
