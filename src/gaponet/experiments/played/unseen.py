"""Motions that no model was trained on: made for the experiment or read from files, and compared with training."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.data.pair import hash_order
from gaponet.data.store import Dataset, Entry
from gaponet.experiments.played.trained import Trained
from gaponet.report.candidate import split_of_run
from gaponet.robot.spec import RobotSpec
from gaponet.sim.model import idle_joints
from gaponet.sysid.motion.files import SUFFIXES, read_motion
from gaponet.sysid.motion.library import Library
from gaponet.sysid.motion.motion import Motion
from gaponet.sysid.motion.upper_body import BUILDERS

VARIANT = 90  # recipes count from 0: motions of this number are of no recipe
SEED = 2026  # of the library here; recipes have others
NEAR = 0.01  # rad: two motions whose targets differ by less, RMS, are one motion


@dataclass(frozen=True)
class Unseen:
    """A motion at the robot's control period.

    Attributes:
        source: generated, or files.
        ctrl: Targets, (T, n) rad; limbs without an operated joint at home, since with a fixed base they share no
            dynamics with the others.
        nearest: The most similar motion of training, and the RMS difference of the operated joints' targets, rad.
    """

    name: str
    source: str
    ctrl: Array
    nearest: tuple[str, float] = ("", float("inf"))


def generated(robot: RobotSpec, count: int, max_payload: float) -> list[Unseen]:
    """Coordinated motions of all kinds, both hands first; joint by joint for a robot without arms by name."""
    library = Library(robot, SEED, max_payload)
    sides = ["both", *library.kit.arms] if len(library.kit.arms) == 2 else list(library.kit.arms)
    names = [f"{kind}-{side}-{VARIANT}" for side in sides for kind in BUILDERS]
    names = names or hash_order(library.names())
    if count > len(names):
        raise UsageError(f"--count {count}: {robot.name} has {len(names)} motions to draw from here")
    return [_unseen(name, "generated", library, robot) for name in names[:count]]


def from_files(robot: RobotSpec, folder: Path, max_payload: float) -> list[Unseen]:
    """Every motion file of a folder or below it, slowed or brought nearer until it fits the robot's limits.

    Raises:
        UsageError: No motion file there.
    """
    files = sorted(f for f in folder.rglob("*") if f.suffix in SUFFIXES)
    if not files:
        raise UsageError(f"--motions {folder}: no motion file there ({', '.join(SUFFIXES)})")
    library = Library(robot, SEED, max_payload)
    found = []
    for file in files:
        motion = read_motion(file, robot)
        library.add(motion)
        found.append(_unseen(motion.name, "files", library, robot))
    return found


def _unseen(name: str, source: str, library: Library, robot: RobotSpec) -> Unseen:
    ctrl = library.make(name).sample(robot.dt)
    still = robot.index(idle_joints(robot, robot.operated))
    ctrl[:, still] = robot.qpos_home[still]
    return Unseen(name, source, ctrl)


def require_unseen(
    motions: ListOf[Unseen],
    dataset: Dataset,
    robot: RobotSpec,
    trained: ListOf[Trained],
    whole: Dataset | None = None,
) -> list[Unseen]:
    """The motions, each with its nearest motion of training or validation, over the time that both last.

    Args:
        whole: What the recordings of dataset were cut from, if they were: many motions begin in the same rest.

    Raises:
        UsageError: One of them was trained on, by name or by its targets.
    """
    used = trained_on(dataset, trained)
    op, whole = robot.operated_index, whole or dataset
    first = {e.meta.motion: e for e in reversed(whole.entries)}
    targets = {name: _at(whole, first[name], robot.dt)[:, op] for name in used}
    out = []
    for motion in motions:
        away = {name: _rms(motion.ctrl[:, op], c) for name, c in targets.items()}
        nearest = min(away, key=lambda name: away[name], default="")
        if motion.name in used or (away and away[nearest] < NEAR):
            near = motion.name if motion.name in used else nearest
            raise UsageError(
                f"motion '{motion.name}' is motion '{near}' of training ({away[near] * 1e3:.1f} mrad RMS apart); the "
                "experiment needs motions that were never seen: leave it out"
            )
        out.append(replace(motion, nearest=(nearest, away.get(nearest, float("inf")))))
    return out


def trained_on(dataset: Dataset, trained: ListOf[Trained]) -> set[str]:
    """Names of the motions that any of the runs was trained or chosen on."""
    hashes = {h for t in trained for part in ("train", "val") for h in split_of_run(t.run)[part].values()}
    found = {e.meta.motion for e in dataset.entries if e.hash in hashes}
    if not found:
        raise UsageError(f"{dataset.path}: holds nothing that these runs were trained on; give the dataset of the runs")
    return found


def _at(dataset: Dataset, entry: Entry, dt: float) -> Array:
    """Targets of a recording at another period, (T, n) rad."""
    ctrl = dataset.channels(entry, ("ctrl",))["ctrl"]
    return Motion(entry.meta.motion, entry.meta.level, entry.dt, ctrl).sample(dt)


def _rms(a: Array, b: Array) -> float:
    rows = min(len(a), len(b))
    return float(np.sqrt(((a[:rows] - b[:rows]) ** 2).mean()))
