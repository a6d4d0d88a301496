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
from gaponet.deploy.feedback import LowPass
from gaponet.deploy.payload import PayloadFields
from gaponet.deploy.transfer import Transfer, require_measured_range
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import BatchSim, Condition
from gaponet.sim.inverse import AnalyticInverse


class Follower:
    """Targets of num policies → commands of num robots, and what these policies are to see.

    Attributes:
        deviation: Slow part of what distinguishes the robots from their identified simulators,
            (num, n operated) rad.
    """

    def __init__(
        self,
        robot: RobotSpec,
        loads: list[Condition],
        locked: tuple[str, ...],
        deviation: LowPass,
        extrapolate: bool = False,
    ) -> None:
        """
        Args:
            robot: The identified robot, which knows its nominal one.
            loads: Control period, and the payloads that a robot can carry; it starts with the
                first.
            locked: Joints that are clamped at home.
            deviation: Low-pass for `observe`, with one row for each robot.
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
        conditions = [loads[0]] * len(deviation.value)
        plant = BatchSim(robot, conditions, 1, locked)
        inverse = AnalyticInverse.of(plant)
        self._transfer = Transfer(nominal, inverse, conditions, locked, 1, extrapolate=True)
        self._nominal = self._transfer.sim
        if not extrapolate:
            require_measured_range(inverse, AnalyticInverse.of(self._nominal), plant.joint_names)
        self._carried = [PayloadFields(sim, loads, locked) for sim in (plant, self._nominal)]
        self._operated = np.array([plant.joint_names.index(name) for name in robot.operated])
        self.deviation = deviation

    @property
    def saturated(self) -> Array:
        """Operated joints whose motors cannot give the torque of the nominal motion, (num, n)."""
        saturated: Array = self._transfer.inverse.saturated[:, self._operated]
        return saturated

    def carry(self, mass: Array) -> None:
        """Let each robot carry one of the loads, (num,) indices."""
        for fields in self._carried:
            fields.carry(mass)

    def reset(self, target: Array, periods: int) -> None:
        """Let the nominal simulators come to rest in some control periods.

        target: Of the joints that are not locked, (num, n_free) rad.
        """
        self._transfer.reset(slice(None), target, np.zeros_like(target), past=target[:, None])
        for _ in range(periods):
            self._nominal.step(target)
        self.deviation.reset()

    def command(self, target: Array) -> Array:
        """Return the commands of the coming control period. Call this once per period.

        Args:
            target: Of the joints that are not locked, (num, n_free) rad.

        Returns:
            Of the operated joints, (num, n) rad.
        """
        inverse = self._transfer.inverse
        period = self._transfer.step_reference(target)
        travel = period.next_qpos - period.qpos  # rad, in the period
        ahead = inverse.servos.delay / inverse.steps.dt * travel
        moved = replace(period, qpos=period.qpos + ahead, next_qpos=period.next_qpos + ahead)
        commands: Array = inverse.targets_in_force(moved)[:, self._operated]
        return commands

    def observe(self, deviation: Array | None) -> tuple[Array, Array]:
        """Return the positions, rad, and velocities, rad/s, that policies are to see.

        They are the nominal simulators', plus the slow part of the deviation.

        Args:
            deviation: Measured positions less those of the identified simulators, (num, n) rad, of
                the operated joints; None if nothing new was measured.
        """
        if deviation is not None:
            self.deviation.update(deviation, np.isfinite(deviation).all(axis=1))
        qpos = self._nominal.qpos[:, self._operated] + self.deviation.value
        qvel = self._nominal.qvel[:, self._operated]
        return qpos, qvel
