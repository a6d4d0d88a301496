"""One file per log format. A reader takes a path and yields Logs; it is imported when its format is asked for."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

from gaponet.data.log import Log
from gaponet.errors import LogError
from gaponet.robot import RobotSpec

FORMATS = {
    "sage": "SAGE folder: control.csv and state_motor.csv beside each other",
    "table": "CSV or Parquet with named columns",
}


def detect(path: Path) -> str:
    """The format of a file or folder."""
    if not path.exists():
        raise LogError(f"{path}: does not exist")
    if path.is_dir() and next(path.rglob("control.csv"), None):
        return "sage"
    if path.suffix.lower() in (".csv", ".parquet"):
        return "table"
    known = "; ".join(f"{name}: {text}" for name, text in FORMATS.items())
    raise LogError(f"{path}: not a log this version reads. Known formats: {known}")


def read_logs(path: Path, robot: RobotSpec, fmt: str | None = None, **options: Any) -> Iterator[tuple[str, Log]]:
    """Yield (motion name, Log) for every recording under a path.

    Args:
        path: File or folder.
        robot: Whose joint names and units apply.
        fmt: One of FORMATS; default by looking.
        options: joint_map {log name: robot name}; for tables also columns, position_unit and time_unit.
    """
    fmt = fmt or detect(path)
    if fmt not in FORMATS:
        raise LogError(f"unknown format '{fmt}'; use one of {', '.join(FORMATS)}")
    if not path.exists():
        raise LogError(f"{path}: does not exist")
    yield from import_module(f"gaponet.data.formats.{fmt}").read(path, robot, **options)


def refuse_degrees(log: Log, robot: RobotSpec) -> Log:
    """Return the log, or refuse positions that can only be degrees (or another joint's).

    A real joint may pass its MJCF limit by a calibration offset, not by a radian and half a turn.
    """
    for name in ("ctrl", "qpos"):
        values = log.channels[name].values
        for column, joint in enumerate(log.joint_names):
            j = robot.joint_names.index(joint)
            if robot.log_units[j] != "rad":
                continue
            row = int(abs(values[:, column]).argmax())
            value, (low, high) = values[row, column], robot.qpos_range[j]
            if abs(value) > 3.3 and not low - 1.0 <= value <= high + 1.0:
                raise LogError(
                    f"{log.row(name, row)}: {name} of {joint} is {value:.3f}, outside its range "
                    f"[{low:.2f}, {high:.2f}] rad; positions must be in radians: these look like degrees "
                    "(tables: --position-unit deg)"
                )
    return log
