"""Hidden parameters of a virtual robot: the effect of each, its unit, and its value for "no
effect".

The numbers and their sources are in fleets/*.toml.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError


def _metadata(scope: str, effect: str, neutral: float, unit: str) -> dict[str, Any]:
    return {"effect": effect, "neutral": neutral, "unit": unit, "scope": scope}


_joint = partial(_metadata, "joint")
_unit = partial(_metadata, "unit")


@dataclass(frozen=True)
class Physics:
    """One unit's hidden parameters: (n,) arrays in the robot's joint order, or one number for the
    whole unit.

    `stack` makes (N, n) and (N, 1) arrays of it, one row per simulation, for the effects in
    motor.py.
    """

    # Gain: stiffness and damping of the drive over those it was set to.
    kp_scale: Array = field(metadata=_joint("gain", 1.0, "1"))
    kd_scale: Array = field(metadata=_joint("gain", 1.0, "1"))
    # Torque constant: torque per ampere over the datasheet's, at 25 °C.
    kt_scale: Array = field(metadata=_joint("torque_constant", 1.0, "1"))
    # Thermal: torque constant lost per kelvin, motor constant, and two nodes (winding, housing).
    kt_drift: Array = field(metadata=_joint("thermal", 0.0, "1/K"))
    motor_constant: Array = field(metadata=_joint("thermal", np.inf, "N·m/√W"))
    winding_resistance: Array = field(metadata=_joint("thermal", 1.0, "K/W"))
    winding_time: Array = field(metadata=_joint("thermal", 30.0, "s"))
    housing_resistance: Array = field(metadata=_joint("thermal", 1.0, "K/W"))
    housing_time: Array = field(metadata=_joint("thermal", 600.0, "s"))
    # Temperature above ambient at the start of a recording: mean and standard deviation between
    # recordings.
    warmth: Array = field(metadata=_unit("thermal", 0.0, "K"))
    warmth_spread: Array = field(metadata=_unit("thermal", 0.0, "K"))
    # Friction beyond that of the nominal model, and its difference between directions; Stribeck
    # peak over it.
    friction: Array = field(metadata=_joint("friction", 0.0, "N·m"))
    friction_asymmetry: Array = field(metadata=_joint("friction", 0.0, "1"))
    stribeck: Array = field(metadata=_joint("stribeck", 0.0, "1"))
    stribeck_speed: Array = field(metadata=_joint("stribeck", 0.1, "rad/s"))
    # Pre-sliding: angle over which the friction of an unloaded joint builds up.
    presliding: Array = field(metadata=_joint("presliding", 0.0, "rad"))
    # Friction and damping lost per kelvin of the housing.
    thinning: Array = field(metadata=_joint("thinning", 0.0, "1/K"))
    # Load friction: gear efficiency.
    efficiency: Array = field(metadata=_joint("load_friction", 1.0, "1"))
    # Viscous damping beyond the nominal model's.
    damping: Array = field(metadata=_joint("damping", 0.0, "N·m·s/rad"))
    # Backlash between motor and link.
    backlash: Array = field(metadata=_joint("backlash", 0.0, "rad"))
    # Compliance of gear and link behind the encoder: twist at the torque limit.
    windup: Array = field(metadata=_joint("compliance", 0.0, "rad"))
    # Current loop: time constant of the torque.
    current_time: Array = field(metadata=_joint("current_loop", 0.0, "s"))
    # Torque against speed: no-load speed, and the share of it up to which the torque limit is
    # constant.
    no_load_speed: Array = field(metadata=_joint("torque_speed", np.inf, "rad/s"))
    corner: Array = field(metadata=_joint("torque_speed", 0.0, "1"))
    # Command link: constant delay; jitter (uniform up to this) and lost packets.
    delay: Array = field(metadata=_unit("delay", 0.0, "s"))
    jitter: Array = field(metadata=_unit("jitter", 0.0, "s"))
    drop: Array = field(metadata=_unit("jitter", 0.0, "1"))
    # Supply: nominal voltage, resistance of battery and leads, and share of the gain that follows
    # the voltage.
    supply_voltage: Array = field(metadata=_unit("supply", np.inf, "V"))
    supply_resistance: Array = field(metadata=_unit("supply", 0.0, "Ω"))
    supply_gain: Array = field(metadata=_unit("supply", 0.0, "1"))
    # Cables along the joint: a weak spring about an angle.
    cable_stiffness: Array = field(metadata=_joint("cable", 0.0, "N·m/rad"))
    cable_angle: Array = field(metadata=_joint("cable", 0.0, "rad"))
    # Cogging: torque ripple over the joint angle.
    cogging: Array = field(metadata=_joint("cogging", 0.0, "N·m"))
    cogging_count: Array = field(metadata=_joint("cogging", 1.0, "1/rev"))
    cogging_phase: Array = field(metadata=_joint("cogging", 0.0, "rad"))
    # Tilt: the base is not level.
    tilt_roll: Array = field(metadata=_unit("tilt", 0.0, "rad"))
    tilt_pitch: Array = field(metadata=_unit("tilt", 0.0, "rad"))
    # Drag: largest friction of a cable bundle that the neighbouring joint bends away from an angle.
    drag: Array = field(metadata=_joint("drag", 0.0, "N·m"))
    drag_angle: Array = field(metadata=_joint("drag", 0.0, "rad"))
    # Churning: resistance of grease with the square of the speed.
    churning: Array = field(metadata=_joint("churning", 0.0, "N·m·s²/rad²"))
    # Limb current: loss of gain per unit of the sum of a chain's torques, each over its limit,
    # beyond a budget.
    limb_loss: Array = field(metadata=_unit("limb_current", 0.0, "1"))
    limb_budget: Array = field(metadata=_unit("limb_current", 0.0, "1"))
    # Derating: loss of gain per kelvin of the winding above 40 °C.
    derating: Array = field(metadata=_joint("derating", 0.0, "1/K"))
    # Firmware: targets are rounded, then smoothed; at `smoothing_lag` the time constant is half.
    target_step: Array = field(metadata=_unit("smoothing", 0.0, "rad"))
    smoothing: Array = field(metadata=_joint("smoothing", 0.0, "s"))
    smoothing_lag: Array = field(metadata=_unit("smoothing", 1.0, "rad"))
    # Flex: tilt of the base per moment of the moving links' weight, and its time constant.
    flex: Array = field(metadata=_unit("flex", 0.0, "rad/(N·m)"))
    flex_time: Array = field(metadata=_unit("flex", 0.1, "s"))
    # Grip: offset of the payload's centre from the nominal place in the hand.
    grip_x: Array = field(metadata=_unit("grip", 0.0, "m"))
    grip_z: Array = field(metadata=_unit("grip", 0.0, "m"))
    # Links: mass over the published one, and offset of the centre of mass.
    mass_scale: Array = field(metadata=_joint("mass", 1.0, "1"))
    com_x: Array = field(metadata=_joint("mass", 0.0, "m"))
    com_y: Array = field(metadata=_joint("mass", 0.0, "m"))
    com_z: Array = field(metadata=_joint("mass", 0.0, "m"))
    # Encoder: zero error, step and noise.
    zero_offset: Array = field(metadata=_joint("zero", 0.0, "rad"))
    encoder_step: Array = field(metadata=_joint("encoder", 0.0, "rad"))
    encoder_noise: Array = field(metadata=_joint("encoder", 0.0, "rad"))
    velocity_noise: Array = field(metadata=_joint("encoder", 0.0, "rad/s"))
    # Current sensor: noise and offset, as torque.
    current_noise: Array = field(metadata=_joint("current_sensor", 0.0, "N·m"))
    current_offset: Array = field(metadata=_joint("current_sensor", 0.0, "N·m"))

    def only(self, effects: tuple[str, ...] | list[str]) -> Physics:
        """Return the unit with all other effects switched off."""
        unknown = sorted(set(effects) - set(EFFECTS))
        if unknown:
            raise UsageError(f"effect '{unknown[0]}' is unknown; effects are {', '.join(EFFECTS)}")
        off = {}
        for f in fields(self):
            if f.metadata["effect"] not in effects:
                off[f.name] = np.full_like(getattr(self, f.name), f.metadata["neutral"])
        return replace(self, **off)


EFFECTS: tuple[str, ...] = tuple(dict.fromkeys(f.metadata["effect"] for f in fields(Physics)))


def neutral(n: int) -> Physics:
    """Return the physics of the nominal simulator, without any effect, for n joints."""
    size = {"joint": n, "unit": 1}
    values = {}
    for f in fields(Physics):
        values[f.name] = np.full(size[f.metadata["scope"]], f.metadata["neutral"])
    return Physics(**values)


def stack(units: list[Physics], columns: Array) -> Physics:
    """Return one row per simulation, (N, len(columns)) or (N, 1), with the joints `columns`."""
    rows = {}
    for f in fields(Physics):
        table = np.stack([np.atleast_1d(getattr(u, f.name)) for u in units])
        if f.metadata["scope"] == "joint":
            table = table[:, columns]
        rows[f.name] = np.ascontiguousarray(table)
    return Physics(**rows)
