"""JSON of BAM's servo test bench, a file or a folder of files.

github.com/Rhoban/bam: one servo on a pendulum, {mass, length, kp, vin, motor, trajectory, entries}.

The mass at the arm's end is the payload, and the arm's length says at which mount: `--robot
xl330_bench` has one for each. kp is the firmware's: what it means in N·m/rad is the gain of the
joint's [[servo]] in robot.toml. A recording ends where torque is switched off: from there on
nothing is commanded.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NotRequired

import numpy as np
from annotated_types import Gt, Interval, Len
from typing_extensions import TypedDict

from gaponet.base.errors import LogError
from gaponet.base.structure import read_json
from gaponet.data.formats import files_below
from gaponet.data.log import Channel, Log
from gaponet.robot.spec import RobotSpec

# channel → field of a Sample
FIELDS = {"ctrl": "goal_position", "qpos": "position", "qvel": "speed", "temperature": "temp"}
MAX_VOLTS_RATIO = 0.1  # difference of stated and measured supply voltage, relative
Size = Annotated[float, Gt(0), Interval(le=1e3)]


class Sample(TypedDict):
    """One sample; rad, rad/s, s, °C, V."""

    timestamp: float
    position: float
    goal_position: float | None
    torque_enable: bool
    speed: NotRequired[float]
    temp: NotRequired[float]
    input_volts: NotRequired[float]


class BamFile(TypedDict):
    """One file; kg, m, V."""

    mass: Annotated[float, Interval(ge=0, le=100)]
    arm_mass: NotRequired[Annotated[float, Interval(ge=0, le=100)]]
    length: Size
    kp: Annotated[float, Gt(0), Interval(le=1e6)]
    vin: Size
    motor: str
    trajectory: str
    entries: Annotated[list[Sample], Len(2)]


def detects(path: Path) -> bool:
    """A file that begins as BAM's do, or a folder with one."""
    if path.is_file():
        return path.suffix.lower() == ".json" and _is_bam(path)
    return any(_is_bam(file) for file in path.glob("*.json"))


def _is_bam(file: Path) -> bool:
    if not file.is_file():
        return False
    with file.open("rb") as stream:
        start = stream.read(4096)
    return all(name in start for name in (b'"trajectory"', b'"entries"', b'"goal_position"'))


def find(path: Path) -> list[Path]:
    """The recordings at or below a path."""
    if path.is_file():
        return [path]
    return sorted(file for file in files_below(path) if file.suffix == ".json" and _is_bam(file))


def read(
    path: Path, robot: RobotSpec, joint_map: dict[str, str] | None = None
) -> Iterator[tuple[str, Callable[[], Log]]]:
    """Yield (trajectory, what reads its Log) for every recording; the motor's name stands for the
    joint.
    """
    files = find(path)
    if not files:
        raise LogError(f"{path}: no recording of BAM (JSON with trajectory and entries)")
    for file in files:
        log_data = read_json(
            BamFile, file, LogError, "record it again, or leave the file out", allow_extra=True
        )
        yield log_data["trajectory"], partial(_log, file, log_data, robot, joint_map)


def _log(file: Path, log_data: BamFile, robot: RobotSpec, joint_map: dict[str, str] | None) -> Log:
    joint = robot.resolve(log_data["motor"], str(file), joint_map)
    servo = robot.servo.types[robot.index([joint])[0]]
    if servo is None or servo.gain is None:
        raise LogError(
            f"{file}: motor is '{log_data['motor']}': what its kp {log_data['kp']:g} means in "
            f"N·m/rad is not known; write gain (and gain_volts) into the [[servo]] of {joint} in "
            f"the robot.toml of {robot.name}"
        )
    entries = log_data["entries"]
    end = _rows_with_torque(entries)
    if end < 2:
        raise LogError(
            f"{file}: torque is off from the start; a log needs commands that the servo follows"
        )
    samples = entries[:end]
    vin = log_data["vin"]
    volts = float(np.median([sample.get("input_volts", vin) for sample in samples]))
    if abs(volts - vin) > MAX_VOLTS_RATIO * vin:
        logging.getLogger("gaponet").warning(
            "%s: vin says %g V, the servo measured %g V: the gain is taken at vin; correct the "
            "file if that is wrong",
            file,
            vin,
            volts,
        )
    volts_ratio = vin / servo.gain_volts if servo.gain_volts else 1.0
    arm_mass = log_data.get("arm_mass", 0.0)
    notes: dict[str, Any] = {"firmware_kp": log_data["kp"], "volts": vin}
    if end < len(entries):
        notes["cut"] = f"torque is off from {entries[end]['timestamp']:.2f} s on"
    meta = {
        "files": dict.fromkeys(FIELDS, str(file)),
        "kp": [log_data["kp"] * servo.gain * volts_ratio],
        "stated": {
            "payload_mass": log_data["mass"] + 0.5 * arm_mass,  # as seen from the joint
            "payload_side": f"{1e3 * log_data['length']:.0f}mm",
        },
        "notes": notes,
    }
    return Log(robot.name, (joint,), _channels(samples), str(file), meta)


def _rows_with_torque(entries: list[Sample]) -> int:
    """Return the number of samples before torque is switched off."""
    for i, sample in enumerate(entries):
        if not sample["torque_enable"] or sample["goal_position"] is None:
            return i
    return len(entries)


def _channels(samples: list[Sample]) -> dict[str, Channel]:
    """Return the channels that every sample holds, (k, 1)."""
    time = np.array([sample["timestamp"] for sample in samples])
    channels = {}
    for name, field in FIELDS.items():
        values = [sample.get(field) for sample in samples]
        if None not in values:
            channels[name] = Channel(time, np.array(values, float)[:, None])
    return channels
