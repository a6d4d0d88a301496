"""Parameters of a servo: one record each, which files, searches, uncertainty, tables and exports
read.

docs/architecture.md lists the places that a new parameter of the servo model needs ("Where a change
goes"); its record here is the first.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, get_args

import numpy as np

# Terms of the servo model that identification may add, one by one; `ServoField.term` names a
# field's.
Term = Literal[
    "stribeck",
    "load",
    "limit",
    "external",
    "min_torque",
    "encoder",
    "speed",
    "backlash",
    "temperature",
]
DEFAULT_TERMS: tuple[Term, ...] = ("stribeck", "load", "backlash")
Axis = Literal["value", "log", "over kp", "inverse"]

MAX_VALUE = 1e6  # of gains and torques in robot.toml
MAX_ANGLE_RAD = 1e3
MAX_CELSIUS = 400.0
MIN_FRICTION_FACTOR = 0.1  # of a temperature: friction does not vanish


@dataclass(frozen=True)
class ServoField:
    """One parameter of a servo.

    Attributes:
        name: Attribute of ServoParameters, and key of [identified.JOINT] in robot.toml.
        unit: SI unit.
        heading, factor: Heading of a column, which ends in the column's unit, and factor from SI to
            that unit.
        default: Value where robot.toml states none; NaN where the MJCF's value stands, None for a
            required value.
        limits: Least and largest value in robot.toml.
        axis: Axis of searches and of uncertainty.json. A motion shows torques divided by kp,
            whatever kp is; and what a motor loses per rad/s, which is zero without a torque-speed
            line.
        bounds: Lowest value, highest value and a large change on the axis; None where these depend
            on the robot (sysid/axes.py), or where no search has the field.
        guess: Value on the axis from which the search of a term begins; None where it depends on
            the robot.
        prior_std: Prior standard deviation on the axis; None if uncertainty.json does not hold the
            field. Of an axis that is no logarithm at least the value itself.
        large_value: Scale of an error where a value of zero is usual; None: the value itself.
        cause: Step of `gaponet gap` that adds the field.
        term: Term that the field belongs to; None of fields that every fit has.
        in_servo_model: Whether sim/servo.py computes the field, because MuJoCo's position actuator
            lacks it.
        single_joint: Whether only searches of one joint by itself change the field.
        shared: Whether servos of one type have the same value.
        advice: What to check if the fit ends at a bound.
    """

    name: str
    unit: str
    heading: str
    factor: float = 1.0
    default: float | None = 0.0
    limits: tuple[float, float] = (0.0, MAX_VALUE)
    axis: Axis = "value"
    bounds: tuple[float, float, float] | None = None
    guess: float | None = None
    prior_std: float | None = None
    large_value: float | None = None
    cause: str = "gain"
    term: Term | None = None
    in_servo_model: bool = False
    single_joint: bool = False
    shared: bool = True
    advice: str = "the servo model does not fit"

    @property
    def signed(self) -> bool:
        """True if the value may be negative."""
        return self.limits[0] < 0

    @property
    def from_mjcf(self) -> bool:
        """True if NaN stands for the MJCF's value."""
        return self.default is not None and math.isnan(self.default)

    @property
    def shown_unit(self) -> str:
        """Unit of a column of the field."""
        return self.heading.partition(", ")[2]


_angle = partial(ServoField, unit="rad", limits=(-MAX_ANGLE_RAD, MAX_ANGLE_RAD), shared=False)
_load_friction = partial(
    ServoField,
    unit="1",
    factor=1e2,
    limits=(0.0, 1.0),
    bounds=(0.0, 0.8, 0.05),
    prior_std=0.1,
    cause="load",
    in_servo_model=True,
    shared=False,
)

# Searches, tables and MuJoCo's actuator_user have the fields in this order.
SERVO_FIELDS: dict[str, ServoField] = {
    field.name: field
    for field in (
        ServoField(
            "kp",
            "N·m/rad",
            "kp, N·m/rad",
            default=None,
            axis="log",
            prior_std=0.5,
            advice="check its unit (N·m/rad), the stated payload, and torques fed forward",
        ),
        ServoField("kd", "N·m·s/rad", "kd, N·m·s/rad", default=None),
        ServoField(
            "damping",
            "N·m·s/rad",
            "damping, N·m·s/rad",
            default=math.nan,
            axis="over kp",
            bounds=(0.0, 1.0, 0.015),
            prior_std=0.05,
            advice="check kp's unit, and that commands are positions",
        ),
        ServoField(
            "frictionloss",
            "N·m",
            "friction, N·m",
            default=math.nan,
            axis="over kp",
            bounds=(0.0, 0.2, 0.005),
            prior_std=0.02,
            cause="friction",
            advice="check kp's unit, and that nothing held the joint",
        ),
        ServoField(
            "armature",
            "kg·m²",
            "armature, g·m²",
            1e3,
            default=math.nan,
            axis="over kp",
            prior_std=2e-4,
            advice="check the masses in the MJCF and kp's unit",
        ),
        _angle(
            "offset",
            heading="offset, mrad",
            factor=1e3,
            bounds=(-0.2, 0.2, 0.01),
            prior_std=0.03,
            large_value=0.02,
            advice="check the joint's zero and its sign",
        ),
        ServoField(
            "delay",
            "s",
            "delay, ms",
            1e3,
            limits=(0.0, 1.0),
            bounds=(0.0, 0.15, 0.005),
            prior_std=0.02,
            large_value=0.02,
            shared=False,
            advice="check that commands and states have one clock",
        ),
        ServoField("target_speed", "rad/s", "target speed, rad/s"),
        ServoField(
            "effort_limit",
            "N·m",
            "torque limit, N·m",
            default=None,
            axis="over kp",
            term="limit",
            single_joint=True,
            advice="check effort_limit in robot.toml",
        ),
        ServoField(
            "stribeck",
            "N·m",
            "Stribeck friction, N·m",
            axis="over kp",
            bounds=(0.0, 0.1, 0.002),
            guess=0.003,
            prior_std=0.01,
            cause="stribeck",
            term="stribeck",
            in_servo_model=True,
        ),
        ServoField(
            "stribeck_speed",
            "rad/s",
            "Stribeck speed, mrad/s",
            1e3,
            axis="log",
            bounds=(math.log(0.005), 0.0, 0.3),
            guess=math.log(0.05),
            prior_std=1.0,
            cause="stribeck",
            term="stribeck",
            in_servo_model=True,
        ),
        _load_friction("friction_motor", heading="friction, % of motor", guess=0.05, term="load"),
        _load_friction(
            "friction_external", heading="friction, % of load", guess=0.02, term="external"
        ),
        ServoField(
            "min_torque",
            "N·m",
            "minimum torque, N·m",
            axis="over kp",
            bounds=(0.0, 0.05, 0.002),
            guess=0.003,
            prior_std=0.003,
            cause="servo",
            term="min_torque",
            in_servo_model=True,
        ),
        ServoField(
            "encoder_step",
            "rad",
            "encoder, mrad",
            1e3,
            limits=(0.0, 1.0),
            cause="servo",
            term="encoder",
            in_servo_model=True,
            single_joint=True,
            shared=False,
        ),
        ServoField(
            "no_load_speed",
            "rad/s",
            "no-load speed, rad/s",
            axis="inverse",
            prior_std=0.02,
            cause="motor",
            term="speed",
            in_servo_model=True,
            advice="check effort_limit in robot.toml",
        ),
        ServoField(
            "backlash",
            "rad",
            "backlash, mrad",
            1e3,
            limits=(0.0, 1.0),
            bounds=(0.0, 0.1, 0.003),
            guess=0.004,
            prior_std=0.01,
            large_value=0.01,
            cause="servo",
            term="backlash",
            in_servo_model=True,
            shared=False,
            advice="check for a loose horn or a slipping gear",
        ),
        ServoField(
            "friction_per_kelvin",
            "1/K",
            "friction, %/K",
            1e2,
            limits=(-1.0, 1.0),
            bounds=(-0.04, 0.04, 0.01),
            guess=-0.005,
            cause="temperature",
            term="temperature",
            shared=False,
            advice="check the unit of the temperatures, °C",
        ),
        ServoField(
            "damping_per_kelvin",
            "N·m·s/(rad·K)",
            "damping, mN·m·s/rad/K",
            1e3,
            limits=(-MAX_VALUE, MAX_VALUE),
            axis="over kp",
            bounds=(-5e-3, 5e-3, 3e-4),
            guess=-1e-4,
            cause="temperature",
            term="temperature",
            shared=False,
        ),
        ServoField(
            "friction_temperature",
            "°C",
            "friction at, °C",
            limits=(-MAX_CELSIUS, MAX_CELSIUS),
            cause="temperature",
            term="temperature",
            shared=False,
        ),
        _angle("zero", heading="zero, mrad", factor=1e3, cause="contact"),
        _angle("stop_low", heading="low stop, rad", default=math.nan, cause="contact"),
        _angle("stop_high", heading="high stop, rad", default=math.nan, cause="contact"),
    )
}
PASSIVE_FIELDS = ("armature", "damping", "frictionloss")  # that a joint has without a motor
SERVO_TERMS = tuple(f.name for f in SERVO_FIELDS.values() if f.in_servo_model)
STOP_FIELDS = ("stop_low", "stop_high")


def _fields_of(term: Term) -> tuple[str, ...]:
    return tuple(field.name for field in SERVO_FIELDS.values() if field.term == term)


TERMS: dict[Term, tuple[str, ...]] = {term: _fields_of(term) for term in get_args(Term)}


def warmed(
    warming: Any, damping: Any, frictionloss: Any, per_kelvin: Any, damping_per_kelvin: Any
) -> tuple[Any, Any]:
    """Return damping and friction `warming` K above the temperature of the given ones; arrays that
    broadcast.
    """
    factor = np.maximum(1.0 + per_kelvin * warming, MIN_FRICTION_FACTOR)
    return damping + damping_per_kelvin * warming, frictionloss * factor
