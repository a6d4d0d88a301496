"""Identification from recorded torque, for windows so short that positions do not separate a gain
from a load.

A servo's torque is kp (command − position) − kd velocity, which gives its gains. The torque that
the model does not explain gives the payload's place and the mass of a hand that the model lacks, by
least squares. Positions give damping, friction, armature, zero and delay, near those values.
Validation motions choose how near, and which parts are used.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import replace
from typing import Any, NamedTuple

import mujoco
import numpy as np
from scipy.optimize import least_squares

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.data.signals import differentiate, lowpass
from gaponet.robot.spec import RobotSpec
from gaponet.sim.dynamics import CUTOFF_HZ
from gaponet.sim.model import build_model
from gaponet.sysid.adapt import PRIOR_RAD
from gaponet.sysid.axes import CLASSIC, Changes, first_values, with_values
from gaponet.sysid.joint_rollouts import ERROR_SCALE_RAD, SLIP_SPEED, JointRollouts
from gaponet.sysid.least_squares import descend
from gaponet.sysid.robot_rollouts import cut

MAX_WINDOWS = 80  # more than elsewhere, since they may be short
# between rows for the payload's place, and how many
ROW_STEP = 5
MAX_ROWS = 6000
MOUNT_PRIOR_NM_PER_M = 3.0  # price of moving the payload
MIN_MOVE_RAD = 0.05  # of a command that excites a joint
MIN_EXPLAINED = 0.9  # of a torque's variance, from which its gains are used
INSTRUMENTS = 12  # periods whose commands are instruments for measured position and speed
MAX_LATE = 3  # periods between a command and its torque
# in 20 ms; of the fit of positions
START_DELAY = 0.25
ITERATIONS = 10
MAX_HAND_MASS = 5.0  # kg


class TorqueOptions(NamedTuple):
    """Options of a fit from torque: payload's place from torque, friction as well, and the prior
    of the positions' fit around it, rad per large change.
    """

    place: bool
    friction: bool
    prior: float


OPTIONS = (
    TorqueOptions(True, False, 2.0),
    TorqueOptions(True, False, PRIOR_RAD),
    TorqueOptions(True, True, 2.0),
    TorqueOptions(False, False, PRIOR_RAD),
)


class Gains(NamedTuple):
    """Gains of a servo from its torque."""

    kp: float  # N·m/rad
    error: float  # standard error of kp over recordings
    kd: float  # N·m·s/rad
    explained: float  # share of the torque's variance that they explain

    @property
    def trusted(self) -> bool:
        """Return True if the recorded torque is that of a PD servo."""
        return self.explained > MIN_EXPLAINED and self.kp > 0 <= self.kd


def servo_gains(recordings: ListOf[Array], last: int = 0, late: int = 1) -> Gains:
    """Estimate a servo's gains: torque = kp (command so many periods before − position) − kd
    velocity.

    Rows are means of five. Noise of measured position and speed would lower the gains, so two-stage
    least squares take the commands of INSTRUMENTS periods as instruments (Janot, Vandanjon &
    Gautier 2014).

    Args:
        recordings: Command, position, velocity and torque of the joint, (4, T) each.
        last: Only so many rows at the end of each count, as their mean, by plain least squares; 0
            for all.
        late: Periods.
    """
    sums = []
    rows = []
    for ctrl, qpos, qvel, tau in recordings:
        t = np.arange(len(tau) - late)
        past = [ctrl[np.maximum(t - k, 0)] for k in range(INSTRUMENTS)]
        channels = [ctrl[t] - qpos[late:], -qvel[late:], tau[late:], *past]
        error, speed, torque, *commands = (
            np.convolve(x, np.ones(5) / 5, "valid") for x in np.array(channels, float)
        )
        one = np.ones_like(torque)
        x = np.stack([error, speed, one], axis=1)
        z = np.stack([*commands, one], axis=1)
        if last:
            x = x[-last:].mean(axis=0, keepdims=True)
            torque = torque[-last:].mean(keepdims=True)
            z = x
        sums.append(np.concatenate([z.T @ z, z.T @ x, z.T @ torque[:, None]], axis=1))
        rows.append(np.concatenate([x, torque[:, None]], axis=1))

    def solved(s: Array) -> Array:
        first = np.linalg.lstsq(s[:, :-4], s[:, -4:-1])[0]
        return np.asarray(np.linalg.lstsq(first.T @ s[:, -4:-1], first.T @ s[:, -1])[0])

    every = np.concatenate(rows)
    n = len(sums)
    kp, kd, constant = solved(np.sum(sums, axis=0))
    without = np.array([solved(np.sum(sums, axis=0) - one)[0] for one in sums])
    left = every[:, 3] - every[:, :3] @ [kp, kd, constant]
    explained = 1 - float(left.var() / max(every[:, 3].var(), 1e-12))
    error = np.sqrt((n - 1) / n * np.square(without - without.mean()).sum())
    return Gains(float(kp), float(error), float(kd), explained)


class TorqueFit:
    """Fit of a robot to recordings with torque.

    Attributes:
        robot: The robot with gains from torque.
        known: Joint → gains that follow from its torque; none unless all recordings have torque.
        several_payloads: Whether recordings have several payloads, which determine where these
            hang.
    """

    def __init__(self, sequences: ListOf[Sequence], robot: RobotSpec) -> None:
        """Recordings whose gains are stated are left out; the robot's payload masses are taken as
        true.
        """
        self.robot = robot
        self.sequences = [
            s for s in sequences if s.tau is not None and s.meta.recorded_gains[0] is None
        ]
        gains = self.gains() if len(self.sequences) == len(sequences) else {}
        self.known = {joint: g for joint, g in gains.items() if g.trusted}
        self.robot = robot.with_servos(
            {joint: {"kp": g.kp, "kd": g.kd} for joint, g in self.known.items()}
        )
        masses = {s.meta.payload_mass for s in self.sequences}
        self.several_payloads = bool(robot.payload_mounts) and len(masses) > 1

    def gains(self) -> dict[str, Gains]:
        """Return joint → gains; without joints whose command never moves."""
        parts: dict[str, list[Array]] = {}
        for s in self.sequences:
            assert s.tau is not None
            for j in _moved(s, self.robot):
                rows = np.stack([x[:, j] for x in (s.ctrl, s.qpos, s.qvel, s.tau)])
                parts.setdefault(self.robot.joint_names[j], []).append(rows)
        return {
            joint: max(
                (servo_gains(each, late=k) for k in range(1, MAX_LATE + 1)),
                key=lambda g: g.explained,
            )
            for joint, each in parts.items()
        }

    def payload_placed(self, friction: bool = False) -> RobotSpec:
        """Return the robot with the payload's place and the mass of the hand, by least squares on
        recorded torque.

        A joint's torque is that of the model, that of (payload + hand) at the mount, and that of
        the joint's own friction, armature and damping, which the robot takes over with `friction`.
        Every mount is moved alike, mirrored to the other side.
        """
        robot = self.robot
        mount = self.robot.payload_mounts[0]
        joints, column, tau, qacc, qvel, required = self._balance()
        own = np.stack([np.tanh(qvel / SLIP_SPEED), qacc, qvel])  # friction, armature, damping
        n = 3 * len(joints)
        start = np.r_[mount.pos, mount.mass, np.zeros(n)]
        low, high = (
            np.r_[np.array(mount.pos) + a, m, np.full(n, z)]
            for a, m, z in ((-0.3, 0, 0), (0.3, MAX_HAND_MASS, 20))
        )

        def residual(x: Array) -> Array:  # a place that torque does not determine stays
            mine = (x[4:].reshape(3, -1)[:, column] * own).sum(axis=0)
            moved = MOUNT_PRIOR_NM_PER_M * (x[:3] - start[:3])
            return np.concatenate([required(x) + mine - tau, moved])

        scale = np.r_[0.1 * np.ones(3), 1.0, np.ones(n)]
        first = np.clip(start, low + 1e-6, high - 1e-6)
        solution = least_squares(
            residual, first, bounds=(low, high), x_scale=scale, loss="soft_l1"
        ).x
        x, y, z, hand = (round(float(v), 3) for v in solution[:4])
        mounts = tuple(
            replace(m, pos=_place(i, (x, y, z)), mass=hand)
            for i, m in enumerate(robot.payload_mounts)
        )
        armature = build_model(robot).dof_armature
        servos = {
            robot.joint_names[j]: {
                "frictionloss": v[0],
                "armature": float(armature[j]) + v[1],
                "damping": v[2],
            }
            for j, v in zip(joints, solution[4:].reshape(3, -1).T.round(4).tolist(), strict=True)
        }
        return replace(robot.with_servos(servos if friction else {}), payload_mounts=mounts)

    def _balance(self) -> tuple[list[int], Array, Array, Array, Array, Callable[[Array], Array]]:
        """Return the joints; joint, torque, acceleration and speed of each row; and the torque
        that inverse dynamics require for a payload's place and hand x, (4,) m and kg.
        """
        rows = []
        mounts = self.robot.payload_mounts
        empty = tuple(replace(m, mass=0.0) for m in mounts)
        model = build_model(replace(self.robot, payload_mounts=empty))
        every = max(ROW_STEP, sum(map(len, self.sequences)) // MAX_ROWS)
        for s in self.sequences:
            rows += self._balance_rows(s, model, every)
        joints = sorted({r[0] for r in rows})
        column = np.array([joints.index(r[0]) for r in rows])
        mass, bias, motion, frame, tau, qacc, qvel = (
            np.array([r[i] for r in rows]) for i in range(1, 8)
        )

        def required(x: Array) -> Array:
            place = np.array([_place(i, x[:3]) for i in range(len(mounts))])
            # How far each payload moves for a radian, (k, mounts, 3) m: 0 for a joint that does not
            # carry it.
            point = motion[:, :, 0] + np.cross(
                motion[:, :, 1], np.einsum("kmij,mj->kmi", frame, place)
            )
            there = 9.81 * point[..., 2] + np.square(point).sum(axis=-1) * qacc[:, None]
            return np.asarray(bias + ((mass + x[3]) * there).sum(axis=1))

        return joints, column, tau, qacc, qvel, required

    def _balance_rows(
        self, s: Sequence, model: mujoco.MjModel, every: int
    ) -> list[tuple[Any, ...]]:
        """Return a row for each moved joint in every so many rows of a recording: its number;
        payload in each mount, kg; torque without payloads, N·m; Jacobian and frame of each mount's
        body; torque, N·m; acceleration; speed.
        """
        assert s.tau is not None
        moved = _moved(s, self.robot)
        if not moved:
            return []
        mounts = self.robot.payload_mounts
        carried = [s.meta.payload_side in ("both", m.side) for m in mounts]
        mass = s.meta.payload_mass * np.array(carried)
        bodies = [model.body(m.body).id for m in mounts]
        data = mujoco.MjData(model)
        full = np.empty((model.nv, model.nv))
        # Of each mount's body: position and rotation.
        jac = np.empty((len(mounts), 2, 3, model.nv))
        speed = differentiate(lowpass(s.qpos.astype(float), s.dt, CUTOFF_HZ), s.dt)
        qacc = differentiate(speed, s.dt)
        rows = []
        for t in range(every, len(s) - 1, every):
            data.qpos[:] = s.qpos[t]
            data.qvel[:] = 0.0
            mujoco.mj_forward(model, data)
            mujoco.mj_fullM(model, data, full)
            for body, (shift, turn) in zip(bodies, jac, strict=True):
                mujoco.mj_jac(model, data, shift, turn, data.xpos[body], body)
            frame = data.xmat[bodies].reshape(-1, 3, 3)
            for j in moved:
                without = data.qfrc_bias[j] + full[j, j] * qacc[t, j]
                motion = jac[..., j].copy()
                tau = float(s.tau[t, j])
                rows.append((j, mass, without, motion, frame, tau, qacc[t, j], float(s.qvel[t, j])))
        return rows

    def fit(self, options: TorqueOptions) -> RobotSpec:
        """Return the robot with values from torque, and near those with values from positions."""
        start = self.payload_placed(options.friction) if options.place else self.robot
        rollouts = JointRollouts(cut(self.sequences, MAX_WINDOWS), start)
        fields = CLASSIC[1:]  # without kp
        changes = Changes(first_values(start), fields)

        def errors(x: Array) -> Array:
            own = rollouts.flat_errors(changes.values(x))
            return np.concatenate([own, options.prior * x], axis=2) / ERROR_SCALE_RAD

        first = np.zeros((1, *changes.low.shape))
        first[..., fields.index("delay")] = START_DELAY
        x, _ = descend(first, changes.low, changes.high, errors, ITERATIONS)
        values = changes.values(x)
        return with_values(start, {f: values[f][0] for f in fields})


def _place(mount: int, first: ListOf[float] | Array) -> tuple[float, float, float]:
    """Return the payload's position at a mount for that at the first mount: mirrored, m."""
    return first[0], first[1] if mount == 0 else -first[1], first[2]


def _moved(sequence: Sequence, robot: RobotSpec) -> list[int]:
    """Return the operated joints that a recording holds and whose command moves."""
    moved = np.ptp(sequence.ctrl, axis=0) > MIN_MOVE_RAD
    return [
        int(i)
        for i in robot.operated_index
        if moved[i] and robot.joint_names[i] not in sequence.meta.unrecorded
    ]
