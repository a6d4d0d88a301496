"""Fleets: virtual units sampled from documented distributions.

A fleet file (fleets/*.toml) holds a seed and one [[distribution]] with its source per hidden
parameter. All units of a type share the deviations of the type (type_spread, per joint). They
differ by production tolerances (unit_spread for the whole unit, joint_spread per joint). Another
distribution or seed makes another fleet.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Literal, NotRequired

import numpy as np
from annotated_types import Interval, Len
from typing_extensions import TypedDict

from gaponet.base.errors import UsageError
from gaponet.base.structure import Extended, Name, load_toml, validated
from gaponet.robot.servo_parameters import NO_LIMIT
from gaponet.robot.spec import RobotSpec
from gaponet.virtual.physics import Physics, neutral

FLEETS = Path(__file__).parent / "fleets"
UNITS = 4
SIGNIFICANT_DIGITS = 6  # of a sampled number, so that it does not depend on the machine
MAX_DELAY_S = 1.0  # also the limit of the share of lost commands
MAX_PARAMETER = 1e6  # of any other parameter, unless infinity means "no effect"
SIGNED = (
    "friction_asymmetry",
    "drag_angle",
    "grip_x",
    "grip_z",
    "cable_angle",
    "cogging_phase",
    "tilt_roll",
    "tilt_pitch",
    "com_x",
    "com_y",
    "com_z",
    "zero_offset",
    "current_offset",
)
Spread = Annotated[float, Interval(ge=0, le=MAX_PARAMETER)]


@dataclass(frozen=True)
class Distribution:
    """Distribution of one parameter: mean + three normal deviations, clipped to [low, high]."""

    name: str
    mean: Extended
    source: str
    type_spread: Spread = 0.0
    unit_spread: Spread = 0.0
    joint_spread: Spread = 0.0
    low: Extended = -np.inf
    high: Extended = np.inf
    of_effort: bool = False  # the parameter is a factor of the joint's torque limit


class FleetTable(TypedDict):
    """Content of a fleet file."""

    seed: Annotated[int, Interval(ge=0, le=2**63)]
    distribution: Annotated[tuple[Distribution, ...], Len(1, 1000)]
    name: NotRequired[Name]
    virtual: NotRequired[bool]


class RescaledFleetTable(TypedDict):
    """Content of a fleet file with the units of another fleet (`like`) and other gains."""

    like: Literal["easy", "hard", "shifted", "unnamed"]
    gain_scale: Annotated[float, Interval(gt=0, le=1000)]
    name: NotRequired[Name]
    virtual: NotRequired[bool]


@dataclass(frozen=True)
class Fleet:
    """Virtual units of one robot type."""

    name: str
    seed: int
    distributions: tuple[Distribution, ...]
    units: dict[str, Physics]  # hidden physics by unit id
    # gain scale of the robot (ServoParameters.gain_scale); None for the robot's own
    gain_scale: float | None = None

    def unit(self, unit_id: str) -> Physics:
        """Return the hidden physics of a unit."""
        if unit_id not in self.units:
            raise UsageError(
                f"fleet '{self.name}' has no unit '{unit_id}'; it has {', '.join(self.units)}"
            )
        return self.units[unit_id]

    def digest(self) -> str:
        """Return a hash of the hidden numbers, 12 hex digits, so that datasets of different fleets
        are not mixed.
        """
        sha = hashlib.sha256()
        for unit_id, unit in self.units.items():
            sha.update(unit_id.encode())
            for parameter in fields(Physics):
                sha.update(np.ascontiguousarray(getattr(unit, parameter.name), float).tobytes())
        return sha.hexdigest()[:12]


def load_fleet(name_or_path: str | Path, robot: RobotSpec) -> Fleet:
    """Load a fleet of the package by name, or a file.

    Raises:
        UsageError: There is no such fleet, or the file is not valid.
    """
    path, loaded = load_toml("fleet", FLEETS, name_or_path)
    if "like" in loaded:
        file = validated(RescaledFleetTable, loaded, path, UsageError)
        name = file.get("name", path.stem)
        return replace(
            load_fleet(FLEETS / f"{file['like']}.toml", robot),
            name=name,
            gain_scale=file["gain_scale"],
        )
    table = validated(FleetTable, loaded, path, UsageError)
    seed = table["seed"]
    distributions = table["distribution"]
    _require_parameters([distribution.name for distribution in distributions], path)
    units = {}
    for number in range(1, UNITS + 1):
        unit_id = f"virtual-{number}"
        units[unit_id] = sample_unit(robot, distributions, seed, number)
        _require_possible(units[unit_id], f"{path}: unit '{unit_id}'")
    return Fleet(table.get("name", path.stem), seed, distributions, units)


def _require_parameters(names: list[str], path: Path) -> None:
    """Refuse distributions of unknown parameters, or two of one."""
    parameters = [parameter.name for parameter in fields(Physics)]
    for name in names:
        if name not in parameters or names.count(name) > 1:
            raise UsageError(
                f"{path}: [[distribution]] names '{name}' twice, or not one of "
                f"{', '.join(parameters)}"
            )


def sample_unit(
    robot: RobotSpec, distributions: tuple[Distribution, ...], seed: int, unit: int
) -> Physics:
    """Sample unit number `unit`, from 1; the deviations of the type depend on the seed only.

    A parameter without a distribution has no effect. Every parameter has its own random stream, so
    that another parameter does not change it.
    """
    n = len(robot.joint_names)
    scope = {f.name: f.metadata["scope"] for f in fields(Physics)}
    values = {}
    for d in distributions:
        stream = int(hashlib.sha256(d.name.encode()).hexdigest()[:8], 16)
        of_type = np.random.default_rng([seed, stream, 0])
        of_unit = np.random.default_rng([seed, stream, unit])
        size = n if scope[d.name] == "joint" else 1
        deviation = (
            d.type_spread * of_type.standard_normal(size)
            + d.unit_spread * of_unit.standard_normal()
            + d.joint_spread * of_unit.standard_normal(size)
        )
        value = np.clip(d.mean + deviation, d.low, d.high)
        if d.of_effort:
            _require_effort_limits(robot, d.name)
            value = value * robot.servo.effort_limit
        values[d.name] = np.array([float(f"{v:.{SIGNIFICANT_DIGITS}g}") for v in value])
    return replace(neutral(n), **values)


def _require_effort_limits(robot: RobotSpec, name: str) -> None:
    """Refuse a robot with an operated joint whose torque limit, the scale of a parameter, is not
    known.
    """
    limits = robot.servo.effort_limit[robot.operated_index]
    for joint, limit in zip(robot.operated, limits, strict=True):
        if limit >= NO_LIMIT:
            raise UsageError(
                f"{robot.name}: the torque limit of {joint} is not known, and a VIRTUAL unit's "
                f"{name} is a share of it: write effort_limit in robot.toml"
            )


def _require_possible(unit: Physics, where: str) -> None:
    """Refuse parameters that no robot can have."""
    for parameter in fields(Physics):
        value = getattr(unit, parameter.name)
        highest = MAX_DELAY_S if parameter.name in ("delay", "jitter", "drop") else MAX_PARAMETER
        lowest = -highest if parameter.name in SIGNED else 0.0
        possible = (lowest <= value) & (value <= highest)
        if parameter.name == "corner":
            possible &= value < 1.0
        if parameter.metadata["neutral"] == np.inf:
            possible |= value == np.inf
        if not possible.all():
            raise UsageError(
                f"{where}: {parameter.name} is {value.tolist()}; correct its [[distribution]]"
            )
