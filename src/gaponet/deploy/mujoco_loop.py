"""Alignment of a user's MuJoCo loop: correct ctrl before mj_step."""

from __future__ import annotations

import copy

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import ModelError
from gaponet.deploy.transfer import Reference, Transfer, control_periods_of, own_context
from gaponet.nn.artifact import GapModel
from gaponet.nn.loop import DeltaLoop
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import Batch, BatchSim, Condition
from gaponet.sim.commands import ControlPeriods
from gaponet.sim.context import scene_context
from gaponet.sim.inverse import AnalyticInverse
from gaponet.sim.model import driven_joints


class MujocoAligner:
    """ctrl → ctrl + Δa in a scene with a position actuator on each operated joint.

    One object per MjData.

        model = load_robot("./my_h1_2")  # or GapModel.load("run")
        align = MujocoAligner(model, mj_model, dt=0.02, payload_mass=3.0)
        data.ctrl[:] = align(data, target)  # once per control period
        mujoco.mj_step(mj_model, data, round(0.02 / mj_model.opt.timestep))

    If the robot of the scene differs from the identified one or from the simulator of training,
    commands are transferred (deploy/transfer.py): other gains, friction, inertias, actuators, or a
    payload that the scene does not have. The base and the rest of the scene have their present
    state in each period.

    Where commands cannot be transferred, a network for many simulators measures the scene's answers
    to fixed probes (sim/context.py), and corrects the scene directly if they lie within those of
    its training.
    """

    def __init__(
        self,
        model: Reference,
        mj_model: mujoco.MjModel,
        *,
        dt: float,
        payload_mass: float,
        prefix: str = "",
        extrapolate: bool = False,
    ) -> None:
        """
        Args:
            model: The identified robot that the scene is to move like, or a trained model with its
                simulator.
            mj_model: The compiled scene.
            dt: Control period, s.
            payload_mass: kg in each hand of the robot that the scene is to move like.
            prefix: Prefix of the robot's names in the scene ("left/").
            extrapolate: Accept a payload outside the training data, and a scene outside the
                measured ranges.

        Raises:
            ModelError: The scene, the control period or the payload does not fit.
        """
        robot = model.simulator() if isinstance(model, GapModel) else model
        _require_joints(mj_model, robot, model, prefix)
        if isinstance(model, GapModel):
            model.require_payload(payload_mass, extrapolate)
        may_agree = _may_agree(model, dt)
        condition = Condition(payload_mass, "both", dt)
        locked = _undriven(mj_model, robot, prefix)
        reference = BatchSim(robot, [condition], 1, locked)
        inverse = _of_scene(mj_model, tuple(prefix + name for name in reference.joint_names), dt)
        self.payload_mass = payload_mass
        self.loop: DeltaLoop | None = None
        self.transfer: Transfer | None = None
        of_reference = AnalyticInverse.of(reference)
        agrees = may_agree and inverse.agrees_with(of_reference, reference.commands.range)
        if agrees and isinstance(model, GapModel):
            self.loop = model.loop(context=own_context(model, robot, [condition]))
        if not agrees:
            try:
                self.transfer = Transfer(model, inverse, [condition], locked, 1, extrapolate)
            except ModelError:
                self.loop = _loop_of_known_scene(model, mj_model, robot, dt, prefix)
                if self.loop is None:
                    raise
        # Without loop and transfer, the scene moves like the robot already.
        joints = reference.joint_names if self.loop is None else robot.operated
        names = [prefix + name for name in joints]
        self.qpos, self.qvel, self.actuator = _addresses(mj_model, names)
        self._fresh = True

    def reset(self) -> None:
        """Delete the history before another motion starts."""
        self._fresh = True

    def __call__(self, data: mujoco.MjData, ctrl: Array) -> Array:
        """Return corrected targets, (nu,) rad. Call this once per control period."""
        out = np.array(ctrl, float)
        # (1, n): loop and transfer have a row for each robot
        q = data.qpos[None, self.qpos]
        v = data.qvel[None, self.qvel]
        a = out[None, self.actuator]
        if self.loop is not None:
            if self._fresh:
                self.loop.reset()
            self.loop.delta(q, v, a, self.payload_mass)
            out[self.actuator] = self.loop.applied[0]
        elif self.transfer is not None:
            if self._fresh:
                self.transfer.reset(slice(None), q, v, a[:, None])
            self.transfer.inverse.dynamics.set_state(data)
            out[self.actuator] = self.transfer.command(q, v, a)[0]
        self._fresh = False
        return out


def _require_joints(scene: mujoco.MjModel, robot: RobotSpec, model: Reference, prefix: str) -> None:
    """Refuse a scene that lacks an operated joint or its actuator."""
    source = model.path if isinstance(model, GapModel) else model.folder
    joints = [scene.joint(j).name for j in range(scene.njnt)]
    for name in robot.operated:
        if prefix + name not in joints:
            raise ModelError(
                f"{source}: moves joint '{prefix + name}', the scene has {', '.join(joints)}; give "
                "prefix"
            )
    for name in robot.operated:
        if name in _undriven(scene, robot, prefix):
            raise ModelError(
                f"{source}: moves joint '{prefix + name}', which has no actuator in the scene; "
                "give each operated joint a position actuator"
            )


def _may_agree(model: Reference, dt: float) -> bool:
    """Return true if no transfer is needed where the inverse of scene and simulator agree.

    A network must run in each control period. The simulator must have no servo model: plain MuJoCo
    lacks it, and inverse dynamics do not show all of it, such as backlash.
    """
    if isinstance(model, GapModel):
        if control_periods_of(model, dt) != 1:
            return False
        return not model.simulator().servo.has_terms
    return not model.servo.has_terms


def _undriven(scene: mujoco.MjModel, robot: RobotSpec, prefix: str) -> tuple[str, ...]:
    """Return the robot's joints without an actuator in the scene."""
    driven = {scene.joint(j).name for j in driven_joints(scene) if j >= 0}
    return tuple(name for name in robot.joint_names if prefix + name not in driven)


def _loop_of_known_scene(
    model: Reference, scene: mujoco.MjModel, robot: RobotSpec, dt: float, prefix: str
) -> DeltaLoop | None:
    """Return the network's loop if the scene answers fixed probes as simulators of training did."""
    if not isinstance(model, GapModel) or control_periods_of(model, dt) != 1:
        return None
    known = model.known_simulators
    if known is None:
        return None
    context = scene_context(scene, robot, dt, prefix)
    return model.loop(context=context) if known.include(context) else None


def _of_scene(scene: mujoco.MjModel, joints: tuple[str, ...], dt: float) -> AnalyticInverse:
    """Return the inverse dynamics of a robot in a scene, without contacts."""
    model = copy.copy(scene)
    h = scene.opt.timestep
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    periods = ControlPeriods(np.array([round(dt / h)]), np.array([h]))
    return AnalyticInverse(Batch(model, nsim=1, nthread=1), model, joints, periods)


def _addresses(scene: mujoco.MjModel, joints: list[str]) -> tuple[Array, Array, Array]:
    """Return the indices of joints in qpos, qvel and ctrl, each (n)."""
    qpos = [scene.joint(name).qposadr[0] for name in joints]
    qvel = [scene.joint(name).dofadr[0] for name in joints]
    ctrl = [_actuator(scene, name) for name in joints]
    return np.array(qpos), np.array(qvel), np.array(ctrl)


def _actuator(scene: mujoco.MjModel, joint: str) -> int:
    actuators = np.flatnonzero(driven_joints(scene) == scene.joint(joint).id)
    if len(actuators) != 1:
        raise ModelError(
            f"joint '{joint}' has {len(actuators)} actuators in the scene; the model needs one, "
            "position"
        )
    return int(actuators[0])
