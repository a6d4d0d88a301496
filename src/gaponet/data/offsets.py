"""Static offsets of one robot unit, measured in its static poses; recorded beside the data, not
applied to it.

The tracking offset is the static error beyond the gravity sag of the nominal model. It contains
wrong encoder zeros and softer motors alike; gaponet identify separates them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from typing_extensions import TypedDict

from gaponet.base.arrays import Array
from gaponet.base.errors import DatasetError
from gaponet.base.files import write_json
from gaponet.base.structure import Json, read_json
from gaponet.data.static_poses import StaticPoses
from gaponet.data.store import Dataset
from gaponet.robot.spec import RobotSpec

FILE = "offsets.json"
# qpos (k, n) rad, payload_mass kg, payload_side → torques that hold the robot, (k, n) N·m
Gravity = Callable[[Array, float, str], Array]
# qpos, qvel, qacc (k, n) rad, rad/s, rad/s², payload_mass kg, payload_side → torques of that
# motion, (k, n) N·m
Dynamics = Callable[[Array, Array, Array, float, str], Array]


@dataclass(frozen=True)
class JointOffset:
    """Static error of one joint, rad; None where there are too few static poses."""

    rests_up: int  # static poses approached from below
    rests_down: int  # and from above
    static_error: float | None  # qpos − ctrl, mean of both approaches
    # half the distance between both approaches, without nominal sag; times kp a torque
    stiction_band: float | None
    nominal_sag: float | None  # static error of the nominal model in the same poses
    tracking_offset: float | None  # static_error − nominal_sag


class _OffsetsFile(TypedDict):
    applied: bool
    units: dict[str, dict[str, Json]]


def unit_offsets(
    dataset: Dataset,
    robot: RobotSpec,
    unit_id: str,
    gravity: Gravity,
    known: dict[str, StaticPoses],
) -> dict[str, JointOffset]:
    """Measure the offsets of the operated joints of one unit from all its sequences.

    Args:
        known: Content hash → static poses of sequences that need not be read again.
    """
    poses = []
    sags = [np.zeros((0, len(robot.joint_names)))]  # of the nominal model in these poses, rad
    for entry in dataset.entries:
        meta = entry.meta
        if meta.unit_id != unit_id:
            continue
        own = known.get(entry.hash) or StaticPoses.of(dataset.read(entry), robot.operated_index)
        recorded_kp, _ = meta.recorded_gains
        kp = robot.with_gains(recorded_kp, None).servo.kp
        torque = gravity(own.qpos, meta.payload_mass, meta.payload_side)
        poses.append(own)
        sags.append(-torque / np.where(kp > 0, kp, np.inf))
    joined = StaticPoses.joined(poses, len(robot.joint_names))
    sag = np.concatenate(sags)
    offsets = {}
    for name, j in zip(robot.operated, robot.operated_index, strict=True):
        error = joined.static_error(j)
        beyond_sag = joined.static_error(j, sag[:, j])
        offsets[name] = JointOffset(
            rests_up=error.up,
            rests_down=error.down,
            static_error=_rounded(error.middle),
            stiction_band=_rounded(beyond_sag.half_band),
            nominal_sag=_rounded(error.middle - beyond_sag.middle),
            tracking_offset=_rounded(beyond_sag.middle),
        )
    return offsets


def _rounded(value: float) -> float | None:
    """Return a value in rad to the microradian; None if it is not known."""
    return round(value, 6) if math.isfinite(value) else None


def record_offsets(
    dataset: Dataset, unit_id: str, offsets: dict[str, JointOffset], simulator: str
) -> Path:
    """Write a unit's offsets into offsets.json; those of other units stay.

    Args:
        simulator: Hash of the model whose gravity was used.
    """
    file = dataset.path / FILE
    with dataset.writing():
        content = read_offsets(dataset)
        content["units"][unit_id] = {"joints": offsets, "simulator": simulator}
        write_json(file, content)
    return file


def read_offsets(dataset: Dataset) -> dict[str, Any]:
    """Return the content of offsets.json.

    Its units are {unit_id: {"joints": {joint: fields of JointOffset}, "simulator": hash}}.

    Raises:
        DatasetError: The file is damaged.
    """
    file = dataset.path / FILE
    if not file.is_file():
        return {"applied": False, "unit": "rad", "units": {}}
    hint = "delete it, the next import writes it again"
    return {**read_json(_OffsetsFile, file, DatasetError, hint, allow_extra=True)}
