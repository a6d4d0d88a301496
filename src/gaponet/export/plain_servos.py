"""PD servos nearest to a robot with a servo model, and errors of a robot's forms."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from collections.abc import Sequence as ListOf
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import mujoco
import numpy as np
from typing_extensions import TypedDict

from gaponet import __version__
from gaponet.base.arrays import Array
from gaponet.base.errors import FolderError, RobotError
from gaponet.base.files import lock_folder, write_json
from gaponet.base.progress import Progress, no_progress
from gaponet.base.structure import read_json, validated
from gaponet.data.sequence import Sequence, SequenceMeta, is_same_rate
from gaponet.data.split import split_entries
from gaponet.data.store import Dataset
from gaponet.evaluation.candidate import read_origin
from gaponet.robot.by_name import identified_catalogue
from gaponet.robot.servo_fields import SERVO_FIELDS, SERVO_TERMS
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.batch import Condition
from gaponet.sim.commands import speed_limited
from gaponet.sim.model import model_hash
from gaponet.sim.replay import replay, rollout_errors
from gaponet.sysid.identify import identify
from gaponet.sysid.options import IdentifyOptions

T = TypeVar("T")

PlainServos = dict[str, dict[str, float]]  # joint → SERVO_FIELDS

CACHE = "plain_servos.json"  # in the robot folder
MAX_CHECK_MOTIONS = 5
MAX_CHECK_MOTION_S = 30.0
OWN_MOTION_S = 10.0


class _Stored(TypedDict):
    key: str
    content: Any


def lost_recordings(folder: Path, data: str | None) -> str:
    """Return what became of the dataset that a robot was identified from, if nobody says where it
    is now: "not at hand", or "gone from" where it was. Empty: it is there, or there was none.
    """
    origin = read_origin(folder)
    if data is not None or origin is None:
        return ""
    place = Path(os.path.normpath(folder / origin["dataset"]))
    if place.is_dir():
        return ""
    never_here = Path(origin["dataset"]).name == origin["dataset"]
    return "not at hand" if never_here else f"gone from {place}"


def read_recordings(
    folder: Path, data: str | None, robot: RobotSpec
) -> tuple[list[Sequence], list[Sequence]] | None:
    """Read training and validation motions of a dataset.

    The default are those that the robot was identified from.

    Returns:
        None if there is no dataset, or if its robot was driven by torque, so that no motion can be
        commanded again.
    """
    origin = read_origin(folder)
    if data is None and origin is not None:
        fitted_to = folder / origin["dataset"]
        data = str(fitted_to) if fitted_to.is_dir() else None  # it may have moved away
    if data is None:
        return None
    dataset = Dataset(data)
    dataset.require_robot(robot)
    first = dataset.read(dataset.entries[0])
    if np.array_equal(first.ctrl, first.qpos):
        return None
    splits = split_entries(dataset, ())
    if origin is not None:
        own = {}
        for split in ("train", "val"):
            hashes = set(origin["parts"][split].values())
            own[split] = [entry for entry in dataset.entries if entry.hash in hashes]
        if all(own.values()):
            splits |= own
    return dataset.sequences(splits["train"]), dataset.sequences(splits["val"])


def fit_plain_servos(
    robot: RobotSpec,
    recordings: ListOf[Sequence],
    progress: Progress = no_progress,
    engine_terms: tuple[str, ...] = (),
) -> RobotSpec:
    """Fit the parameters of PD servos to recordings.

    They have no servo model but for the terms that the engine has.

    The result is stored in the robot folder, and read from there if nothing changed. A robot of the
    package brings it, fitted to the recordings that it was identified from.

    Args:
        robot: Identified; table, zeros and stops do not change. Returned unchanged if the engine
            has its servo model.
        recordings: Motions that it was fitted to, or its own (`own_motions`).
        progress: Called with done, total and a note, as by `identify`.
    """
    start = _without_terms(robot, engine_terms)
    if start is robot:
        return robot
    if _ships_plain_servos(robot, engine_terms):
        stored = read_json(_Stored, robot.folder / CACHE, RobotError)
        return start.with_identified(validated(PlainServos, stored["content"], CACHE, RobotError))

    def fit() -> PlainServos:
        options = IdentifyOptions(terms=(), table=False)
        return _servos(identify(recordings, start, options=options, progress=progress).robot)

    servos = stored_result(robot.folder / CACHE, PlainServos, fit, start, recordings)
    return start.with_identified(servos)


def keep_plain_servos(folder: Path, fitted: RobotSpec, recordings: ListOf[Sequence]) -> None:
    """Store a fit without terms in a robot folder, where `fit_plain_servos` finds it.

    Args:
        folder: The robot, with terms of the servo model.
        fitted: The robot without terms, fitted to the same recordings.
    """
    start = _without_terms(load_robot(folder))
    content = _servos(fitted)
    write_json(folder / CACHE, {"key": _key(start, recordings), "content": content})


def _without_terms(robot: RobotSpec, engine_terms: tuple[str, ...] = ()) -> RobotSpec:
    """Return the robot without terms of the servo model but those of the engine.

    `robot` itself if it has none.
    """
    names = [name for name in SERVO_TERMS if name not in engine_terms]
    if not robot.servo.has(names):
        return robot
    return robot.with_servo(**dict.fromkeys(names, 0.0))


def _servos(robot: RobotSpec) -> PlainServos:
    """Return the parameters of all servos that have a value."""
    servos: PlainServos = {}
    for i, joint in enumerate(robot.joint_names):
        servos[joint] = robot.servo.finite_of_joint(i)
    return servos


def _key(robot: RobotSpec, recordings: ListOf[Sequence], *other: Array) -> str:
    """Return a hash of all that a stored result depends on.

    The recordings' order is of no account.
    """
    key = hashlib.sha256(
        f"{__version__} {mujoco.__version__} {model_hash(robot)} {robot.operated}".encode()
    )
    for one in (robot, robot.before_identification):
        for name in SERVO_FIELDS:
            key.update(one.servo[name].tobytes())
    for digest in sorted(_recording_digest(recording) for recording in recordings):
        key.update(digest)
    for values in other:
        key.update(np.ascontiguousarray(values).tobytes())
    return key.hexdigest()


def _recording_digest(sequence: Sequence) -> bytes:
    meta = sequence.meta
    told = (sequence.dt, meta.kp, meta.kd, meta.payload_mass, meta.payload_side)
    digest = hashlib.sha256(json.dumps(told).encode())
    for channel in (sequence.ctrl, sequence.qpos, sequence.qvel):
        digest.update(np.ascontiguousarray(channel).tobytes())
    return digest.digest()


def _ships_plain_servos(robot: RobotSpec, engine_terms: tuple[str, ...]) -> bool:
    """Return True for a robot of the package, beside which its nearest plain servos lie."""
    packaged = identified_catalogue().holds(robot.folder) and (robot.folder / CACHE).is_file()
    return packaged and not robot.servo.has(engine_terms)


def stored_result(
    file: Path,
    kind: type[T],
    compute: Callable[[], T],
    robot: RobotSpec,
    recordings: ListOf[Sequence],
    *other: Array,
) -> T:
    """Return a stored result of the robot folder if its inputs are the same, else compute it.

    Args:
        kind: Type of the result, for `validated`.
        robot, recordings, other: All that the result depends on.
    """
    key = _key(robot, recordings, *other)
    with suppress(RobotError):  # missing or damaged
        stored = read_json(_Stored, file, RobotError)
        if stored["key"] == key:
            return validated(kind, stored["content"], file, RobotError)
    result = compute()
    # not of gaponet, or not writable
    with (
        suppress(FolderError, OSError),
        lock_folder(file.parent, "robot"),
    ):
        write_json(file, {"key": key, "content": result})
    return result


def own_motions(robot: RobotSpec, payload_mass: float = 0.0, count: int = 24) -> list[Sequence]:
    """Simulate motions of the robot itself, for use without recordings.

    All joints swing about home and pause.
    """
    rng = np.random.default_rng(0)
    op = robot.operated_index
    t = np.arange(0.0, OWN_MOTION_S, robot.dt)[:, None]
    home = robot.qpos_home[op]
    low, high = np.clip(robot.qpos_range[op].T, home - np.pi, home + np.pi)
    motions = []
    for i in range(count):
        turn = 2 * np.pi * (rng.uniform(0.1, 0.6, len(op)) * t + rng.uniform(0, 1, len(op)))
        swing = (
            np.clip(1.5 * np.sin(turn), -1, 1) * rng.uniform(0.1, 0.8, len(op)) * np.minimum(1, t)
        )
        ctrl = np.tile(robot.qpos_home, (len(t), 1))
        ctrl[:, op] += np.where(swing > 0, high - home, home - low) * swing / 2
        meta = SequenceMeta(robot.name, "itself", f"swing-{i}", payload_mass, virtual=True)
        rest = np.tile(robot.qpos_home, (len(t), 1))
        motions.append(Sequence(meta, robot.joint_names, robot.dt, ctrl, rest, 0 * ctrl))
    rollouts = replay(motions, robot, lock_idle=True)
    played = []
    for motion, rollout in zip(motions, rollouts, strict=True):
        played.append(replace(motion, qpos=rollout.qpos, qvel=rollout.qvel))
    return played


def comparable(
    recordings: ListOf[Sequence], robot: RobotSpec, payload_mass: float
) -> list[Sequence]:
    """Return the recordings made with this payload, kg, and with the robot's own gains."""
    loaded = [recording for recording in recordings if recording.meta.payload_mass == payload_mass]
    return [recording for recording in loaded if Condition.of(recording, robot).kp is None]


def rollout_error(recordings: ListOf[Sequence], robot: RobotSpec) -> float:
    """Return the mean |error| over rollouts of recordings, rad.

    Of the operated joints that each recording holds.
    """
    return float(rollout_errors(recordings, robot).mean())


def check_error(motions: ListOf[Sequence], robot: RobotSpec) -> float:
    """Return the mean |error| of all operated joints over motions of check.npz, rad: what check.py
    computes.
    """
    op = robot.operated_index
    errors = []
    for motion, played in zip(motions, replay(motions, robot, lock_idle=True), strict=True):
        errors.append(mean_error(motion.qpos[:, op], played.qpos[:, op]))
    return float(np.mean(errors))


def mean_error(recorded: np.ndarray, played: np.ndarray) -> float:
    """Return the mean |difference| over all rows but the first, which is given; (T, n) rad."""
    return float(np.abs(np.asarray(played, float) - recorded)[1:].mean())


def at_rate(recordings: ListOf[Sequence], dt: float) -> list[Sequence]:
    """Return the recordings with a control period, s."""
    return [s for s in recordings if is_same_rate(s.dt, dt)]


def check_motions(
    recordings: ListOf[Sequence], robot: RobotSpec, dt: float, ramped: bool = True
) -> list[Sequence]:
    """Return the first motions by name, cut in length, for check.npz.

    Args:
        dt: Control period of all of them, s; recordings with another are left out.
        ramped: Whether targets change as slowly as the servos change them, for engines that do not
            limit the speed of targets.
    """
    first = {s.meta.motion: s for s in reversed(at_rate(recordings, dt))}
    low, high = robot.qpos_range.T
    limited = ramped & (robot.servo.target_speed > 0)
    speed = np.where(limited, robot.servo.target_speed, np.inf)
    motions = []
    for recording in list(first.values())[:MAX_CHECK_MOTIONS]:
        cut = recording.rows(slice(0, round(MAX_CHECK_MOTION_S / recording.dt)))
        ctrl = speed_limited(np.clip(cut.ctrl, low, high), cut.qpos[0], speed, cut.dt)
        motions.append(replace(cut, ctrl=ctrl))
    return motions
