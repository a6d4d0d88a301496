"""Motions that no model was trained on: generated, and checked against the training motions."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import dataclass

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.data.split import hash_order
from gaponet.data.store import Dataset, Entry
from gaponet.experiments.virtual.play import TrainedModel
from gaponet.report.candidate import split_of_run
from gaponet.robot.spec import RobotSpec
from gaponet.sim.model import idle_joints
from gaponet.sysid.motion.coordinated import BUILDERS
from gaponet.sysid.motion.library import Library
from gaponet.sysid.motion.motion import Motion

VARIANT = 90  # recipes count from 0 and have no motion of this number
LIBRARY_SEED = 2026  # recipes have others
MIN_RMS_DIFFERENCE = 0.01  # rad between the targets of two motions that count as different


@dataclass(frozen=True)
class UnseenMotion:
    """A motion at the robot's control period."""

    name: str
    ctrl: Array  # targets, (T, n) rad; limbs without an operated joint stay at home


def generated(robot: RobotSpec, count: int, max_payload: float) -> list[UnseenMotion]:
    """Generate coordinated motions of all kinds, both hands first; single-joint motions for a robot without arms."""
    library = Library(robot, LIBRARY_SEED, max_payload)
    sides = ["both", *library.kit.arms] if len(library.kit.arms) == 2 else list(library.kit.arms)
    names = [f"{kind}-{side}-{VARIANT}" for side in sides for kind in BUILDERS]
    names = names or hash_order(library.names())
    if count > len(names):
        raise UsageError(
            f"--count {count}: {robot.name} has {len(names)} motions for this experiment"
        )
    idle = robot.index(idle_joints(robot, robot.operated))
    motions = []
    for name in names[:count]:
        ctrl = library.make(name).sample(robot.dt)
        ctrl[:, idle] = robot.qpos_home[
            idle
        ]  # with a fixed base they share no dynamics with the others
        motions.append(UnseenMotion(name, ctrl))
    return motions


def require_unseen(
    motions: ListOf[UnseenMotion], dataset: Dataset, robot: RobotSpec, trained: ListOf[TrainedModel]
) -> None:
    """Refuse motions that were trained on, over the time that both last.

    Raises:
        UsageError: One of them is in the training or validation set, by name or by its targets.
    """
    used, op = training_motions(dataset, trained), robot.operated_index
    first = {e.meta.motion: e for e in reversed(dataset.entries)}
    targets = {name: _at(dataset, first[name], robot.dt)[:, op] for name in used}
    for motion in motions:
        rms = {name: _rms(motion.ctrl[:, op], c) for name, c in targets.items()}
        near = motion.name if motion.name in used else min(rms, key=lambda name: rms[name])
        if motion.name in used or rms[near] < MIN_RMS_DIFFERENCE:
            raise UsageError(
                f"motion '{motion.name}' is motion '{near}' of training ({rms[near] * 1e3:.1f} mrad RMS apart); the "
                "experiment needs motions that were never seen: leave it out"
            )


def training_motions(dataset: Dataset, trained: ListOf[TrainedModel]) -> set[str]:
    """Return the names of the motions in the training and validation sets of the runs."""
    hashes = {
        h for t in trained for part in ("train", "val") for h in split_of_run(t.run)[part].values()
    }
    names = {e.meta.motion for e in dataset.entries if e.hash in hashes}
    if not names:
        raise UsageError(
            f"{dataset.path}: holds nothing that these runs were trained on; give the dataset of the runs"
        )
    return names


def _at(dataset: Dataset, entry: Entry, dt: float) -> Array:
    """Resample the targets of a recording to another period, (T, n) rad."""
    ctrl = dataset.channels(entry, ("ctrl",))["ctrl"]
    return Motion(entry.meta.motion, entry.meta.level, entry.dt, ctrl).sample(dt)


def _rms(a: Array, b: Array) -> float:
    rows = min(len(a), len(b))
    return float(np.sqrt(((a[:rows] - b[:rows]) ** 2).mean()))
