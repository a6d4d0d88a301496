"""SAGE folders: {real,sim}/{robot}/{source}/{motion}/{control,state_motor,event}.csv and joint_list.txt.

Rows are TYPE,timestamp,"[...]"; the case of TYPE differs between recordings. Real timestamps are microseconds, simulated
ones seconds; the reader decides by the period and refuses one that is neither.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gaponet.data.formats import refuse_degrees
from gaponet.data.log import Channel, Log
from gaponet.errors import LogError
from gaponet.robot import RobotSpec

Array = np.ndarray

COLUMNS = {"positions": "qpos", "velocities": "qvel", "torques": "tau"}


def read(path: Path, robot: RobotSpec, joint_map: dict[str, str] | None = None) -> Iterator[tuple[str, Log]]:
    """Yield (motion, Log) for every real motion folder under path; simulated ones are skipped."""
    folders = sorted(p.parent for p in path.rglob("control.csv"))
    folders = [f for f in folders if f.relative_to(path).parts[:1] != ("sim",)]
    if not folders:
        raise LogError(f"{path}: no folder with control.csv and state_motor.csv; point at a SAGE folder")
    for folder in folders:
        yield folder.name, refuse_degrees(_read_motion(folder, robot, joint_map), robot)


def _read_motion(folder: Path, robot: RobotSpec, joint_map: dict[str, str] | None) -> Log:
    list_file = folder / "joint_list.txt"
    if not list_file.is_file():
        raise LogError(f"{list_file}: missing; one joint name a line, in the order of the columns")
    raw_names = [line.strip() for line in list_file.read_text(encoding="utf-8").splitlines() if line.strip()]
    names = tuple(robot.resolve(name, str(list_file), joint_map) for name in raw_names)
    if len(set(names)) != len(names):
        raise LogError(f"{list_file}: two names map to one joint: {', '.join(names)}; mend --map")
    control, state = folder / "control.csv", folder / "state_motor.csv"
    ctrl_time, ctrl = _read_csv(control, len(names), required=("positions",))
    state_time, values = _read_csv(state, len(names), required=("positions",))
    channels = {COLUMNS[k]: Channel(state_time, v) for k, v in values.items() if k in COLUMNS}
    channels["ctrl"] = Channel(ctrl_time, ctrl["positions"])
    files = dict.fromkeys(channels, str(state)) | {"ctrl": str(control)}
    return Log(
        robot.name, names, channels, str(folder),
        {"files": files, "first_line": 2, "raw_joint_names": raw_names, "events": _events(folder / "event.csv")},
    )  # fmt: skip


def _read_csv(file: Path, n: int, required: tuple[str, ...]) -> tuple[Array, dict[str, Array]]:
    """Time (k,) in seconds and {column: (k, n)}."""
    if not file.is_file():
        raise LogError(f"{file}: missing; a SAGE motion needs control.csv and state_motor.csv")
    text = file.read_text(encoding="utf-8")
    header, _, body = text.partition("\n")
    columns = [c.strip().lower() for c in header.split(",")]
    lists = columns[2:]
    if columns[:2] != ["type", "timestamp"]:
        raise LogError(f"{file}:1: header is '{header.strip()}', expected type,timestamp,positions,...")
    for name in required:
        if name not in lists:
            raise LogError(f"{file}:1: column '{name}' is missing; the header has: {', '.join(columns)}")
    if not body.strip():
        raise LogError(f"{file}: holds no rows; delete the motion folder or record it again")
    _check_rows(file, body, n, len(lists))
    table = np.loadtxt(io.StringIO(re.sub(r'["\[\]]', "", body)), delimiter=",", usecols=range(1, 2 + n * len(lists)),
                       ndmin=2)  # fmt: skip
    time = table[:, 0] * _seconds(file, table[:, 0])
    return time, {name: table[:, 1 + i * n : 1 + (i + 1) * n] for i, name in enumerate(lists)}


def _check_rows(file: Path, body: str, n: int, k: int) -> None:
    """Every row is TYPE,time and k lists of n numbers; refuse the first that is not, by line."""
    number = r" *(?:[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|[-+]?nan|[-+]?inf) *"
    row = re.compile(rf'[A-Za-z_]+,{number}(?:,"\[{number}(?:,{number}){{{n - 1}}}\]"){{{k}}}', re.IGNORECASE)
    for i, line in enumerate(body.splitlines()):
        if line and not row.fullmatch(line):
            shown = line if len(line) < 60 else line[:57] + "..."
            raise LogError(
                f"{file}:{i + 2}: expected TYPE,timestamp and {k} list(s) of {n} numbers, got '{shown}'; "
                "the file may be cut short: remove the row or record the motion again"
            )


def _seconds(file: Path, time: Array) -> float:
    """Factor from the file's time unit to seconds."""
    period = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    if 1e-4 <= period <= 1.0:
        return 1.0
    if 1e2 <= period <= 1e6:
        return 1e-6
    if period <= 0:
        return 1e-6  # Log refuses the row where time goes back
    raise LogError(f"{file}: the median period is {period:g}, neither microseconds nor seconds; mend the timestamps")


def _events(file: Path) -> list[list[str]]:
    if not file.is_file():
        return []
    rows = [line.split(",") for line in file.read_text(encoding="utf-8").splitlines()[1:] if line.strip()]
    return [[r[1].strip(), r[2].strip()] for r in rows if len(r) >= 3]
