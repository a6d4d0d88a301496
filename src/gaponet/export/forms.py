"""What plain PD servos can do of an identified robot, and what each form of it leaves of recorded motions."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.data.split import split_entries
from gaponet.report.candidate import read_origin
from gaponet.robot.spec import SERVO_TERMS, RobotSpec
from gaponet.share.reading import load_dataset
from gaponet.sim.batch import Condition, ramped
from gaponet.sim.replay import replay
from gaponet.sysid.identify import identify

CHECKED = 5  # motions that travel with an export
LONGEST = 30.0  # s of each
OWN = 10.0  # s of a motion of our own


def recordings_of(folder: Path, data: str | None, robot: RobotSpec) -> tuple[list[Sequence], list[Sequence]] | None:
    """Training and validation motions of a dataset, by default those that the robot was identified from."""
    origin = read_origin(folder)
    if data is None and origin is not None:
        there = origin["dataset"]
        data = there if "://" in there else str(folder / there)
        data = data if "://" in there or Path(data).is_dir() else None  # it may have moved away
    if data is None:
        return None
    dataset = load_dataset(data)
    dataset.require_robot(robot)
    first = dataset.read(dataset.entries[0])
    if np.array_equal(first.ctrl, first.qpos):  # driven by torque: no position was commanded, so none can be followed
        return None
    parts = split_entries(dataset, ())
    if origin is not None:
        known = {part: set(origin["parts"][part].values()) for part in ("train", "val")}
        mine = {part: [e for e in dataset.entries if e.hash in hashes] for part, hashes in known.items()}
        parts |= mine if all(mine.values()) else {}
    return dataset.sequences(parts["train"]), dataset.sequences(parts["val"])


def plain_form(
    robot: RobotSpec,
    recordings: ListOf[Sequence],
    progress: Callable[[float, float, str], None] = lambda done, total, note: None,
) -> RobotSpec:
    """The robot without a servo law whose other parameters follow the recordings best; the same where it has no law.

    Args:
        robot: Identified; its table, zeros and stops are kept.
        recordings: What it was fitted to, or what it answers itself (`own_motions`).
        windows: Free runs of 8 s, as in identification.
        progress: The same as identification's.
    """
    if not robot.has_servo_model:
        return robot
    none: dict[str, Any] = dict.fromkeys(SERVO_TERMS, np.array(0.0))
    start = replace(robot, **none)
    return identify(recordings, start, terms=(), table=False, progress=progress).robot


def own_motions(robot: RobotSpec, payload_mass: float = 0.0, count: int = 24) -> list[Sequence]:
    """What the robot itself answers where no recordings are given: all joints swing about home, and stand between."""
    rng, op = np.random.default_rng(0), robot.operated_index
    t = np.arange(0.0, OWN, robot.dt)[:, None]
    low, high = (
        np.clip(x, h - np.pi, h + np.pi) for x, h in ((x, robot.qpos_home[op]) for x in robot.qpos_range[op].T)
    )
    made = []
    for i in range(count):
        turn = 2 * np.pi * (rng.uniform(0.1, 0.6, len(op)) * t + rng.uniform(0, 1, len(op)))
        swing = np.clip(1.5 * np.sin(turn), -1, 1) * rng.uniform(0.1, 0.8, len(op)) * np.minimum(1, t)
        ctrl = np.tile(robot.qpos_home, (len(t), 1))
        ctrl[:, op] += np.where(swing > 0, high - robot.qpos_home[op], robot.qpos_home[op] - low) * swing / 2
        meta = SequenceMeta(robot.name, "itself", f"swing-{i}", payload_mass, virtual=True)
        made.append(Sequence(meta, robot.joint_names, robot.dt, ctrl, np.tile(robot.qpos_home, (len(t), 1)), 0 * ctrl))
    twins = replay(made, robot, lock_idle=True)
    return [replace(s, qpos=t.qpos, qvel=t.qvel) for s, t in zip(made, twins, strict=True)]


def comparable(recordings: ListOf[Sequence], robot: RobotSpec, payload_mass: float) -> list[Sequence]:
    """Those made with this payload and with the robot's own gains."""
    fits = lambda s: Condition.of(s, robot).kp is None and s.meta.payload_mass == payload_mass  # noqa: E731
    return [s for s in recordings if fits(s)]


def left(recordings: ListOf[Sequence], robot: RobotSpec) -> float:
    """Mean |error| of the operated joints over recordings that the robot plays in gaponet, rad."""
    op = robot.operated_index
    twins = replay(recordings, robot, lock_idle=True)
    return float(np.mean([mean_error(s.qpos[:, op], t.qpos[:, op]) for s, t in zip(recordings, twins, strict=True)]))


def mean_error(recorded: np.ndarray, played: np.ndarray) -> float:
    """Mean |difference| over all rows but the first, which was given; (T, n) rad."""
    return float(np.abs(np.asarray(played, float) - recorded)[1:].mean())


def check_motions(recordings: ListOf[Sequence], robot: RobotSpec) -> list[Sequence]:
    """The motions that travel: the first CHECKED by name, at most LONGEST long, with targets as servos take them."""
    first = {s.meta.motion: s for s in reversed(recordings)}
    low, high = robot.qpos_range.T
    parts = [s.rows(slice(0, round(LONGEST / s.dt))) for s in list(first.values())[:CHECKED]]
    speed = np.where(robot.target_speed > 0, robot.target_speed, np.inf)
    return [replace(s, ctrl=ramped(np.clip(s.ctrl, low, high), s.qpos[0], speed, s.dt)) for s in parts]
