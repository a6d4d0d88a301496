"""Zero-shot tracking on a VIRTUAL unit: how near is the aligned simulator to it, and how near it to what it is asked?

    alignment      Q_dis between a simulator and the robot under the same targets (the paper's Figure 3)
    compensation   Q_dis between the targets and the robot, which is given corrected targets

Q_dis = Δt Σ_t |e_t| per joint over the whole motion, rad·s. The robot is at rest under the first target, compensated or
not, when a motion begins. e_t compares the target of a moment with the joint at that moment.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.deploy.compensator import CompensatorConfig
from gaponet.robot import RobotSpec
from gaponet.sim.model import model_hash
from gaponet.sim.replay import replay
from gaponet.study.played.kept import Kept, revived
from gaponet.study.played.play import Driven, Played, Progress, of_seed, play, side_by_side, with_payloads
from gaponet.study.played.trained import Trained
from gaponet.study.played.unseen import Unseen
from gaponet.virtual.physics import Physics

Array = np.ndarray

REST = 2.0  # s under the first target before a motion begins: time for a compensator to blend in
PLANNED = CompensatorConfig(dynamics=True)  # targets of planned motions are smooth
HOLDING = CompensatorConfig()


@dataclass(frozen=True)
class Score:
    """One motion with one payload.

    Attributes:
        part: alignment or compensation.
        method, seed: Of the model; seed None where nothing was trained.
        source: generated or files, of the motion.
        motion: Name.
        payload: kg per hand.
        q_dis: Of each operated joint, (n) rad·s.
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
class Example:
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
    progress: Progress = lambda method, share: None,
    folder: Path | None = None,
) -> tuple[list[Score], Example]:
    """Play every motion with every payload on the unit, raw and compensated, and in every simulator.

    Args:
        robot: The nominal simulator.
        unit, unit_id: Who plays.
        motions: What.
        payloads: kg per hand.
        trained: Models.
        progress: Of each method.
        folder: Where each method's part is kept when it is done.
    """
    pairs = with_payloads(motions, payloads)
    rest = round(REST / robot.dt)
    ctrl = [np.concatenate([np.repeat(m.ctrl[:1], rest, axis=0), m.ctrl]) for m, _ in pairs]
    lengths, targets = np.array([len(c) for c in ctrl]), side_by_side(ctrl)
    mass = np.array([p for _, p in pairs])
    kept = Kept(folder, "tracking", model_hash(robot), unit, unit_id, list(motions), payloads)

    def drive(name: str, driven: Driven | None) -> Played:
        return play(robot, unit, targets, mass, list(range(len(pairs))), driven, lengths, partial(progress, name))

    @cache
    def raw() -> Played:
        return drive("raw", None)

    def recorded() -> list[Sequence]:
        return [_recording(robot, unit_id, m, p, raw(), i, rest) for i, (m, p) in enumerate(pairs)]

    scores = align(recorded, [m.source for m, _ in pairs], robot, trained, progress, kept)
    shown = int(kept("shown", make=lambda: {"row": _shown(pairs, robot, targets, raw())})["row"])
    example: dict[str, Array] = {}
    for method, seed, driven in compensations(robot, trained):

        def work(method: str = method, seed: int | None = seed, driven: Driven | None = driven) -> Any:
            played = raw() if driven is None else drive(of_seed(method, seed), driven)
            found = _tracked(pairs, played, targets, lengths, rest, robot, method, seed)
            return {"scores": found, "qpos": played.qpos[rest : lengths[shown], shown][:, robot.operated_index]}

        part = kept("compensation", method, seed, driven and driven.facts, make=work)
        scores += [revived(Score, s) for s in part["scores"]]
        if seed in (None, trained[0].seed):
            example[method] = np.array(part["qpos"])
    target = targets[rest : lengths[shown], shown][:, robot.operated_index]
    return scores, Example(pairs[shown][0].name, float(mass[shown]), robot.dt, target, example)


def compensations(robot: RobotSpec, trained: ListOf[Trained]) -> Iterable[tuple[str, int | None, Driven | None]]:
    """Ways to drive the robot: raw; by the simulators' own physics alone; and through each model."""
    yield "raw", None, None
    bare = replace(PLANNED, iterations=0)
    first = {t.robot.nominal is not None: t for t in reversed(trained)}
    for fitted, t in sorted(first.items()):
        yield ("identified feedforward" if fitted else "feedforward"), None, Driven(t.model, t.robot, bare)
    for t in trained:
        yield t.method, t.seed, Driven(t.model, t.robot, PLANNED)


def align(
    recorded: Callable[[], ListOf[Sequence]],
    sources: ListOf[str],
    robot: RobotSpec,
    trained: ListOf[Trained],
    progress: Progress = lambda method, share: None,
    kept: Kept = Kept(None),  # noqa: B008
) -> list[Score]:
    """Free runs of every simulator under the recordings' targets, from their first state.

    Args:
        recorded: What the robot did; asked for when there is something to do.
        sources: Of each motion.
        robot: The nominal simulator.
        trained: Models; the identified simulator comes from those that correct it.
        progress: Of each method.
        kept: What is done already.
    """
    simulators: list[tuple[str, int | None, RobotSpec, Trained | None]] = [("nominal", None, robot, None)]
    simulators += [("identified", None, t.robot, None) for t in trained if t.robot.nominal is not None][:1]
    simulators += [(t.method, t.seed, t.robot, t) for t in trained]
    scores: list[Score] = []
    for method, seed, simulator, model in simulators:

        def work(
            method: str = method, seed: int | None = seed, simulator: RobotSpec = simulator,
            model: Trained | None = model,
        ) -> Any:  # fmt: skip
            corrector = None if model is None else model.model.corrector(simulator)
            tell = lambda done, total: progress(f"{method} simulator", done / total)  # noqa: E731
            done = recorded()
            twins = replay(done, simulator, corrector, nthread=1, progress=tell, lock_idle=True)
            return {"scores": [
                _score("alignment", method, seed, source, s.meta.motion, s.meta.payload_mass,
                       (twin.qpos - s.qpos)[1:, robot.operated_index], s.dt)
                for s, twin, source in zip(done, twins, sources, strict=True)
            ]}  # fmt: skip

        weights = model and model.model.weights_hash
        part = kept("alignment", method, seed, model_hash(simulator), weights, make=work)
        scores += [revived(Score, s) for s in part["scores"]]
    return scores


def _recording(
    robot: RobotSpec, unit: str, motion: Unseen, payload: float, raw: Played, row: int, rest: int
) -> Sequence:
    """What the robot itself measured while it played a motion raw."""
    meta = SequenceMeta(robot.name, unit, motion.name, payload, virtual=True, source="experiment tracking")
    span = slice(rest, rest + len(motion.ctrl))
    return Sequence(meta, robot.joint_names, robot.dt, motion.ctrl, raw.qpos[span, row], raw.qvel[span, row])


def _tracked(
    pairs: ListOf[tuple[Unseen, float]],
    played: Played,
    targets: Array,
    lengths: Array,
    rest: int,
    robot: RobotSpec,
    method: str,
    seed: int | None,
) -> list[Score]:
    op = robot.operated_index
    scores = []
    for i, (motion, payload) in enumerate(pairs):
        span = slice(rest, lengths[i])
        error = (played.qpos[span, i] - targets[span, i])[:, op]
        scores.append(_score("compensation", method, seed, motion.source, motion.name, payload, error, robot.dt))
    return scores


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
