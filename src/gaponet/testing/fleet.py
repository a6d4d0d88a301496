"""Fleets: virtual units drawn once from written-down distributions, and kept as data.

A fleet file (fleets/*.toml) holds a seed, one [[distribution]] with its source per hidden parameter that does something
in it, and the drawn units. All units of a type share what the type has (type_spread, from joint to joint) and differ by
what production leaves open (unit_spread for the whole unit, joint_spread for each joint of it). For a robot whose units
are not in the file they are drawn when the fleet is loaded, by the same rule.
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
from gaponet.robot.spec import RobotSpec
from gaponet.testing.physics import Physics, neutral

Array = np.ndarray

FLEETS = Path(__file__).parent / "fleets"
UNITS = 4
DIGITS = 6  # significant, of a saved number
LATEST = 1.0  # s: a link with a longer delay is none; also of the share of commands that it drops
LARGEST = 1e6  # of any other parameter; infinity where that is how an effect is switched off
SIGNED = ("friction_asymmetry", "drag_angle", "grip_x", "grip_z", "cable_angle", "cogging_phase", "tilt_roll",
          "tilt_pitch", "com_x", "com_y", "com_z", "zero_offset", "current_offset")  # fmt: skip
Spread = Annotated[float, Interval(ge=0, le=LARGEST)]
UnitTable = dict[str, Extended | dict[str, dict[str, Extended]]]


@dataclass(frozen=True)
class Distribution:
    """How one parameter is drawn: mean + three normal deviations, clipped to [low, high]."""

    name: str
    mean: Extended
    source: str
    type_spread: Spread = 0.0
    unit_spread: Spread = 0.0
    joint_spread: Spread = 0.0
    low: Extended = -np.inf
    high: Extended = np.inf
    of_effort: bool = False  # in parts of the joint's torque limit


class FleetTable(TypedDict):
    """A fleet file; robot: robot → unit → parameter, or the parameters of each joint."""

    seed: Annotated[int, Interval(ge=0, le=2**63)]
    distribution: Annotated[tuple[Distribution, ...], Len(1, 1000)]
    name: NotRequired[Name]
    virtual: NotRequired[bool]
    robot: NotRequired[dict[str, Annotated[dict[Name, UnitTable], Len(1, 1000)]]]


class Redriven(TypedDict):
    """A fleet file of the same units as another fleet's, driven with other gains."""

    like: Literal["easy", "hard", "shifted", "unnamed"]
    gain_scale: Annotated[float, Interval(gt=0, le=1000)]
    name: NotRequired[Name]
    virtual: NotRequired[bool]


@dataclass(frozen=True)
class Fleet:
    """Virtual units of one robot type, by id; gain_scale: what they are driven with, None for the robot's own."""

    name: str
    robot: str
    seed: int
    distributions: tuple[Distribution, ...]
    units: dict[str, Physics]
    gain_scale: float | None = None

    def unit(self, unit_id: str) -> Physics:
        """One unit's hidden physics."""
        if unit_id not in self.units:
            raise UsageError(f"fleet '{self.name}' has no unit '{unit_id}'; it has {', '.join(self.units)}")
        return self.units[unit_id]

    def digest(self) -> str:
        """Identity of the hidden numbers, 12 hex digits: datasets of different fleets are not mixed."""
        sha = hashlib.sha256()
        for unit_id, unit in self.units.items():
            sha.update(unit_id.encode())
            for f in fields(Physics):
                sha.update(np.ascontiguousarray(getattr(unit, f.name), float).tobytes())
        return sha.hexdigest()[:12]


def load_fleet(name_or_path: str | Path, robot: RobotSpec) -> Fleet:
    """A fleet of the package by name, or a file.

    Raises:
        UsageError: No such fleet, or the file is not one; with the file and what is wrong.
    """
    path, loaded = load_toml("fleet", FLEETS, name_or_path)
    if "like" in loaded:
        file = validated(Redriven, loaded, path, UsageError)
        name = file.get("name", path.stem)
        return replace(load_fleet(FLEETS / f"{file['like']}.toml", robot), name=name, gain_scale=file["gain_scale"])
    table = validated(FleetTable, loaded, path, UsageError)
    seed, laws = table["seed"], known(table["distribution"], path)
    saved = table.get("robot", {}).get(robot.name)
    if saved is None:
        units = {f"virtual-{k}": draw(robot, laws, seed, k) for k in range(1, UNITS + 1)}
        for unit_id, unit in units.items():
            _require_possible(unit, f"{path}: unit '{unit_id}', drawn from the distributions")
    else:
        drawn = {law.name for law in laws}
        units = {unit_id: _physics(unit_id, unit, drawn, robot, path) for unit_id, unit in saved.items()}
    return Fleet(table.get("name", path.stem), robot.name, seed, laws, units)


def known(laws: tuple[Distribution, ...], path: Path) -> tuple[Distribution, ...]:
    """The same; refuses a parameter that does not exist or is there twice. path is for messages."""
    parameters, named = [f.name for f in fields(Physics)], [law.name for law in laws]
    for name in named:
        if name not in parameters or named.count(name) > 1:
            raise UsageError(f"{path}: [[distribution]] names '{name}' twice, or not one of {', '.join(parameters)}")
    return laws


def draw(robot: RobotSpec, laws: tuple[Distribution, ...], seed: int, unit: int) -> Physics:
    """Unit number `unit` (from 1); the type's own deviations come from the seed alone. No distribution, no effect.

    Every parameter has its own stream, so that adding one leaves the others as they were.
    """
    n = len(robot.joint_names)
    scope = {f.name: f.metadata["scope"] for f in fields(Physics)}
    values = {}
    for law in laws:
        stream = int(hashlib.sha256(law.name.encode()).hexdigest()[:8], 16)
        kind, own = np.random.default_rng([seed, stream, 0]), np.random.default_rng([seed, stream, unit])
        size = n if scope[law.name] == "joint" else 1
        deviation = (
            law.type_spread * kind.standard_normal(size)
            + law.unit_spread * own.standard_normal()
            + law.joint_spread * own.standard_normal(size)
        )
        value = np.clip(law.mean + deviation, law.low, law.high)
        if law.of_effort:
            value = value * robot.effort_limit
        values[law.name] = np.array([float(f"{v:.{DIGITS}g}") for v in value])
    return replace(neutral(n), **values)


def _physics(unit_id: str, unit: UnitTable, drawn: set[str], robot: RobotSpec, path: Path) -> Physics:
    joints = unit.get("joint", {})
    values = {}
    for f in (f for f in fields(Physics) if f.name in drawn):
        try:
            if f.metadata["scope"] == "unit":
                values[f.name] = np.array([float(unit[f.name])])  # type: ignore[arg-type]
            else:
                values[f.name] = np.array([joints[name][f.name] for name in robot.joint_names])  # type: ignore[index]
        except (KeyError, TypeError) as error:
            raise UsageError(f"{path}: unit '{unit_id}': {f.name}: {error} is missing; draw the fleet again") from None
    physics = replace(neutral(len(robot.joint_names)), **values)
    _require_possible(physics, f"{path}: unit '{unit_id}'")
    return physics


def _require_possible(unit: Physics, where: str) -> None:
    """Refuse parameters that no robot can have."""
    for f in fields(Physics):
        value = getattr(unit, f.name)
        most = LATEST if f.name in ("delay", "jitter", "drop") else LARGEST
        good = (value <= most) & (value >= (-most if f.name in SIGNED else 0.0))
        if f.name == "corner":
            good &= value < 1.0
        if not (good | ((value == np.inf) & (f.metadata["neutral"] == np.inf))).all():
            raise UsageError(f"{where}: {f.name} is {value.tolist()}; draw the fleet again")


def to_toml(robot: RobotSpec, units: dict[str, Physics], laws: tuple[Distribution, ...]) -> str:
    """The drawn units as the part of a fleet file that follows its distributions."""
    scope = {f.name: f.metadata["scope"] for f in fields(Physics)}
    scopes = {law.name: scope[law.name] for law in laws}
    lines = []
    for unit_id, unit in units.items():
        lines.append(f"\n[robot.{robot.name}.{unit_id}]")
        lines += [f"{name} = {float(getattr(unit, name)[0])!r}" for name, s in scopes.items() if s == "unit"]
        lines.append(f"[robot.{robot.name}.{unit_id}.joint]")
        for i, joint in enumerate(robot.joint_names):
            pairs = [f"{name} = {float(getattr(unit, name)[i])!r}" for name, s in scopes.items() if s == "joint"]
            lines.append(f"{joint} = {{ {', '.join(pairs)} }}")
    return "\n".join(lines) + "\n"
