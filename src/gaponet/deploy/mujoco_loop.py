"""A MuJoCo loop of one's own becomes an aligned one: look the joints up once, correct ctrl before mj_step."""

from __future__ import annotations

import copy
from collections.abc import Callable

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import ModelError
from gaponet.deploy.transfer import Inverse, Reference, Transfer, periods_of
from gaponet.nn.artifact import GapModel
from gaponet.robot.folder import has_stored_robot, stored_robot_holder
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import Batch, BatchSim, Condition
from gaponet.sim.inverse import ClosedForm, Probed

STATE = mujoco.mjtState.mjSTATE_INTEGRATION
GAIN_TOLERANCE = 1e-3  # of kp and kd


class MujocoAligner:
    """ctrl → ctrl + Δa for a model with a position actuator on each operated joint; one MjData, one control period.

    align = MujocoAligner(load_robot("./my_h1_2"), mj_model, dt=0.02, payload_mass=3.0)  # or GapModel.load("run")
    data.ctrl[:] = align(data, target)                    # once per control period
    mujoco.mj_step(mj_model, data, round(0.02 / mj_model.opt.timestep))

    A scene whose robot does not move as the identified one, or as in the simulator of training, gets the commands that
    make it do so (deploy/transfer.py): other gains, friction, inertias, actuators, a payload that it does not have. Its
    base and whatever else is in it are taken as they stand in each period.
    """

    def __init__(
        self,
        model: Reference,
        mj_model: mujoco.MjModel,
        dt: float,
        payload_mass: float,
        prefix: str = "",
        extrapolate: bool = False,
        inverse: Inverse = "closed",
    ) -> None:
        """Refuse a scene without the joints trained on, too far from the simulator of training; other rates, payloads.

        Args:
            model: The identified robot that the scene is to move like; or what training made, on top of one: where no
                run or export keeps its simulator, the scene must have the gains trained with.
            mj_model: The compiled scene.
            dt: Control period, s.
            payload_mass: kg in each hand of the robot that the scene is to move like.
            prefix: What stands before the robot's names in the scene ("left/").
            extrapolate: Take a payload beyond those trained on, and a scene beyond those measured.
            inverse: How a scene is inverted: in closed form, which needs position actuators, or by answers of copies.
        """
        own = model.card["joint_names"] if isinstance(model, GapModel) else model.operated
        place = model.path if isinstance(model, GapModel) else model.folder
        self.payload_mass, self.loop = payload_mass, None
        known = [mj_model.joint(j).name for j in range(mj_model.njnt)]
        for name in own:
            if prefix + name not in known:
                raise ModelError(
                    f"{place}: moves joint '{prefix + name}', the scene has {', '.join(known)}; give prefix"
                )
        self.transfer: Transfer | None = None
        self._stand: Callable[[mujoco.MjData], None] = lambda data: None
        told = Condition(payload_mass, "both", dt)
        if isinstance(model, GapModel):
            model.require_payload(payload_mass, extrapolate)
        if isinstance(model, RobotSpec) or has_stored_robot(stored_robot_holder(model.path)):
            self._invert(model, mj_model, told, prefix, extrapolate, inverse)
        else:
            _require_gains(model, mj_model, prefix)
        if self.transfer is None and isinstance(model, GapModel):
            model.require_rate(dt)
            self.loop = model.loop()  # it moves as the simulator of the run
        joints = own if self.transfer is None else self.transfer.joint_names
        names = [prefix + name for name in joints]
        self.qpos = np.array([mj_model.joint(name).qposadr[0] for name in names])
        self.qvel = np.array([mj_model.joint(name).dofadr[0] for name in names])
        self.actuator = np.array([_actuator(mj_model, name) for name in names])
        self._fresh = True

    def reset(self) -> None:
        """Forget the past, because another motion begins."""
        self._fresh = True

    def __call__(self, data: mujoco.MjData, ctrl: Array) -> Array:
        """Targets to apply, (nu,) rad, given those asked for; once per control period."""
        out = np.array(ctrl, float)
        q, v, a = data.qpos[None, self.qpos], data.qvel[None, self.qvel], out[None, self.actuator]
        if self.loop is not None:
            if self._fresh:
                self.loop.reset()
            self.loop.delta(q, v, a, self.payload_mass)
            out[self.actuator] = self.loop.applied[0]
        elif self.transfer is not None:  # else the scene moves as the robot of itself
            if self._fresh:
                self.transfer.reset(slice(None), q, v, a[:, None])
            self._stand(data)
            out[self.actuator] = self.transfer.command(q, v, a)[0]
        self._fresh = False
        return out

    def _invert(
        self, model: Reference, scene: mujoco.MjModel, told: Condition, prefix: str, extrapolate: bool, how: Inverse
    ) -> None:
        """Transfer, unless the scene moves as the robot, or as the simulator that the model was trained in."""
        robot = model.simulator() if isinstance(model, GapModel) else model
        driven = {scene.joint(j).name for j in scene.actuator_trnid[:, 0]}
        locked = tuple(name for name in robot.joint_names if prefix + name not in driven)
        reference = BatchSim(robot, [told], 1, locked)
        joints = tuple(prefix + name for name in reference.joint_names)
        inverse: ClosedForm | Probed
        if how == "closed":
            inverse = _of_scene(scene, joints, told.dt)
            as_is = periods_of(model, told.dt) == 1 if isinstance(model, GapModel) else not robot.has_servo_model
            if as_is and inverse.alike(ClosedForm.of(reference), reference.range):
                return
            self._stand = inverse.stand
        else:
            copies = _SceneCopies(scene, joints, told.dt)
            inverse = Probed(copies, told.dt)
            self._stand = copies.stand
        self.transfer = Transfer(model, inverse, [told], locked, 1, extrapolate)


class _SceneCopies:
    """Where targets would lead the robot of a scene, asked of copies of its MjData in which nothing touches."""

    def __init__(self, scene: mujoco.MjModel, joints: tuple[str, ...], dt: float) -> None:
        self.scene, self.steps = _untouched(scene), round(dt / scene.opt.timestep)
        self.qpos = [scene.joint(name).qposadr[0] for name in joints]
        self.qvel = [scene.joint(name).dofadr[0] for name in joints]
        self.actuator = [_actuator(scene, name) for name in joints]
        self.copy, self.seen = mujoco.MjData(self.scene), mujoco.MjData(self.scene)

    def stand(self, data: mujoco.MjData) -> None:
        """The scene is here now."""
        self.seen = data

    def __call__(self, targets: Array, speeds: Array) -> tuple[Array, Array]:
        """Targets (k, 1, n) rad, from speeds (1, n) rad/s → next qpos and qvel, each (k, 1, n)."""
        qpos, qvel = np.empty_like(targets), np.empty_like(targets)
        state = np.empty(mujoco.mj_stateSize(self.scene, STATE))
        mujoco.mj_getState(self.scene, self.seen, state, STATE)
        for k, target in enumerate(targets[:, 0]):
            mujoco.mj_setState(self.scene, self.copy, state, STATE)
            self.copy.qvel[self.qvel] = speeds[0]
            self.copy.ctrl[self.actuator] = target
            mujoco.mj_step(self.scene, self.copy, self.steps)
            qpos[k, 0], qvel[k, 0] = self.copy.qpos[self.qpos], self.copy.qvel[self.qvel]
        return qpos, qvel


def _of_scene(scene: mujoco.MjModel, joints: tuple[str, ...], dt: float) -> ClosedForm:
    """The inverse of a robot in a scene."""
    model, h = _untouched(scene), scene.opt.timestep
    return ClosedForm(Batch(model, nsim=1, nthread=1), model, joints, np.array([round(dt / h)]), np.array([h]))


def _untouched(scene: mujoco.MjModel) -> mujoco.MjModel:
    free = copy.copy(scene)
    free.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    return free


def _actuator(scene: mujoco.MjModel, joint: str) -> int:
    mine = np.flatnonzero(scene.actuator_trnid[:, 0] == scene.joint(joint).id)
    if len(mine) != 1:
        raise ModelError(f"joint '{joint}' has {len(mine)} actuators in the scene; the model needs one, position")
    return int(mine[0])


def _require_gains(model: GapModel, scene: mujoco.MjModel, prefix: str) -> None:
    for joint, *trained in zip(model.card["joint_names"], model.card["kp"], model.card["kd"], strict=True):
        i = _actuator(scene, prefix + joint)
        for what, is_, was in zip(
            ("kp", "kd"), (scene.actuator_gainprm[i, 0], -scene.actuator_biasprm[i, 2]), trained, strict=True
        ):
            if abs(is_ - was) > GAIN_TOLERANCE * max(abs(was), 1.0):
                raise ModelError(
                    f"joint '{prefix + joint}': {what} is {is_:g} in the scene, the model was trained with {was:g}; "
                    "load the model with its run folder, so that commands can be transferred, or set the gains trained "
                    "with (card.json)"
                )
