"""AlignedSim: a simulator that behaves like the robot.

An identified robot needs no model for that. With a model, a target becomes target + Δa before it
reaches the servos. In the simulator of training, Δa is the model's correction. In another
simulator, commands are transferred so that it moves like the corrected one (deploy/transfer.py).
"""

from __future__ import annotations

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import ModelError, UsageError
from gaponet.deploy.transfer import Reference, Transfer, control_periods_of, own_context
from gaponet.nn.artifact import GapModel
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import BatchSim, Condition
from gaponet.sim.inverse import AnalyticInverse


class AlignedSim:
    """num_envs aligned simulations, one control period per step.

    It equals sim.replay with the model's corrector.

        sim = AlignedSim(load_robot("./my_h1_2"), payload_mass=3.0)  # and GapModel.load("run"), if
        a model helps sim.reset(qpos) sim.step(target)          # for one control period sim.qpos,
        sim.qvel

    Arrays are (num_envs, n) in the order of `joint_names`; without num_envs there is one simulation
    and they are (n,).
    """

    def __init__(
        self,
        robot: RobotSpec,
        model: Reference | None = None,
        payload_mass: Array | float = 0.0,
        payload_side: str = "both",
        dt: float | None = None,
        num_envs: int | None = None,
        nthread: int = 0,
        locked: tuple[str, ...] = (),
        extrapolate: bool = False,
        simulator_payload: Array | float | None = None,
    ) -> None:
        """
        Args:
            robot: The simulator. If the model was trained in another one, commands are transferred;
                where that is refused, a model for many simulators is told this one's answers to
                fixed probes (`transfer` is None).
            model: A trained model, or an identified robot that the simulator then moves like; None
                for the simulator without correction.
            payload_mass: kg in each hand of payload_side, one number or one per simulation.
            payload_side: "both", or the side of one mount.
            dt: Control period, s; default the robot's.
            num_envs: Simulations side by side; None for one, with arrays (n,).
            nthread: Threads, 0 for all cores.
            locked: Joints clamped at home (sim.model.idle_joints): quicker; arrays are without
                them.
            extrapolate: Take payloads beyond those trained on, and simulators beyond those
                measured.
            simulator_payload: kg that the simulator has in its hands, where it does not know of
                payload_mass.
        """
        self.dt = robot.dt if dt is None else dt
        if isinstance(model, GapModel):
            model.require_payload(payload_mass, extrapolate)
        self.robot = robot
        self.model = model
        self.single = num_envs is None
        self.num_envs = 1 if num_envs is None else num_envs
        self.payload_mass = np.array(
            np.broadcast_to(np.asarray(payload_mass, float), self.num_envs)
        )
        conditions = [Condition(float(mass), payload_side, self.dt) for mass in self.payload_mass]
        own = conditions
        other_payload = simulator_payload is not None
        if other_payload:
            masses = np.broadcast_to(np.asarray(simulator_payload, float), self.num_envs)
            own = [
                c._replace(payload_mass=float(m)) for c, m in zip(conditions, masses, strict=True)
            ]
        self.sim = BatchSim(robot, own, nthread, locked)
        self.joint_names = self.sim.joint_names
        self.n = self.sim.n
        free = robot.index(self.joint_names)
        self.qpos_home = robot.qpos_home[free]
        self.qpos_range = self.sim.range
        missing = [name for name in robot.operated if name in locked]
        if missing:
            raise UsageError(f"joint '{missing[0]}' is corrected by the model and cannot be locked")
        self.op = np.array([self.joint_names.index(name) for name in robot.operated])
        self.loop = None
        self.transfer = None
        trained = model if isinstance(model, GapModel) and not other_payload else None
        if (
            trained is not None
            and trained.is_trained_in(robot)
            and control_periods_of(trained, self.dt) == 1
        ):
            self.loop = trained.loop(self.num_envs, own_context(trained, robot, conditions))
        elif model is not None:
            inverse = AnalyticInverse.of(BatchSim(robot, own, nthread, locked))
            try:
                self.transfer = Transfer(model, inverse, conditions, locked, nthread, extrapolate)
            except ModelError:
                if trained is None or not trained.knows(robot, self.dt):
                    raise
                if control_periods_of(trained, self.dt) != 1:
                    raise
                self.loop = trained.loop(self.num_envs, trained.contexts_of(robot, own))
        self.target = np.zeros((self.num_envs, self.n))
        self._uncorrected = self.target[:, self.op]
        self.reset()

    @property
    def qpos(self) -> Array:
        """Joint positions, rad; a view: writing to it changes the state of the simulation."""
        return self.sim.qpos[0] if self.single else self.sim.qpos

    @property
    def qvel(self) -> Array:
        """Joint velocities, rad/s; a view."""
        return self.sim.qvel[0] if self.single else self.sim.qvel

    @property
    def delta(self) -> Array:
        """Correction of the last step, of the operated joints, rad."""
        delta = self.target[:, self.op] - self._uncorrected
        return delta[0] if self.single else delta

    def reset(
        self,
        qpos: Array | None = None,
        qvel: Array | float = 0.0,
        ctrl: Array | None = None,
        ids: Array | slice = slice(None),
    ) -> None:
        """Reset simulations to a state.

        Args:
            qpos: Positions, rad; default home.
            qvel: Velocities, rad/s.
            ctrl: Target in force before, rad, which delayed servos (robot.delay) still follow;
                default qpos.
            ids: Which simulations, (k,); arrays are then (k, n).
        """
        count = len(np.arange(self.num_envs)[ids])
        q = np.broadcast_to(
            self.qpos_home if qpos is None else np.asarray(qpos, float), (count, self.n)
        )
        v = np.broadcast_to(np.asarray(qvel, float), (count, self.n))
        u = q if ctrl is None else np.broadcast_to(np.asarray(ctrl, float), (count, self.n))
        past = u[:, None]  # delayed servos hold the oldest target that is given
        self.sim.reset(ids, q, v, past=past)
        if self.loop is not None:
            self.loop.reset(ids)
        if self.transfer is not None:
            self.transfer.reset(ids, q, v, past)
        self.target[ids] = u
        self._uncorrected = self.target[:, self.op]

    def step(self, ctrl: Array) -> None:
        """Step one control period with targets `ctrl`, rad, which the model corrects."""
        sim = self.sim
        op = self.op
        target = self.target
        target[:] = ctrl
        self._uncorrected = target[:, op]
        if self.loop is not None:
            self.loop.delta(sim.qpos[:, op], sim.qvel[:, op], self._uncorrected, self.payload_mass)
            target[:, op] = self.loop.applied
        if self.transfer is not None:
            target[:] = self.transfer.command(sim.qpos, sim.qvel, target)
        sim.step(target)
