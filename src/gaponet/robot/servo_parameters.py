"""Parameters of a robot's servos: what [[joint]] and [identified.JOINT] of robot.toml state, and
what identification changes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import RobotError
from gaponet.robot.servo_fields import SERVO_FIELDS, SERVO_TERMS, warmed
from gaponet.robot.toml_file import ServoType

# Of a robot whose model states no torque limit, N·m.
NO_LIMIT = 1e6


def _zero() -> Array:
    """Return the default of a field that has no effect unless it is stated."""
    return np.array(0.0)


def _from_mjcf() -> Array:
    """Return the default of a field that replaces a value of the MJCF."""
    return np.array(np.nan)


def ratio_to(values: Array, base: Array) -> Array:
    """Return values over base, 1 where base is 0; shapes broadcast."""
    values, base = np.broadcast_arrays(values, base)
    ratio: Array = np.divide(values, base, out=np.ones(base.shape), where=base > 0)
    return ratio


@dataclass(frozen=True)
class ServoParameters:
    """Parameters of the servos of n joints, in the order of RobotSpec.joint_names.

    All fields of SERVO_FIELDS are read-only arrays, (n). One number stands for all joints, but for
    kp, kd and effort_limit. `servo["kp"]` is `servo.kp`.

    Attributes:
        kp, kd: PD gains, N·m/rad and N·m·s/rad.
        effort_limit: Torque limit, N·m; NO_LIMIT where none is known.
        damping, armature, frictionloss: Identified values that replace the MJCF's, N·m·s/rad,
            kg·m², N·m; NaN keeps the MJCF's value.
        stop_low, stop_high: Joint stops that narrow the MJCF's range, rad; NaN keeps the MJCF's
            limit.
        delay: Time from command to servo, s.
        offset: Offset of the servo's zero, rad: its goal is command + offset.
        zero: Offset of the encoder, rad: the MJCF's angle is reading + zero.
        target_speed: Speed of the servo's own trajectory generator, rad/s; 0 without one.
        stribeck, stribeck_speed: Friction at rest beyond frictionloss, N·m, and the speed at which
            it has decreased to 1/e, rad/s.
        friction_motor, friction_external: Friction per N·m of the motor's torque and of gravity's.
        min_torque: Smallest torque that turns the motor, N·m.
        encoder_step: Resolution of the servo's angle, rad; 0 if it has no effect.
        no_load_speed: Speed at which the motor has no torque left, rad/s at the nominal supply; 0
            without effect.
        backlash: Width of the gap between motor and link, rad.
        friction_per_kelvin, damping_per_kelvin: Relative change of frictionloss, 1/K, and change of
            damping, N·m·s/(rad·K); 0 without effect.
        friction_temperature: Temperature at which frictionloss and damping hold, °C.
        types: Servo type of each joint, (n), of robot.toml or servos.toml; None where robot.toml
            names none.
        gain_scale: Factor on kp and kd of operated joints in [[joint]]; kp and kd include it.
    """

    kp: Array
    kd: Array
    effort_limit: Array
    damping: Array = field(default_factory=_from_mjcf)
    armature: Array = field(default_factory=_from_mjcf)
    frictionloss: Array = field(default_factory=_from_mjcf)
    stop_low: Array = field(default_factory=_from_mjcf)
    stop_high: Array = field(default_factory=_from_mjcf)
    delay: Array = field(default_factory=_zero)
    offset: Array = field(default_factory=_zero)
    zero: Array = field(default_factory=_zero)
    target_speed: Array = field(default_factory=_zero)
    stribeck: Array = field(default_factory=_zero)
    stribeck_speed: Array = field(default_factory=_zero)
    friction_motor: Array = field(default_factory=_zero)
    friction_external: Array = field(default_factory=_zero)
    min_torque: Array = field(default_factory=_zero)
    encoder_step: Array = field(default_factory=_zero)
    no_load_speed: Array = field(default_factory=_zero)
    backlash: Array = field(default_factory=_zero)
    friction_per_kelvin: Array = field(default_factory=_zero)
    damping_per_kelvin: Array = field(default_factory=_zero)
    friction_temperature: Array = field(default_factory=_zero)
    types: tuple[ServoType | None, ...] = ()
    gain_scale: float = 1.0

    def __post_init__(self) -> None:
        n = np.size(self.kp)
        for name in SERVO_FIELDS:
            object.__setattr__(self, name, self._checked(name, n))
        object.__setattr__(self, "types", self.types or (None,) * n)

    def _checked(self, name: str, n: int) -> Array:
        """Return a field as a read-only array with a value for each joint, (n).

        Raises:
            RobotError: It has another shape, a value is infinite, or NaN or negative where it must
                not be.
        """
        record = SERVO_FIELDS[name]
        given = np.asarray(self[name], float)
        one_for_all = given.shape == () and record.default is not None
        if given.shape != (n,) and not one_for_all:
            raise RobotError(f"{name} must be {n} finite numbers, got shape {given.shape}")
        value = np.array(np.broadcast_to(given, n))
        is_lacking = np.isnan(value).any() and not record.from_mjcf
        if np.isinf(value).any() or is_lacking:
            raise RobotError(f"{name} must be {n} finite numbers, got {value}")
        if not record.signed and (value < 0).any():
            raise RobotError(f"{name} must not be negative, got {value}")
        value.flags.writeable = False
        return value

    def __getitem__(self, name: str) -> Array:
        """Return a field of SERVO_FIELDS, (n)."""
        value: Array = getattr(self, name)
        return value

    @property
    def has_terms(self) -> bool:
        """True if a servo has terms beyond MuJoCo's position actuator (sim/servo.py)."""
        return self.has(SERVO_TERMS)

    def has(self, names: Iterable[str]) -> bool:
        """Return True if one of these fields is not zero at a joint."""
        return any(self[name].any() for name in names)

    def of_joint(self, i: int, names: Iterable[str] = tuple(SERVO_FIELDS)) -> dict[str, float]:
        """Return the values of joint i, by field."""
        return {name: float(self[name][i]) for name in names}

    def finite_of_joint(
        self, i: int, names: Iterable[str] = tuple(SERVO_FIELDS)
    ) -> dict[str, float]:
        """Return the values of joint i that are known and no infinite limits, by field."""
        values = {}
        for name, value in self.of_joint(i, names).items():
            if np.isfinite(value):
                values[name] = value
        return values

    def with_joints(self, joints: Mapping[int, Mapping[str, float]]) -> ServoParameters:
        """Return the servos with values of some joints: index → field → value.

        Negative damping reduces kd instead.
        """
        changed: dict[str, Any] = {name: np.array(self[name]) for name in SERVO_FIELDS}
        for i, values in joints.items():
            for name, value in values.items():
                changed[name][i] = value
            if changed["damping"][i] < 0:
                changed["kd"][i] = max(changed["kd"][i] + changed["damping"][i], 0.0)
                changed["damping"][i] = 0.0
        return replace(self, **changed)

    def with_gains(self, kp: Array, kd: Array, nominal: ServoParameters) -> ServoParameters:
        """Return the servos where the nominal gains are others, (n) N·m/rad and N·m·s/rad.

        The gains keep their ratio to those of `nominal`.
        """
        return replace(
            self, kp=self.kp * ratio_to(kp, nominal.kp), kd=kd * ratio_to(self.kd, nominal.kd)
        )

    def with_gain_scale(self, scale: float, joints: Array) -> ServoParameters:
        """Return the servos whose kp and kd at `joints` (indices) are `scale` times those of
        [[joint]].
        """
        ratio = np.ones(len(self.kp))
        ratio[joints] = scale / self.gain_scale
        return replace(self, kp=self.kp * ratio, kd=self.kd * ratio, gain_scale=scale)

    def at_temperature(self, temperature: Array) -> ServoParameters:
        """Return the servos with friction and damping at joint temperatures, (n) °C; NaN: as
        stated.
        """
        warming = np.nan_to_num(temperature - self.friction_temperature)
        damping, friction = warmed(
            warming,
            self.damping,
            self.frictionloss,
            self.friction_per_kelvin,
            self.damping_per_kelvin,
        )
        kd = np.maximum(self.kd + np.fmin(damping, 0.0), 0.0)
        return replace(self, frictionloss=friction, damping=np.maximum(damping, 0.0), kd=kd)

    def within_stops(self, ranges: Array) -> Array:
        """Narrow joint ranges (n, 2) of the MJCF, rad, by identified stops."""
        low = np.fmax(ranges[:, 0], self.stop_low)
        high = np.fmin(ranges[:, 1], self.stop_high)
        return np.stack([low, high], axis=1)
