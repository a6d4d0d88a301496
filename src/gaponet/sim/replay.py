"""Replay recorded commands in the simulator, open-loop from the recorded start state."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from collections.abc import Sequence as ListOf
from concurrent.futures import Executor
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from typing import Protocol

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.executor import LOCAL, open_pool
from gaponet.base.progress import no_progress
from gaponet.data.pair import SimulatedReplay
from gaponet.data.sequence import Sequence
from gaponet.data.store import Dataset, Entry
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import BatchSim, Condition
from gaponet.sim.metrics import by_motion, runs
from gaponet.sim.model import LOOSE_IMPEDANCE, STIFF_MOBILITY, idle_joints, model_hash

CHUNK = 256  # simulations side by side
BATCH = 64  # sequences paired together; what an interruption can cost

Progress = Callable[[int, int], None]  # control steps done, total
Clamped = tuple[tuple[str, float], ...]  # joints and where they stand, rad


class Corrector(Protocol):
    """Correction of the targets of a batch of simulations."""

    def reset(self, start: ListOf[Sequence]) -> None:
        """Begin one rollout per sequence, simulation i at row 0 of start[i]."""

    def correct(self, t: int, target: Array, qpos: Array, qvel: Array) -> Array:
        """Return the targets to apply over [t, t+1), for commanded ones and the simulated state;
        all (k, n), rad.
        """


def replay(
    sequences: ListOf[Sequence],
    robot: RobotSpec,
    corrector: Corrector | None = None,
    nthread: int = 0,
    progress: Progress = no_progress,
    lock_idle: bool = False,
    creeps: bool = False,
) -> list[SimulatedReplay]:
    """Step every sequence's commands from its first recorded state (open loop).

    Args:
        sequences: Recordings; payload, period and gains of each are the simulation's.
        robot: The nominal simulator.
        corrector: Corrects targets.
        nthread: Threads, 0 for all cores.
        progress: Called with control steps done and in all.
        lock_idle: Clamp limbs that no command moves at home: faster, and equal up to rounding for
            others.
        creeps: Use MuJoCo's own friction, which creeps.
    """
    idle: list[tuple[str, ...]] = [()] * len(sequences)
    if lock_idle:
        idle = _idle_limbs(sequences, robot)
    locked = [_held(s, robot, limbs) for s, limbs in zip(sequences, idle, strict=True)]
    digest = _replay_hash(robot, creeps)
    total = sum(len(s) - 1 for s in sequences)
    done = 0
    replays: dict[int, SimulatedReplay] = {}  # by place in sequences

    def tell(steps: int) -> None:
        progress(done + steps, total)  # of earlier chunks, and of this one

    for chunk in _chunks(sequences, locked):
        part = [sequences[i] for i in chunk]
        sim = _simulations(part, robot, locked[chunk[0]], nthread, creeps=creeps)
        out = rollout(sim, part, corrector, tell)
        for i, s in enumerate(part):
            qpos, qvel, torque, target = out[:, : len(s), i].astype(np.float32)
            replays[chunk[i]] = SimulatedReplay(digest, qpos, qvel, tau=torque, ctrl=target)
        done += sum(len(s) - 1 for s in part)
    return [replays[i] for i in range(len(sequences))]


def _simulations(
    sequences: ListOf[Sequence], robot: RobotSpec, clamped: Clamped, nthread: int, *, creeps: bool
) -> BatchSim:
    """Return a simulation of each recording, in which joints are clamped where they stand."""
    angles = dict(clamped)
    joints = tuple(angles)
    home = np.array(robot.qpos_home)
    home[robot.index(joints)] = list(angles.values())
    conditions = [Condition.of(s, robot) for s in sequences]
    sim = BatchSim(replace(robot, qpos_home=home), conditions, nthread, joints)
    if creeps:  # MuJoCo's own mobility and impedance
        sim.batch.expand("dof_invweight0")[:] /= STIFF_MOBILITY
        sim.batch.expand("dof_solimp")[:, :, :2] = LOOSE_IMPEDANCE
    return sim


def _replay_hash(robot: RobotSpec, creeps: bool) -> str:
    """Return the hash under which replays are kept: the simulator's, and whether friction creeps
    as MuJoCo's own.
    """
    return f"{model_hash(robot)}-creeps" if creeps else model_hash(robot)


def kept_replays(
    dataset: Dataset,
    entries: list[Entry],
    robot: RobotSpec,
    progress: Progress = no_progress,
    creeps: bool = False,
) -> list[SimulatedReplay]:
    """Return `replay` of a dataset's recordings with idle limbs locked, out of the dataset where
    it keeps them.

    What it lacks is simulated and kept by the simulator's hash.
    """
    pair_dataset(dataset, robot, progress, entries, lock_idle=True, creeps=creeps)
    digest = _replay_hash(robot, creeps)
    return [dataset.pair(entry, digest).sim for entry in entries]


def rollout_errors(
    sequences: ListOf[Sequence],
    robot: RobotSpec,
    nthread: int = 0,
    corrector: Corrector | None = None,
) -> Array:
    """Return the mean |error| of each sequence's rollout, of the operated joints that it holds,
    (sequences,) rad.
    """
    replays = replay(sequences, robot, corrector, nthread, lock_idle=True)
    simulated = [replayed.qpos for replayed in replays]
    errors = [run.mean_error() for run in runs(sequences, simulated, robot)]
    result: Array = np.nan_to_num(np.array(errors), nan=np.pi)
    return result


def motion_errors(sequences: ListOf[Sequence], robot: RobotSpec) -> Array:
    """Return `rollout_errors` averaged over the sequences of each independent motion, (motions,)
    rad.
    """
    return by_motion([s.meta for s in sequences], rollout_errors(sequences, robot))


def idle_limbs(sequences: ListOf[Sequence], robot: RobotSpec) -> tuple[str, ...]:
    """Return the joints of limbs that no command of these sequences moves and that have no
    operated joint.
    """
    idle = set.intersection(*map(set, _idle_limbs(sequences, robot)))  # in all sequences
    return tuple(sorted(idle, key=robot.joint_names.index))


def _held(sequence: Sequence, robot: RobotSpec, idle: tuple[str, ...]) -> Clamped:
    """Return the joints that are clamped in a rollout, and where, rad: idle limbs at home,
    unrecorded joints where the recording says that they stood.
    """
    unknown = sequence.meta.unrecorded
    held = []
    angles = zip(robot.joint_names, sequence.qpos[0], robot.qpos_home, strict=True)
    for joint, recorded, home in angles:
        if joint in unknown:
            held.append((joint, float(recorded)))
        elif joint in idle:
            held.append((joint, float(home)))
    return tuple(held)


def _idle_limbs(sequences: ListOf[Sequence], robot: RobotSpec) -> list[tuple[str, ...]]:
    """Return `idle_limbs` of each sequence."""
    names = np.array(robot.joint_names)
    idle: dict[frozenset[str], tuple[str, ...]] = {}  # joints that move → those of idle limbs
    by_sequence = []
    for s in sequences:
        away = np.abs(s.ctrl - robot.qpos_home).max(axis=0) > 1e-6
        moved = frozenset(names[away].tolist()).union(robot.operated)
        if moved not in idle:
            idle[moved] = idle_joints(robot, tuple(moved))
        by_sequence.append(idle[moved])
    return by_sequence


def _chunks(sequences: ListOf[Sequence], locked: list[Clamped]) -> Iterator[list[int]]:
    """Yield indices of sequences with the same locked joints and similar lengths, so that few wait
    for a long one.
    """
    for limbs in dict.fromkeys(locked):
        group = [i for i, mine in enumerate(locked) if mine == limbs]
        group.sort(key=lambda i: -len(sequences[i]))
        for start in range(0, len(group), CHUNK):
            yield group[start : start + CHUNK]


def rollout(
    sim: BatchSim,
    sequences: ListOf[Sequence],
    corrector: Corrector | None = None,
    progress: Callable[[int], None] = lambda done: None,
    touch: Array | None = None,
) -> Array:
    """Step a batch, one simulation per sequence, from the recorded start under the recorded
    commands.

    Args:
        touch: Rows in which a simulation goes on from the recording, (T, k).
        progress: Called with the control steps done.

    Returns:
        qpos, qvel, torque and target by row, (4, T, k, n of all joints): rad, rad/s, N·m, rad. Row
        t has the state at t·dt, the torque at the end of [t − 1, t), and the target of [t, t + 1).
        Locked joints stand at sim.robot.qpos_home. Rows after the end of a sequence have no
        meaning.
    """
    lengths = np.array([len(s) for s in sequences])
    free = sim.robot.index(sim.joint_names)
    ctrl = _commands(sequences)
    out = np.zeros((4, *ctrl.shape))
    qpos, qvel, torque, targets = out  # views of all rows
    qpos[:] = sim.robot.qpos_home
    start_qpos = np.stack([s.qpos[0, free] for s in sequences])
    start_qvel = np.stack([s.qvel[0, free] for s in sequences])
    sim.reset(slice(None), start_qpos, start_qvel, past=ctrl[0][:, None, free])
    qpos[0][:, free] = sim.qpos
    qvel[0][:, free] = sim.qvel
    if corrector is not None:
        corrector.reset(sequences)
    finished = 0
    last = len(ctrl) - 2
    for t in range(last + 1):
        ids = np.flatnonzero(lengths > t + 1)  # still running
        target = ctrl[t]
        if corrector is not None:
            target = corrector.correct(t, target, qpos[t], qvel[t])
        sim.step(target[:, free], None if len(ids) == sim.num_envs else ids)
        targets[t] = target
        qpos[t + 1][:, free] = sim.qpos
        qvel[t + 1][:, free] = sim.qvel
        torque[t + 1][:, free] = sim.torque
        if touch is not None:
            _go_on_from_recordings(sim, sequences, ids[touch[t + 1, ids]], t + 1)
        finished += len(ids)
        if t % 200 == 0 or t == last:
            progress(finished)
    return out


def _commands(sequences: ListOf[Sequence]) -> Array:
    """Return the commands by row, (longest T, k, n) rad, with zeros after a sequence's end."""
    longest = max(len(s) for s in sequences)
    ctrl = np.zeros((longest, len(sequences), sequences[0].ctrl.shape[1]))
    for i, s in enumerate(sequences):
        ctrl[: len(s), i] = s.ctrl
    return ctrl


def _go_on_from_recordings(
    sim: BatchSim, sequences: ListOf[Sequence], ids: Array, row: int
) -> None:
    """Put simulations `ids` into the states of their recordings' rows."""
    free = sim.robot.index(sim.joint_names)
    for i in ids.tolist():
        sim.qpos[i] = sequences[i].qpos[row, free]
        sim.qvel[i] = sequences[i].qvel[row, free]


def pair_dataset(
    dataset: Dataset,
    robot: RobotSpec,
    progress: Progress = no_progress,
    entries: list[Entry] | None = None,
    lock_idle: bool = False,
    executor: str | Executor = LOCAL,
    creeps: bool = False,
) -> int:
    """Replay the sequences that have no replay by this simulator yet, and store the replays;
    return their number.

    All sequences, or only some; `lock_idle` and `creeps` as in replay. Locally on threads of this
    process, else on an executor. Replays are stored per simulator hash: a changed gain makes new
    ones and leaves the old.
    """
    dataset.require_robot(robot)
    digest = _replay_hash(robot, creeps)
    todo = sorted(
        (e for e in entries or dataset.entries if not dataset.has_replay(e, digest)),
        key=lambda e: e.rows,
    )
    if not todo:
        return 0
    total = sum(e.rows - 1 for e in todo)
    done = 0
    parts = [todo[start : start + BATCH] for start in range(0, len(todo), BATCH)]
    sequences = map(dataset.sequences, parts)
    work = partial(replay, robot=robot, lock_idle=lock_idle, creeps=creeps)

    def replay_here(part: list[Sequence]) -> list[SimulatedReplay]:
        return work(part, progress=lambda steps, _: progress(done + steps, total))

    with dataset.writing_replays(), ExitStack() as stack:
        if executor == LOCAL:
            replayed: Iterator[list[SimulatedReplay]] = map(replay_here, sequences)
        else:
            pool = stack.enter_context(open_pool(executor, 0))
            replayed = pool.map(partial(work, nthread=1), sequences)
        for part, replays in zip(parts, replayed, strict=True):
            for entry, simulated in zip(part, replays, strict=True):
                dataset.write_replay(entry, simulated)
            done += sum(e.rows - 1 for e in part)
            progress(done, total)
    return len(todo)
