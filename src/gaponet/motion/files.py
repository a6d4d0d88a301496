"""Motion files: SAGE motion txt, csv and npz, read into a Motion, or written from one.

SAGE txt: a line of joint names (comma separated, each a name or a path /robot/link/joint), then one
row per sample in rad at 50 Hz. csv: the same with a `time` column (s) that sets the period. npz:
joint_names, ctrl (T, k) rad and dt s.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import LogError, UsageError
from gaponet.base.files import atomic_write, write_text
from gaponet.base.structure import read_npz
from gaponet.data.describe.plausibility import require_radians
from gaponet.data.sequence import MAX_PERIOD_S, MIN_PERIOD_S
from gaponet.motion.motion import Motion
from gaponet.robot.spec import RobotSpec

SAGE_PERIOD_S = 0.02  # the format has no time column, its files are at 50 Hz
MAX_BYTES = 64 << 20  # of a file, unpacked: 10 hours of 27 joints at 10 Hz
SUFFIXES = (".txt", ".csv", ".npz")
# Kinds of dtypes in npz files:
TEXT = "U"
NUMBERS = "fiu"


def read_motion(path: str | Path, robot: RobotSpec) -> Motion:
    """A motion from a file; joints that the file does not name are at home, and stay where they
    are found on a robot.

    Raises:
        LogError: Unreadable; with file, line and what is wrong.
        JointMismatchError: A joint that the robot does not have.
    """
    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise LogError(f"{path}: motion files end in {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise LogError(f"{path}: no such file")
    if path.stat().st_size > MAX_BYTES:
        raise LogError(f"{path}: has more than {MAX_BYTES >> 20} MiB; cut it into shorter motions")
    read = _npz if path.suffix == ".npz" else _text
    names, rows, period = read(path)
    if not MIN_PERIOD_S <= period <= MAX_PERIOD_S:
        raise LogError(
            f"{path}: its period is {period:g} s; expected {MIN_PERIOD_S} to {MAX_PERIOD_S:g}"
        )
    joints = tuple(robot.resolve(name, str(path)) for name in names)
    columns = robot.index(joints)
    if len(set(joints)) != len(joints):
        raise LogError(f"{path}: two columns are the same joint of {robot.name}; delete one")
    require_radians(rows, joints, robot, lambda row: f"{path}: command {row + 1}")
    ctrl = np.repeat(robot.qpos_home[None], len(rows), axis=0)
    ctrl[:, columns] = rows
    return Motion(path.stem, _level_of(ctrl, robot), period, ctrl, joints)


def write_motion(path: Path, motion: Motion, robot: RobotSpec, rate: float) -> None:
    """The joints that a motion names, at a control rate, Hz, as a file that read_motion reads.

    Raises:
        UsageError: No robot has this rate; or a .txt, which has no time column, at another than 50
            Hz.
    """
    if not 1 / MAX_PERIOD_S <= rate <= 1 / MIN_PERIOD_S:
        raise UsageError(
            f"--rate {rate:g}: give the rate of the commands in Hz, 1 to {1 / MIN_PERIOD_S:g}"
        )
    names = list(motion.named(robot))
    rows = motion.sample(1 / rate)[:, robot.index(names)]
    if path.suffix == ".npz":
        with atomic_write(path) as temporary, temporary.open("wb") as file:
            np.savez(file, joint_names=np.array(names), ctrl=rows, dt=1 / rate)
        return
    if path.suffix == ".txt" and abs(rate * SAGE_PERIOD_S - 1) > 1e-9:
        raise UsageError(
            f"{path}: SAGE motion files are at {1 / SAGE_PERIOD_S:g} Hz; write csv or npz at "
            f"{rate:g} Hz"
        )
    if path.suffix == ".csv":
        rows = np.column_stack([np.arange(len(rows)) / rate, rows])
        names = ["time", *names]
    lines = [", ".join(names)]
    for row in rows:
        lines.append(", ".join(f"{number:.6f}" for number in row))
    write_text(path, "\n".join(lines) + "\n")


def _level_of(ctrl: Array, robot: RobotSpec) -> str:
    """joint when one joint moves, upper_body when only operated joints and torso move, else
    whole_body.
    """
    moves = np.ptp(ctrl, axis=0) > 1e-6
    moved = {robot.joint_names[i] for i in np.flatnonzero(moves)}
    if len(moved) <= 1:
        return "joint"
    trunk = {name for name in robot.joint_names if name.startswith(("torso", "waist"))}
    upper = trunk.union(robot.operated)
    if moved <= upper and len(upper) < len(robot.joint_names):
        return "upper_body"
    return "whole_body"


def _text(path: Path) -> tuple[list[str], Array, float]:
    """Return names, targets (T, k) rad and period, s, of a txt or csv file."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise LogError(f"{path}: not a text file") from None
    names = [name.strip() for name in lines[0].split(",")] if lines else []
    table = _table(lines, len(names), path)
    if "time" in names:
        at = names.index("time")
        dt = _even_period(table[:, at], path)
        return names[:at] + names[at + 1 :], np.delete(table, at, axis=1), dt
    if path.suffix == ".csv":
        raise LogError(f"{path}:1: no column time, s, so its pace is not known; add one")
    return names, table, SAGE_PERIOD_S


def _table(lines: list[str], columns: int, path: Path) -> Array:
    """Return the rows of numbers after the first line, (rows, columns)."""
    rows = []
    for number, line in enumerate(lines[1:], 2):
        if not line.strip():
            continue
        cells = line.replace(",", " ").split()
        try:
            row = [float(cell) for cell in cells]
        except ValueError:
            raise LogError(f"{path}:{number}: not a row of numbers: {line[:60]}") from None
        if len(row) != columns or not np.isfinite(row).all():
            raise LogError(
                f"{path}:{number}: {len(row)} values for {columns} names, or one is not finite"
            )
        rows.append(row)
    if len(rows) < 2:
        raise LogError(
            f"{path}: {len(rows)} rows after the line of joint names; a motion needs two or more"
        )
    return np.array(rows)


def _even_period(time: Array, path: Path) -> float:
    """Return the period of times (rows,), s."""
    period = np.diff(time)
    if not (period > 0).all() or np.ptp(period) > 0.01 * period.mean():
        raise LogError(
            f"{path}: time must rise evenly; it steps by {period.min():.4g} to {period.max():.4g} s"
        )
    return float(period.mean())


def _npz(path: Path) -> tuple[list[str], Array, float]:
    """Return names, targets (T, k) rad and period, s, of an npz file."""
    hint = "give a motion of at most 10 hours, as gaponet excite writes it"
    arrays = read_npz(path, LogError, hint, MAX_BYTES)
    names = _array(path, arrays, "joint_names", TEXT, 1).tolist()
    rows = _array(path, arrays, "ctrl", NUMBERS, 2).astype(float)
    period = float(_array(path, arrays, "dt", NUMBERS, 0))
    if rows.shape[1] != len(names) or len(rows) < 2 or not np.isfinite(rows).all():
        raise LogError(
            f"{path}: ctrl has shape {rows.shape} or holds NaN; {len(names)} joint names"
        )
    return names, rows, period


def _array(path: Path, arrays: dict[str, Array], name: str, kinds: str, dimensions: int) -> Array:
    """Return an array of a file; refuse one of another kind (of its dtype) or shape."""
    if name not in arrays:
        raise LogError(
            f"{path}: array '{name}' is missing; it holds {', '.join(arrays) or 'nothing'}"
        )
    array = arrays[name]
    if array.dtype.kind not in kinds or array.ndim != dimensions:
        what = "text" if kinds == TEXT else "numbers"
        raise LogError(
            f"{path}: array '{name}' must hold {what} in {dimensions} dimensions; write it again"
        )
    return array
