"""AlignedSim: the simulator that behaves like the robot. A target becomes target + Δa on its way to the servos."""

from __future__ import annotations

import numpy as np

from gaponet.arrays import Array
from gaponet.errors import UsageError
from gaponet.model.artifact import GapModel
from gaponet.robot import RobotSpec
from gaponet.sim.batch import BatchSim, Condition


class AlignedSim:
    """num_envs aligned simulations, one control period per step; the same as sim.replay with the model's corrector.

        sim = AlignedSim(load_robot("h1_2"), GapModel.load("run"), payload_mass=3.0)
        sim.reset(qpos)
        sim.step(target)          # for one control period
        sim.qpos, sim.qvel

    Arrays are (num_envs, n) in the order of `joint_names`; without num_envs there is one simulation and they are (n,).
    """

    def __init__(
        self,
        robot: RobotSpec,
        model: GapModel | None,
        payload_mass: Array | float = 0.0,
        payload_side: str = "both",
        dt: float | None = None,
        num_envs: int | None = None,
        nthread: int = 0,
        locked: tuple[str, ...] = (),
        extrapolate: bool = False,
    ) -> None:
        """Refuse a robot, simulator, gains, joints, rate or payload that the model was not trained on.

        Args:
            robot: The simulator that the model corrects: the package's robot, or RUN/robot after an identification.
            model: What training made; None for the nominal simulator behind the same calls.
            payload_mass: kg in each hand of payload_side, one number or one per simulation.
            payload_side: "both", or the side of one mount.
            dt: Control period, s; default the robot's.
            num_envs: Simulations side by side; None for one, with arrays (n,).
            nthread: Threads, 0 for all cores.
            locked: Joints clamped at home (sim.model.idle_joints): quicker; arrays are without them.
            extrapolate: Take payloads beyond those trained on.
        """
        self.dt = robot.dt if dt is None else dt
        if model is not None:
            model.require(robot, self.dt)
            model.require_payload(payload_mass, extrapolate)
        self.robot, self.model, self.single = robot, model, num_envs is None
        self.num_envs = 1 if num_envs is None else num_envs
        self.payload_mass = np.array(np.broadcast_to(np.asarray(payload_mass, float), self.num_envs))
        conditions = [Condition(float(mass), payload_side, self.dt) for mass in self.payload_mass]
        self.sim = BatchSim(robot, conditions, nthread, locked)
        self.joint_names, self.n = self.sim.joint_names, self.sim.n
        free = robot.index(self.joint_names)
        self.qpos_home, self.qpos_range = robot.qpos_home[free], self.sim.range
        missing = [name for name in robot.operated if name in locked]
        if missing:
            raise UsageError(f"joint '{missing[0]}' is corrected by the model and cannot be locked")
        self.op = np.array([self.joint_names.index(name) for name in robot.operated])
        self.loop = None if model is None else model.loop(self.num_envs)
        self._depth = 1 + int(np.ceil(robot.delay.max() / self.dt))
        self.target = np.zeros((self.num_envs, self.n))
        self.reset()

    @property
    def qpos(self) -> Array:
        """Joint positions, rad; a live view: a write is the state at the next step."""
        return self.sim.qpos[0] if self.single else self.sim.qpos

    @property
    def qvel(self) -> Array:
        """Joint velocities, rad/s; a live view."""
        return self.sim.qvel[0] if self.single else self.sim.qvel

    @property
    def delta(self) -> Array:
        """Correction of the last step, of the operated joints, rad."""
        delta = self.target[:, self.op] - self._asked
        return delta[0] if self.single else delta

    def reset(
        self,
        qpos: Array | None = None,
        qvel: Array | float = 0.0,
        ctrl: Array | None = None,
        ids: Array | slice = slice(None),
    ) -> None:
        """Start the simulations, or some of them, in a new state.

        Args:
            qpos: Positions, rad; default home.
            qvel: Velocities, rad/s.
            ctrl: Target in force before, rad, which late servos (robot.delay) still follow; default qpos.
            ids: Which simulations, (k,); arrays are then (k, n).
        """
        count = len(np.arange(self.num_envs)[ids])
        q = np.broadcast_to(self.qpos_home if qpos is None else np.asarray(qpos, float), (count, self.n))
        v = np.broadcast_to(np.asarray(qvel, float), (count, self.n))
        u = q if ctrl is None else np.broadcast_to(np.asarray(ctrl, float), (count, self.n))
        self.sim.reset(ids, q, v, past=np.repeat(u[:, None], self._depth, axis=1))
        if self.loop is not None:
            self.loop.reset(ids)
        self.target[ids] = u
        self._asked = self.target[:, self.op]

    def step(self, ctrl: Array) -> None:
        """Step one control period under targets `ctrl`, rad, which the model corrects."""
        sim, op, target = self.sim, self.op, self.target
        target[:] = ctrl
        self._asked = target[:, op]
        if self.loop is not None:
            self.loop.delta(sim.qpos[:, op], sim.qvel[:, op], self._asked, self.payload_mass)
            target[:, op] = self.loop.applied
        sim.step(target)
