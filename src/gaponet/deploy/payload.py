"""The mass in the hands of robots, and the simulators and networks that must carry it too."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from typing import Protocol

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.deploy.payload_estimate import PayloadEstimate
from gaponet.sim.batch import BatchSim, Condition, differing_fields
from gaponet.sim.model import build_model


class Carrier(Protocol):
    """Something of num robots that depends on their payload."""

    def carry(self, mass: Array) -> None:
        """Let each robot carry one of the possible masses, (num,) indices."""


class PayloadFields:
    """Values of the model fields that depend on the payload, for each possible mass."""

    def __init__(self, sim: BatchSim, loads: list[Condition], locked: tuple[str, ...]) -> None:
        """
        Args:
            sim: Simulations that carry one of the loads each.
            loads: Their condition with each of the masses.
            locked: Joints that are clamped at home in `sim`.
        """
        models = []
        for load in loads:
            model = build_model(
                sim.robot, load.payload_mass, load.payload_side, load.dt, locked, physics_only=True
            )
            models.append(model)
        self._values = differing_fields(models)  # (masses, …)
        self._fields = {name: sim.batch.expand(name) for name in self._values}  # (simulations, …)

    def carry(self, mass: Array) -> None:
        """Let each simulation carry one of the masses, (simulations,) indices."""
        for name, field in self._fields.items():
            field[:] = self._values[name][mass]


class Payload:
    """The mass in each hand of num robots, stated or estimated.

    Attributes:
        masses: Those that can be carried, (k,) kg. Of a stated or estimated mass, the nearest one
            is carried.
        mass: Of each robot, (num,) kg, as stated or estimated.
        stated: Whether it was stated, or can only be zero.
        estimate: From the torques of the same robots.
        compared: Whether a stated mass is compared with the torques of the first robot.
    """

    def __init__(
        self,
        masses: Array,
        max_stated: float | None,
        num: int,
        carriers: ListOf[Carrier],
        estimate: PayloadEstimate,
        compared: bool,
    ) -> None:
        """
        Args:
            masses: Those that can be carried, (k,) kg.
            max_stated: Largest mass that `require` accepts, kg; None: the robot has no place for
                any.
            num: Number of robots.
            carriers: Everything that depends on the mass.
            estimate: From the torques of the same robots.
            compared: Whether a stated mass is compared with the torques of the first robot.
        """
        self.masses = masses
        self.mass = np.zeros(num)
        self.stated = False
        self.estimate = estimate
        self._max_stated = max_stated
        self._carriers = carriers
        self._carried = np.full(num, -1)  # index of the mass that is carried for each robot
        self.compared = compared and len(masses) > 1

    def require(self, mass: Array | float) -> None:
        """Refuse masses, kg, that are not physical or too large."""
        given = np.asarray(mass, float)
        if self._max_stated is None:
            if (given != 0).any():
                raise UsageError(
                    f"payload_mass is {mass}, and the robot has no [[payload_mount]]; add one to "
                    "robot.toml, or give 0"
                )
            return
        if not ((given >= 0) & (given <= self._max_stated)).all():
            raise UsageError(
                f"payload_mass is {mass}; give kg, 0 when empty, up to {self._max_stated:g}, or "
                "raise payload_max (--compensation.payload-max)"
            )

    def reset(self, mass: Array | float | None) -> None:
        """Start with a stated mass, kg, one number or (num,); None to estimate it, from 0 on."""
        self.stated = mass is not None or len(self.masses) == 1
        self.estimate.reset()
        self._set(0.0 if mass is None else mass)

    def state(self, mass: Array | float) -> None:
        """State the mass, kg, one number or (num,); it is no longer estimated.

        The torques so far were those of another mass, and do not contradict this one.
        """
        self.stated = True
        self.estimate.reset()
        self._set(mass)

    def _set(self, mass: Array | float) -> None:
        self.mass = np.array(np.broadcast_to(np.asarray(mass, float), self.mass.shape))
        self._carry_nearest()

    def observe(
        self, qpos: Array, qvel: Array, command: Array, tau: Array | None, valid: Array
    ) -> None:
        """Estimate the mass, or compare the stated one; arguments as of PayloadEstimate."""
        if self.stated and not self.compared:
            return
        self.estimate.observe(qpos, qvel, command, tau, valid)
        if not self.stated:
            self.mass = self.estimate.update()
            self._carry_nearest()

    @property
    def contradiction(self) -> str:
        """Message if torques are those of another mass than stated; else ""."""
        if self.stated and self.compared:
            return self.estimate.contradiction(float(self.mass[0]))
        return ""

    def _carry_nearest(self) -> None:
        nearest = np.abs(self.mass[:, None] - self.masses).argmin(axis=1)
        if (nearest != self._carried).any():
            for carrier in self._carriers:
                carrier.carry(nearest)
            self._carried = nearest
