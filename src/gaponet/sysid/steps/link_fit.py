"""Fit of a robot's links together with its servos, in the simulator of the whole robot.

Only directions of the links' coordinates that recordings determine better than the prior are
fitted; what is at right angles to them stays. Without payloads, nothing shows whether all masses
and all gains are larger alike, and both stay.
"""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.data.signals import differentiate, lowpass
from gaponet.sim.dynamics import CUTOFF_HZ, inverse_dynamics
from gaponet.sim.links import COORDINATES, LinkAxes, LinkResult
from gaponet.sim.model import build_model, with_links
from gaponet.sysid import least_squares
from gaponet.sysid.axes import CLASSIC, Axes, Values
from gaponet.sysid.joint_rollouts import ERROR_SCALE_RAD, SLIP_SPEED
from gaponet.sysid.least_squares import DIFFERENCE_STEP, Progress
from gaponet.sysid.problem import MIN_COST_DECREASE, PRIOR_LOG_STD, PRIORS, RobotFit, cluster_sums

ROWS = 400  # of recordings, whose torques choose directions
MIN_INFORMATION = 1.0  # of a direction that is fitted, over the prior's
MAX_DIRECTIONS = 12
MIN_KP_LOG_STD = 0.05  # of a kp from recorded torque, whose scale is a motor constant
ITERATIONS = (1, 2)  # with the first residual, and with what that leaves
FIRST_RESIDUAL_SHARE = 0.25  # of the servos' residual, which wrong links may have caused
MAX_SERVO_NUMBERS = 36  # that are fitted with the links; of robots with more, FEW_FIELDS
FEW_FIELDS = ("kp", "armature")
MIN_CHANGE = 0.1  # of a link's coordinates, in standard deviations of the prior; less is none
MAX_CHANGE = 6.0
ENCODER_ZERO_STD_RAD = 0.006  # a third of a degree, as a joint's zero at its stop is set by hand
MIN_SIGNIFICANCE = 2.0  # standard errors, of the change along some direction; else all links stay


class LinkFit:
    """Fit of links and servos; `directions` are orthonormal columns (L · COORDINATES, K) that
    recordings determine.
    """

    def __init__(
        self, whole: RobotFit, values: Values, torque_kp: dict[str, tuple[float, float]]
    ) -> None:
        """Take a fit of servos, its values (n,), and joint → kp from torque and its standard
        error.
        """
        fields = CLASSIC if whole.bounds.n * len(CLASSIC) <= MAX_SERVO_NUMBERS else FEW_FIELDS
        self.whole = whole
        self._servos = Axes(whole.bounds, fields, values)
        self._first = values
        self.axes = LinkAxes(whole.robot)
        self._n = whole.bounds.n
        self._prior = copy.copy(whole.prior)
        self._prior.log_std = dict(PRIOR_LOG_STD)  # a stated kp would shift all masses
        kp, error = np.array([torque_kp.get(j, (np.nan, np.nan)) for j in whole.robot.operated]).T
        self._kp_std = np.maximum(error / kp, MIN_KP_LOG_STD)  # nan where torque does not state it
        self._prior.state_kp(kp, self._kp_std)
        self._prior.residual = FIRST_RESIDUAL_SHARE * whole.prior.residual
        self._weigh()
        none: Array = np.zeros((0, 0))
        self.directions, self._rest = self._determined() if self.axes.names else (none, none)

    def _weigh(self) -> None:
        """Weigh each joint's errors by its residual; the prior weighs as much as errors of the
        mean residual.
        """
        std = self._prior.error_std()
        self._level = float(np.sqrt(np.mean(std**2)))
        self._weight = np.clip(self._level / std, 0.3, 3.0)

    def _determined(self) -> tuple[Array, Array]:
        """Return directions with more information than the prior's, and the covariance along
        others, (10 L, 10 L).

        They come from inverse dynamics. A change of torque moves a joint by itself over kp. What
        gains, offsets, damping, friction and armature of the joint explain as well does not count,
        so without payloads or recorded torque all masses do not change together.
        """
        parts = self.whole.rollouts.parts
        motions = list[Array]()
        torques = list[Array]()
        changes = list[Array]()
        stride = max(1, sum(map(len, parts)) // ROWS)
        for payload in dict.fromkeys(map(_payload, parts)):
            same = [_smooth_motion(s)[:, ::stride] for s in parts if _payload(s) == payload]
            motion = np.concatenate(same, axis=1)
            torque, torque_changes = self._torques_by_link(motion, payload)
            motions.append(motion)
            torques.append(torque)
            changes.append(torque_changes)
        torque = np.concatenate(torques)  # (rows, n) N·m
        _, v, a = np.concatenate(motions, axis=1)
        kp = self._first["kp"]
        moved = np.concatenate(changes, axis=1) / DIFFERENCE_STEP / kp  # (10 L, rows, n) rad
        measurements = sum(s.duration for s in parts) / self._prior.correlation_time  # (n,)
        size = self.axes.scale.size
        information = np.zeros((size, size))
        for i, j in enumerate(self.whole.rollouts.op):
            weight = np.sqrt(measurements[i] / len(v)) / self._prior.residual[i]
            friction = np.tanh(v[:, j] / SLIP_SPEED)
            own = [torque[:, i] / kp[i], np.ones(len(v)), v[:, j], a[:, j], friction]
            by_servo = weight * np.stack(own, axis=1)  # (rows, 5)
            by_link = weight * moved[:, :, i].T  # (rows, 10 L)
            stated = np.diag([np.nan_to_num(self._kp_std[i] ** -2), 0, 0, 0, 0])
            # What links explain beyond the servo, by the Schur complement.
            of_servo = np.linalg.pinv(by_servo.T @ by_servo + stated)
            information += (
                by_link.T @ by_link - by_link.T @ by_servo @ of_servo @ by_servo.T @ by_link
            )
        strength, vectors = np.linalg.eigh(information)
        chosen = np.flatnonzero(strength > MIN_INFORMATION)[::-1][:MAX_DIRECTIONS]
        rest = np.delete(vectors / np.sqrt(np.maximum(strength, MIN_INFORMATION)), chosen, axis=1)
        return vectors[:, chosen], rest @ rest.T

    def _torques_by_link(self, motion: Array, payload: tuple[float, str]) -> tuple[Array, Array]:
        """Return the torques that a motion requires, (rows, n) N·m, and their changes by
        DIFFERENCE_STEP of each link coordinate, (10 L, rows, n) N·m.

        Args:
            motion: Positions, velocities and accelerations of all joints, (3, rows, joints).
        """
        op = self.whole.rollouts.op
        robot = self.whole.robot.with_table(None)
        model = build_model(robot, *payload)
        torque = inverse_dynamics(model, *motion)[:, op]
        changed = []
        for x in DIFFERENCE_STEP * np.eye(self.axes.scale.size):
            other = with_links(model, replace(robot, links=self.axes.links(x)))
            changed.append(inverse_dynamics(other, *motion)[:, op])
        return torque, np.array(changed) - torque

    def _unpacked(self, x: Array) -> tuple[Values, list[Array]]:
        """Return servo values (k, n) and link coordinates of candidates x (k, 1, P)."""
        servos, z = np.split(x[:, 0], [self._n * len(self._servos.names)], axis=1)
        return self._servos.values(servos.reshape(len(x), self._n, -1)), list(z @ self.directions.T)

    def errors(self, x: Array, **other: Array) -> Array:
        """Return errors of candidates (k, 1, P), (k, 1, n · (rows + PRIORS) + K) in
        ERROR_SCALE_RAD.
        """
        values, links = self._unpacked(x)
        errors = (
            self.whole.rollouts.flat_errors(values | other, [self.axes.links(c) for c in links])
            / ERROR_SCALE_RAD
        )
        own = np.concatenate([errors, self._prior.errors(values)], axis=2) * self._weight[:, None]
        z = x[:, 0, self._n * len(self._servos.names) :]
        return np.concatenate([own.reshape(len(x), -1), self._level * z], axis=1)[:, None]

    def descend(self, report: Progress) -> LinkResult:
        """Fit links and servos together; return them with the links' covariance."""
        first = np.r_[
            self._servos.normalize(self._first).ravel(), np.zeros(self.directions.shape[1])
        ]
        if not self.directions.size:
            return LinkResult(
                self.axes, np.zeros(self.axes.scale.size), np.eye(self.axes.scale.size), self._first
            )
        x = first[None, None]
        ends = np.full(self.directions.shape[1], MAX_CHANGE)
        low = np.r_[self._servos.low.ravel(), -ends][None]
        high = np.r_[self._servos.high.ravel(), ends][None]
        for i, count in enumerate(ITERATIONS):
            if i:
                values, coordinates = self._unpacked(x[0][None])
                errors = self.whole.rollouts.flat_errors(
                    values, [self.axes.links(c) for c in coordinates]
                )
                cost = least_squares.soft_l1(errors[0] / ERROR_SCALE_RAD)
                self._prior.update_residual(cost, self.whole.rollouts.rows)
                self._weigh()
            x, _ = least_squares.descend(
                x, low, high, self.errors, count, report, MIN_COST_DECREASE
            )
        values, coordinates = self._unpacked(x[0][None])
        by_link = coordinates[0].reshape(-1, COORDINATES)
        by_noise, by_zeros = self._covariances(x[0, 0])
        along = coordinates[0] @ self.directions  # (K,)
        is_small = np.abs(by_link).max(axis=1, keepdims=True) < MIN_CHANGE
        is_noise = (np.abs(along) <= MIN_SIGNIFICANCE * np.sqrt(np.diag(by_noise))).all()
        changed = np.where(is_small | is_noise, 0.0, by_link).ravel()
        covariance = self.directions @ (by_noise + by_zeros) @ self.directions.T + self._rest
        fitted = {field: value[0].copy() for field, value in values.items()}
        return LinkResult(self.axes, changed, covariance, fitted)

    def _slopes(self, x: Array) -> tuple[Array, Array]:
        """Return errors at x (P,) and their differences over x, (m,) and (m, P)."""
        here, jac = least_squares.slopes(x[None, None], np.full((1, len(x)), np.inf), self.errors)
        return here[0, 0], jac[0, 0]

    def _covariances(self, x: Array) -> tuple[Array, Array]:
        """Return covariances along the directions at x (P,), (K, K): by noise and prior, and by
        the encoders' zeros.

        A wrong zero turns gravity as another centre of mass does, and no recorded position shows
        which it is.
        """
        here, jac = self._slopes(x)
        count = self.directions.shape[1]
        n = self._n
        own_zeros = self.whole.robot.servo.zero[self.whole.rollouts.op]
        zeros = own_zeros + ENCODER_ZERO_STD_RAD * np.eye(n)
        by_zero = self.errors(np.repeat(x[None, None], n, axis=0), zero=zeros)[:, 0] - here
        weighted = jac / np.sqrt(1 + here**2)[:, None]
        rows = (len(here) - count) // n
        mine, by_joint = (
            y[: n * rows].reshape(n, rows, -1) for y in (weighted * here[:, None], jac)
        )
        each = cluster_sums(mine[:, :-PRIORS], self.whole.rollouts.window)[0].sum(axis=0)
        each -= each.mean(axis=0)
        held = np.concatenate([*by_joint[:, -PRIORS:], jac[n * rows :]])
        scatter = (
            each.T @ each * (len(each) / max(len(each) - count, 1)) ** 2
            + self._level**2 * held.T @ held
        )
        inverse = np.linalg.pinv(jac.T @ weighted, rcond=1e-10, hermitian=True)
        shifted = (inverse @ weighted.T @ by_zero.T)[-count:]
        return (inverse @ scatter @ inverse)[-count:, -count:], shifted @ shifted.T

    def servo_slopes(self, result: LinkResult) -> dict[str, Array]:
        """Return how the servos follow the links: field → its change on its axis for one of x, (n,
        L · COORDINATES).
        """
        along_all = copy.copy(self)
        along_all.directions = np.eye(len(result.x))
        count = self._servos.unit.size  # numbers of the servos in x
        x = np.r_[self._servos.normalize(result.values).ravel(), result.x]
        errors, jac = along_all._slopes(x)
        normal = jac.T @ (jac / np.sqrt(1 + errors**2)[:, None])
        of_servos = np.linalg.pinv(normal[:count, :count], rcond=1e-10, hermitian=True)
        slopes = -of_servos @ normal[:count, count:]
        slopes = slopes.reshape(*self._servos.unit.shape, -1) * self._servos.unit[..., None]
        by_field = dict(zip(self._servos.names, np.moveaxis(slopes, 1, 0), strict=True))
        if "damping" in by_field:
            # The fitted sum with kd over kp keeps its value, and kd does not change with kp.
            kd_over_kp = self.whole.bounds.kd / result.values["kp"]
            by_field["damping"] += kd_over_kp[:, None] * by_field["kp"]
        return by_field


def _payload(s: Sequence) -> tuple[float, str]:
    """Return mass, kg, and side of a recording's payload."""
    return s.meta.payload_mass, s.meta.payload_side


def _smooth_motion(s: Sequence) -> Array:
    """Return smooth positions, velocities and accelerations of a recording, (3, T, joints)."""
    qpos = lowpass(s.qpos.astype(float), s.dt, CUTOFF_HZ)
    qvel = differentiate(qpos, s.dt)
    return np.stack([qpos, qvel, differentiate(qvel, s.dt)])
