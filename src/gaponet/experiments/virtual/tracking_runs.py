"""Execution of motions on a VIRTUAL unit, raw and compensated, and in every simulator; Q_dis of each."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from functools import partial

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.experiments.virtual.play import (
    Progress,
    Trajectories,
    compensations,
    play,
    stack_targets,
    step_name,
    with_payloads,
)
from gaponet.experiments.virtual.trained_models import TrainedModel
from gaponet.experiments.virtual.unseen_motions import UnseenMotion
from gaponet.robot.spec import RobotSpec
from gaponet.sim.replay import replay
from gaponet.testing.physics import Physics

REST_S = 2.0  # under the first target before a motion begins, for the compensator to blend in


@dataclass(frozen=True)
class Score:
    """Q_dis of one motion with one payload.

    Attributes:
        part: alignment or compensation.
        seed: Seed of the model; None for a method without training.
        source: Source of the motion: generated, files or recorded.
        payload: kg per hand.
        q_dis: Q_dis of each operated joint, (n,) rad·s.
        seconds: Length of the motion.
    """

    part: str
    method: str
    seed: int | None
    source: str
    motion: str
    payload: float
    q_dis: Array
    seconds: float


@dataclass(frozen=True)
class ExampleMotion:
    """One motion of the compensation: targets, and joint positions by method, (T, n operated) rad."""

    motion: str
    payload: float
    dt: float
    target: Array
    qpos: dict[str, Array]


def track(
    robot: RobotSpec,
    unit: Physics,
    unit_id: str,
    motions: ListOf[UnseenMotion],
    payloads: tuple[float, ...],
    trained: ListOf[TrainedModel],
    progress: Progress = lambda step, share: None,
) -> tuple[list[Score], ExampleMotion]:
    """Execute every motion with every payload (kg per hand), raw and compensated, and in every simulator."""
    pairs, op, rest = with_payloads(motions, payloads), robot.operated_index, round(REST_S / robot.dt)
    ctrl = [np.concatenate([np.repeat(m.ctrl[:1], rest, axis=0), m.ctrl]) for m, _ in pairs]
    lengths, targets = np.array([len(c) for c in ctrl]), stack_targets(ctrl)
    mass = np.array([p for _, p in pairs])
    scores: list[Score] = []
    example: dict[str, Array] = {}
    shown, span = 0, slice(0)
    for method, seed, compensation in compensations(robot, trained):
        done = partial(progress, step_name(method, seed))
        played = play(robot, unit, targets, mass, lengths=lengths, compensation=compensation, progress=done)
        if method == "raw":
            recorded = _recordings(robot, unit_id, pairs, played, rest)
            scores += align(recorded, [m.source for m, _ in pairs], robot, trained, progress)
            shown = _median_row(pairs, robot, targets, played)
            span = slice(rest, lengths[shown])
        errors = [(played.qpos[rest:n, i] - targets[rest:n, i])[:, op] for i, n in enumerate(lengths)]
        scores += [
            _score("compensation", method, seed, motion.source, motion.name, payload, error, robot.dt)
            for (motion, payload), error in zip(pairs, errors, strict=True)
        ]
        if seed in (None, trained[0].seed):
            example[method] = played.qpos[span, shown][:, op]
    target = targets[span, shown][:, op]
    return scores, ExampleMotion(pairs[shown][0].name, float(mass[shown]), robot.dt, target, example)


def align(
    recorded: ListOf[Sequence],
    sources: ListOf[str],
    robot: RobotSpec,
    trained: ListOf[TrainedModel],
    progress: Progress = lambda step, share: None,
) -> list[Score]:
    """Compare open-loop rollouts of every simulator with the recordings, from their first state.

    The identified simulator is that of the models that correct it.
    """
    simulators: list[tuple[str, int | None, RobotSpec, TrainedModel | None]] = [("nominal", None, robot, None)]
    simulators += [("identified", None, t.robot, None) for t in trained if t.robot.nominal is not None][:1]
    simulators += [(t.method, t.seed, t.robot, t) for t in trained]
    scores: list[Score] = []
    for method, seed, simulator, model in simulators:
        corrector = None if model is None else model.model.corrector(simulator)

        def report(done: int, total: int, method: str = method) -> None:
            progress(f"{method} simulator", done / total)

        replays = replay(list(recorded), simulator, corrector, nthread=1, progress=report, lock_idle=True)
        for s, simulated, source in zip(recorded, replays, sources, strict=True):
            error = (simulated.qpos - s.qpos)[1:, robot.operated_index]
            scores.append(_score("alignment", method, seed, source, s.meta.motion, s.meta.payload_mass, error, s.dt))
    return scores


def _recordings(
    robot: RobotSpec, unit: str, pairs: ListOf[tuple[UnseenMotion, float]], raw: Trajectories, rest: int
) -> list[Sequence]:
    """Return the measurements of the robot while it executed the raw targets."""
    sequences = []
    for i, (motion, payload) in enumerate(pairs):
        meta = SequenceMeta(robot.name, unit, motion.name, payload, virtual=True, source="experiment tracking")
        span = slice(rest, rest + len(motion.ctrl))
        sequences.append(Sequence(meta, robot.joint_names, robot.dt, motion.ctrl, raw.qpos[span, i], raw.qvel[span, i]))
    return sequences


def _score(
    part: str, method: str, seed: int | None, source: str, motion: str, payload: float, error: Array, dt: float
) -> Score:
    q_dis = np.abs(error.astype(float)).sum(axis=0) * dt
    return Score(part, method, seed, source, motion, payload, q_dis, len(error) * dt)


def _median_row(pairs: ListOf[tuple[UnseenMotion, float]], robot: RobotSpec, targets: Array, raw: Trajectories) -> int:
    """Return the row of the motion with the median raw error among those with the heaviest payload."""
    heaviest = [i for i, (_, p) in enumerate(pairs) if p == max(p for _, p in pairs)]
    op = robot.operated_index
    error = [np.abs(raw.qpos[:, i][:, op] - targets[:, i][:, op]).mean() for i in heaviest]
    return heaviest[int(np.argsort(error)[len(heaviest) // 2])]
