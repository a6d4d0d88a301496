"""Replay recorded commands in the nominal simulator: the twins. Free-running from the recorded start state."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from collections.abc import Sequence as ListOf
from typing import Protocol

import numpy as np

from gaponet.data.pair import Twin
from gaponet.data.sequence import Sequence
from gaponet.robot import RobotSpec
from gaponet.sim.batch import BatchSim
from gaponet.sim.model import model_hash

Array = np.ndarray
Progress = Callable[[int, int], None]  # control steps done, total


class Corrector(Protocol):
    """Turns targets into corrected targets for a batch of simulations; what makes a simulator an aligned one."""

    def reset(self, start: ListOf[Sequence]) -> None:
        """Begin one free run per sequence, simulation i at row 0 of start[i]."""

    def correct(self, t: int, target: Array, qpos: Array, qvel: Array) -> Array:
        """Targets to apply over [t, t+1), given the commanded ones and the simulated state; all (k, n), rad."""


def replay(
    sequences: ListOf[Sequence],
    robot: RobotSpec,
    corrector: Corrector | None = None,
    nthread: int = 0,
    progress: Progress | None = None,
) -> list[Twin]:
    """Step every sequence's commands from its first recorded state; the recording is not looked at again.

    Args:
        sequences: Recordings; payload and period of each are the simulation's.
        robot: The nominal simulator.
        corrector: Alters targets on the way; None for the nominal simulator.
        nthread: Threads, 0 for all cores.
        progress: Called now and then.

    Returns:
        One twin per sequence, in order.
    """
    order = sorted(range(len(sequences)), key=lambda i: -len(sequences[i]))
    total = sum(len(s) - 1 for s in sequences)
    done = 0
    twins: dict[int, Twin] = {}
    for chunk in _chunks(order, 256):
        part = [sequences[i] for i in chunk]

        def tell(k: int, before: int = done) -> None:
            if progress is not None:
                progress(before + k, total)

        runs = _free_run(part, robot, corrector, nthread, tell)
        twins |= dict(zip(chunk, runs, strict=True))
        done += sum(len(s) - 1 for s in part)
    return [twins[i] for i in range(len(sequences))]


def _chunks(order: list[int], size: int) -> Iterator[list[int]]:
    """Sequences of like length together, so that few simulations wait for a long one."""
    for start in range(0, len(order), size):
        yield order[start : start + size]


def _free_run(
    sequences: list[Sequence],
    robot: RobotSpec,
    corrector: Corrector | None,
    nthread: int,
    progress: Callable[[int], None],
) -> list[Twin]:
    """Sequences in order of falling length: those still running are always a prefix."""
    lengths = np.array([len(s) for s in sequences])
    sim = BatchSim(robot, [(s.meta.payload_mass, s.meta.payload_side, s.dt) for s in sequences], nthread)
    ctrl = np.zeros((lengths[0], len(sequences), sim.n))
    out = np.zeros((4, *ctrl.shape))
    for i, s in enumerate(sequences):
        ctrl[: len(s), i] = s.ctrl
    sim.reset(slice(None), np.stack([s.qpos[0] for s in sequences]), np.stack([s.qvel[0] for s in sequences]))
    out[0, 0], out[1, 0] = sim.qpos, sim.qvel
    if corrector is not None:
        corrector.reset(sequences)
    running = (lengths[None, :] > np.arange(1, lengths[0])[:, None]).sum(axis=1)  # at each step
    everyone, finished = np.arange(len(sequences)), 0
    for t, k in enumerate(running):
        target = ctrl[t]
        if corrector is not None:
            target = corrector.correct(t, target, sim.qpos, sim.qvel)
        sim.step(target, None if k == sim.num_envs else everyone[:k])
        out[0, t + 1], out[1, t + 1], out[2, t + 1], out[3, t] = sim.qpos, sim.qvel, sim.torque, target
        finished += int(k)
        if t % 200 == 0 or t == len(running) - 1:
            progress(finished)
    digest = model_hash(robot)
    return [Twin(digest, *out[:, : len(s), i].astype(np.float32)) for i, s in enumerate(sequences)]
