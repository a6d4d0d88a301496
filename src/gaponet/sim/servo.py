"""What a servo does that MuJoCo's position actuator and friction loss do not, set before every physics step.

The encoder counts in steps; a motor that is told to turn at all turns with a least torque (minimum PWM); friction is
larger at rest (Stribeck) and grows with what the gear transmits (load-dependent as in BAM, Duclusaud et al. 2024).
MuJoCo integrates: these laws only move the actuator's bias and the limit of friction, so friction sticks as MuJoCo's
does. A compiled model carries the numbers in actuator_user; without any, nothing here runs.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from gaponet.arrays import Array, copy_of, library, like, zeros_like
from gaponet.robot import LAW

Law = dict[str, Any]  # name of LAW → values that broadcast to the simulations' joints, numpy or torch

SLOWEST = 1e-3  # rad/s: of stribeck_speed
FINEST = 1e-9  # rad: of encoder_step


def present(law: Law) -> Law:
    """The part of a law that is not zero everywhere; what is not in a law is not computed."""
    return {name: x for name, x in law.items() if x.any()}


def friction_limit(law: Law, frictionloss: Any, qvel: Any, torque: Any, load: Any) -> Any:
    """The most that friction takes, N·m, at a speed, under the motor's torque and gravity's; law as of `present`."""
    limit = frictionloss
    if "friction_motor" in law or "friction_external" in law:
        limit = limit + abs(law.get("friction_motor", 0.0) * torque + law.get("friction_external", 0.0) * load)
    if "stribeck" in law:
        speed = law["stribeck_speed"].clip(min=SLOWEST) if "stribeck_speed" in law else SLOWEST
        limit = limit + law["stribeck"] * library(qvel).exp(-abs(qvel) / speed)
    return limit


def servo_torque(law: Law, kp: Any, aim: Any, qpos: Any) -> Any:
    """What the servo asks of its motor, N·m, for an angle (rad) that it reads in its encoder's steps."""
    xp, read, deadband = library(qpos), qpos, 0.0
    if "encoder_step" in law:
        step = law["encoder_step"]
        fine, deadband = step.clip(min=FINEST), 0.5 * step * kp
        read = xp.where(step > 0, xp.round(qpos / fine) * fine, qpos)
    torque = kp * (aim - read)
    if "min_torque" not in law:
        return torque
    return xp.where(abs(torque) > deadband, xp.copysign(xp.maximum(abs(torque), law["min_torque"]), torque), 0.0)


class ServoLaw:
    """The servos of every simulation in a batch.

    Attributes:
        values: Name of LAW → (nsim, nu); may be written.
        frictionloss, bias: Of the model, without what is added here, (nsim, nu) N·m; may be written.
        torque, load: Of the last physics step, (nsim, nu) N·m: the actuators', and what gravity and Coriolis forces
            take from them. Together with the batch's own state all that the next step follows from.
    """

    def __init__(self, batch: Any, model: mujoco.MjModel) -> None:
        """Take the model's numbers for all simulations.

        batch: A mujoco.batch.Batch, or what has its bind, expand and forward.
        """
        self.batch, self.model = batch, model
        user = model.actuator_user if model.nuser_actuator else np.zeros((model.nu, len(LAW)))
        self._qpos, self._qvel, self._ctrl = batch.bind("qpos"), batch.bind("qvel"), batch.bind("ctrl")
        self.dof = like(self._qpos, model.jnt_dofadr[model.actuator_trnid[:, 0]])
        self._force, self._passing = batch.bind("actuator_force"), batch.bind("qfrc_bias")
        self._gain, self._bias = batch.expand("actuator_gainprm"), batch.expand("actuator_biasprm")
        self._limit = batch.expand("dof_frictionloss")
        self.values: Law = {name: np.tile(user[:, i], (len(self._qpos), 1)) for i, name in enumerate(LAW)}
        self.frictionloss, self.bias = copy_of(self._limit[:, self.dof]), copy_of(self._bias[:, :, 0])
        self.torque, self.load = (zeros_like(self._force, *self._force.shape) for _ in range(2))
        self._lasting: Law | None = None

    def take(self, other: ServoLaw, rows: Array) -> None:
        """Be servos of another batch, its simulations `rows`; for good, so that nothing is looked up at each step."""
        self.bias[:], self.frictionloss[:] = (
            like(self.bias, other.bias[rows]),
            like(self.bias, other.frictionloss[rows]),
        )
        self.values = {name: like(self.bias, x[rows]) for name, x in other.values.items()}
        self._lasting = present(self.values)

    def reset(self, ids: Any, target: Any) -> None:
        """Simulations `ids` were put into a state, under position targets (k, nu) rad."""
        error = target - self._qpos[ids][:, self.dof]
        low, high = like(error, self.model.actuator_forcerange.T)
        self.torque[ids] = (self._gain[ids][..., 0] * error + self.bias[ids]).clip(low, high)
        self.batch.forward(ids, stage=mujoco.mjtStage.mjSTAGE_VEL.value)
        self.load[ids] = self._passing[ids][:, self.dof]

    def before(self) -> None:
        """Set bias and friction for the next physics step."""
        law, gain = present(self.values) if self._lasting is None else self._lasting, self._gain[:, :, 0]
        if "encoder_step" in law or "min_torque" in law:
            # Of a late servo (MuJoCo delays ctrl behind this) the least torque goes by the target that is under way.
            qpos = self._qpos[:, self.dof]
            aim = self._ctrl + self.bias / gain
            self._bias[:, :, 0] = servo_torque(law, gain, aim, qpos) - gain * (self._ctrl - qpos)
        qvel = self._qvel[:, self.dof]
        self._limit[:, self.dof] = friction_limit(law, self.frictionloss, qvel, self.torque, self.load)

    def after(self, ids: Any = None) -> None:
        """A physics step of these simulations has passed."""
        moved = slice(None) if ids is None else ids
        self.torque[moved] = self._force[moved]
        self.load[moved] = self._passing[moved][:, self.dof]
