"""What a servo does that MuJoCo's position actuator and friction loss do not, set before every physics step.

The encoder counts in steps; a motor that is told to turn at all turns with a least torque (minimum PWM); friction is
larger at rest (Stribeck) and grows with what the gear transmits (load-dependent as in BAM, Duclusaud et al. 2024).
MuJoCo integrates: these laws only move the actuator's bias and the limit of friction, so friction sticks as MuJoCo's
does. A compiled model carries the numbers in actuator_user; without any, nothing here runs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from gaponet.robot import LAW

if TYPE_CHECKING:
    from mujoco.batch import Batch

Array = np.ndarray
Law = dict[str, Array]  # name of LAW → values that broadcast to the simulations' joints

SLOWEST = 1e-3  # rad/s: of stribeck_speed


def friction_limit(law: Law, frictionloss: Array, qvel: Array, torque: Array, load: Array) -> Array:
    """The most that friction takes, N·m, at a speed, under the motor's torque and gravity's."""
    limit = frictionloss
    if law["friction_motor"].any() or law["friction_external"].any():
        limit = limit + np.abs(law["friction_motor"] * torque + law["friction_external"] * load)
    if law["stribeck"].any():
        limit = limit + law["stribeck"] * np.exp(-np.abs(qvel) / np.maximum(law["stribeck_speed"], SLOWEST))
    return limit


def servo_torque(law: Law, kp: Array, aim: Array, qpos: Array) -> Array:
    """What the servo asks of its motor, N·m, for an angle (rad) that it reads in its encoder's steps."""
    step = law["encoder_step"]
    fine = np.maximum(step, 1e-9)
    torque = kp * (aim - np.where(step > 0, np.round(qpos / fine) * fine, qpos))
    least = law["min_torque"]
    if not least.any():
        return torque
    return np.where(np.abs(torque) > 0.5 * step * kp, np.copysign(np.maximum(np.abs(torque), least), torque), 0.0)


class ServoLaw:
    """The servos of every simulation in a batch.

    Attributes:
        values: Name of LAW → (nsim, nu); may be written.
        frictionloss, bias: Of the model, without what is added here, (nsim, nu) N·m; may be written.
        torque, load: Of the last physics step, (nsim, nu) N·m: the actuators', and what gravity and Coriolis forces
            take from them. Together with the batch's own state all that the next step follows from.
    """

    def __init__(self, batch: Batch, model: mujoco.MjModel) -> None:
        """Take the model's numbers for all simulations."""
        self.batch, self.model = batch, model
        self.dof = model.jnt_dofadr[model.actuator_trnid[:, 0]]
        user = model.actuator_user if model.nuser_actuator else np.zeros((model.nu, len(LAW)))
        self.values: Law = {name: np.tile(user[:, i], (batch.nsim, 1)) for i, name in enumerate(LAW)}
        self._qpos, self._qvel, self._ctrl = batch.bind("qpos"), batch.bind("qvel"), batch.bind("ctrl")
        self._force, self._passing = batch.bind("actuator_force"), batch.bind("qfrc_bias")
        self._gain, self._bias = batch.expand("actuator_gainprm"), batch.expand("actuator_biasprm")
        self._limit = batch.expand("dof_frictionloss")
        self.frictionloss, self.bias = self._limit[:, self.dof], self._bias[:, :, 0].copy()
        self.torque, self.load = np.zeros_like(self._force), np.zeros_like(self._force)

    def reset(self, ids: Array | slice, target: Array) -> None:
        """Simulations `ids` were put into a state, under position targets (k, nu) rad."""
        error = target - self._qpos[ids][:, self.dof]
        self.torque[ids] = np.clip(self._gain[ids, :, 0] * error + self.bias[ids], *self.model.actuator_forcerange.T)
        self.batch.forward(np.arange(self.batch.nsim)[ids], stage=mujoco.mjtStage.mjSTAGE_VEL.value)
        self.load[ids] = self._passing[ids][:, self.dof]

    def before(self) -> None:
        """Set bias and friction for the next physics step."""
        law, gain = self.values, self._gain[:, :, 0]
        if law["encoder_step"].any() or law["min_torque"].any():
            # Of a late servo (MuJoCo delays ctrl behind this) the least torque goes by the target that is under way.
            qpos = self._qpos[:, self.dof]
            aim = self._ctrl + self.bias / gain
            self._bias[:, :, 0] = servo_torque(law, gain, aim, qpos) - gain * (self._ctrl - qpos)
        self._limit[:, self.dof] = friction_limit(
            law, self.frictionloss, self._qvel[:, self.dof], self.torque, self.load
        )

    def after(self, ids: Array | None = None) -> None:
        """A physics step of these simulations has passed."""
        moved = slice(None) if ids is None else ids
        self.torque[moved] = self._force[moved]
        self.load[moved] = self._passing[moved][:, self.dof]
