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
from gaponet.data.sequence import Sequence, SequenceMeta
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
    """Mean |error| after each step, in open-loop rollouts of motions that the candidate was not
    fitted to.

    Steps: nominal; of a run, delay (fitted on the training motions) and offset (delay and offset);
    of an identified simulator its CAUSES, one after the other, and static friction that holds
    ("creep": with the step "friction" alone, friction creeps as MuJoCo's does); of a run, its
    model. Standard errors are over independent motions, of paired reductions. The reduction by a
    cause depends on the order of causes. "unexplained" is the error above the floor.

    Args:
        candidate: An identified robot, or a run; its recordings, baseline, simulator and model are
            used.
        dataset: The recordings.
        motions: Only these; default: those that the candidate was not fitted to.
        progress: Called while recordings are simulated.

    Returns:
        {"methods": {nominal, identified, …: metrics.summary}, "baselines": {delay_offset, command:
        rad}, "left": {step: rad}, "removed": {step: [rad, standard error]}, "unexplained": rad,
        "by_joint": {joint: the same and "floor"}, "by_payload": {kg: {step: rad}}, "floor":
        {"encoder", "repeatability", "both": rad}, …}; an unknown floor is None, and so is the error
        above it.
    """
    robot = candidate.robot
    dataset.require_robot(robot)
    nominal = robot.before_identification
    entries, unseen = select_entries([candidate.folder], dataset, motions)
    sequences = dataset.sequences(entries)
    causes = cause_steps(robot)
    done = _simulate(_steps(candidate, causes), dataset, entries, sequences, robot, progress)
    floors = _floors(sequences, dataset, robot)
    simulators = {"nominal": model_hash(nominal)}
    if causes:
        simulators["identified"] = model_hash(robot)
    commands = [command_run(sequence, robot) for sequence in sequences]
    return {
        "methods": _methods(candidate, causes, done),
        "baselines": baseline_errors(done["nominal"], commands),
        **_sources(done, floors["all"]),
        "by_joint": _by_joint(done, floors, robot),
        "by_payload": _by_payload(done, sequences),
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
    """Return the runs of all recordings after each step."""
    done = {}
    for step in steps:
        report = with_note(progress, step.name)
        if step.corrector is None:
            creeps = step.name == "friction"
            replays = kept_replays(dataset, entries, step.simulator, report, creeps=creeps)
        else:
            replays = replay(
                sequences, step.simulator, step.corrector, lock_idle=True, progress=report
            )
        done[step.name] = runs(sequences, [one.qpos for one in replays], robot)
    return done


def _methods(
    candidate: Candidate, causes: ListOf[GapStep], done: dict[str, list[Run]]
) -> dict[str, Any]:
    """Return the errors of the methods that some steps are: nominal, identified, …"""
    step_of = {"nominal": "nominal"}
    if "offset" in done:
        step_of["delay_offset"] = "offset"
    if causes:
        step_of["identified"] = causes[-1].name
    if candidate.model is not None:
        step_of[candidate.method] = list(done)[-1]
    return {name: errors_of(done[step], candidate.robot) for name, step in step_of.items()}


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
    done: dict[str, list[Run]], floors: dict[str, dict[str, float | None]], robot: RobotSpec
) -> dict[str, Any]:
    """Return the sources of the gap of each joint that was recorded."""
    last = list(done)[-1]
    sources = {}
    for column, joint in enumerate(robot.operated):
        if metrics(done[last], [column]):
            sources[joint] = _sources(done, floors[joint], [column])
    return sources


def _by_payload(
    done: dict[str, list[Run]], sequences: list[Sequence]
) -> dict[str, dict[str, float]]:
    """Return payload, kg → step → error, rad."""
    errors: dict[str, dict[str, float]] = {}
    for payload in sorted({sequence.meta.payload_mass for sequence in sequences}):
        left = {}
        for name, part in done.items():
            same = [run for run in part if run.meta.payload_mass == payload]
            left[name] = metrics(same)["mpjae"]
        errors[f"{payload:g}"] = left
    return errors


def _steps(candidate: Candidate, causes: list[GapStep]) -> list[GapStep]:
    """Return the steps from the nominal simulator over the causes to the model."""
    nominal = candidate.robot.before_identification
    start = [GapStep("nominal", nominal)]
    if candidate.model is None:
        return start + causes
    fitted = DelayOffset.read(candidate.folder)
    only_delay = DelayOffset(fitted.delay, dict.fromkeys(fitted.offset, 0.0))
    start.append(GapStep("delay", nominal, only_delay.corrector(nominal)))
    start.append(GapStep("offset", nominal, fitted.corrector(nominal)))
    corrected = GapStep(candidate.method, candidate.robot, candidate.corrector())
    return [*start, *causes, corrected]


def _sources(
    done: dict[str, list[Run]], floor: dict[str, float | None], columns: list[int] | None = None
) -> dict[str, Any]:
    """Return the error after each step, its reductions, the floor, and the error above it, rad."""
    left = {name: metrics(part, columns)["mpjae"] for name, part in done.items()}
    least = floor["both"]
    unexplained = None
    if least is not None:
        last = list(left.values())[-1]
        unexplained = max(last - least, 0.0)
    return {
        "left": left,
        "removed": reductions(done, columns),
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
# Cause → what else of the robot it changes.
BESIDE_SERVOS = {"contact": "table", "hand": "payload_mounts", "links": "links"}


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
        servos[joint] = {}
        for field in fields:
            value = float(getattr(identified, field)[row])
            if np.isfinite(value):
                servos[joint][field] = value
    changed = robot.with_servos(servos)
    if cause not in BESIDE_SERVOS:
        return changed
    other = BESIDE_SERVOS[cause]
    return replace(changed, **{other: getattr(identified, other)})


def reductions(
    done: dict[str, list[Run]], columns: list[int] | None = None
) -> dict[str, list[float]]:
    """Return the reduction of the error by each step and its standard error over independent
    motions, rad.
    """
    errors = {}
    metas: list[SequenceMeta] = []
    for name, part in done.items():
        held = [run for run in part if run.holds(columns)]
        errors[name] = np.array([run.mean_error(columns) for run in held])
        metas = metas or [run.meta for run in held]
    removed = {}
    for before, after in pairwise(errors):
        removed[after] = list(mean_reduction(metas, errors[before], errors[after]))
    return removed


def error_floor(
    sequences: Iterable[Sequence], robot: RobotSpec
) -> dict[str, dict[str, float | None]]:
    """Mean |error| that no simulator can remove, by joint: {"encoder", "repeatability", "both"},
    rad; None if unknown.

    An encoder of step s reads wrong by s/4 on average. A robot that differs from itself by σ from
    one repetition, or from one period of a motion, to the next differs from its own mean by
    √(2/π)·σ on average, encoder included.
    """
    groups: dict[Any, Repetitions] = defaultdict(Repetitions)
    angles: list[Array] = []
    compared: list[Sequence] = []
    for sequence in sequences:
        if len(compared) < MAX_COMPARED:
            compared.append(sequence)
        angles.append(sequence.qpos[:, robot.operated_index])
        same = (*sequence.meta.repetition_key, round(sequence.dt * 1e6))
        groups[same].add(sequence)
        for period in Repetitions.periods(sequence):
            groups[*same, "period"].add(period)
    std = _std_of_repetitions(groups.values(), robot)
    if not std:
        std = _std_under_several_names(compared, robot)
    floors: dict[str, dict[str, float | None]] = {}
    for column, joint in enumerate(robot.operated):
        encoder = encoder_step([angle[:, column] for angle in angles]) / 4 or None
        repeatability = std[joint] * np.sqrt(2 / np.pi) if joint in std else None
        both = max(encoder or 0.0, repeatability or 0.0) or None
        floors[joint] = {"encoder": encoder, "repeatability": repeatability, "both": both}
    return floors


def _std_of_repetitions(groups: Iterable[Repetitions], robot: RobotSpec) -> dict[str, float]:
    """Return joint → standard deviation among repetitions, rad; empty if nothing was repeated."""
    repeated = [group.result() for group in groups if group.count > 1]
    if not repeated:
        return {}
    summary = Repetitions.summary(repeated, robot.joint_names)
    return dict(summary["channels"]["qpos"]["joints"])


def _std_under_several_names(sequences: list[Sequence], robot: RobotSpec) -> dict[str, float]:
    """Return joint → standard deviation, rad, among recordings of one command with other names."""
    differences = repetition_difference(sequences, robot.operated).tolist()
    std = {}
    for joint, difference in zip(robot.operated, differences, strict=True):
        if difference:
            std[joint] = difference / np.sqrt(2)
    return std


def _mean(values: ListOf[float | None]) -> float | None:
    """Return the mean of numbers; None if one is unknown."""
    numbers = [value for value in values if value is not None]
    if len(numbers) < len(values):
        return None
    return float(np.mean(numbers))
