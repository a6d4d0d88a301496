"""AlignedSim: a simulator that behaves like the robot.

An identified robot needs no model for that. With a model, a target becomes target + Δa before it
reaches the servos. In the simulator of training, Δa is the model's correction. In another
simulator, commands are transferred so that it moves like the corrected one (deploy/transfer.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import ModelError, UsageError
from gaponet.deploy.transfer import Reference, Transfer, control_periods_of, own_context
from gaponet.nn.artifact import GapModel
from gaponet.nn.loop import DeltaLoop
from gaponet.robot.spec import RobotSpec, as_robot
from gaponet.sim.batch import BatchSim, Condition
from gaponet.sim.inverse import AnalyticInverse


@dataclass(frozen=True, kw_only=True)
class AlignedSimOptions:
    """Settings of an AlignedSim that few programs change."""

    payload_side: str = "both"
    """Hands that carry the payload: "both", or the side of one mount."""
    simulator_payload: Array | float | None = None
    """kg that the simulator has in its hands, where it does not know of payload_mass."""
    locked: tuple[str, ...] = ()
    """Joints clamped at home (sim.model.idle_joints): quicker; arrays are without them."""
    nthread: int = 0
    """Threads, 0 for all cores."""


class AlignedSim:
    """num_envs aligned simulations, one control period per step.

    It equals sim.replay with the model's corrector.

        model = GapModel.load("run")  # if a model helps
        sim = AlignedSim(load_robot("./my_h1_2"), model, payload_mass=3.0)
        sim.reset(qpos)
        sim.step(target)  # for one control period
        print(sim.qpos, sim.qvel)

    Arrays are (num_envs, n) in the order of `joint_names`; without num_envs there is one simulation
    and they are (n,).
    """

    def __init__(
        self,
        robot: RobotSpec | str | Path,
        model: Reference | None = None,
        payload_mass: Array | float = 0.0,
        *,
        dt: float | None = None,
        num_envs: int | None = None,
        extrapolate: bool = False,
        options: AlignedSimOptions = AlignedSimOptions(),
    ) -> None:
        """
        Args:
            robot: The simulator, or what `load_robot` takes. If the model was trained in another
                one, commands are transferred; where that is refused, a model for many simulators
                is told this one's answers to fixed probes (`transfer` is None).
            model: A trained model, or an identified robot that the simulator then moves like; None
                for the simulator without correction.
            payload_mass: Payload in each hand of options.payload_side, kg; one number, or one per
                simulation.
            dt: Control period, s. Default: the robot's.
            num_envs: Simulations side by side; None for one, with arrays (n,).
            extrapolate: Take payloads beyond those trained on, and simulators beyond those
                measured.
            options: The side of the payload, locked joints and threads.

        Raises:
            ModelError: The robot, the control period or the payload does not fit the model.
            UsageError: A joint that the model corrects is locked.
        """
        robot = as_robot(robot)
        if isinstance(model, GapModel):
            model.require_payload(payload_mass, extrapolate)
        for name in robot.operated:
            if name in options.locked:
                raise UsageError(f"joint '{name}' is corrected by the model and cannot be locked")
        self.robot = robot
        self.dt = robot.dt if dt is None else dt
        self.single = num_envs is None
        self.num_envs = 1 if num_envs is None else num_envs
        self.payload_mass = np.array(np.broadcast_to(payload_mass, self.num_envs), float)
        stated = self._conditions(self.payload_mass, options.payload_side)
        carried = stated
        if options.simulator_payload is not None:
            held = np.broadcast_to(options.simulator_payload, self.num_envs)
            carried = self._conditions(held, options.payload_side)
        self.sim = BatchSim(robot, carried, options.nthread, options.locked)
        self.joint_names = self.sim.joint_names
        self.op = np.array([self.joint_names.index(name) for name in robot.operated])
        self.loop: DeltaLoop | None = None
        self.transfer: Transfer | None = None
        if model is not None:
            self._correct_with(model, stated, carried, extrapolate, options)
        self.target = np.zeros(self.sim.qpos.shape)
        self._uncorrected = self.target[:, self.op]
        self.reset()

    def _conditions(self, payload_mass: Array, side: str) -> list[Condition]:
        """Return the condition of each simulation; payload_mass (num_envs,), kg."""
        return [Condition(float(mass), side, self.dt) for mass in payload_mass]

    def _correct_with(
        self,
        model: Reference,
        stated: list[Condition],
        carried: list[Condition],
        extrapolate: bool,
        options: AlignedSimOptions,
    ) -> None:
        """Use a network directly in the simulator of its training; elsewhere transfer commands.

        Args:
            model: A network with its simulator, or a simulator.
            stated: Conditions of the robot that the simulations are to move like.
            carried: Conditions of the simulations.
            extrapolate, options: As in `__init__`.
        """
        robot = self.robot
        nthread = options.nthread
        locked = options.locked
        # With another payload than stated, this is not the simulator of training.
        network = model if isinstance(model, GapModel) and carried is stated else None
        if network is not None and network.is_trained_in(robot) and self._has_rate_of(network):
            self.loop = network.loop(self.num_envs, own_context(network, robot, stated))
            return
        inverse = AnalyticInverse.of(BatchSim(robot, carried, nthread, locked))
        try:
            self.transfer = Transfer(model, inverse, stated, locked, nthread, extrapolate)
        except ModelError:
            if network is None or not network.knows(robot, self.dt):
                raise
            if not self._has_rate_of(network):
                raise
            self.loop = network.loop(self.num_envs, network.contexts_of(robot, carried))

    def _has_rate_of(self, network: GapModel) -> bool:
        """Return true if the control period is that of the network's training."""
        return control_periods_of(network, self.dt) == 1

    @property
    def qpos_home(self) -> Array:
        """Home position of `joint_names`, (n,) rad."""
        home: Array = self.robot.qpos_home[self.robot.index(self.joint_names)]
        return home

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
            ctrl: Target in force before, rad, which delayed servos (robot.servo.delay) still
                follow; default qpos.
            ids: Which simulations, (k,); arrays are then (k, n).
        """
        if qpos is None:
            qpos = self.qpos_home
        shape = self.target[ids].shape
        q = np.broadcast_to(np.asarray(qpos, float), shape)
        v = np.broadcast_to(np.asarray(qvel, float), shape)
        u = q if ctrl is None else np.broadcast_to(np.asarray(ctrl, float), shape)
        past = u[:, None]  # delayed servos hold the oldest target that is given
        self.sim.reset(ids, q, v, past=past)
        if self.loop is not None:
            self.loop.reset(ids)
        if self.transfer is not None:
            self.transfer.reset(ids, q, v, past)
        self.target[ids] = u
        self._uncorrected[ids] = self.target[ids][:, self.op]

    def step(self, ctrl: Array) -> None:
        """Step one control period with targets `ctrl`, rad, which the model corrects.

        Raises:
            UsageError: A target is not finite, or the number of joints is another one.
        """
        sim = self.sim
        op = self.op
        target = self.target
        _require_targets(ctrl, self.joint_names)
        target[:] = ctrl
        self._uncorrected = target[:, op]
        if self.loop is not None:
            self.loop.delta(sim.qpos[:, op], sim.qvel[:, op], self._uncorrected, self.payload_mass)
            target[:, op] = self.loop.applied
        if self.transfer is not None:
            target[:] = self.transfer.command(sim.qpos, sim.qvel, target)
        sim.step(target)


def _require_targets(ctrl: Array, joint_names: tuple[str, ...]) -> None:
    """Refuse targets that are no row of one finite number for each joint."""
    ctrl = np.asarray(ctrl, float)
    if ctrl.shape[-1:] != (len(joint_names),):
        raise UsageError(
            f"AlignedSim.step: targets have shape {ctrl.shape}; give {len(joint_names)} in a row, "
            f"rad: {', '.join(joint_names)}"
        )
    if not np.isfinite(ctrl).all():
        bad = np.flatnonzero(~np.isfinite(ctrl).reshape(-1, len(joint_names)).all(axis=0))
        raise UsageError(f"AlignedSim.step: the target of {joint_names[bad[0]]} is not finite")
