"""Sources of the gap: the error after each step from the nominal to the identified simulator and to a model on top of
it, and the error floor."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from collections.abc import Sequence as ListOf
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.progress import Progress, no_progress, with_note
from gaponet.data.repeatability import Repetitions, repetition_difference
from gaponet.data.sequence import Sequence
from gaponet.data.signals import encoder_step
from gaponet.data.store import Dataset
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


def gap_by_step(
    candidate: Candidate,
    dataset: Dataset,
    motions: tuple[str, ...] = (),
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Mean |error| after each step, in open-loop rollouts of motions that the candidate was not fitted to.

    Steps: nominal; of a run, delay (fitted on the training motions) and offset (delay and offset); of an identified
    simulator its CAUSES, one after the other, and static friction that holds ("creep": with the step "friction" alone,
    friction creeps as MuJoCo's does); of a run, its model. Standard errors are over independent motions, of paired
    reductions. The reduction by a cause depends on the order of causes. "unexplained" is the error above the floor.

    Args:
        candidate: An identified robot, or a run; its recordings, baseline, simulator and model are used.

    Returns:
        {"methods": {nominal, identified, …: metrics.summary}, "baselines": {delay_offset, command: rad}, "left": {step:
        rad}, "removed": {step: [rad, standard error]}, "unexplained": rad, "by_joint": {joint: the same and "floor"},
        "by_payload": {kg: {step: rad}}, "floor": {"encoder": rad, "repeatability": rad, "both": rad}, …}; an unknown
        floor is None, and so is the error above it.
    """
    robot = candidate.robot
    dataset.require_robot(robot)
    nominal = robot.before_identification
    entries, unseen = select_entries([candidate.folder], dataset, motions)
    sequences = dataset.sequences(entries)
    causes, done = cause_steps(robot), {}
    for name, physics, corrector in _steps(candidate, causes):
        report = with_note(progress, name)
        if corrector is None:
            replays = kept_replays(dataset, entries, physics, report, creeps=name == "friction")
        else:
            replays = replay(sequences, physics, corrector, lock_idle=True, progress=report)
        done[name] = runs(sequences, [t.qpos for t in replays], robot)
    units = {s.meta.unit_id for s in sequences}
    others = (dataset.sequences([e])[0] for e in dataset.entries if e.meta.unit_id in units)
    floors = error_floor(sequences if any(s.meta.repetition for s in sequences) else others, robot)
    floors["all"] = {
        k: _mean([f[k] for f in floors.values()]) for k in ("encoder", "repeatability", "both")
    }
    last = list(done)[-1]
    methods = {"nominal": "nominal"} | ({"delay_offset": "offset"} if "offset" in done else {})
    methods |= {"identified": causes[-1][0]} if causes else {}
    methods |= {candidate.method: last} if candidate.model is not None else {}
    return {
        "methods": {name: errors_of(done[step], robot) for name, step in methods.items()},
        "baselines": baseline_errors(done["nominal"], [command_run(s, robot) for s in sequences]),
        **_sources(done, floors["all"]),
        "by_joint": {
            j: _sources(done, floors[j], [i]) for i, j in enumerate(robot.operated) if metrics(done[last], [i])
        },
        "by_payload": {
            f"{p:g}": {n: metrics([r for r in part if r.meta.payload_mass == p])["mpjae"] for n, part in done.items()}
            for p in sorted({s.meta.payload_mass for s in sequences})
        },
        "virtual": any(s.meta.virtual for s in sequences),
        "unseen": unseen,
        "sequences": len(sequences),
        "hours": sum(e.rows * e.dt for e in entries) / 3600,
        "simulator_hash": model_hash(nominal),
        "simulators": {"nominal": model_hash(nominal)} | ({"identified": model_hash(robot)} if causes else {}),
        "dataset": dataset.path.name,
        "robot": robot.name,
    }  # fmt: skip


def _steps(
    candidate: Candidate, causes: list[tuple[str, RobotSpec]]
) -> list[tuple[str, RobotSpec, Corrector | None]]:
    """Return name, simulator and corrector of each step, from the nominal simulator over the causes to the model."""
    nominal = candidate.robot.before_identification
    start: list[tuple[str, RobotSpec, Corrector | None]] = [("nominal", nominal, None)]
    middle: list[tuple[str, RobotSpec, Corrector | None]] = [
        (cause, physics, None) for cause, physics in causes
    ]
    if candidate.model is None:
        return start + middle
    fitted = DelayOffset.read(candidate.folder)
    only_delay = DelayOffset(fitted.delay, dict.fromkeys(fitted.offset, 0.0))
    start += [
        ("delay", nominal, only_delay.corrector(nominal)),
        ("offset", nominal, fitted.corrector(nominal)),
    ]
    return [*start, *middle, (candidate.method, candidate.robot, candidate.corrector())]


def _sources(
    done: dict[str, list[Run]], floor: dict[str, float | None], columns: list[int] | None = None
) -> dict[str, Any]:
    """Return the error after each step, its reductions, the floor, and the error above it, rad."""
    left = {name: metrics(part, columns)["mpjae"] for name, part in done.items()}
    least, last = floor["both"], list(left.values())[-1]
    unexplained = None if least is None else max(last - least, 0.0)
    return {
        "left": left,
        "removed": reductions(done, columns),
        "unexplained": unexplained,
        "floor": floor,
    }


# Fields in which an identified simulator differs from the nominal one, in the order of the steps.
CAUSES = {cause: [f.name for f in SERVO_FIELDS.values() if f.cause == cause]
          for cause in (*(f.cause for f in SERVO_FIELDS.values()), "hand", "links")}  # fmt: skip


def cause_steps(simulator: RobotSpec) -> list[tuple[str, RobotSpec]]:
    """Return the simulators from the first cause on; the last one is the identified simulator."""
    if simulator.nominal is None:
        return []
    robot, steps = simulator.before_identification, []
    for cause, fields in CAUSES.items():
        servos = {
            joint: {
                f: float(getattr(simulator, f)[i])
                for f in fields
                if np.isfinite(getattr(simulator, f)[i])
            }
            for i, joint in enumerate(simulator.joint_names)
        }
        changed = robot.with_servos(servos)
        more = {"contact": "table", "hand": "payload_mounts", "links": "links"}.get(cause)
        changed = replace(changed, **{more: getattr(simulator, more)}) if more else changed
        if model_hash(changed) != model_hash(robot):
            steps += (
                [(cause, changed)]
                if cause != "friction"
                else [(cause, changed), ("creep", changed)]
            )
        robot = changed
    return steps


def reductions(
    done: dict[str, list[Run]], columns: list[int] | None = None
) -> dict[str, list[float]]:
    """Return the reduction of the error by each step and its standard error over independent motions, rad."""
    held = {name: [r for r in part if r.holds(columns)] for name, part in done.items()}
    errors = {name: np.array([r.mean_error(columns) for r in part]) for name, part in held.items()}
    metas = [r.meta for r in next(iter(held.values()))]
    pairs = pairwise(errors)
    return {
        after: list(mean_reduction(metas, errors[before], errors[after])) for before, after in pairs
    }


def error_floor(
    sequences: Iterable[Sequence], robot: RobotSpec
) -> dict[str, dict[str, float | None]]:
    """Mean |error| that no simulator can remove, by joint: {"encoder", "repeatability", "both"}, rad; None if unknown.

    An encoder of step s reads wrong by s/4 on average. A robot that differs from itself by σ from one repetition, or
    from one period of a motion, to the next differs from its own mean by √(2/π)·σ on average, encoder included.
    """
    groups: dict[Any, Repetitions] = defaultdict(Repetitions)
    angles: list[Array] = []
    some: list[Sequence] = []
    for s in sequences:
        some += [s] * (len(some) < MAX_COMPARED)
        angles.append(s.qpos[:, robot.operated_index])
        same = (*s.meta.repetition_key, round(s.dt * 1e6))
        groups[same].add(s)
        for period in Repetitions.periods(s):
            groups[*same, "period"].add(period)
    repeated = [g.result() for g in groups.values() if g.count > 1]
    std = (
        Repetitions.summary(repeated, robot.joint_names)["channels"]["qpos"]["joints"]
        if repeated
        else {}
    )
    if not std:  # recordings of one command under several names
        differences = zip(
            robot.operated, repetition_difference(some, robot.operated).tolist(), strict=True
        )
        std = {joint: difference / np.sqrt(2) for joint, difference in differences if difference}
    floors: dict[str, dict[str, float | None]] = {}
    for i, joint in enumerate(robot.operated):
        encoder = encoder_step([a[:, i] for a in angles]) / 4 or None
        repeatability = std[joint] * np.sqrt(2 / np.pi) if joint in std else None
        both = max(encoder or 0.0, repeatability or 0.0) or None
        floors[joint] = {"encoder": encoder, "repeatability": repeatability, "both": both}
    return floors


def _mean(values: ListOf[float | None]) -> float | None:
    numbers = [v for v in values if v is not None]
    return float(np.mean(numbers)) if len(numbers) == len(values) else None
