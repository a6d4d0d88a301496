"""Friction and damping by recorded temperature: whether recordings show it, and what
identification says of it.

Friction is frictionloss · (1 + c (T − T₀)) and damping is damping + d (T − T₀), with the mean
temperature T of a recording. A simulation without recorded temperatures is at the reference T₀, the
mean of the fitted recordings.
"""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as ListOf

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.text import format_uncertainty
from gaponet.data.sequence import Sequence
from gaponet.robot.servo_fields import TERMS, warmed
from gaponet.robot.spec import RobotSpec

MIN_STD_K = 2.0  # of the temperature among recordings with equal gains and payload
MAX_CONFOUNDED = 0.5  # share of the temperature's variance that gains and payload explain


def recorded_temperatures(parts: ListOf[Sequence], op: Array) -> Array:
    """Return the mean temperature of joints `op` in each recording, (recordings, n) °C; NaN where
    it is unknown.
    """
    temperatures = np.full((len(parts), len(parts[0].joint_names)), np.nan)
    for row, part in zip(temperatures, parts, strict=True):
        if part.temperatures is not None:
            row[:] = part.temperatures
    return np.asarray(temperatures[:, op])


def warm_values(values: Mapping[str, Array], temperature: Array) -> tuple[Array, Array]:
    """Return damping and friction of candidates (k, n) at temperatures (n, windows) °C, (k, n,
    windows) each.
    """
    zero = np.zeros_like(values["kp"])
    given = {}  # (k, n, 1)
    for name in ("damping", "frictionloss", *TERMS["temperature"]):
        given[name] = values.get(name, zero)[..., None]
    damping, friction = warmed(
        np.nan_to_num(temperature - given["friction_temperature"]),
        given["damping"],
        given["frictionloss"],
        given["friction_per_kelvin"],
        given["damping_per_kelvin"],
    )
    return damping, friction


def temperature_spread(sequences: ListOf[Sequence], robot: RobotSpec) -> Array:
    """Return the standard deviation of each operated joint's temperature in all recordings, and
    among those with equal gains and payload, (2, n) K; zero where a recording lacks it.
    """
    warm = recorded_temperatures(sequences, robot.operated_index)
    alike = [(s.meta.recorded_gains, s.meta.payload_mass, s.meta.payload_side) for s in sequences]
    among = warm.copy()
    for key in set(alike):
        rows = [i for i, one in enumerate(alike) if one == key]
        among[rows] -= warm[rows].mean(axis=0)
    recorded = np.all([s.meta.records(robot.operated) for s in sequences], axis=0)
    return np.where(recorded, np.nan_to_num([warm.std(axis=0), among.std(axis=0)]), 0.0)


def temperature_varies(sequences: ListOf[Sequence], robot: RobotSpec) -> Array:
    """Return the operated joints, (n,), whose temperature varies enough, and not with gains or
    payload.
    """
    whole, among = temperature_spread(sequences, robot)
    result: Array = (among > MIN_STD_K) & (among**2 > (1 - MAX_CONFOUNDED) * whole**2)
    return result


def temperature_findings(
    sequences: ListOf[Sequence], robot: RobotSpec, std: Mapping[str, Mapping[str, float]]
) -> tuple[str, ...]:
    """Return a sentence for each joint with friction by temperature, or whose temperature varies
    with another factor.

    Args:
        sequences: The fitted recordings.
        std: Joint → field → standard error.
    """
    sentences = []
    warm = recorded_temperatures(sequences, robot.operated_index)
    whole, among = temperature_spread(sequences, robot)
    for i, (joint, at) in enumerate(zip(robot.operated, robot.operated_index, strict=True)):
        per_kelvin = robot.servo.friction_per_kelvin[at]
        error = std[joint].get("friction_per_kelvin", 0.0)
        between = f"{warm[:, i].min():.0f} to {warm[:, i].max():.0f} °C"
        if per_kelvin:
            change = "rises" if per_kelvin > 0 else "falls"
            size = format_uncertainty(1e2 * abs(per_kelvin), 1e2 * error)
            sentences.append(
                f"{joint}: friction {change} by {size} % per K, recorded at {between}; the stated "
                f"value is that at {robot.servo.friction_temperature[at]:.0f} °C"
            )
        elif whole[i] > MIN_STD_K and among[i] ** 2 <= (1 - MAX_CONFOUNDED) * whole[i] ** 2:
            sentences.append(
                f"{joint}: the temperature, {between}, varies with gains or payload, so its "
                "effect cannot be told from theirs; record one motion cold and warm with the same "
                "gains and payload"
            )
    return tuple(sentences)
