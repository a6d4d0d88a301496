"""Axes of a search: servo parameters in units in which a change of one is large, inside their
bounds.

A motion shows torques divided by kp, whatever kp is. So torques are searched as multiples of kp,
damping as a time, and armature as a time squared, with bounds that hold for any motor. The gains of
a robot file only start a search.
"""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as ListOf
from typing import Literal, NamedTuple

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.data.signals import encoder_step
from gaponet.robot.servo_fields import SERVO_FIELDS, SERVO_TERMS, TERMS
from gaponet.robot.spec import RobotSpec
from gaponet.sim.model import build_model
from gaponet.sim.temperature import recorded_temperatures, temperature_varies

Values = dict[str, Array]  # field → (…, n) of the operated joints

# Fields that every fit has.
CLASSIC = ("kp", "damping", "frictionloss", "armature", "offset", "delay")
WARM = TERMS["temperature"]
# Those of WARM that are fitted; the temperature is stated.
WARM_SLOPES = ("friction_per_kelvin", "damping_per_kelvin")
# Of friction by temperature, and of damping over damping, 1/K: less counts as none.
MIN_PER_KELVIN = 1e-3
START_DELAY_S = 0.02  # a start without delay has no slope over it
# Physics steps in a radian of the stiffest oscillation of a start.
MIN_STEPS_PER_RADIAN = 5.0
MAX_KP_LOG_CHANGE = 5.0
LARGE_KP_LOG_CHANGE = 0.2
MAX_ARMATURE_TIME_S = 0.3
MIN_ARMATURE_OVER_KP = 1e-6  # s², of a start
MAX_ON_AXIS = {f.name: f.bounds[1] for f in SERVO_FIELDS.values() if f.bounds}
MIN_EXCITATION_RAD = 0.01  # commands that differ by less do not excite a joint
# What is fitted of an unexcited joint, as others move it.
UNEXCITED_FIELDS = ("kp", "offset", "damping", "frictionloss")
MIN_INVERSE = 1e-5  # on an inverse axis; less counts as none
# Of a torque-speed line, in the share of torque that the motor has lost at the joint's greatest
# speed: the least that counts, and a large change.
MIN_LINE = 0.2
LARGE_LINE_CHANGE = 0.1
GREATEST_SPEED_QUANTILE = 0.995  # of a joint's recorded speeds
MIN_GREATEST_SPEED = 0.1  # rad/s
# Large changes: a value as near to its bound is at it.
BOUND_TOLERANCE = 0.02


def one_candidate(values: Values) -> Values:
    """Return values (n,) as a single candidate, (1, n)."""
    return {field: value[None] for field, value in values.items()}


def first_candidate(values: Values) -> Values:
    """Return values (n,) of the first of k candidates (k, n), as arrays of their own."""
    return {field: value[0].copy() for field, value in values.items()}


def to_axis(field: str, value: Array, kp: Array) -> Array:
    """Return values of a field on its axis."""
    axis = SERVO_FIELDS[field].axis
    if axis == "inverse":
        none = np.zeros_like(value, float)
        return np.asarray(np.divide(1.0, value, out=none, where=value > 0))
    if axis == "log":
        return np.asarray(np.log(np.maximum(value, 1e-9)))
    if axis == "over kp":
        return np.asarray(value / kp)
    return value


def from_axis(x: dict[str, Array], kp: Array | None = None) -> Values:
    """Return values in SI units of fields on their axes; kp is that of `x`, or given."""
    if "kp" in x:
        kp = np.exp(x["kp"])
    values = {}
    for field, on_axis in x.items():
        axis = SERVO_FIELDS[field].axis
        if axis == "log":
            values[field] = np.exp(on_axis)
        elif axis == "inverse":
            none = np.zeros_like(on_axis, float)
            values[field] = np.divide(1.0, on_axis, out=none, where=on_axis > MIN_INVERSE)
        elif axis == "over kp":
            values[field] = on_axis * kp
        else:
            values[field] = on_axis
    return values


def greatest_speeds(sequences: ListOf[Sequence], robot: RobotSpec) -> Array:
    """Return the greatest recorded speed of each operated joint, at least MIN_GREATEST_SPEED, (n,)
    rad/s; without outliers.
    """
    speeds = []
    for s in sequences:
        speed = np.abs(s.qvel[:, robot.operated_index])
        speeds.append(np.quantile(speed, GREATEST_SPEED_QUANTILE, axis=0))
    return np.asarray(np.maximum(np.max(speeds, axis=0), MIN_GREATEST_SPEED))


def first_values(robot: RobotSpec) -> Values:
    """Return the robot's own values, (n,) each.

    Damping is the MJCF's; below zero it is taken from the servo's kd.
    """
    model = build_model(robot.with_table(None))
    op = robot.operated_index
    values = {}
    for field in ("damping", "frictionloss", "armature"):
        values[field] = np.array(getattr(model, f"dof_{field}")[op])
    for field in ("kp", "offset", "delay", "effort_limit", *SERVO_TERMS, *WARM):
        values[field] = robot.servo[field][op]
    return values


def identified_joints(robot: RobotSpec) -> set[str]:
    """Return the operated joints whose classic fields differ from those of the robot before
    identification.
    """
    now = first_values(robot)
    then = first_values(robot.before_identification)
    has_changed = np.zeros(len(robot.operated), bool)
    for field in CLASSIC:
        has_changed |= ~np.isclose(now[field], then[field], rtol=1e-3, atol=1e-6)
    return {joint for joint, changed in zip(robot.operated, has_changed, strict=True) if changed}


def with_values(robot: RobotSpec, values: Mapping[str, Array]) -> RobotSpec:
    """Return the robot with values (n,) of its operated joints, rounded to 6 digits."""
    servos = {}
    for i, joint in enumerate(robot.operated):
        servos[joint] = {field: float(f"{value[i]:.6g}") for field, value in values.items()}
    return robot.with_identified(servos)


class Changes:
    """Changes x (…, n, P) of P fields of a robot's own values, in large changes; of kp by its
    logarithm.

    Attributes:
        fields: The P fields, out of CLASSIC.
        low, high: Bounds, (n, P).
    """

    def __init__(
        self,
        first: Values,
        fields: ListOf[str],
        kd_slack: Array | float = 0.0,
    ) -> None:
        """
        Args:
            first: Own values, (n,).
            kd_slack: kd that damping may take from the servos, (n,) N·m·s/rad.
        """
        self.fields = tuple(fields)
        self._first = first
        kp = first["kp"]
        damping = first["damping"]
        friction = first["frictionloss"]
        armature = first["armature"]
        delay = first["delay"]
        one = np.ones_like(kp)
        large = {
            "kp": LARGE_KP_LOG_CHANGE * one,
            "damping": np.fmax(damping, 0.01 * kp),
            "frictionloss": np.fmax(friction, 0.005 * kp),
            "armature": np.fmax(armature, 1e-3 * one),
            "offset": 0.02 * one,
            "delay": 0.02 * one,
        }
        lowest = {
            "kp": -MAX_KP_LOG_CHANGE * one,
            "damping": -damping - kd_slack,
            "frictionloss": -friction,
            "armature": -armature,
            "offset": -MAX_ON_AXIS["offset"] * one,
            "delay": -delay,
        }
        highest = {
            "kp": MAX_KP_LOG_CHANGE * one,
            "damping": MAX_ON_AXIS["damping"] * kp,
            "frictionloss": kp,
            "armature": MAX_ARMATURE_TIME_S**2 * kp,
            "offset": MAX_ON_AXIS["offset"] * one,
            "delay": MAX_ON_AXIS["delay"] - delay,
        }
        self._large = np.stack([large[field] for field in fields], axis=1)  # (n, P)
        self.low = np.stack([lowest[field] for field in fields], axis=1) / self._large
        self.high = np.stack([highest[field] for field in fields], axis=1) / self._large

    def start(self, delay: float) -> Array:
        """Return no change, but for a delay of at least so many seconds, (n, P)."""
        more = np.maximum(delay - self._first["delay"], 0)[:, None]
        is_delay = np.array(self.fields) == "delay"
        return np.where(is_delay, more / self._large, 0.0)

    def values(self, x: Array) -> Values:
        """Return the values of x; fields that are not changed stay.

        A bound of zero is met exactly.
        """
        values = {}
        for field, own in self._first.items():
            values[field] = np.broadcast_to(own, x.shape[:-1])
        changes = np.moveaxis(x * self._large, -1, 0)  # (P, …, n)
        for field, change in zip(self.fields, changes, strict=True):
            own = self._first[field]
            if field == "kp":
                values[field] = own * np.exp(change)
            else:
                values[field] = own + change
            if field in ("armature", "frictionloss", "delay"):
                values[field] = np.maximum(values[field], 0.0)
        return values


class Limits(NamedTuple):
    """Limits of a field on its axis, (n,) each."""

    low: Array
    high: Array
    large_change: Array


class Bounds:
    """Bounds of the parameters of a robot's n operated joints.

    Attributes:
        first: The given robot's own values.
        start: Start of a search: with a delay, and with as much armature as the physics step
            resolves.
        stated: Whether all recordings state their kp.
        inertia: Inertia of the links at the MJCF's reference pose, without armature, (n,) kg·m².
        kd: The servos' kd, (n,) N·m·s/rad. Damping may take from it, stated or not: firmware
            filters the velocity.
        unexcited: Joints that no command moves, (n,) bool.
        limits: Field → its limits.
        guess: Field of the servo model → value from which its search begins, (n,) SI.
    """

    def __init__(self, robot: RobotSpec, sequences: ListOf[Sequence]) -> None:
        op = robot.operated_index
        kp = robot.servo.kp[op]
        effort_limit = robot.servo.effort_limit[op]
        model = build_model(robot.with_table(None))
        self._joints = robot.operated
        self.n = len(robot.operated)
        self.kd = robot.servo.kd[op]
        self.first = first_values(robot)
        self.stated = all(s.meta.recorded_gains[0] is not None for s in sequences)
        excitation = np.max([np.ptp(s.ctrl[:, op], axis=0) for s in sequences], axis=0)
        self.unexcited = excitation < MIN_EXCITATION_RAD
        self.inertia = (model.dof_M0 - model.dof_armature)[op]
        self.start = self._start(kp, model.opt.timestep)
        slow = 1 / greatest_speeds(sequences, robot)  # s/rad
        encoder_steps = _encoder_steps(sequences, op)
        varies = temperature_varies(sequences, robot)
        self.limits = self._limits(kp, effort_limit, slow, encoder_steps, varies)
        temperature = np.nan_to_num(recorded_temperatures(sequences, op)).mean(axis=0)  # °C
        self.guess = self._guess(kp, varies)
        self.guess["effort_limit"] = 0.6 * effort_limit  # one that is too high has no slope
        self.guess["encoder_step"] = encoder_steps
        self.guess["no_load_speed"] = np.where(self.unexcited, 0.0, 2 / slow)
        self.guess["friction_temperature"] = temperature.round()

    def _start(self, kp: Array, timestep: float) -> Values:
        """Return the start of a search: the own values, but for delay and armature of joints that
        are excited; kp (n,) N·m/rad.
        """
        delay = np.maximum(self.first["delay"], START_DELAY_S)
        least_inertia = kp * (MIN_STEPS_PER_RADIAN * timestep) ** 2
        lacking = least_inertia - self.inertia
        armature = np.maximum(self.first["armature"], MIN_ARMATURE_OVER_KP * kp)
        armature = np.maximum(armature, lacking)
        start = {field: self.first[field] for field in CLASSIC}
        start["delay"] = np.where(self.unexcited, self.first["delay"], delay)
        start["armature"] = np.where(self.unexcited, self.first["armature"], armature)
        for field in (*SERVO_TERMS, *WARM):
            if self.first[field].any():
                start[field] = self.first[field]
        return start

    def _limits(
        self,
        kp: Array,
        effort_limit: Array,
        slow: Array,
        encoder_steps: Array,
        varies: Array,
    ) -> dict[str, Limits]:
        """Return field → its limits.

        Bounds that do not depend on the robot are those of SERVO_FIELDS.

        Args:
            kp, effort_limit: The robot's own, N·m/rad and N·m.
            slow: One over the greatest speed, s/rad.
            encoder_steps: rad; 0 where none is seen.
            varies: Whether the temperature varies; else the robot's own values by temperature stay.
        """
        one = np.ones(self.n)
        limits = {}
        for field in SERVO_FIELDS.values():
            if field.bounds:
                low, high, large_change = field.bounds
                limits[field.name] = Limits(low * one, high * one, large_change * one)
        log_kp = np.log(kp)
        limits["kp"] = Limits(log_kp - MAX_KP_LOG_CHANGE, log_kp + MAX_KP_LOG_CHANGE, 0.3 * one)
        own_armature = np.maximum(self.start["armature"] / kp, MIN_ARMATURE_OVER_KP)
        large_armature = np.clip(0.4 * own_armature, 1e-5, 1e-3)
        limits["armature"] = Limits(0 * one, MAX_ARMATURE_TIME_S**2 * one, large_armature)
        limits["effort_limit"] = Limits(
            0.05 * effort_limit / kp, 5 * effort_limit / kp, 0.2 * effort_limit / kp
        )
        limits["encoder_step"] = Limits(encoder_steps, encoder_steps, one)
        limits["no_load_speed"] = Limits(0 * one, 2 * slow, LARGE_LINE_CHANGE * slow)
        for name in WARM_SLOPES:
            usual = limits[name]
            own = to_axis(name, self.first[name], kp)
            lowest = np.where(varies, usual.low, own)
            highest = np.where(varies, usual.high, own)
            limits[name] = Limits(lowest, highest, usual.large_change)
        return limits

    def _guess(self, kp: Array, varies: Array) -> Values:
        """Return the values of the fields that have a guess in SERVO_FIELDS, (n,) each; arguments
        as of `_limits`.
        """
        guess = {}
        for field in SERVO_FIELDS.values():
            if field.guess is None:
                continue
            guess[field.name] = np.full(self.n, field.guess)
            if field.name in WARM:
                guess[field.name] = np.where(varies, guess[field.name], 0.0)
        return from_axis(guess, kp)

    def visible(self, field: str, values: Values) -> Array:
        """Return a field of values (n,), 0 where it is a torque-speed line of less than MIN_LINE,
        or of friction and damping that change by less than MIN_PER_KELVIN.
        """
        value = values[field]
        if field == "friction_per_kelvin":
            total_damping = np.maximum(values["damping"] + self.kd, 0.0)
            damping_change = np.abs(values["damping_per_kelvin"])
            damping_stays = damping_change < MIN_PER_KELVIN * total_damping
            friction_stays = np.abs(value) < MIN_PER_KELVIN
            return np.where(damping_stays & friction_stays, 0.0, value)
        if SERVO_FIELDS[field].axis == "inverse":
            least = MIN_LINE / LARGE_LINE_CHANGE * self.limits[field].large_change
            line = to_axis(field, value, values["kp"])
            return np.where(line < least, 0.0, value)
        return value

    def warnings(self, values: Values, names: ListOf[str]) -> tuple[str, ...]:
        """Return a sentence for each field of values (n,) at its bound; no friction, armature or
        delay is ordinary.
        """
        axes = Axes(self, names, values)
        x = axes.normalize(values)
        warnings = []
        for i, joint in enumerate(self._joints):
            for k, field in enumerate(names):
                has_no_effect = field == "stribeck_speed" and not values["stribeck"][i]
                end = _end_of_range(field, x[i, k], axes.low[i, k], axes.high[i, k])
                if end and not has_no_effect:
                    warnings.append(_at_bound(joint, field, values[field][i], end))
        return tuple(warnings)


def _encoder_steps(sequences: ListOf[Sequence], joints: Array) -> Array:
    """Return the steps of the encoders of joints, by number, (n,) rad; 0 where none is seen."""
    steps = np.zeros(len(joints))
    for i, joint in enumerate(joints):
        steps[i] = encoder_step([s.qpos[:, joint] for s in sequences])
    return steps


def _end_of_range(
    field: str,
    x: float,
    low: float,
    high: float,
) -> Literal["", "least", "most"]:
    """Return at which end of its range a field is, in large changes; nothing where it is fixed or
    at a zero that is ordinary.
    """
    if low == high:
        return ""
    zero_is_ordinary = field != "damping" and low == 0
    if x - low < BOUND_TOLERANCE and not zero_is_ordinary:
        return "least"
    if high - x < BOUND_TOLERANCE:
        return "most"
    return ""


def _at_bound(joint: str, field: str, value: float, end: str) -> str:
    """Return a sentence about a field at the end of what is tried."""
    what = f"{value:.4g}, the {end} that is tried; {SERVO_FIELDS[field].advice}"
    if field == "damping" and end == "least":
        what = "none at all; check that commands are what the servo was given, and their clock"
    return f"{joint}: {field} ended at its bound: {what}"


class Axes:
    """Fields on the axes of a search, (…, n, P).

    Attributes:
        names: The P fields.
        rest: Values of the fields that are not searched.
        unit: A large change, (n, P).
        low, high: Bounds, (n, P); equal where a field of an unexcited joint is fixed.
    """

    def __init__(self, bounds: Bounds, fields: ListOf[str], rest: Values) -> None:
        self.names = list(dict.fromkeys(fields))
        self.rest = rest
        self._kd_slack = bounds.kd
        limits = [bounds.limits[field] for field in self.names]
        low, high, self.unit = np.stack(limits, axis=-1)  # (n, P) each
        self.low = low / self.unit
        self.high = high / self.unit
        own = self._unclipped(rest)
        is_fixed = bounds.unexcited[:, None] & ~np.isin(self.names, UNEXCITED_FIELDS)
        self.low = np.where(is_fixed, own, self.low)
        self.high = np.where(is_fixed, own, self.high)

    def normalize(self, values: Values) -> Array:
        """Return values (…, n) on the axes, inside the bounds."""
        return np.asarray(np.clip(self._unclipped(values), self.low, self.high))

    def _unclipped(self, values: Values) -> Array:
        """Return values (…, n) on the axes."""
        on_axes = []
        for field in self.names:
            value = values[field]
            if field == "damping":
                value = value + self._kd_slack
            on_axes.append(to_axis(field, value, values["kp"]))
        return np.asarray(np.stack(on_axes, axis=-1) / self.unit)

    def values(self, x: Array) -> Values:
        """Return values of x on the axes; fields that are not searched stay."""
        values = {}
        for field, value in self.rest.items():
            values[field] = np.broadcast_to(value, x.shape[:-1])
        on_axes = np.moveaxis(x * self.unit, -1, 0)  # (P, …, n)
        own = dict(zip(self.names, on_axes, strict=True))
        values |= from_axis(own, values["kp"])
        if "damping" in own:
            values["damping"] = values["damping"] - self._kd_slack
        return values
