"""Plays motions on a VIRTUAL unit, raw and compensated, and in every simulator: Q_dis of each."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.experiments.played.kept import KeptParts, revived
from gaponet.experiments.played.play import Driven, Played, compensations, of_seed, play, stacked, with_payloads
from gaponet.experiments.played.session import Tell
from gaponet.experiments.played.trained import Trained
from gaponet.experiments.played.unseen import Unseen
from gaponet.robot.spec import RobotSpec
from gaponet.sim.model import model_hash
from gaponet.sim.replay import replay
from gaponet.testing.physics import Physics

REST = 2.0  # s under the first target before a motion begins: time for a compensator to blend in


@dataclass(frozen=True)
class Score:
    """One motion with one payload.

    Attributes:
        part: alignment or compensation.
        method, seed: Seed of the model; seed None where nothing was trained.
        source: generated or files, of the motion.
        payload: kg per hand.
        q_dis: Q_dis of each operated joint, (n) rad·s.
        seconds: The motion's length.
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
class ShownMotion:
    """One motion of the compensation: targets and where the joints were by method, (T, n operated) rad."""

    motion: str
    payload: float
    dt: float
    target: Array
    qpos: dict[str, Array]


def track(
    robot: RobotSpec,
    unit: Physics,
    unit_id: str,
    motions: ListOf[Unseen],
    payloads: tuple[float, ...],
    trained: ListOf[Trained],
    tell: Tell = lambda what, share: None,
    folder: Path | None = None,
) -> tuple[list[Score], ShownMotion]:
    """Play every motion with every payload on the unit, raw and compensated, and in every simulator.

    Args:
        payloads: kg per hand.
        folder: Where each method's part is kept when it is done.
    """
    pairs, op, rest = with_payloads(motions, payloads), robot.operated_index, round(REST / robot.dt)
    ctrl = [np.concatenate([np.repeat(m.ctrl[:1], rest, axis=0), m.ctrl]) for m, _ in pairs]
    lengths, targets = np.array([len(c) for c in ctrl]), stacked(ctrl)
    mass = np.array([p for _, p in pairs])
    kept = KeptParts(folder, "tracking", model_hash(robot), unit, unit_id, list(motions), payloads)

    def drive(name: str, driven: Driven | None) -> Played:
        return play(robot, unit, targets, mass, list(range(len(pairs))), driven, lengths, partial(tell, name))

    raw = cache(lambda: drive("raw", None))
    sources = [m.source for m, _ in pairs]
    scores = align(lambda: _recordings(robot, unit_id, pairs, raw(), rest), sources, robot, trained, tell, kept)
    shown = int(kept("shown", make=lambda: {"row": _shown(pairs, robot, targets, raw())})["row"])
    example: dict[str, Array] = {}

    def work(method: str, seed: int | None, driven: Driven | None) -> Any:
        played = raw() if driven is None else drive(of_seed(method, seed), driven)
        errors = [(played.qpos[rest:n, i] - targets[rest:n, i])[:, op] for i, n in enumerate(lengths)]
        found = [
            _score("compensation", method, seed, motion.source, motion.name, payload, error, robot.dt)
            for (motion, payload), error in zip(pairs, errors, strict=True)
        ]
        return {"scores": found, "qpos": played.qpos[rest : lengths[shown], shown][:, op]}

    for way in compensations(robot, trained):
        method, seed, driven = way
        part = kept("compensation", method, seed, driven and driven.facts, make=partial(work, *way))
        scores += [revived(Score, s) for s in part["scores"]]
        if seed in (None, trained[0].seed):
            example[method] = np.array(part["qpos"])
    target = targets[rest : lengths[shown], shown][:, op]
    return scores, ShownMotion(pairs[shown][0].name, float(mass[shown]), robot.dt, target, example)


def align(
    recorded: Callable[[], ListOf[Sequence]],
    sources: ListOf[str],
    robot: RobotSpec,
    trained: ListOf[Trained],
    tell: Tell = lambda what, share: None,
    kept: KeptParts = KeptParts(None),  # noqa: B008
) -> list[Score]:
    """Free runs of every simulator under the recordings' targets, from their first state.

    Args:
        recorded: What the robot did; asked for when there is something to do.
        trained: Models; the identified simulator comes from those that correct it.
    """
    simulators: list[tuple[str, int | None, RobotSpec, Trained | None]] = [("nominal", None, robot, None)]
    simulators += [("identified", None, t.robot, None) for t in trained if t.robot.nominal is not None][:1]
    simulators += [(t.method, t.seed, t.robot, t) for t in trained]

    def work(method: str, seed: int | None, simulator: RobotSpec, model: Trained | None) -> Any:
        corrector = None if model is None else model.model.corrector(simulator)
        told = lambda done, total: tell(f"{method} simulator", done / total)  # noqa: E731
        real = recorded()
        twins = replay(real, simulator, corrector, nthread=1, progress=told, lock_idle=True)
        return {"scores": [
            _score("alignment", method, seed, source, s.meta.motion, s.meta.payload_mass,
                   (twin.qpos - s.qpos)[1:, robot.operated_index], s.dt)
            for s, twin, source in zip(real, twins, sources, strict=True)
        ]}  # fmt: skip

    scores: list[Score] = []
    for way in simulators:
        method, seed, simulator, model = way
        weights = model and model.model.weights_hash
        part = kept("alignment", method, seed, model_hash(simulator), weights, make=partial(work, *way))
        scores += [revived(Score, s) for s in part["scores"]]
    return scores


def _recordings(
    robot: RobotSpec, unit: str, pairs: ListOf[tuple[Unseen, float]], raw: Played, rest: int
) -> list[Sequence]:
    """What the robot itself measured while it played the motions raw."""
    found = []
    for i, (motion, payload) in enumerate(pairs):
        meta = SequenceMeta(robot.name, unit, motion.name, payload, virtual=True, source="experiment tracking")
        span = slice(rest, rest + len(motion.ctrl))
        found.append(Sequence(meta, robot.joint_names, robot.dt, motion.ctrl, raw.qpos[span, i], raw.qvel[span, i]))
    return found


def _score(
    part: str, method: str, seed: int | None, source: str, motion: str, payload: float, error: Array, dt: float
) -> Score:
    q_dis = np.abs(error.astype(float)).sum(axis=0) * dt
    return Score(part, method, seed, source, motion, payload, q_dis, len(error) * dt)


def _shown(pairs: ListOf[tuple[Unseen, float]], robot: RobotSpec, targets: Array, raw: Played) -> int:
    """The heaviest payload's motion of median error: neither the best nor the worst."""
    heaviest = [i for i, (_, p) in enumerate(pairs) if p == max(p for _, p in pairs)]
    op = robot.operated_index
    error = [np.abs(raw.qpos[:, i][:, op] - targets[:, i][:, op]).mean() for i in heaviest]
    return heaviest[int(np.argsort(error)[len(heaviest) // 2])]
