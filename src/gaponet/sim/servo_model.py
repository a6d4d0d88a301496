"""Servo models of the simulations in a batch, which run sim/servo.py before every physics step."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.robot.servo_fields import SERVO_TERMS
from gaponet.sim.servo import (
    SERVO_RECORD,
    ActuatorState,
    Play,
    ServoTerms,
    compiled,
    set_servos,
)


class Servos:
    """Parameters of the servos of all simulations in a batch, (nsim, nu) each; may be written.

    Attributes:
        terms: Name of SERVO_TERMS → values, in force from the next reset on.
        records: SERVO_RECORD, what is in force. Its friction and its largest torque are the MuJoCo
            model's own, without the servo model.
        armature, damping: The MuJoCo model's own, without backlash.
    """

    def __init__(self, batch: Any, model: mujoco.MjModel) -> None:
        """Take the MuJoCo model's parameters for all simulations."""
        friction = batch.expand("dof_frictionloss")
        own = batch.expanded("actuator_forcerange")
        limits = model.actuator_forcerange if own is None else own
        self.records = np.zeros(friction.shape, SERVO_RECORD)
        self.records["frictionloss"] = friction
        self.records["effort_limit"] = limits[..., 1]
        self.armature = np.zeros(friction.shape) + model.dof_armature
        self.damping = np.zeros(friction.shape) + model.dof_damping
        user = np.zeros((model.nu, len(SERVO_TERMS)))
        if model.nuser_actuator:
            user = model.actuator_user
        self.terms: ServoTerms = {}
        for i, name in enumerate(SERVO_TERMS):
            self.terms[name] = np.tile(user[:, i], (len(friction), 1))

    def set(self, at: Array, values: dict[str, Array]) -> None:
        """Set the joints `at` (k,) of all simulations to values (nsim, k), as of
        BatchSim.set_servos.
        """
        self.records["frictionloss"][:, at] = values["frictionloss"]
        self.armature[:, at] = values["armature"]
        self.damping[:, at] = np.maximum(values["damping"], 0.0)
        if "effort_limit" in values:
            self.records["effort_limit"][:, at] = values["effort_limit"]
        for name in SERVO_TERMS:
            self.terms[name][:, at] = values.get(name, 0.0)

    def latest_records(self) -> Array:
        """Return a copy of `records` with the terms as they are now."""
        records = self.records.copy()
        for name, values in self.terms.items():
            records[name] = values
        return records


class Backlash:
    """Backlash of the servos of a batch: parts motors from links in MuJoCo's fields.

    Attributes:
        play: Gaps, and speeds of the motors.
    """

    def __init__(self, batch: Any, model: mujoco.MjModel, play: Play) -> None:
        self.play = play
        self._links = (
            batch.expand("dof_armature"),
            batch.expand("dof_damping"),
            batch.bind("qfrc_applied"),
            batch.expand("actuator_gear")[..., 0],
        )
        self._constraint = batch.bind("qfrc_constraint")
        step = batch.expanded("opt.timestep")
        self._h = model.opt.timestep if step is None else np.array(step).reshape(-1, 1)

    def before(self, state: ActuatorState, friction: Array, bias: Array) -> None:
        """Set the links' fields for the next physics step, also their friction and the actuators'
        bias, (nsim, nu) N·m, which the servo model has set.
        """
        gain = state.gain[:, :, 0]
        *values, more = self.play.before(friction, gain, state.qpos, state.qvel, self._h)
        bias += more
        for field, value in zip((friction, *self._links), values, strict=True):
            field[:] = value

    def after(self, state: ActuatorState, moved: Any) -> None:
        """Advance the gaps of simulations after a physics step."""
        self.play.after(state.qvel, state.torque, self._constraint, self._h, moved)


class ServoModel:
    """Servo models of all simulations in a batch, whose actuators are in the order of its joints.

    Attributes:
        servos: Parameters of the servos.
        state: What the actuators do. Torque and load are those of the last physics step; the next
            one follows from these and the batch's own state.
        backlash: None where no servo has any.
    """

    def __init__(self, batch: Any, model: mujoco.MjModel) -> None:
        """Take the MuJoCo model's parameters for all simulations of a Batch, or of an object with
        its methods.
        """
        self.batch = batch
        self.model = model
        self.servos = Servos(batch, model)
        self._force = batch.bind("actuator_force")
        self._passing = batch.bind("qfrc_bias")
        self._bias = batch.expand("actuator_biasprm")
        self._friction = batch.expand("dof_frictionloss")
        self._range = np.zeros((0, 0, 2))  # of torques, expanded where a term changes it
        self.state = ActuatorState(
            gain=batch.expand("actuator_gainprm"),
            bias=self._bias[:, :, 0].copy(),
            ctrl=batch.bind("ctrl"),
            qpos=batch.bind("qpos"),
            qvel=batch.bind("qvel"),
            torque=np.zeros(self._force.shape),
            load=np.zeros(self._force.shape),
        )
        self.backlash: Backlash | None = None
        self._set_servos = compiled(set_servos)
        self._take_terms()
        bias = self._bias.copy()
        friction = self._friction.copy()
        self.before()  # compiles now, since the first step may belong to a control loop
        self._bias[:] = bias
        self._friction[:] = friction
        if self.servos.terms["backlash"].any():
            self._reset_backlash(np.arange(len(self._force)))

    def _take_terms(self) -> None:
        """Take the present values of the terms for the steps to come."""
        if self.servos.terms["no_load_speed"].any() or self._range.size:
            limit = self.servos.records["effort_limit"]
            self._range = self.batch.expand("actuator_forcerange")
            self._range[..., 0] = -limit
            self._range[..., 1] = limit
        self.servos.records[:] = self.servos.latest_records()

    def reset(self, ids: Array, target: Array) -> None:
        """Begin again for simulations `ids`, which were put into a state, under position targets
        (k, nu) rad.
        """
        self._take_terms()
        state = self.state
        limit = self.servos.records["effort_limit"][ids]
        requested = state.gain[ids][..., 0] * (target - state.qpos[ids]) + state.bias[ids]
        state.torque[ids] = requested.clip(-limit, limit)
        self.batch.forward(ids, stage=mujoco.mjtStage.mjSTAGE_VEL.value)
        state.load[ids] = self._passing[ids]
        if self.backlash is not None or self.servos.terms["backlash"].any():
            self._reset_backlash(ids)

    def _reset_backlash(self, ids: Array) -> None:
        """Take the present gaps; simulations other than `ids` keep their state in them."""
        play = Play(
            self.servos.terms["backlash"],
            self.servos.armature,
            self.servos.damping,
            -self._bias[..., 2],
            self.state.load,
            self.state.qvel,
        )
        if self.backlash is not None:
            before = self.backlash.play
            others = np.delete(np.arange(len(play.gap)), ids)
            play.gap[others] = before.gap[others]
            play.rotor[others] = before.rotor[others]
            play.seen[others] = before.seen[others]
        self.backlash = Backlash(self.batch, self.model, play)

    def before(self) -> None:
        """Set bias, torque limits and friction for the next physics step.

        MuJoCo delays ctrl after this: the least torque of a late servo follows the target that is
        under way.
        """
        bias = self._bias[:, :, 0]
        if self.backlash is not None:
            bias[:] = self.state.bias
        self._set_servos(self.servos.records, self.state, self._bias, self._friction, self._range)
        if self.backlash is not None:
            self.backlash.before(self.state, self._friction, bias)

    def after(self, ids: Any = None) -> None:
        """Store torque and load after a physics step of these simulations."""
        moved = slice(None) if ids is None else ids
        self.state.torque[moved] = self._force[moved]
        self.state.load[moved] = self._passing[moved]
        if self.backlash is not None:
            self.backlash.after(self.state, moved)

    def memory(self) -> dict[str, Array]:
        """Return live arrays: what the next step follows from beside the batch's own state."""
        arrays = {"servo_torque": self.state.torque, "servo_load": self.state.load}
        if self.backlash is not None:
            play = self.backlash.play
            arrays |= {"servo_gap": play.gap, "servo_rotor": play.rotor, "servo_seen": play.seen}
        return arrays
