"""Fields of robot.toml with their ranges."""

from __future__ import annotations

from dataclasses import dataclass, field, make_dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

from annotated_types import Interval, Len

from gaponet.base.errors import RobotError
from gaponet.base.structure import Angle, Count, Name
from gaponet.robot.servo_fields import PASSIVE_FIELDS, SERVO_FIELDS

Gain = Annotated[float, Interval(ge=0, le=1e6)]
Metres = Annotated[float, Interval(ge=-10, le=10)]  # more are millimetres


@dataclass(frozen=True)
class _Joint:
    name: Name
    kp: Gain  # N·m/rad
    effort_limit: Gain  # N·m
    kd: Gain = 0.0  # N·m·s/rad
    home: Angle = 0.0  # rad
    operated: bool = True
    log_unit: Literal["rad", "deg", "fraction"] = "rad"
    servo: str = ""  # name of a servo type
    # Joint that moves this one by a linkage or gear: a mimic joint, without a motor.
    follows: str = ""
    ratio: Annotated[float, Interval(ge=-100, le=100)] = 1.0  # its angle per rad of that joint
    at_zero: Angle = 0.0  # its angle where that joint is at 0, rad
    aliases: tuple[str, ...] = ()


@dataclass(frozen=True)
class Spread:
    """Value of a servo type: the median of its joints, and the 5 and 95 % of their estimates and
    standard errors.
    """

    value: float
    low: float
    high: float

    def __post_init__(self) -> None:
        if not self.low <= self.value <= self.high:
            raise RobotError(
                f"value {self.value:g} must lie from low {self.low:g} to high {self.high:g}"
            )


@dataclass(frozen=True)
class ServoType:
    """[[servo]]: servo type that joints refer to; in servos.toml, or in a robot.toml, whose types
    come first.
    """

    name: Name
    variant: str = ""  # gear, supply, place
    source: str = ""  # data set of the measured values
    licence: str = ""  # of the data set
    gaponet: str = ""  # version or commit that identified the values
    robots: Count = 0  # that the values are of
    joints: Count = 0
    gain: Gain | None = None  # N·m/rad for a firmware kp of 1
    # V, of its supply; gain is in proportion
    gain_volts: Annotated[float, Interval(ge=0.1, le=1000)] | None = None
    effort_limit: Gain | None = None  # N·m
    speed_limit: Gain | None = None  # rad/s
    limit_source: str = ""
    # N·m·s/rad beside the stated kd; below 0 the servo acts with less kd
    damping: Spread | Gain | None = None
    frictionloss: Spread | Gain | None = None  # N·m
    armature: Spread | Gain | None = None  # kg·m²
    stribeck: Spread | Gain | None = None  # N·m
    stribeck_speed: Spread | Gain | None = None  # rad/s
    friction_motor: Spread | Gain | None = None  # N·m per N·m of the motor

    @property
    def measured(self) -> dict[str, Spread]:
        """Measured values by field; one without an interval is its own."""
        found = {}
        for name in MEASURED_FIELDS:
            value = getattr(self, name)
            if isinstance(value, Spread):
                found[name] = value
            elif value is not None:
                found[name] = Spread(value, value, value)
        return found

    def text(self, field: str) -> str:
        """Return a value in the unit of the field's heading, with its interval or supply; "" if
        there is none.
        """
        value = getattr(self, field)
        factor = SERVO_FIELDS[field].factor if field in MEASURED_FIELDS else 1.0
        if value is None:
            return ""
        if isinstance(value, Spread):
            middle = _two_digits(factor * value.value)
            low = _two_digits(factor * value.low)
            high = _two_digits(factor * value.high)
            return f"{middle} ({low}…{high})"
        supply = f" at {self.gain_volts:g} V" if field == "gain" and self.gain_volts else ""
        return f"{factor * value:.3g}{supply}"

    def measured_text(self, field: str) -> str:
        """Return `text` of a measured field; "" for others."""
        return self.text(field) if field in MEASURED_FIELDS else ""


def _two_digits(value: float) -> str:
    return f"{float(f'{value:.2g}'):g}"


MEASURED_FIELDS = (*PASSIVE_FIELDS, "stribeck", "stribeck_speed", "friction_motor")


@dataclass(frozen=True)
class ServoTable:
    """servos.toml; `version` rises when a value changes."""

    version: Count
    servo: tuple[ServoType, ...]


@dataclass(frozen=True)
class PayloadMount:
    """[[payload_mount]]: a payload's centre is at `pos` (m) in the frame of MJCF body `body`.

    `mass` (kg) is always there, such as a hand that the MJCF lacks.
    """

    side: Name
    body: str
    pos: tuple[Metres, Metres, Metres]
    mass: Annotated[float, Interval(ge=0, le=100)] = 0.0


@dataclass(frozen=True)
class _Mount:
    """[identified_mount.SIDE]."""

    pos: tuple[Metres, Metres, Metres]
    mass: Annotated[float, Interval(ge=0, le=100)]


@dataclass(frozen=True)
class Link:
    """[identified_link.BODY]: mass (kg), centre (m), inertia about it (xx, yy, zz, xy, xz, yz,
    kg·m²), body's frame.
    """

    mass: Annotated[float, Interval(ge=0, le=1e4)]
    pos: tuple[Metres, Metres, Metres]
    inertia: Annotated[tuple[float, ...], Len(6, 6)]


if TYPE_CHECKING:
    IdentifiedServo = Any
else:  # [identified.JOINT]: values that replace those of the MJCF and the nominal gains
    IdentifiedServo = make_dataclass(
        "IdentifiedServo",
        [
            (f.name, Annotated[float, Interval(ge=f.limits[0], le=f.limits[1])] | None, None)
            for f in SERVO_FIELDS.values()
        ],
        frozen=True,
    )


@dataclass(frozen=True)
class Tip:
    """[[tip]]: sphere of `radius` (m) that can touch the table, at `pos` (m) in the frame of MJCF
    body `body`.
    """

    body: str
    pos: tuple[Metres, Metres, Metres]
    radius: Annotated[float, Interval(ge=1e-4, le=1)] = 1e-3


@dataclass(frozen=True)
class Table:
    """[table]: level plane at `height` (m, MJCF world), with friction coefficient and stiffness
    under a tip (N/m).
    """

    height: Metres
    friction: Annotated[float, Interval(ge=0, le=10)] = 0.3
    stiffness: Annotated[float, Interval(ge=1, le=1e7)] = 2000.0


@dataclass(frozen=True)
class RobotTable:
    """Content of robot.toml."""

    name: Name
    dt: Annotated[float, Interval(ge=1e-4, le=1)]  # s
    timestep: Annotated[float, Interval(ge=1e-6, le=1)]  # s
    joint: Annotated[tuple[_Joint, ...], Len(1, 500)]
    servo: Annotated[tuple[ServoType, ...], Len(0, 50)] = ()
    payload_mount: Annotated[tuple[PayloadMount, ...], Len(0, 20)] = ()
    tip: Annotated[tuple[Tip, ...], Len(0, 20)] = ()
    table: Table | None = None
    contacts: bool = False  # links collide as the MJCF states; else only tips and table collide
    carries_payload: bool = True  # false: the simulator omits the payload
    # Factor on kp and kd of operated joints in [[joint]].
    gain_scale: Annotated[float, Interval(gt=0, le=1000)] = 1.0
    identified: dict[str, IdentifiedServo] = field(default_factory=dict)
    identified_table: Table | None = None
    identified_mount: dict[str, _Mount] = field(default_factory=dict)
    identified_link: dict[str, Link] = field(default_factory=dict)
    description: str = ""
    license: str = ""
    mjcf: str = "robot.xml"


@dataclass(frozen=True)
class RobotOptions:
    """What a user states of a robot.toml that is made from a vendor's model (robot/new.py)."""

    joints: tuple[str, ...] = ()
    """Recorded joints, by name or pattern ('*_elbow_*'); all others are frozen. Default: all hinges
    with an actuator, or all hinges."""
    kp: tuple[str, ...] = ()
    """Stiffness of the controller that recorded the logs, N·m/rad: 100 for all joints,
    '*wrist*=20' for some. A later value replaces an earlier one. Default: the model's actuators."""
    kd: tuple[str, ...] = ()
    """Damping gain of that controller, N·m·s/rad: NUMBER or PATTERN=NUMBER. Default: the model's
    actuators."""
    effort_limit: tuple[str, ...] = ()
    """Largest torque of the motors, N·m: NUMBER or PATTERN=NUMBER. Default: the model's
    actuators."""
    servo: tuple[str, ...] = ()
    """Type of the servos, TYPE or PATTERN=TYPE; gaponet robot servos lists the types. Damping,
    friction, armature and torque limit of the type replace the model's."""
    packages: tuple[str, ...] = ()
    """NAME=FOLDER: where package://NAME of a URDF is. Default: searched around the file."""
    rate: float = 50.0
    """Commands per second, Hz."""
    keyframe: str = ""
    """Keyframe that gives the home position and the angles of frozen joints. Default: the first, or
    zero."""
    contacts: bool = False
    """Keep the contacts between links that the model has."""
    name: str = ""
    """Name of the robot. Default: the file's name."""
