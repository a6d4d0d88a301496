"""One file per log format. A reader takes a path and yields Logs; it is imported when its format is asked for.

A format is a module with

    OPTIONS                 options of `read` beside joint_map that it understands
    find(path)              the recordings under a path: files or folders, sorted
    read(path, robot, joint_map=None, **options)    yields (motion name, Log), in the order of find
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from gaponet.arrays import Array
from gaponet.data.log import UNITS, Log
from gaponet.errors import LogError, UsageError
from gaponet.robot import RobotSpec

FORMATS = {
    "sage": "SAGE folder: control.csv and state_motor.csv beside each other",
    "table": "CSV or Parquet with named columns, a file or a folder of files",
    "lerobot": "LeRobotDataset v3.0 folder: meta/info.json",
    "bam": "JSON of BAM's servo test bench, a file or a folder of files",
}
TABLES = (".csv", ".parquet")
# Beyond these nothing was measured: 9,500 turns a minute; what differentiation and inverse dynamics make of noise.
MOST = {"qpos": 1e3, "qvel": 1e3, "temperature": 400.0, "qacc": 1e6, "tau_eq": 1e6}


def detect(path: Path) -> str:
    """The format of a file or folder."""
    if not path.exists():
        raise LogError(f"{path}: does not exist")
    if path.is_dir() and any(next(path.glob(name), None) for name in ("meta/info.json", "*/meta/info.json")):
        return "lerobot"
    if path.is_dir() and any(next(path.rglob(name), None) for name in ("control.csv", "state_motor.csv")):
        return "sage"
    files = [path] if path.is_file() else sorted(path.iterdir())
    if any(f.is_file() and f.suffix.lower() in TABLES for f in files):
        return "table"
    if any(f.is_file() and f.suffix.lower() == ".json" and is_bam(f) for f in files):
        return "bam"
    known = "; ".join(f"{name}: {text}" for name, text in FORMATS.items())
    raise LogError(f"{path}: not a log this version reads. Known formats: {known}")


def is_bam(file: Path) -> bool:
    """Whether a file begins as BAM's logs do."""
    with file.open("rb") as stream:
        start = stream.read(4096)
    return all(name in start for name in (b'"trajectory"', b'"entries"', b'"goal_position"'))


def find_logs(path: Path, fmt: str | None = None) -> list[Path]:
    """The recordings under a path, without reading them."""
    return _reader(path, fmt).find(path)


def read_logs(path: Path, robot: RobotSpec, fmt: str | None = None, **options: Any) -> Iterator[tuple[str, Log]]:
    """Yield (motion name, Log) for every recording under a path.

    Args:
        fmt: One of FORMATS; default by looking.
        options: joint_map {log name: robot name}. For tables also columns (a TOML file that maps column names),
            position_unit and time_unit; for LeRobot sets position_unit. None counts as not given; one that the format
            does not know is refused.
    """
    reader = _reader(path, fmt)
    given = {name: value for name, value in options.items() if value is not None}
    for name in given:
        if name != "joint_map" and name not in reader.OPTIONS:
            flag, kind = name.replace("_", "-"), reader.__name__.rsplit(".", 1)[-1]
            raise UsageError(f"--{flag} means nothing to the {kind} format, which fixes it itself; leave it out")
    yield from reader.read(path, robot, **given)


def _reader(path: Path, fmt: str | None) -> ModuleType:
    fmt = fmt or detect(path)
    if fmt not in FORMATS:
        raise LogError(f"unknown format '{fmt}'; use one of {', '.join(FORMATS)}")
    if not path.exists():
        raise LogError(f"{path}: does not exist")
    return import_module(f"gaponet.data.formats.{fmt}")


def to_radians(name: str, values: Array, joint_names: tuple[str, ...], units: list[str], robot: RobotSpec) -> Array:
    """Positions or velocities in the unit of the log → rad or rad/s.

    Args:
        name: Channel: an offset applies to positions (ctrl, qpos) only; torques and temperatures pass untouched.
        values: (k, n), columns in the order of joint_names.
        joint_names: The robot's own names, (n).
        units: Unit of each joint, (n): rad, deg, or fraction (0..1 of the robot's joint range).
        robot: Whose joint ranges give a fraction its meaning.
    """
    if name not in ("ctrl", "qpos", "qvel") or set(units) == {"rad"}:
        return values
    out = np.array(values, float)
    for column, (joint, unit) in enumerate(zip(joint_names, units, strict=True)):
        if unit == "deg":
            out[:, column] *= np.pi / 180
        if unit == "fraction":
            low, high = robot.qpos_range[robot.joint_names.index(joint)]
            out[:, column] = out[:, column] * (high - low) + (0.0 if name == "qvel" else low)
    return out


def refuse_absurd(log: Log, robot: RobotSpec) -> Log:
    """Return the log, or refuse positions that can only be degrees (or another joint's), and what no motor does.

    A sensor may read more torque than the motor has, not 20 times as much.
    """
    columns = robot.index(log.joint_names)
    for name in (n for n in UNITS if n in log.channels):
        values = log.channels[name].values
        if name in ("ctrl", "qpos"):
            refuse_degrees(values, log.joint_names, robot, partial(_place, log, name))
            continue
        most = np.maximum(20 * robot.effort_limit[columns], 100.0) if name == "tau" else MOST[name]
        beyond = np.argwhere(np.abs(values) > most)
        if len(beyond):
            row, column = beyond[0]
            raise LogError(
                f"{log.row(name, int(row))}: {name} of {log.joint_names[column]} is {values[row, column]:.4g} "
                f"{UNITS[name]}: no joint does that; repair or cut the row, or leave the column out"
            )
    return log


def _place(log: Log, name: str, row: int) -> str:
    return f"{log.row(name, row)}: {name}"


def refuse_degrees(values: Array, joint_names: tuple[str, ...], robot: RobotSpec, where: Callable[[int], str]) -> None:
    """Refuse positions (k, n) that can only be degrees, or another joint's; where: what to call a row in the error.

    A real joint may pass its MJCF limit by a calibration offset, not by a radian and half a turn.
    """
    for column, joint in enumerate(joint_names):
        row = int(abs(values[:, column]).argmax())
        value, (low, high) = values[row, column], robot.qpos_range[robot.joint_names.index(joint)]
        if abs(value) > 3.3 and (not low - 1.0 <= value <= high + 1.0 or abs(value) > MOST["qpos"]):
            raise LogError(
                f"{where(row)} of {joint} is {value:.3f}, outside its range [{low:.2f}, {high:.2f}] rad; positions "
                "must be in radians: these look like degrees (tables: --position-unit deg)"
            )
