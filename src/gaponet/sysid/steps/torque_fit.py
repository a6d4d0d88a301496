"""Identification from recorded torque, for windows so short that positions do not separate a gain
from a load.

A servo's torque is kp (command − position) − kd velocity, which gives its gains. The torque that
the model does not explain gives the payload's place and the mass of a hand that the model lacks, by
least squares. Positions give damping, friction, armature, zero and delay, near those values.
Validation motions choose how near, and which parts are used.
"""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.optimize import least_squares

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.data.signals import differentiate, lowpass
from gaponet.robot.spec import RobotSpec
from gaponet.robot.toml_file import PayloadMount
from gaponet.sim.dynamics import CUTOFF_HZ
from gaponet.sim.model import build_model
from gaponet.sysid.adapt import PRIOR_RAD
from gaponet.sysid.axes import CLASSIC, Changes, first_values, with_values
from gaponet.sysid.joint_rollouts import ERROR_SCALE_RAD, SLIP_SPEED, JointRollouts
from gaponet.sysid.least_squares import Problems, descend
from gaponet.sysid.robot_rollouts import cut

MAX_WINDOWS = 80  # more than elsewhere, since they may be short
# Rows of a recording, between those that place the payload.
MIN_BALANCE_STRIDE = 5
MAX_BALANCE_ROWS = 6000  # of all recordings
MOUNT_PRIOR_NM_PER_M = 3.0  # price of moving the payload
MIN_VARIANCE = 1e-12  # (N·m)², so that it can be divided by
MIN_MOVE_RAD = 0.05  # of a command that excites a joint
MIN_EXPLAINED = 0.9  # of a torque's variance, from which its gains are used
AVERAGED_ROWS = 5  # of which the regression takes the mean
# Periods whose commands are instruments for measured position and speed.
INSTRUMENTS = 12
MAX_LATE_S = 0.06  # between a command and its torque
MIN_LATE_PERIODS = 3  # of slow recordings, that are tried nevertheless
START_DELAY = 0.25  # of the fit of positions, large changes of 20 ms
ITERATIONS = 10  # of that fit
GRAVITY = 9.81  # m/s²
MAX_HAND_MASS_KG = 5.0
# Of the payload from where the robot's file has it, along each axis.
MAX_MOVE_M = 0.3
MAX_OWN = 20.0  # of a joint's own friction, armature and damping, SI


class TorqueOptions(NamedTuple):
    """Options of a fit from torque."""

    place: bool  # whether torque gives the payload's place
    friction: bool  # whether it gives the joints' friction as well; only with the place
    prior: float  # of the fit to positions around the values from torque, rad per large change


OPTIONS = (
    TorqueOptions(place=True, friction=False, prior=2.0),
    TorqueOptions(place=True, friction=False, prior=PRIOR_RAD),
    TorqueOptions(place=True, friction=True, prior=2.0),
    TorqueOptions(place=False, friction=False, prior=PRIOR_RAD),
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
        return self.explained > MIN_EXPLAINED and self.kp > 0 and self.kd >= 0


def servo_gains(recordings: ListOf[Array], late: ListOf[int], last: int = 0) -> Gains:
    """Estimate a servo's gains: torque = kp (earlier command − position) − kd velocity + constant.

    Rows are means of five. Noise of measured position and speed would lower the gains, so two-stage
    least squares take the commands of INSTRUMENTS periods as instruments (Janot, Vandanjon &
    Gautier 2014).

    Args:
        recordings: Command, position, velocity and torque of the joint, (4, T) each.
        late: How many periods earlier the command was given, of each recording.
        last: Only so many rows at the end of each count, as their mean, by plain least squares; 0
            for all.
    """
    sums = []  # of each recording, as `_two_stage_least_squares` takes them
    rows = []  # columns x and the torque, (rows, 4) of each recording
    for recording, periods in zip(recordings, late, strict=True):
        x, torque, z = _regression_rows(recording, periods)
        if last:
            x = x[-last:].mean(axis=0, keepdims=True)
            torque = torque[-last:].mean(keepdims=True)
            z = x
        sums.append(np.concatenate([z.T @ z, z.T @ x, z.T @ torque[:, None]], axis=1))
        rows.append(np.concatenate([x, torque[:, None]], axis=1))
    total = np.sum(sums, axis=0)
    kp, kd, constant = _two_stage_least_squares(total)
    every = np.concatenate(rows)
    torque = every[:, 3]
    unexplained = torque - every[:, :3] @ [kp, kd, constant]
    share = float(unexplained.var() / max(torque.var(), MIN_VARIANCE))
    return Gains(float(kp), _jackknife_error(sums), float(kd), 1 - share)


def _jackknife_error(sums: list[Array]) -> float:
    """Return the standard error of kp, N·m/rad, by leaving out each recording in turn; arguments as
    of `_two_stage_least_squares`, of each recording.
    """
    n = len(sums)
    total = np.sum(sums, axis=0)
    kp = np.array([_two_stage_least_squares(total - own)[0] for own in sums])
    return float(np.sqrt((n - 1) / n * np.square(kp - kp.mean()).sum()))


def _regression_rows(recording: Array, late: int) -> tuple[Array, Array, Array]:
    """Return the columns error of the command, −velocity and 1, (rows, 3), the torque, (rows,),
    and the instruments, (rows, INSTRUMENTS + 1); arguments as of `servo_gains`, of one recording.
    """
    ctrl, qpos, qvel, tau = recording
    row = np.arange(len(tau) - late)
    earlier = [ctrl[np.maximum(row - periods, 0)] for periods in range(INSTRUMENTS)]
    error = _moving_mean(ctrl[row] - qpos[late:])
    speed = _moving_mean(-qvel[late:])
    torque = _moving_mean(tau[late:])
    commands = [_moving_mean(command) for command in earlier]
    one = np.ones_like(torque)
    x = np.stack([error, speed, one], axis=1)
    instruments = np.stack([*commands, one], axis=1)
    return x, torque, instruments


def _moving_mean(x: Array) -> Array:
    """Return the means of AVERAGED_ROWS successive numbers."""
    return np.convolve(x.astype(float), np.ones(AVERAGED_ROWS) / AVERAGED_ROWS, "valid")


def _two_stage_least_squares(sums: Array) -> Array:
    """Return the factors (3,) of the columns x, for torque τ, from zᵀz, zᵀx and zᵀτ of instruments
    z beside each other, (m, m + 3 + 1).
    """
    zz = sums[:, :-4]
    zx = sums[:, -4:-1]
    zt = sums[:, -1]
    x_by_z, *_ = np.linalg.lstsq(zz, zx)  # the first stage: x by its instruments
    factors, *_ = np.linalg.lstsq(x_by_z.T @ zx, x_by_z.T @ zt)
    return np.asarray(factors)


class _BalanceRow(NamedTuple):
    """Torque of one joint in one row of a recording, and what it has to move."""

    joint: int
    mass: Array  # payload in each mount, (mounts,) kg
    without_payload: float  # torque that the robot alone requires, N·m
    motion: Array  # of each mount's body per radian of the joint: shift, turn, (mounts, 2, 3)
    frame: Array  # of each mount's body, (mounts, 3, 3)
    tau: float  # recorded torque, N·m
    qacc: float  # rad/s²
    qvel: float  # rad/s


@dataclass(frozen=True)
class _Balance:
    """Rows of `_BalanceRow` as arrays, (k, …).

    Attributes:
        joints: Numbers of the joints that have rows.
        column: Place of each row's joint among them, (k,).
    """

    joints: list[int]
    column: Array
    mass: Array
    without_payload: Array
    motion: Array
    frame: Array
    tau: Array
    qacc: Array
    qvel: Array

    @classmethod
    def of_rows(cls, rows: list[_BalanceRow]) -> _Balance:
        """Stack rows."""
        joint, *channels = zip(*rows, strict=True)
        joints = sorted(set(joint))
        column = np.array([joints.index(j) for j in joint])
        return cls(joints, column, *map(np.array, channels))

    def required(self, place: Array, hand: float) -> Array:
        """Return the torques that inverse dynamics require, (k,) N·m.

        Args:
            place: Of the payload at the first mount, (3,) m.
            hand: Mass of the hand that the model lacks, kg.
        """
        mounts = self.mass.shape[1]
        places = np.array([_place(number, place) for number in range(mounts)])
        lever = np.einsum("kmij,mj->kmi", self.frame, places)
        shift = self.motion[:, :, 0]
        turn = self.motion[:, :, 1]
        # How far each payload moves for a radian, (k, mounts, 3) m: 0 for a joint that does not
        # carry it.
        moved = shift + np.cross(turn, lever)
        inertia = np.square(moved).sum(axis=-1)  # of a kilogram, (k, mounts) m²
        torque_of_kilogram = GRAVITY * moved[..., 2] + inertia * self.qacc[:, None]
        of_payloads = ((self.mass + hand) * torque_of_kilogram).sum(axis=1)
        return np.asarray(self.without_payload + of_payloads)


def _solve_balance(balance: _Balance, mount: PayloadMount) -> tuple[Array, Array]:
    """Return the payload's place, m, and the hand's mass, kg, (4,), and the joints' own friction,
    armature and damping, (3, joints) SI, by least squares; a place that torque does not determine
    stays.
    """
    friction = np.tanh(balance.qvel / SLIP_SPEED)
    by_own = np.stack([friction, balance.qacc, balance.qvel])  # (3, k)
    count = 3 * len(balance.joints)
    pos = np.array(mount.pos)
    start = np.concatenate([pos, [mount.mass], np.zeros(count)])
    low = np.concatenate([pos - MAX_MOVE_M, [0.0], np.zeros(count)])
    high = np.concatenate([pos + MAX_MOVE_M, [MAX_HAND_MASS_KG], np.full(count, MAX_OWN)])

    def residual(x: Array) -> Array:
        place = x[:3]
        hand = x[3]
        own = x[4:].reshape(3, -1)[:, balance.column]  # (3, k)
        required = balance.required(place, hand) + (own * by_own).sum(axis=0)
        price = MOUNT_PRIOR_NM_PER_M * (place - pos)
        return np.concatenate([required - balance.tau, price])

    scale = np.concatenate([0.1 * np.ones(3), [1.0], np.ones(count)])
    first = np.clip(start, low + 1e-6, high - 1e-6)
    solution = least_squares(residual, first, bounds=(low, high), x_scale=scale, loss="soft_l1").x
    return solution[:4], solution[4:].reshape(3, -1)


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
        self.sequences = [s for s in sequences if _has_torque_of_unknown_gains(s)]
        self._given = robot
        self.known: dict[str, Gains] = {}
        servos = {}
        if len(self.sequences) == len(sequences):
            for joint, gains in self.gains().items():
                if gains.trusted:
                    self.known[joint] = gains
                    servos[joint] = {"kp": gains.kp, "kd": gains.kd}
        self.robot = robot.with_identified(servos)
        masses = {s.meta.payload_mass for s in self.sequences}
        self.several_payloads = bool(robot.payload_mounts) and len(masses) > 1

    def gains(self) -> dict[str, Gains]:
        """Return joint → gains; without joints whose command never moves."""
        recordings: dict[str, list[Array]] = {}  # joint → (4, T) each, as of `servo_gains`
        periods: dict[str, list[float]] = {}  # joint → control period of each, s
        for s in self.sequences:
            assert s.tau is not None
            for j in _moved(s, self._given):
                own = np.stack([s.ctrl[:, j], s.qpos[:, j], s.qvel[:, j], s.tau[:, j]])
                joint = self._given.joint_names[j]
                recordings.setdefault(joint, []).append(own)
                periods.setdefault(joint, []).append(s.dt)
        return {joint: _best_gains(own, periods[joint]) for joint, own in recordings.items()}

    def payload_placed(self, friction: bool = False) -> RobotSpec:
        """Return the robot with the payload's place and the mass of the hand, by least squares on
        recorded torque.

        A joint's torque is that of the model, that of (payload + hand) at the mount, and that of
        the joint's own friction, armature and damping, which the robot takes over with `friction`.
        Every mount is moved alike, mirrored to the other side.
        """
        robot = self.robot
        balance = self._balance()
        place_and_hand, own = _solve_balance(balance, robot.payload_mounts[0])
        x, y, z, hand = (round(float(v), 3) for v in place_and_hand)
        mounts = []
        for number, mount in enumerate(robot.payload_mounts):
            mounts.append(replace(mount, pos=_place(number, (x, y, z)), mass=hand))
        if friction:
            robot = robot.with_identified(self._own_servos(balance.joints, own))
        return replace(robot, payload_mounts=tuple(mounts))

    def _own_servos(self, joints: list[int], own: Array) -> dict[str, dict[str, float]]:
        """Return joint → friction, armature and damping by torque; `own` as of `_solve_balance`."""
        armature_of_model = build_model(self.robot).dof_armature
        servos = {}
        for j, (dry, armature, damping) in zip(joints, own.T.round(4).tolist(), strict=True):
            servos[self.robot.joint_names[j]] = {
                "frictionloss": dry,
                "armature": float(armature_of_model[j]) + armature,
                "damping": damping,
            }
        return servos

    def _balance(self) -> _Balance:
        """Return the torques that inverse dynamics require, in rows of all recordings."""
        empty = tuple(replace(mount, mass=0.0) for mount in self.robot.payload_mounts)
        model = build_model(replace(self.robot, payload_mounts=empty))
        stride = max(MIN_BALANCE_STRIDE, sum(map(len, self.sequences)) // MAX_BALANCE_ROWS)
        rows: list[_BalanceRow] = []
        for s in self.sequences:
            rows += self._balance_rows(s, model, stride)
        return _Balance.of_rows(rows)

    def _balance_rows(
        self,
        s: Sequence,
        model: mujoco.MjModel,
        stride: int,
    ) -> list[_BalanceRow]:
        """Return a row for each moved joint in every `stride`th row of a recording."""
        assert s.tau is not None
        moved = _moved(s, self.robot)
        if not moved:
            return []
        mounts = self.robot.payload_mounts
        is_loaded = [s.meta.payload_side in ("both", mount.side) for mount in mounts]
        mass = s.meta.payload_mass * np.array(is_loaded)
        bodies = [model.body(mount.body).id for mount in mounts]
        data = mujoco.MjData(model)
        inertia = np.empty((model.nv, model.nv))
        # Of each mount's body: its shift and its turn by each joint.
        jac = np.empty((len(mounts), 2, 3, model.nv))
        speed = differentiate(lowpass(s.qpos.astype(float), s.dt, CUTOFF_HZ), s.dt)
        qacc = differentiate(speed, s.dt)
        rows = []
        for t in range(stride, len(s) - 1, stride):
            data.qpos[:] = s.qpos[t]
            data.qvel[:] = 0.0
            mujoco.mj_forward(model, data)
            mujoco.mj_fullM(model, data, inertia)
            for body, (shift, turn) in zip(bodies, jac, strict=True):
                mujoco.mj_jac(model, data, shift, turn, data.xpos[body], body)
            frame = data.xmat[bodies].reshape(-1, 3, 3)
            for j in moved:
                row = _BalanceRow(
                    joint=j,
                    mass=mass,
                    without_payload=data.qfrc_bias[j] + inertia[j, j] * qacc[t, j],
                    motion=jac[..., j].copy(),
                    frame=frame,
                    tau=float(s.tau[t, j]),
                    qacc=qacc[t, j],
                    qvel=float(s.qvel[t, j]),
                )
                rows.append(row)
        return rows

    def fit(self, options: TorqueOptions) -> RobotSpec:
        """Return the robot with values from torque, and near those with values from positions."""
        start = self.robot
        if options.place:
            start = self.payload_placed(options.friction)
        rollouts = JointRollouts(cut(self.sequences, MAX_WINDOWS), start)
        fields = CLASSIC[1:]  # without kp
        changes = Changes(first_values(start), fields)

        def errors(x: Array) -> Array:
            of_rollouts = rollouts.flat_errors(changes.values(x))
            of_prior = options.prior * x
            return np.concatenate([of_rollouts, of_prior], axis=2) / ERROR_SCALE_RAD

        first = np.zeros((1, *changes.low.shape))
        first[..., fields.index("delay")] = START_DELAY
        x, _ = descend(Problems(errors, changes.low, changes.high), first, ITERATIONS)
        values = changes.values(x)
        return with_values(start, {field: values[field][0] for field in fields})


def _has_torque_of_unknown_gains(s: Sequence) -> bool:
    """Return whether a recording has torque, and does not state the gains that made it."""
    return s.tau is not None and s.meta.recorded_gains[0] is None


def _best_gains(recordings: list[Array], periods: list[float]) -> Gains:
    """Return a servo's gains with the delay that explains most of its torque.

    Args:
        recordings: As of `servo_gains`.
        periods: Control period of each, s.
    """
    shortest = min(periods)
    most = max(MIN_LATE_PERIODS, round(MAX_LATE_S / shortest))
    tried = []
    for count in range(1, most + 1):
        delay = count * shortest
        late = [max(1, round(delay / dt)) for dt in periods]
        tried.append(servo_gains(recordings, late))
    return max(tried, key=lambda gains: gains.explained)


def _place(mount: int, first: ListOf[float] | Array) -> tuple[float, float, float]:
    """Return the payload's position at a mount for that at the first mount: mirrored, m."""
    x, y, z = first
    if mount > 0:
        y = -y
    return x, y, z


def _moved(sequence: Sequence, robot: RobotSpec) -> list[int]:
    """Return the operated joints that a recording holds and whose command moves."""
    op = robot.operated_index
    is_moved = np.ptp(sequence.ctrl[:, op], axis=0) > MIN_MOVE_RAD
    moved: list[int] = op[is_moved & sequence.meta.records(robot.operated)].tolist()
    return moved
