"""Plausibility of logs: units become SI, and values that no joint of this robot reaches are
refused.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import LogError
from gaponet.data.describe.encoders import Encoder
from gaponet.data.log import FEEDFORWARD, UNITS, Channel, Log
from gaponet.robot.spec import RobotSpec

# Beyond these nothing was measured: 9,500 turns a minute; what differentiation and inverse dynamics
# make of noise. In SI.
MAX_PLAUSIBLE = {"qpos": 1e3, "qvel": 1e3, "temperature": 400.0, "qacc": 1e6, "tau_eq": 1e6}
MAX_TORQUE_RATIO = 20.0  # of a reading, over the torque limit of its motor
MAX_WEAK_TORQUE = 100.0  # N·m, of a reading of a motor with less than a 20th of it
MAX_SPEED_RATIO = 10.0  # of a reading, over the fastest that the positions ever move
MAX_SPEED_BEYOND_RAD_S = 50.0  # added to this
MAX_NONSENSE_SHARE = 0.2  # of a joint's rows: with more, nothing of the channel is believed
MAX_UNASKED_RAD = 1.0  # that a joint moves of itself while all are told to stand still
TICKS_PER_TURN = 4096  # of the encoders of Feetech and Dynamixel servos
# Unit → where it starts, and its span, of a joint's range.
FRACTIONS = {
    "fraction": (0.0, 1.0),
    "percent": (0.0, 100.0),
    "signed_percent": (-100.0, 200.0),
}
FULL_PERCENT = 100.0
MAX_OFFSET_RAD = 3.3  # from zero, of a calibration: little more than half a turn
MAX_BEYOND_RAD = 1.0  # of a joint's range, the same
MIN_KIND_CORRELATION = 0.5  # of a command with speed or torque that tells what it is
SAME_MOTION_CORRELATION = 0.8  # of positions in two units
TURN_RAD = 2 * np.pi
LARGEST_DEG = 360.0  # larger positions of a limb are no degrees


def to_radians(
    name: str,
    values: Array,
    joint_names: tuple[str, ...],
    units: list[str],
    robot: RobotSpec,
    encoders: Mapping[str, Encoder] | None = None,
) -> Array:
    """Positions or velocities in the unit of the log → rad or rad/s.

    Args:
        name: Channel: an offset applies to positions (ctrl, qpos) only; torques and temperatures
            pass untouched.
        values: (k, n), columns in the order of joint_names.
        joint_names: The robot's own names, (n).
        units: Unit of each joint, (n), one of LOG_UNITS.
        robot: The robot whose joint ranges give a fraction its meaning.
        encoders: The arm's calibration, which gives ticks and percent their meaning. Without it,
            ticks are 4096 a turn and 2048 at zero, as Feetech and Dynamixel servos count, and
            percent are of the robot's joint range.
    """
    if name not in ("ctrl", "qpos", "qvel") or set(units) == {"rad"}:
        return values
    out = np.array(values, float)
    for column, (joint, unit) in enumerate(zip(joint_names, units, strict=True)):
        encoder = (encoders or {}).get(joint)
        out[:, column] = _angles(out[:, column], joint, unit, robot, encoder, name == "qvel")
    return out


def not_in_radians(joint_names: Iterable[str], units: Iterable[str]) -> dict[str, str]:
    """Return joint → unit, of the joints whose positions have to be converted."""
    converted = {}
    for joint, unit in zip(joint_names, units, strict=True):
        if unit != "rad":
            converted[joint] = unit
    return converted


def _angles(
    values: Array, joint: str, unit: str, robot: RobotSpec, encoder: Encoder | None, speed: bool
) -> Array:
    """Return one joint's values (k,) in rad or, if they are speeds, in rad/s."""
    if unit in ("rad", "deg", "turns"):
        return _from_angles(values, unit)
    place = robot.joint_names.index(joint)
    is_gripper = robot.log_joints.units[place] == "fraction"
    if encoder is not None and unit == "ticks" and is_gripper:
        values = encoder.fractions(values, speed)
        unit = "fraction"
    if encoder is not None and unit in ("ticks", "signed_percent"):
        return encoder.angles(values, unit, speed)
    if unit == "ticks":
        zero = 0.0 if speed else TICKS_PER_TURN / 2
        return (values - zero) * 2 * np.pi / TICKS_PER_TURN
    low, high = robot.qpos_range[place]
    start, span = FRACTIONS[unit]
    if speed:
        return np.asarray(values / span * (high - low))
    return np.asarray((values - start) / span * (high - low) + low)


def _from_angles(values: Array, unit: str) -> Array:
    """Return angles in rad, degrees or turns in rad."""
    if unit == "deg":
        return np.asarray(np.radians(values))
    if unit == "turns":
        return TURN_RAD * values
    return values


def require_plausible(log: Log, robot: RobotSpec, strict: bool = False) -> Log:
    """Return the log without what no joint does, or refuse it.

    Positions that can only be degrees (or another joint's) refuse it. Where velocity, torque or
    temperature is nonsense, a counter for a speed, that channel is made up for in those rows and
    the log notes it (notes, "nonsense"): velocity from positions, others from the rows around them;
    a channel that is mostly nonsense is left out. `strict` refuses it. A sensor may read more
    torque than the motor has, not 20 times as much.
    """
    _require_told_to_move(log)
    _require_targets(log, robot)
    channels = dict(log.channels)
    replaced = {}
    for name in UNITS:
        if name not in log.channels:
            continue
        if name in ("ctrl", "qpos"):
            values = log.channels[name].values
            require_radians(values, log.joint_names, robot, partial(_place, log, name))
            continue
        wrong = _nonsense(name, log, robot)
        if not wrong.any():
            continue
        if strict or name == FEEDFORWARD:  # commands are never made up
            raise _implausible(name, log, wrong)
        tolerable = bool(wrong.mean(axis=0).max() <= MAX_NONSENSE_SHARE)
        replaced[name] = _note(name, log, wrong, tolerable)
        channels.pop(name)
        if tolerable:
            channels[name] = Channel(log.channels[name].time, _made_up(name, log, wrong))
    if not replaced:
        return log
    notes = log.meta.get("notes", {}) | {"nonsense": replaced}
    return replace(log, channels=channels, meta=log.meta | {"notes": notes})


def _require_told_to_move(log: Log) -> None:
    """Refuse commands that all stand still while the joints move."""
    commanded = np.ptp(log.channels["ctrl"].values, axis=0).max()
    moved = np.ptp(log.channels["qpos"].values, axis=0).max()
    if commanded == 0 and moved > MAX_UNASKED_RAD:
        raise LogError(
            f"{log.source}: every commanded position stands still while the joints move by up to "
            f"{moved:.3g} rad: a robot driven by torques, by velocities or by hand; such commands "
            "are no position targets to learn from"
        )


def _implausible(name: str, log: Log, wrong: Array) -> LogError:
    """Return the error that a channel holds nonsense. wrong: (k, n) bool."""
    row, column = np.argwhere(wrong)[0]
    value = log.channels[name].values[row, column]
    return LogError(
        f"{log.row(name, int(row))}: {name} of {log.joint_names[column]} is "
        f"{value:.4g} {UNITS[name]}: no joint does that; repair or cut the "
        "row, or leave the column out"
    )


def _note(name: str, log: Log, wrong: Array, tolerable: bool) -> dict[str, Any]:
    """Return the note of nonsense in a channel.

    Args:
        wrong: Where it is, (k, n) bool.
        tolerable: It is made up for; else the channel is left out.
    """
    values = log.channels[name].values
    joints = zip(log.joint_names, np.ravel(wrong.any(axis=0)), strict=True)
    done = "left out"
    if tolerable:
        done = "from positions" if name == "qvel" else "from the rows around them"
    return {
        "rows": int(wrong.any(axis=1).sum()),
        "of": len(values),
        "worst": float(values[wrong][0]),
        "joints": [joint for joint, bad in joints if bad],
        "done": done,
    }


def _require_targets(log: Log, robot: RobotSpec) -> None:
    """Refuse commands that no joint reaches beside positions that all do: speeds, torques or
    currents under a name of targets.
    """
    time, positions = log.channels["qpos"]
    command_time, commands = log.channels["ctrl"]
    for column, joint in enumerate(log.joint_names):
        low, high = robot.qpos_range[robot.joint_names.index(joint)]
        command = commands[:, column]
        qpos = positions[:, column]
        if not _beyond(command, low, high) or _beyond(qpos, low, high):
            continue
        correlations = _correlations(np.interp(time, command_time, command), column, log)
        if correlations.pop("positions") > SAME_MOTION_CORRELATION:
            return  # positions in another unit
        likely = max(correlations, key=lambda kind: correlations[kind])
        if correlations[likely] < MIN_KIND_CORRELATION:
            return  # a reading that is wrong in some rows
        row = int(np.abs(command).argmax())
        raise LogError(
            f"{_place(log, 'ctrl', row)} of {joint} is {command[row]:.3f}, outside its range "
            f"[{low:.2f}, {high:.2f}] rad, while its measured positions are inside: these are no "
            f"position targets but, by how the joint moves, {likely}. Log the targets of the "
            "position controller; of a robot that is driven by torque or current see "
            "docs/logs.md, 'Driven by torque or current'"
        )


def _correlations(command: Array, column: int, log: Log) -> dict[str, float]:
    """Return what a command (k,) may be → its correlation with that, of either sign.

    Args:
        command: At the times of the positions.
        column: Of the joint.
    """
    time, positions = log.channels["qpos"]
    qpos = positions[:, column]
    speed = np.gradient(qpos, time)
    acceleration = np.gradient(speed, time)
    torque = abs(_correlation(command, acceleration))
    if "tau" in log.channels and len(log.channels["tau"].time) == len(time):
        recorded = log.channels["tau"].values[:, column]
        torque = max(torque, abs(_correlation(command, recorded)))
    return {
        "positions": abs(_correlation(command, qpos)),
        "speeds": abs(_correlation(command, speed)),
        "torques or currents": torque,
    }


def _beyond(values: Array, low: float, high: float) -> bool:
    """Return True if positions (k,), rad, are further from zero and from the joint's range than a
    calibration offset.
    """
    far = np.abs(values) > MAX_OFFSET_RAD
    outside = (values < low - MAX_BEYOND_RAD) | (values > high + MAX_BEYOND_RAD)
    return bool((far & outside).any())


def _correlation(one: Array, other: Array) -> float:
    spread = one.std() * other.std()
    if not spread > 0:
        return 0.0
    return float(((one - one.mean()) * (other - other.mean())).mean() / spread)


def _nonsense(name: str, log: Log, robot: RobotSpec) -> Array:
    """Where a channel holds what no joint does, (k, n)."""
    values = np.abs(log.channels[name].values)
    if name in ("tau", FEEDFORWARD):
        limits = robot.servo.effort_limit[robot.index(log.joint_names)]
        return np.asarray(values > np.maximum(MAX_TORQUE_RATIO * limits, MAX_WEAK_TORQUE))
    if name != "qvel":
        return np.asarray(values > MAX_PLAUSIBLE[name])
    time, qpos = log.channels["qpos"]
    fastest = np.abs(np.diff(qpos, axis=0) / np.diff(time)[:, None]).max(axis=0)  # (n) rad/s
    most = MAX_SPEED_BEYOND_RAD_S + MAX_SPEED_RATIO * fastest
    return np.asarray(values > np.minimum(most, MAX_PLAUSIBLE[name]))


def _made_up(name: str, log: Log, wrong: Array) -> Array:
    """Return a channel whose wrong values, (k, n) bool, come from positions or from the rows
    around them.
    """
    position_time, qpos = log.channels["qpos"]
    time, values = log.channels[name]
    out = np.array(values, float)
    for j in np.flatnonzero(wrong.any(axis=0)):
        bad = wrong[:, j]
        if name == "qvel":
            speed = np.gradient(qpos[:, j], position_time)
            out[bad, j] = np.interp(time[bad], position_time, speed)
        else:
            out[bad, j] = np.interp(time[bad], time[~bad], values[~bad, j])
    return out


def _place(log: Log, name: str, row: int) -> str:
    return f"{log.row(name, row)}: {name}"


def require_radians(
    values: Array, joint_names: tuple[str, ...], robot: RobotSpec, where: Callable[[int], str]
) -> None:
    """Refuse positions (k, n) that can only be degrees, or another joint's; where: what to call a
    row in the error.

    A real joint may pass its MJCF limit by a calibration offset, not by a radian and half a turn.
    NaN, a reading that is missing, is left alone.
    """
    for column, joint in enumerate(joint_names):
        of_joint = values[:, column]
        sizes = np.nan_to_num(np.abs(of_joint), nan=0.0)
        row = int(sizes.argmax())
        value = of_joint[row]
        low, high = robot.qpos_range[robot.joint_names.index(joint)]
        near = low - MAX_BEYOND_RAD <= value <= high + MAX_BEYOND_RAD
        if sizes[row] <= MAX_OFFSET_RAD or (near and sizes[row] <= MAX_PLAUSIBLE["qpos"]):
            continue
        raise LogError(
            f"{where(row)} of {joint} is {value:.3f}, outside its range [{low:.2f}, "
            f"{high:.2f}] rad; positions must be in radians: these look like "
            f"{_likely_unit(of_joint)}, or for one joint with [joint_units]"
        )


def _likely_unit(values: Array) -> str:
    """Say what positions (k,) are that are no radians, and how to state it."""
    stated_as_degrees = np.round(np.degrees(values), 6)
    if look_like_ticks(values) or look_like_ticks(stated_as_degrees):
        return (
            "ticks of an encoder, whole numbers from 0 to 4095; logs state them with "
            "--position-unit ticks"
        )
    if look_like_percent(values):
        return (
            "degrees, or LeRobot's −100..100 of the range; logs state them with --position-unit "
            "deg or signed_percent"
        )
    return "degrees; logs state them with --position-unit deg"


def look_like_ticks(values: Array) -> bool:
    """Return True if positions can only be ticks of an encoder with TICKS_PER_TURN a turn."""
    whole = np.array_equal(values, np.round(values))
    return bool(whole and values.min() >= 0 and LARGEST_DEG < values.max() < TICKS_PER_TURN)


def look_like_percent(values: Array) -> bool:
    """Return True if positions end at exactly ±100, as LeRobot's normalised ones do."""
    return float(np.abs(values).max()) == FULL_PERCENT
