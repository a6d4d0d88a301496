"""Fleets: virtual units sampled once from documented distributions, and stored.

A fleet file (fleets/*.toml) holds a seed, one [[distribution]] with its source per hidden parameter, and the sampled
units. All units of a type share the deviations of the type (type_spread, per joint). They differ by production
tolerances (unit_spread for the whole unit, joint_spread per joint). For a robot without units in the file they are
sampled when the fleet is loaded, by the same rule.

python -m gaponet.testing.fleet FLEET ROBOT     # samples the units again and writes them into the fleet's file

Do that once after a distribution or the seed was changed; earlier results then belong to another fleet.
"""

from __future__ import annotations

import hashlib
import sys
import tomllib
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Literal, NotRequired

import numpy as np
from annotated_types import Interval, Len
from typing_extensions import TypedDict

from gaponet.base.errors import UsageError
from gaponet.base.files import write_text
from gaponet.base.structure import Extended, Name, load_toml, validated
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.testing.physics import Physics, neutral

Array = np.ndarray

FLEETS = Path(__file__).parent / "fleets"
UNITS = 4
UNITS_MARKER = "\n# ---- drawn units ----\n"  # line of a fleet file before its units
SIGNIFICANT_DIGITS = 6  # of a stored number
MAX_DELAY_S = 1.0  # also the limit of the share of lost commands
MAX_PARAMETER = 1e6  # of any other parameter, unless infinity means "no effect"
SIGNED = ("friction_asymmetry", "drag_angle", "grip_x", "grip_z", "cable_angle", "cogging_phase", "tilt_roll",
          "tilt_pitch", "com_x", "com_y", "com_z", "zero_offset", "current_offset")  # fmt: skip
Spread = Annotated[float, Interval(ge=0, le=MAX_PARAMETER)]
UnitTable = dict[str, Extended | dict[str, dict[str, Extended]]]


@dataclass(frozen=True)
class Distribution:
    """Distribution of one parameter: mean + three normal deviations, clipped to [low, high].

    Attributes:
        of_effort: The parameter is a factor of the joint's torque limit.
    """

    name: str
    mean: Extended
    source: str
    type_spread: Spread = 0.0
    unit_spread: Spread = 0.0
    joint_spread: Spread = 0.0
    low: Extended = -np.inf
    high: Extended = np.inf
    of_effort: bool = False


class FleetTable(TypedDict):
    """Content of a fleet file.

    Attributes:
        robot: Robot → unit → parameter of the unit, or joint → parameters of the joint.
    """

    seed: Annotated[int, Interval(ge=0, le=2**63)]
    distribution: Annotated[tuple[Distribution, ...], Len(1, 1000)]
    name: NotRequired[Name]
    virtual: NotRequired[bool]
    robot: NotRequired[dict[str, Annotated[dict[Name, UnitTable], Len(1, 1000)]]]


class RescaledFleetTable(TypedDict):
    """Content of a fleet file with the units of another fleet (`like`) and other gains."""

    like: Literal["easy", "hard", "shifted", "unnamed"]
    gain_scale: Annotated[float, Interval(gt=0, le=1000)]
    name: NotRequired[Name]
    virtual: NotRequired[bool]


@dataclass(frozen=True)
class Fleet:
    """Virtual units of one robot type.

    Attributes:
        units: Hidden physics by unit id.
        gain_scale: Gain scale of the robot (RobotSpec.gain_scale); None for the robot's own.
    """

    name: str
    robot: str
    seed: int
    distributions: tuple[Distribution, ...]
    units: dict[str, Physics]
    gain_scale: float | None = None

    def unit(self, unit_id: str) -> Physics:
        """Return the hidden physics of a unit."""
        if unit_id not in self.units:
            raise UsageError(f"fleet '{self.name}' has no unit '{unit_id}'; it has {', '.join(self.units)}")
        return self.units[unit_id]

    def digest(self) -> str:
        """Return a hash of the hidden numbers, 12 hex digits, so that datasets of different fleets are not mixed."""
        sha = hashlib.sha256()
        for unit_id, unit in self.units.items():
            sha.update(unit_id.encode())
            for f in fields(Physics):
                sha.update(np.ascontiguousarray(getattr(unit, f.name), float).tobytes())
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
        return replace(load_fleet(FLEETS / f"{file['like']}.toml", robot), name=name, gain_scale=file["gain_scale"])
    table = validated(FleetTable, loaded, path, UsageError)
    seed, distributions = table["seed"], _require_parameters(table["distribution"], path)
    saved = table.get("robot", {}).get(robot.name)
    if saved is None:
        units = sample_fleet(robot, distributions, seed)
        for unit_id, unit in units.items():
            _require_possible(unit, f"{path}: unit '{unit_id}', sampled from the distributions")
    else:
        names = {d.name for d in distributions}
        units = {unit_id: _physics(unit_id, unit, names, robot, path) for unit_id, unit in saved.items()}
    return Fleet(table.get("name", path.stem), robot.name, seed, distributions, units)


def _require_parameters(distributions: tuple[Distribution, ...], path: Path) -> tuple[Distribution, ...]:
    """Return the distributions; refuse a parameter that does not exist or appears twice in the file `path`."""
    parameters, names = [f.name for f in fields(Physics)], [d.name for d in distributions]
    for name in names:
        if name not in parameters or names.count(name) > 1:
            raise UsageError(f"{path}: [[distribution]] names '{name}' twice, or not one of {', '.join(parameters)}")
    return distributions


def sample_fleet(robot: RobotSpec, distributions: tuple[Distribution, ...], seed: int) -> dict[str, Physics]:
    """Sample the units of a fleet, by id."""
    return {f"virtual-{k}": sample_unit(robot, distributions, seed, k) for k in range(1, UNITS + 1)}


def sample_unit(robot: RobotSpec, distributions: tuple[Distribution, ...], seed: int, unit: int) -> Physics:
    """Sample unit number `unit`, from 1; the deviations of the type depend on the seed only.

    A parameter without a distribution has no effect. Every parameter has its own random stream, so that another
    parameter does not change it.
    """
    n = len(robot.joint_names)
    scope = {f.name: f.metadata["scope"] for f in fields(Physics)}
    values = {}
    for d in distributions:
        stream = int(hashlib.sha256(d.name.encode()).hexdigest()[:8], 16)
        kind, own = np.random.default_rng([seed, stream, 0]), np.random.default_rng([seed, stream, unit])
        size = n if scope[d.name] == "joint" else 1
        deviation = (
            d.type_spread * kind.standard_normal(size)
            + d.unit_spread * own.standard_normal()
            + d.joint_spread * own.standard_normal(size)
        )
        value = np.clip(d.mean + deviation, d.low, d.high)
        if d.of_effort:
            value = value * robot.effort_limit
        values[d.name] = np.array([float(f"{v:.{SIGNIFICANT_DIGITS}g}") for v in value])
    return replace(neutral(n), **values)


def _physics(unit_id: str, unit: UnitTable, names: set[str], robot: RobotSpec, path: Path) -> Physics:
    """Return a stored unit with the parameters `names`."""
    joints = unit.get("joint", {})
    values = {}
    for f in (f for f in fields(Physics) if f.name in names):
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
        limit = MAX_DELAY_S if f.name in ("delay", "jitter", "drop") else MAX_PARAMETER
        good = (value <= limit) & (value >= (-limit if f.name in SIGNED else 0.0))
        if f.name == "corner":
            good &= value < 1.0
        if not (good | ((value == np.inf) & (f.metadata["neutral"] == np.inf))).all():
            raise UsageError(f"{where}: {f.name} is {value.tolist()}; draw the fleet again")


def to_toml(robot: RobotSpec, units: dict[str, Physics], distributions: tuple[Distribution, ...]) -> str:
    """Return sampled units as the part of a fleet file after its distributions."""
    scope = {f.name: f.metadata["scope"] for f in fields(Physics)}
    scopes = {d.name: scope[d.name] for d in distributions}
    lines = []
    for unit_id, unit in units.items():
        lines.append(f"\n[robot.{robot.name}.{unit_id}]")
        lines += [f"{name} = {float(getattr(unit, name)[0])!r}" for name, s in scopes.items() if s == "unit"]
        lines.append(f"[robot.{robot.name}.{unit_id}.joint]")
        for i, joint in enumerate(robot.joint_names):
            pairs = [f"{name} = {float(getattr(unit, name)[i])!r}" for name, s in scopes.items() if s == "joint"]
            lines.append(f"{joint} = {{ {', '.join(pairs)} }}")
    return "\n".join(lines) + "\n"


def main(fleet: str, robot_name: str) -> None:
    """Sample the units of a fleet of the package again; everything above UNITS_MARKER in its file stays."""
    path = FLEETS / f"{fleet}.toml"
    head = path.read_text(encoding="utf-8").split(UNITS_MARKER)[0]
    table = validated(FleetTable, tomllib.loads(head), path, UsageError)
    distributions, robot = _require_parameters(table["distribution"], path), load_robot(robot_name)
    units = sample_fleet(robot, distributions, table["seed"])
    write_text(path, head + UNITS_MARKER + to_toml(robot, units, distributions))


if __name__ == "__main__":
    main(*sys.argv[1:])
