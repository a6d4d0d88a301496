"""Static offsets of one robot unit, fitted from its rests; recorded beside the data, never applied to it.

Two readings of the same static errors:

- `tracking_offset`: what a joint misses beyond the gravity sag of the nominal model. Nothing else is assumed.
- `zero_offset`: the turn z of encoder zero against MJCF zero with which gravity at qpos + z explains the errors.

The second is a weak inference and says so: sag is a few hundredths of a radian and changes slowly with posture, a motor
softer than kp sags more in every posture, and a joint with a vertical axis does not sag at all. So z is fitted twice,
with the nominal stiffness and with the stiffness free, and the distance between the answers is part of its standard
error. On the public SO-101 logs the two answers for shoulder_lift differ by 0.46 rad: not identifiable, and reported as
that. Measure zeros with the arm against a square, or hold known payloads in many postures, to do better.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from typing_extensions import TypedDict

from gaponet.base.arrays import Array
from gaponet.base.errors import DatasetError
from gaponet.base.files import write_text
from gaponet.base.structure import Json, read_json
from gaponet.data.holds import Holds, StaticError
from gaponet.data.store import Dataset
from gaponet.robot.spec import RobotSpec

Carried = tuple[float, str]  # payload_mass kg, payload_side
Load = tuple[float, str, tuple[float, ...] | None]  # the same, and kp while recording where it is known
Gravity = Callable[
    [Array, float, str], Array
]  # qpos (k, n) rad, payload_mass, payload_side → holding torque (k, n) N·m

FILE = "offsets.json"
NOISE = 0.01  # scatter of a rest about its band's edge, rad; beyond it residuals count linearly (soft_l1)
PRIOR = 0.5  # encoder zeros are mounted this well, rad; keeps what gravity does not see at 0
STIFFNESS_PRIOR = 0.5  # of ln(kp_real / kp)
SURE = 0.1  # largest standard error at which a zero offset is called identified, rad
MIN_RESTS, MAX_POSES = 20, 250


@dataclass(frozen=True)
class JointOffset:
    """Angles in rad; None where the rests do not say.

    Attributes:
        rests_up, rests_down: Rests approached from below and above.
        static_error: qpos − ctrl at rest, half way between both approaches.
        stiction_band: Half the distance between both approaches, nominal sag taken off; times kp it is a torque.
        nominal_sag: Static error of the nominal model in the same postures.
        tracking_offset: static_error − nominal_sag, from the same rests.
        zero_offset, zero_std: Encoder zero against MJCF zero, and its standard error.
        identifiable: Whether zero_offset means anything; `reason` says why not.
    """

    rests_up: int
    rests_down: int
    static_error: float | None
    stiction_band: float | None
    nominal_sag: float | None
    tracking_offset: float | None
    zero_offset: float | None = None
    zero_std: float | None = None
    identifiable: bool = False
    reason: str = ""


@dataclass(frozen=True)
class UnitOffsets:
    """Offsets of the operated joints by name; stiffness is kp_real / kp of all joints, None without enough rests."""

    joints: dict[str, JointOffset]
    stiffness: float | None

    @classmethod
    def of_unit(
        cls, dataset: Dataset, robot: RobotSpec, unit_id: str, gravity: Gravity, known: dict[str, Holds] | None = None
    ) -> UnitOffsets:
        """Fit those of one unit from all its sequences; those whose rests are known, by hash, are not read again."""
        known = known or {}
        found: dict[Load, list[Holds]] = {}
        for entry in dataset.entries:
            if entry.meta.unit_id == unit_id:
                key = (entry.meta.payload_mass, entry.meta.payload_side, entry.meta.known_gains[0])
                rests = known.get(entry.hash) or Holds.of(dataset.read(entry), robot.operated_index)
                found.setdefault(key, []).append(rests)
        n = len(robot.joint_names)
        return UnitOffsets.of({key: Holds.joined(parts, n) for key, parts in found.items()}, robot, gravity)

    @classmethod
    def of(cls, holds: dict[Load, Holds], robot: RobotSpec, gravity: Gravity) -> UnitOffsets:
        """Fit the offsets of the operated joints.

        Args:
            robot: The robot whose gains carry the load.
        """
        n = len(robot.joint_names)
        every = Holds.joined(list(holds.values()), n)
        sag = np.concatenate(
            [np.zeros((0, n)), *(_nominal_sag(h.qpos, key, robot, gravity) for key, h in holds.items())]
        )
        plain: dict[str, JointOffset] = {}
        zeros: dict[str, dict[str, Any]] = {}
        stiffness = None
        for name, j in zip(robot.operated, robot.operated_index, strict=True):
            error, beyond = every.static_error(j), every.static_error(j, sag[:, j])
            plain[name] = _without_zero(error, beyond)
        rests = {key: _rests(h, robot, max(30, MAX_POSES // len(holds))) for key, h in holds.items()}
        if sum(int(r.used.sum()) for r in rests.values()) >= MIN_RESTS:
            zeros, stiffness = _fit_zeros(rests, robot, gravity)
        few = {"reason": f"fewer than {MIN_RESTS} rests after a motion: let the robot stand still in many postures"}
        joints = {name: JointOffset(**(asdict(plain[name]) | zeros.get(name, few))) for name in robot.operated}
        return UnitOffsets(joints, stiffness)


class _OffsetsFile(TypedDict):
    """offsets.json: unit → what UnitOffsets holds, and the hash of the simulator whose gravity was used."""

    applied: bool
    units: dict[str, dict[str, Json]]


@dataclass(frozen=True)
class _Rests:
    """Fresh rests of the operated joints (m) under one condition: error, approach (k, m); used (k, m) bool."""

    qpos: Array
    error: Array
    approach: Array
    used: Array


def record_offsets(dataset: Dataset, unit_id: str, offsets: UnitOffsets, simulator: str) -> Path:
    """Write offsets.json, keeping what it says of other units. simulator: hash of the model whose gravity was used."""
    file = dataset.path / FILE
    with dataset.writing():
        content = read_offsets(dataset)
        content["units"][unit_id] = asdict(offsets) | {"simulator": simulator}
        write_text(file, json.dumps(content, indent=1, allow_nan=False) + "\n")
    return file


def read_offsets(dataset: Dataset) -> dict[str, Any]:
    """Content of offsets.json: {"applied": false, "units": {unit_id: {joints, stiffness, simulator}}}."""
    file = dataset.path / FILE
    if not file.is_file():
        return {"applied": False, "unit": "rad", "units": {}}
    hint = "delete it, the next import writes it again"
    return {**read_json(_OffsetsFile, file, DatasetError, hint, allow_extra=True)}


def _nominal_sag(qpos: Array, setting: Load, robot: RobotSpec, gravity: Gravity) -> Array:
    """Static error of the nominal model, (k, n) rad; 0 for a joint without gain."""
    kp = robot.with_gains(setting[2], None).kp
    return -gravity(qpos, *setting[:2]) / np.where(kp > 0, kp, np.inf)


def _without_zero(error: StaticError, beyond: StaticError) -> JointOffset:
    number = lambda x: round(float(x), 6) if math.isfinite(x) else None  # noqa: E731
    return JointOffset(
        rests_up=error.up,
        rests_down=error.down,
        static_error=number(error.middle),
        stiction_band=number(beyond.half_band),
        nominal_sag=number(error.middle - beyond.middle),
        tracking_offset=number(beyond.middle),
    )


def _rests(holds: Holds, robot: RobotSpec, most: int) -> _Rests:
    """Evenly thinned to `most` postures: gravity is evaluated some hundred times in each."""
    op = robot.operated_index
    used = holds.fresh[:, op] & (holds.approach[:, op] != 0)
    rows = np.flatnonzero(used.any(axis=1))
    rows = rows[:: max(1, math.ceil(len(rows) / most))]
    error = (holds.qpos - holds.ctrl)[rows][:, op]
    return _Rests(holds.qpos[rows], error, holds.approach[rows][:, op].astype(float), used[rows])


def _fit_zeros(
    rests: dict[Load, _Rests], robot: RobotSpec, gravity: Gravity
) -> tuple[dict[str, dict[str, Any]], float]:
    """Zero offsets by joint as fields of JointOffset, and kp_real / kp."""
    fixed, cov = _least_squares(rests, robot, gravity, free_stiffness=False)
    free, _ = _least_squares(rests, robot, gravity, free_stiffness=True)
    stiffness = math.exp(free[-1])
    fields = {}
    for i, name in enumerate(robot.operated):
        sampling, model = math.sqrt(cov[i, i]), abs(fixed[i] - free[i])
        std = math.hypot(sampling, model)
        reason = ""
        if sampling > 0.7 * PRIOR:
            reason = "gravity hardly loads this joint in these postures"
        elif std > SURE and model > sampling:
            reason = f"motors with {stiffness:.2f} of the nominal kp explain the sag with another zero"
        elif std > SURE:
            reason = "the sag changes too little over these postures"
        fields[name] = {
            "zero_offset": round(float(fixed[i]), 6),
            "zero_std": round(std, 6),
            "identifiable": not reason,
            "reason": reason,
        }
    return fields, round(stiffness, 4)


def _least_squares(
    rests: dict[Load, _Rests], robot: RobotSpec, gravity: Gravity, free_stiffness: bool
) -> tuple[Array, Array]:
    """Parameters [z (m), half_band (m), ln stiffness or 0] and their covariance.

    Model of a rest: error = −gravity(qpos + z) / (stiffness kp) − half_band · approach.
    """
    from scipy.optimize import least_squares

    op, m = robot.operated_index, len(robot.operated)

    def load(z: Array) -> Array:
        """Nominal sag at qpos + z for all used rests, (rests,), rad."""
        turned = np.zeros(len(robot.joint_names))
        turned[op] = z
        sags = {key: _nominal_sag(r.qpos + turned, key, robot, gravity)[:, op] for key, r in rests.items()}
        return np.concatenate([sags[key][r.used] for key, r in rests.items()])

    error = np.concatenate([r.error[r.used] for r in rests.values()])
    side = np.concatenate([(r.approach[:, :, None] * np.eye(m))[r.used] for r in rests.values()])  # (rests, m)
    prior = np.diag([*[1 / PRIOR] * m, *[0.0] * m, 1 / STIFFNESS_PRIOR if free_stiffness else 1e6])

    def residual(p: Array) -> Array:
        return np.concatenate([(error - load(p[:m]) * np.exp(-p[-1]) + side @ p[m:-1]) / NOISE, prior @ p])

    def jacobian(p: Array) -> Array:
        base, step = load(p[:m]), 1e-3
        turns = np.stack([load(p[:m] + step * unit) - base for unit in np.eye(m)], axis=1) / step  # (rests, m)
        data = np.column_stack([-turns * np.exp(-p[-1]), side, base * np.exp(-p[-1])]) / NOISE
        return np.concatenate([data, prior])

    start = np.r_[np.zeros(m), np.full(m, NOISE), 0.0]
    fit = least_squares(residual, start, jacobian, loss="soft_l1", max_nfev=40)
    scatter = max(1.0, 2 * fit.cost / len(error))
    return fit.x, np.linalg.inv(fit.jac.T @ fit.jac + 1e-9 * np.eye(len(start))) * scatter
