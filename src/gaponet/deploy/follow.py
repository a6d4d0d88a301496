"""Follow the nominal simulator: commands under which the robot moves as its nominal simulator does.

A policy that was trained in the nominal simulator then runs on the robot as it is. The nominal
simulator runs beside the robot, under the targets of the policy. The command is the inverse
dynamics of the identified robot along that motion, and the robot's own servos hold it there.

The measured state is not used, so following adds no loop that could become unstable. Where servos
are late, the nominal motion is moved ahead by their delay at its present speed. What a delay still
costs is half the acceleration times its square, 1 mrad at 5 rad/s² and 20 ms. (Simulating the
nominal robot ahead under the present target is worse: it brakes for a target that will have moved
on.)
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.deploy.payload import PayloadFields
from gaponet.deploy.transfer import Transfer, require_measured_range
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import BatchSim, Condition
from gaponet.sim.inverse import AnalyticInverse


class Follower:
    """Targets of num policies → commands of num robots.

    Arrays are (num, n), of the joints that are not locked.
    """

    def __init__(
        self,
        robot: RobotSpec,
        condition: Condition,
        masses: Array,
        num: int,
        locked: tuple[str, ...],
        extrapolate: bool = False,
    ) -> None:
        """
        Args:
            robot: The identified robot, which knows its nominal one.
            condition: Control period, and the hands that carry a payload; its mass is not used.
            masses: Payloads that a robot can carry, kg; it starts with the first.
            num: Number of robots.
            locked: Joints that are clamped at home.
            extrapolate: Accept a robot outside the ranges in which transfer was measured.

        Raises:
            UsageError: The robot is not identified, so there is nothing to follow.
            ModelError: The robot is outside the measured ranges.
        """
        nominal = robot.nominal
        if nominal is None:
            raise UsageError(
                f"{robot.folder} is not identified: it would follow itself. Give the robot folder "
                "of gaponet identify (--robot)"
            )
        conditions = [condition._replace(payload_mass=float(masses[0]))] * num
        plant = BatchSim(robot, conditions, 1, locked)
        inverse = AnalyticInverse.of(plant)
        self._transfer = Transfer(nominal, inverse, conditions, locked, 1, extrapolate=True)
        self._nominal = self._transfer.sim
        if not extrapolate:
            require_measured_range(inverse, AnalyticInverse.of(self._nominal), plant.joint_names)
        loads = [condition._replace(payload_mass=float(mass)) for mass in masses]
        self._carried = [PayloadFields(sim, loads, locked) for sim in (plant, self._nominal)]

    @property
    def saturated(self) -> Array:
        """Joints whose motors cannot give the torque of the nominal motion, (num, n)."""
        return self._transfer.inverse.saturated

    @property
    def qpos(self) -> Array:
        """Positions of the nominal simulators, rad; live."""
        return self._nominal.qpos

    @property
    def qvel(self) -> Array:
        """Velocities of the nominal simulators, rad/s; live."""
        return self._nominal.qvel

    def carry(self, simulations: Array, mass: Array) -> None:
        """Let robots, (k,) indices, carry masses, (k,) indices."""
        for fields in self._carried:
            fields.carry(simulations, mass)

    def reset(self, target: Array, periods: int) -> None:
        """Let the nominal simulators come to rest under targets, rad, in some control periods."""
        self._transfer.reset(slice(None), target, np.zeros_like(target), past=target[:, None])
        for _ in range(periods):
            self._nominal.step(target)

    def command(self, target: Array) -> Array:
        """Return the commands of the coming control period, rad. Call this once per period."""
        inverse = self._transfer.inverse
        period = self._transfer.step_reference(target)
        way = period.next_qpos - period.qpos
        ahead = inverse.delay / inverse.dt * way
        moved = replace(period, qpos=period.qpos + ahead, next_qpos=period.next_qpos + ahead)
        return inverse.targets_in_force(moved)
