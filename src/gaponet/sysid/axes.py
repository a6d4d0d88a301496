"""Axes of a search: servo parameters in units in which a change of one is large, inside their
bounds.

A motion shows torques divided by kp, whatever kp is. So torques are searched as multiples of kp,
damping as a time, and armature as a time squared, with bounds that hold for any motor. The gains of
a robot file only start a search.
"""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as ListOf

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.data.signals import encoder_step
from gaponet.robot.servo_fields import SERVO_FIELDS, SERVO_TERMS, TERMS
from gaponet.robot.spec import RobotSpec
from gaponet.sim.model import build_model
from gaponet.sim.temperature import recorded_temperatures, temperature_varies

Values = dict[str, Array]  # field → (…, n) of the operated joints

CLASSIC = ("kp", "damping", "frictionloss", "armature", "offset", "delay")  # that every fit has
WARM = TERMS["temperature"]
MIN_PER_KELVIN = 1e-3  # 1/K, of friction by temperature and of damping; less counts as none
START_DELAY_S = 0.02  # a start without delay has no slope over it
MIN_STEPS_PER_RADIAN = 5.0  # physics steps in a radian of the stiffest oscillation of a start
MAX_KP_LOG_CHANGE = 5.0
LARGE_KP_LOG_CHANGE = 0.2
MAX_ARMATURE_TIME_S = 0.3
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
BOUND_TOLERANCE = 0.02  # of a large change: a value as near to its bound is at it


def to_axis(field: str, value: Array, kp: Array) -> Array:
    """Return values of a field on its axis."""
    axis = SERVO_FIELDS[field].axis
    if axis == "inverse":
        inverse = np.divide(1.0, value, out=np.zeros_like(value, float), where=value > 0)
        return np.asarray(inverse)
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
    for field, v in x.items():
        axis = SERVO_FIELDS[field].axis
        if axis == "log":
            values[field] = np.exp(v)
        elif axis == "inverse":
            none = np.zeros_like(v, float)
            values[field] = np.divide(1.0, v, out=none, where=v > MIN_INVERSE)
        elif axis == "over kp":
            values[field] = v * kp
        else:
            values[field] = v
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
    moved = np.any([~np.isclose(now[f], then[f], rtol=1e-3, atol=1e-6) for f in CLASSIC], axis=0)
    return {joint for joint, by in zip(robot.operated, moved, strict=True) if by}


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

    def __init__(self, first: Values, fields: ListOf[str], kd_slack: Array | float = 0.0) -> None:
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
        self._large = np.stack([large[f] for f in fields], axis=1)  # (n, P)
        self.low = np.stack([lowest[f] for f in fields], axis=1) / self._large
        self.high = np.stack([highest[f] for f in fields], axis=1) / self._large

    def start(self, delay: float) -> Array:
        """Return no change, but for a delay of at least so many seconds, (n, P)."""
        more = np.maximum(delay - self._first["delay"], 0)[:, None]
        is_delay = np.array(self.fields) == "delay"
        return np.where(is_delay, more / self._large, 0.0)

    def values(self, x: Array) -> Values:
        """Return the values of x; fields that are not changed stay.

        A bound of zero is met exactly.
        """
        changes = dict(zip(self.fields, np.moveaxis(x * self._large, -1, 0), strict=True))
        values = {f: np.broadcast_to(v, x.shape[:-1]) for f, v in self._first.items()}
        for field, change in changes.items():
            own = self._first[field]
            values[field] = own * np.exp(change) if field == "kp" else own + change
            if field in ("armature", "frictionloss", "delay"):
                values[field] = np.maximum(values[field], 0.0)
        return values


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
        limits: Field → lowest, highest, a large change on its axis, (n,) each.
        guess: Field of the servo model → value from which its search begins, (n,) SI.
    """

    def __init__(self, robot: RobotSpec, sequences: ListOf[Sequence]) -> None:
        op = robot.operated_index
        self.n = len(robot.operated)
        self._joints = robot.operated
        self.kd = robot.servo.kd[op]
        model = build_model(robot.with_table(None))
        kp = robot.servo.kp[op]
        limit = robot.servo.effort_limit[op]
        self.first = first_values(robot)
        self.stated = all(s.meta.recorded_gains[0] is not None for s in sequences)
        excitation = np.max([np.ptp(s.ctrl[:, op], axis=0) for s in sequences], axis=0)
        self.unexcited = excitation < MIN_EXCITATION_RAD
        self.inertia = (model.dof_M0 - model.dof_armature)[op]
        self.start = self._start(kp, model.opt.timestep)
        slow = 1 / greatest_speeds(sequences, robot)  # s/rad
        encoder_steps = np.zeros(self.n)
        for i, j in enumerate(op):
            encoder_steps[i] = encoder_step([s.qpos[:, j] for s in sequences])
        varies = temperature_varies(sequences, robot)
        self.limits = self._limits(kp, limit, slow, encoder_steps, varies)
        self.guess = self._guess(kp, varies) | {
            "effort_limit": 0.6 * limit,  # one that is too high has no slope
            "encoder_step": encoder_steps,
            "no_load_speed": np.where(self.unexcited, 0.0, 2 / slow),
            WARM[2]: np.nan_to_num(recorded_temperatures(sequences, op)).mean(axis=0).round(),
        }

    def _start(self, kp: Array, timestep: float) -> Values:
        """Return the start of a search: the own values, but for delay and armature of joints that
        are excited; kp (n,) N·m/rad.
        """
        delay = np.maximum(self.first["delay"], START_DELAY_S)
        least_inertia = kp * (MIN_STEPS_PER_RADIAN * timestep) ** 2
        lacking = least_inertia - self.inertia
        armature = np.maximum(np.maximum(self.first["armature"], 1e-6 * kp), lacking)
        start = {f: self.first[f] for f in CLASSIC}
        start["delay"] = np.where(self.unexcited, self.first["delay"], delay)
        start["armature"] = np.where(self.unexcited, self.first["armature"], armature)
        for field in (*SERVO_TERMS, *WARM):
            if self.first[field].any():
                start[field] = self.first[field]
        return start

    def _limits(
        self, kp: Array, effort_limit: Array, slow: Array, encoder_steps: Array, varies: Array
    ) -> dict[str, tuple[Array, Array, Array]]:
        """Return field → lowest, highest and a large change on its axis, (n,) each.

        Bounds that do not depend on the robot are those of SERVO_FIELDS.

        Args:
            kp, effort_limit: The robot's own, N·m/rad and N·m.
            slow: One over the greatest speed, s/rad.
            encoder_steps: rad; 0 where none is seen.
            varies: Whether the temperature varies; else the robot's own values by temperature stay.
        """
        one = np.ones(self.n)
        limits = {}
        for f in SERVO_FIELDS.values():
            if f.bounds:
                low, high, large = f.bounds
                limits[f.name] = low * one, high * one, large * one
        limits["kp"] = np.log(kp) - MAX_KP_LOG_CHANGE, np.log(kp) + MAX_KP_LOG_CHANGE, 0.3 * one
        own_armature = np.maximum(self.start["armature"] / kp, 1e-6)
        large_armature = np.clip(0.4 * own_armature, 1e-5, 1e-3)
        limits["armature"] = 0 * one, MAX_ARMATURE_TIME_S**2 * one, large_armature
        limits["effort_limit"] = (
            0.05 * effort_limit / kp,
            5 * effort_limit / kp,
            0.2 * effort_limit / kp,
        )
        limits["encoder_step"] = encoder_steps, encoder_steps, one
        limits["no_load_speed"] = 0 * one, 2 * slow, LARGE_LINE_CHANGE * slow
        for name in WARM[:2]:
            lowest, highest, change = limits[name]
            own = to_axis(name, self.first[name], kp)
            limits[name] = np.where(varies, lowest, own), np.where(varies, highest, own), change
        return limits

    def _guess(self, kp: Array, varies: Array) -> Values:
        """Return the values of the fields that have a guess in SERVO_FIELDS, (n,) each; arguments
        as of `_limits`.
        """
        guess = {}
        for f in SERVO_FIELDS.values():
            if f.guess is None:
                continue
            guess[f.name] = np.full(self.n, f.guess)
            if f.name in WARM:
                guess[f.name] = np.where(varies, guess[f.name], 0.0)
        return from_axis(guess, kp)

    def visible(self, field: str, values: Values) -> Array:
        """Return a field of values (n,), 0 where it is a torque-speed line of less than MIN_LINE,
        or of friction and damping that change by less than MIN_PER_KELVIN.
        """
        if field == WARM[0]:
            total = np.maximum(values["damping"] + self.kd, 0.0)
            slow = np.abs(values[WARM[1]]) < MIN_PER_KELVIN * total
            return np.where(slow & (np.abs(values[field]) < MIN_PER_KELVIN), 0.0, values[field])
        if SERVO_FIELDS[field].axis != "inverse":
            return values[field]
        least = MIN_LINE / LARGE_LINE_CHANGE * self.limits[field][2]
        line = to_axis(field, values[field], values["kp"])
        return np.where(line < least, 0.0, values[field])

    def warnings(self, values: Values, names: ListOf[str]) -> tuple[str, ...]:
        """Return a sentence for each field of values (n,) at its bound; no friction, armature or
        delay is ordinary.
        """
        axes = Axes(self, names, values)
        x = axes.normalize(values)
        warnings = []
        for i, joint in enumerate(self._joints):
            for k, f in enumerate(names):
                low = axes.low[i, k]
                high = axes.high[i, k]
                without = f == "stribeck_speed" and not values["stribeck"][i]
                if low == high or without:
                    continue
                zero_is_ordinary = f != "damping" and low == 0
                if x[i, k] - low < BOUND_TOLERANCE and not zero_is_ordinary:
                    warnings.append(_at_bound(joint, f, values[f][i], "least"))
                elif high - x[i, k] < BOUND_TOLERANCE:
                    warnings.append(_at_bound(joint, f, values[f][i], "most"))
        return tuple(warnings)


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
        here = self._unclipped(rest)
        fixed = bounds.unexcited[:, None] & ~np.isin(self.names, UNEXCITED_FIELDS)
        self.low = np.where(fixed, here, self.low)
        self.high = np.where(fixed, here, self.high)

    def normalize(self, values: Values) -> Array:
        """Return values (…, n) on the axes, inside the bounds."""
        return np.asarray(np.clip(self._unclipped(values), self.low, self.high))

    def _unclipped(self, values: Values) -> Array:
        own = {f: values[f] for f in self.names}
        if "damping" in own:
            own["damping"] = own["damping"] + self._kd_slack
        on_axes = [to_axis(f, x, values["kp"]) for f, x in own.items()]
        return np.asarray(np.stack(on_axes, axis=-1) / self.unit)

    def values(self, x: Array) -> Values:
        """Return values of x on the axes; fields that are not searched stay."""
        own = dict(zip(self.names, np.moveaxis(x * self.unit, -1, 0), strict=True))
        values = {f: np.broadcast_to(v, x.shape[:-1]) for f, v in self.rest.items()}
        values |= from_axis(own, values["kp"])
        if "damping" in own:
            values["damping"] = values["damping"] - self._kd_slack
        return values
