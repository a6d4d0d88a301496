"""Transfer: the commands with which one simulator moves as another one does, with its operator.

An operator is trained in one simulator, the reference. Of the robot it knows how it moves; how a simulator must be told
to move so is known in closed form, of any simulator. So in each control period the reference, put where the target
simulator is, takes the period's step, and the target is told the inverse of that step (sim/inverse.py).

Exact, but for what happens within a control period: free motion, whatever differs: gains, damping, friction, inertia,
payload, offsets, delays up to the reference's, torque limits, integrator, time step. A push moves the target, and the
reference goes on from there. In contact the motors give what the reference's would in free space, and the target's
contacts answer to that; what the reference itself touches (the table of an identified one) the target is stopped at by
its motors.
"""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from typing import Literal

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import ModelError
from gaponet.data.sequence import Sequence
from gaponet.nn.artifact import RATE_TOLERANCE, GapModel
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import BatchSim, Condition
from gaponet.sim.inverse import ClosedForm, Period, Probed
from gaponet.sim.replay import idle_limbs

Inverse = Literal["closed", "probes"]
Reference = GapModel | RobotSpec  # a model with the simulator of its run, or a simulator alone

GAINS = (0.15, 5.0)  # of kp, to the reference's; this and what follows as far as was measured
BAND = 0.06  # rad, frictionloss / kp
STEP = 0.0051  # s
LATER = 0.005  # s, servos than the reference's
RESTING = 0.02  # rad/s: of a joint that is pressed on something, so that its friction is not seen


class Transfer:
    """Commands for num_envs simulations of the target; the reference runs along, one simulation for each.

    Arrays are (num_envs, n) in the order of `joint_names`, the reference's joints without those locked.
    """

    def __init__(
        self,
        reference: Reference,
        inverse: ClosedForm | Probed,
        conditions: list[Condition],
        locked: tuple[str, ...] = (),
        nthread: int = 1,
        extrapolate: bool = False,
    ) -> None:
        """
        Args:
            reference: How the robot moves.
            inverse: The target's inverse dynamics, for the same joints.
            conditions: The reference's payloads and the control period.
            locked: Joints that the reference has clamped at home.
            nthread: Threads of the reference, 0 for all cores.
            extrapolate: Take a target beyond those that were measured.

        Raises:
            ModelError: The model cannot be asked at this control period, or the target is beyond those measured.
        """
        model = reference if isinstance(reference, GapModel) else None
        robot = reference.simulator() if isinstance(reference, GapModel) else reference
        self.inverse, self.num_envs = inverse, len(conditions)
        self.sim = sim = BatchSim(robot, conditions, nthread, locked)
        if not extrapolate:
            _require_measured(inverse, ClosedForm.of(sim), sim.joint_names)
        self.joint_names = sim.joint_names
        self.op = np.array([sim.joint_names.index(name) for name in robot.operated])
        self.every = 1 if model is None else max(periods_of(model, c.dt) for c in dict.fromkeys(conditions))
        self.loop = None if model is None else model.loop(self.num_envs)
        self.payload_mass = np.array([c.payload_mass for c in conditions])
        self._delta = np.zeros((self.num_envs, len(self.op)))
        self._offset = np.zeros((self.num_envs, sim.n))  # of the last command from where the joint was, rad
        self._asked = 0  # control periods since the operator was asked
        self._limit = sim.batch.expand("dof_frictionloss")  # the servo's law writes there
        self._held: Array = sim.batch.bind("qfrc_constraint")
        self._dt = (sim.nstep * sim.timestep)[:, None]

    def reset(self, ids: Array | slice, qpos: Array, qvel: Array, past: Array) -> None:
        """Begin anew in some simulations, in a state (k, n), under targets of the periods before, (k, depth, n)."""
        self.sim.reset(ids, qpos, qvel, past=past)
        self._offset[ids], self._delta[ids] = 0.0, 0.0
        if self.loop is not None:
            self.loop.reset(ids)
        if len(np.arange(self.num_envs)[ids]) == self.num_envs:
            self._asked = 0

    def command(self, qpos: Array, qvel: Array, target: Array) -> Array:
        """What to command over the coming control period; once per period.

        Args:
            qpos, qvel: The target simulator's state, rad, rad/s.
            target: What the robot would be asked for, rad.

        Returns:
            rad, not limited to the joints' range.
        """
        self.sim.qpos[:], self.sim.qvel[:] = qpos, qvel
        asked = self._corrected(qpos, qvel, target)
        periods = [self._period(asked)]
        if self.inverse.ahead:
            reached = self.sim.state()
            periods += [self._period(asked) for _ in range(self.inverse.ahead)]
            self.sim.set_state(reached)
        out = self.inverse(periods, qpos + self._offset)
        self._offset = out - qpos
        return out

    def _corrected(self, qpos: Array, qvel: Array, target: Array) -> Array:
        """Target + Δa, the operator asked in periods as long as those that it was trained with."""
        out = np.array(target, float)
        if self.loop is not None:
            if self._asked % self.every == 0:
                at = self.op
                self._delta[:] = self.loop.delta(qpos[:, at], qvel[:, at], out[:, at], self.payload_mass)
            self._asked += 1
            out[:, self.op] += self._delta
        return out

    def _period(self, asked: Array) -> Period:
        """Step the reference."""
        sim = self.sim
        qpos, qvel = sim.qpos.copy(), sim.qvel.copy()
        sim.step(asked)
        ends = sim.qpos.copy(), sim.qvel.copy()
        return Period(qpos, qvel, *ends, self._friction(ends[0] - qpos))

    def _friction(self, way: Array) -> Array:
        """Shares of friction; where a joint is held by more than its friction, by stops or contacts, from its speed."""
        share = -self._held / np.maximum(self._limit, 1e-9)
        by_speed = np.tanh(way / self._dt / RESTING)
        return np.where((np.abs(share) > 1.05) | (self._limit == 0), by_speed, np.clip(share, -1.0, 1.0))


class TransferCorrector:
    """Transfer in the free run of sim.replay: the target is the simulator that is stepped."""

    def __init__(self, reference: Reference, target: RobotSpec, extrapolate: bool = False) -> None:
        """reference: How the robot moves. target: The simulator that is replayed in."""
        self.reference, self.target, self.extrapolate = reference, target, extrapolate
        self.robot = reference.simulator() if isinstance(reference, GapModel) else reference

    def reset(self, start: ListOf[Sequence]) -> None:
        """Begin one simulation per sequence at its first row."""
        locked = idle_limbs(start, self.robot)
        own = BatchSim(self.target, [Condition.of(s, self.target) for s in start], locked=locked)
        reference = [Condition.of(s, self.robot) for s in start]
        self.transfer = Transfer(self.reference, ClosedForm.of(own), reference, locked, 0, self.extrapolate)
        self.free = self.robot.index(self.transfer.joint_names)
        first = [np.stack([getattr(s, name)[0, self.free] for s in start]) for name in ("qpos", "qvel", "ctrl")]
        self.transfer.reset(slice(None), first[0], first[1], past=first[2][:, None])

    def correct(self, t: int, target: Array, qpos: Array, qvel: Array) -> Array:
        """Commands, (k, n_all) rad."""
        out, free = np.array(target, float), self.free
        out[:, free] = self.transfer.command(qpos[:, free], qvel[:, free], target[:, free])
        return out


def _require_measured(inverse: ClosedForm | Probed, reference: ClosedForm, joints: tuple[str, ...]) -> None:
    """Refuse a target outside the range that transfer was measured in: LATER, GAINS, BAND, STEP."""
    periods = (inverse.ahead - reference.ahead) * reference.dt
    later = periods if isinstance(inverse, Probed) else inverse.delay - reference.delay
    if later.max() > LATER:
        raise ModelError(
            f"joint '{joints[later.argmax() % len(joints)]}': its servo is {1e3 * later.max():.0f} ms later than the "
            "reference's, and cannot follow it: it hears of a target when the reference has moved. Make the reference "
            "as late (delay in robot.toml; gaponet identify), or extrapolate (extrapolate=True, --extrapolate)"
        )
    if isinstance(inverse, Probed):
        return  # what is in a black box is not known
    for what, value, (least, most) in (
        ("kp, as a ratio to the reference's,", inverse.kp / reference.kp, GAINS),
        ("frictionloss / kp, rad,", inverse.frictionloss / inverse.kp, (0.0, BAND)),
        ("the physics step, s,", np.tile(inverse.h, len(joints)), (0.0, STEP)),
    ):
        for joint, least_of, most_of in zip(joints, value.min(axis=0), value.max(axis=0), strict=True):
            for x in (least_of, most_of):
                if not least * (1 - 1e-6) <= x <= most * (1 + 1e-6):
                    raise ModelError(
                        f"joint '{joint}': {what} is {x:.3g}; transfer was measured from {least:g} to {most:g}. Train "
                        "in this simulator, or extrapolate (extrapolate=True, --extrapolate)"
                    )


def periods_of(model: GapModel, dt: float) -> int:
    """How many control periods of dt s are one of those that a model was trained with.

    Raises:
        ModelError: None of these is a whole number of them.
    """
    for trained in model.card.get("dt") or [dt]:
        times = max(1, round(trained / dt))
        if abs(dt * times / trained - 1) <= RATE_TOLERANCE:
            return times
    rates = ", ".join(f"{1 / trained:.1f}" for trained in model.card["dt"])
    raise ModelError(
        f"{model.path}: trained at {rates} Hz, asked to run at {1 / dt:.1f} Hz; run the loop at a trained rate or a "
        "whole multiple of it, or train on logs of this rate"
    )
