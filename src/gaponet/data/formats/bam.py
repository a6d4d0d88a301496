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
from typing import Annotated, NotRequired

import numpy as np
from annotated_types import Gt, Interval, Len
from typing_extensions import TypedDict

from gaponet.base.errors import LogError
from gaponet.base.structure import read_json
from gaponet.data.formats import files_below
from gaponet.data.log import Channel, Log
from gaponet.robot.spec import RobotSpec

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
    return any(
        f.suffix.lower() == ".json" and _is_bam(f)
        for f in ([path] if path.is_file() else path.glob("*.json"))
    )


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
    return sorted(f for f in files_below(path) if f.suffix == ".json" and _is_bam(f))


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
    servo = robot.servos[robot.index([joint])[0]]
    if servo is None or servo.gain is None:
        raise LogError(
            f"{file}: motor is '{log_data['motor']}': what its kp {log_data['kp']:g} means in "
            f"N·m/rad is not known; write gain (and gain_volts) into the [[servo]] of {joint} in "
            f"the robot.toml of {robot.name}"
        )
    on = log_data["entries"]
    off = next(
        (i for i, e in enumerate(on) if not e["torque_enable"] or e["goal_position"] is None),
        len(on),
    )
    if off < 2:
        raise LogError(
            f"{file}: torque is off from the start; a log needs commands that the servo follows"
        )
    on, cut = on[:off], on[off:]
    channels = {"ctrl": "goal_position", "qpos": "position", "qvel": "speed", "temperature": "temp"}
    time = np.array([e["timestamp"] for e in on])
    volts = float(np.median([e.get("input_volts", log_data["vin"]) for e in on]))
    if abs(volts - log_data["vin"]) > MAX_VOLTS_RATIO * log_data["vin"]:
        logging.getLogger("gaponet").warning(
            "%s: vin says %g V, the servo measured %g V: the gain is taken at vin; correct the "
            "file if that is wrong",
            file,
            log_data["vin"],
            volts,
        )
    gain = (
        log_data["kp"]
        * servo.gain
        * (log_data["vin"] / servo.gain_volts if servo.gain_volts else 1.0)
    )
    return Log(
        robot.name,
        (joint,),
        {
            name: Channel(time, np.array([[e[key]] for e in on], float))  # type: ignore[literal-required]
            for name, key in channels.items()
            if all(key in e for e in on)
        },
        str(file),
        {
            "files": {name: str(file) for name in channels},
            "kp": [gain],
            "stated": {
                "payload_mass": log_data["mass"]
                + 0.5 * log_data.get("arm_mass", 0.0),  # its weight as seen from the joint
                "payload_side": f"{1e3 * log_data['length']:.0f}mm",
            },
            "notes": {"firmware_kp": log_data["kp"], "volts": log_data["vin"]}
            | ({"cut": f"torque is off from {cut[0]['timestamp']:.2f} s on"} if cut else {}),
        },
    )
