"""A servo's parameters as a search sees them: in units in which a change of one is large, inside their bounds.

What a motion shows is a torque over kp, whatever kp is: so torques are searched as multiples of kp, damping as a time,
armature as a time squared, in bounds that hold for any motor. A robot file's gains are where a search starts, no more.
"""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import replace

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.data.signals import encoder_step
from gaponet.robot.spec import SERVO_TERMS, RobotSpec
from gaponet.sim.model import build_model

Values = dict[str, Array]  # field → (…, n) of the operated joints

CLASSIC = ("kp", "damping", "frictionloss", "armature", "offset", "delay")
LOGARITHM = ("kp", "stribeck_speed")
OVER_KP = ("damping", "frictionloss", "armature", "stribeck", "min_torque", "effort_limit")
FIRST_DELAY, MAX_DELAY = 0.02, 0.15  # s: a delay of zero hides what it does
RESOLVED = 5.0  # physics steps in a radian of the stiffest oscillation that a search starts from
WIDE_KP, SLOW, HEAVY, ZERO = 5.0, 1.0, 0.3, 0.2  # logarithm of kp, s of damping/kp, s of √(armature/kp), rad of offset
STILL = 0.01  # rad: commands that differ by less ask nothing of a joint
STANDING = ("kp", "offset", "damping", "frictionloss")  # of a joint that is never moved: how it gives way to others


def first_values(robot: RobotSpec) -> Values:
    """The given robot's own, (n,) each. Damping is the MJCF's: what is below zero is taken from the servo's kd."""
    model, op = build_model(replace(robot, table=None)), robot.operated_index
    dof = np.array([model.joint(j).dofadr[0] for j in robot.operated])
    passive = {f: np.array(getattr(model, f"dof_{f}")[dof]) for f in ("damping", "frictionloss", "armature")}
    return passive | {f: getattr(robot, f)[op] for f in ("kp", "offset", "delay", "effort_limit", *SERVO_TERMS)}


class Bounds:
    """What the parameters of a robot's operated joints may be.

    Attributes:
        first: The given robot's own values.
        start: Where a search starts: a little late, and with as much armature as the physics step resolves.
        spare: kd that may be lacking, (n,) N·m·s/rad: the servos', where no recording states it.
        still: Joints that no recording moves, (n,).
        limits: Field → lowest, highest, a large change, (n,) each, on the search's axes.
        guess: A first value for a field of the law.
    """

    def __init__(self, robot: RobotSpec, sequences: ListOf[Sequence]) -> None:
        op, self.n = robot.operated_index, len(robot.operated)
        model = build_model(replace(robot, table=None))
        dof = np.array([model.joint(j).dofadr[0] for j in robot.operated])
        kp, kd, limit = robot.kp[op], robot.kd[op], robot.effort_limit[op]
        self.first = first_values(robot)
        stated = all(s.meta.known_gains[1] is not None for s in sequences)
        self.stated = all(s.meta.known_gains[0] is not None for s in sequences)
        self.spare = np.zeros(self.n) if stated else kd.copy()
        moved = np.max([np.ptp(s.ctrl[:, op], axis=0) for s in sequences], axis=0)
        self.still = moved < STILL
        resolved = kp * (RESOLVED * model.opt.timestep) ** 2 - (model.dof_M0[dof] - model.dof_armature[dof])
        self.start: Values = {f: self.first[f] for f in CLASSIC} | {
            "delay": np.maximum(self.first["delay"], FIRST_DELAY),
            "armature": np.maximum(np.maximum(self.first["armature"], 1e-6 * kp), resolved),
        }
        self.start |= {f: np.where(self.still, self.first[f], self.start[f]) for f in ("delay", "armature")}
        self.start |= {f: self.first[f] for f in SERVO_TERMS if self.first[f].any()}
        counts = np.array([encoder_step([s.qpos[:, j] for s in sequences]) for j in op])
        one, heavy = np.ones(self.n), np.maximum(self.start["armature"] / kp, 1e-6)
        self.limits: dict[str, tuple[Array, Array, Array]] = {
            "kp": (np.log(kp) - WIDE_KP, np.log(kp) + WIDE_KP, 0.3 * one),
            "damping": (0 * one, SLOW * one, 0.015 * one),
            "frictionloss": (0 * one, 0.2 * one, 0.005 * one),
            "armature": (0 * one, HEAVY**2 * one, np.clip(0.4 * heavy, 1e-5, 1e-3)),
            "offset": (-ZERO * one, ZERO * one, 0.01 * one),
            "delay": (0 * one, MAX_DELAY * one, 0.005 * one),
            "stribeck": (0 * one, 0.1 * one, 0.002 * one),
            "stribeck_speed": (np.log(0.005) * one, 0 * one, 0.3 * one),
            "friction_motor": (0 * one, 0.8 * one, 0.05 * one),
            "friction_external": (0 * one, 0.8 * one, 0.05 * one),
            "min_torque": (0 * one, 0.05 * one, 0.002 * one),
            "effort_limit": (0.05 * limit / kp, 5 * limit / kp, 0.2 * limit / kp),
            "encoder_step": (counts, counts, one),
        }
        self.guess = {"stribeck": 0.003 * kp, "stribeck_speed": 0.05 * one, "friction_motor": 0.05 * one,
                      "friction_external": 0.02 * one, "effort_limit": 0.6 * limit,  # one that is too high is not felt
                      "min_torque": 0.003 * kp, "encoder_step": counts}  # fmt: skip


class Axes:
    """Fields as the search sees them, (…, n, P). Those that are not searched stay, as do those of joints that stand."""

    def __init__(self, bounds: Bounds, fields: ListOf[str], rest: Values) -> None:
        self.names, self.rest, self.spare = list(dict.fromkeys(fields)), rest, bounds.spare
        low, high, self.unit = (np.stack([bounds.limits[f][i] for f in self.names], axis=1) for i in range(3))
        self.low, self.high = low / self.unit, high / self.unit
        here = self._seen(rest)
        held = bounds.still[:, None] & ~np.isin(self.names, STANDING)
        self.low, self.high = np.where(held, here, self.low), np.where(held, here, self.high)

    def of(self, values: Values) -> Array:
        """From values, inside the bounds."""
        return np.clip(self._seen(values), self.low, self.high)

    def _seen(self, values: Values) -> Array:
        kp = values["kp"]
        seen = {f: values[f] + self.spare if f == "damping" else values[f] for f in self.names}
        return (
            np.stack([
                np.log(np.maximum(x, 1e-9)) if f in LOGARITHM else x / kp ** (f in OVER_KP) for f, x in seen.items()
            ], axis=-1) / self.unit
        )  # fmt: skip

    def values(self, x: Array) -> Values:
        """To values; fields that are not searched stay."""
        own = dict(zip(self.names, np.moveaxis(x * self.unit, -1, 0), strict=True))
        found = {f: np.broadcast_to(v, x.shape[:-1]) for f, v in self.rest.items()} | own
        found |= {f: np.exp(own[f]) for f in LOGARITHM if f in own}
        found |= {f: own[f] * found["kp"] for f in OVER_KP if f in own}
        return found | {"damping": found["damping"] - self.spare} if "damping" in own else found
