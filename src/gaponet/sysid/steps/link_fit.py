"""Fit of a robot's links together with its servos, in the simulator of the whole robot.

Only directions of the links' coordinates that recordings determine better than the prior are
fitted; what is at right angles to them stays. Without payloads, nothing shows whether all masses
and all gains are larger alike, and both stay.
"""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.data.signals import differentiate, lowpass
from gaponet.sim.dynamics import CUTOFF_HZ, inverse_dynamics
from gaponet.sim.links import COORDINATES, LinkAxes, LinkResult
from gaponet.sim.model import build_model, with_links
from gaponet.sysid.axes import CLASSIC, Axes, Values
from gaponet.sysid.joint_rollouts import ERROR_SCALE_RAD, SLIP_SPEED
from gaponet.sysid.least_squares import (
    DIFFERENCE_STEP,
    Problems,
    Progress,
    descend,
    slopes,
    soft_l1,
)
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


class _DynamicsRows(NamedTuple):
    """Rows of recordings, with what the links' inertias do in them."""

    qvel: Array  # of operated joints, (rows, n) rad/s
    qacc: Array  # (rows, n) rad/s²
    torque: Array  # that the motion requires, (rows, n) N·m
    moved: Array  # angle over kp by which each link coordinate moves joints, (10 L, rows, n) rad


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
        size = self.axes.scale.size
        rows = self._dynamics_rows()
        information = np.zeros((size, size))
        for i in range(self._n):
            information += self._information_beyond_servo(i, rows)
        strength, vectors = np.linalg.eigh(information)
        chosen = np.flatnonzero(strength > MIN_INFORMATION)[::-1][:MAX_DIRECTIONS]
        rest = np.delete(vectors / np.sqrt(np.maximum(strength, MIN_INFORMATION)), chosen, axis=1)
        return vectors[:, chosen], rest @ rest.T

    def _dynamics_rows(self) -> _DynamicsRows:
        """Return some rows of the recordings, about ROWS, those of one payload after another."""
        parts = self.whole.rollouts.parts
        stride = max(1, sum(map(len, parts)) // ROWS)
        motions = list[Array]()
        torques = list[Array]()
        changes = list[Array]()
        for payload in dict.fromkeys(map(_payload, parts)):
            with_payload = [part for part in parts if _payload(part) == payload]
            smooth = [_smooth_motion(part)[:, ::stride] for part in with_payload]
            motion = np.concatenate(smooth, axis=1)
            torque, torque_changes = self._torques_by_link(motion, payload)
            motions.append(motion)
            torques.append(torque)
            changes.append(torque_changes)
        _, qvel, qacc = np.concatenate(motions, axis=1)
        op = self.whole.rollouts.op
        moved = np.concatenate(changes, axis=1) / DIFFERENCE_STEP / self._first["kp"]
        return _DynamicsRows(qvel[:, op], qacc[:, op], np.concatenate(torques), moved)

    def _information_beyond_servo(self, i: int, rows: _DynamicsRows) -> Array:
        """Return the information that errors of joint i hold about link coordinates and that its
        servo does not explain as well, (10 L, 10 L): the Schur complement.
        """
        qvel = rows.qvel[:, i]
        seconds = sum(part.duration for part in self.whole.rollouts.parts)
        measurements = seconds / self._prior.correlation_time[i]
        weight = np.sqrt(measurements / len(qvel)) / self._prior.residual[i]
        by_gain = rows.torque[:, i] / self._first["kp"][i]
        friction = np.tanh(qvel / SLIP_SPEED)
        columns = [by_gain, np.ones(len(qvel)), qvel, rows.qacc[:, i], friction]
        by_servo = weight * np.stack(columns, axis=1)  # (rows, 5)
        by_link = weight * rows.moved[:, :, i].T  # (rows, 10 L)
        stated = np.diag([np.nan_to_num(self._kp_std[i] ** -2), 0, 0, 0, 0])
        of_servo = np.linalg.pinv(by_servo.T @ by_servo + stated)
        explained = by_link.T @ by_servo @ of_servo @ by_servo.T @ by_link
        return np.asarray(by_link.T @ by_link - explained)

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
        if not self.directions.size:
            unchanged = np.zeros(self.axes.scale.size)
            return LinkResult(self.axes, unchanged, np.eye(len(unchanged)), self._first)
        x = self._searched(report)
        values, links = self._unpacked(x)
        by_noise, by_zeros = self._covariances(x[0, 0])
        changed = self._significant(links[0], by_noise)
        covariance = self.directions @ (by_noise + by_zeros) @ self.directions.T + self._rest
        fitted = {field: value[0].copy() for field, value in values.items()}
        return LinkResult(self.axes, changed, covariance, fitted)

    def _searched(self, report: Progress) -> Array:
        """Return servos and links that follow the recordings best, (1, 1, P)."""
        servos = self._servos.normalize(self._first).ravel()
        ends = np.full(self.directions.shape[1], MAX_CHANGE)
        x = np.r_[servos, np.zeros(len(ends))][None, None]
        low = np.r_[self._servos.low.ravel(), -ends][None]
        high = np.r_[self._servos.high.ravel(), ends][None]
        problems = Problems(self.errors, low, high)
        for i, count in enumerate(ITERATIONS):
            if i:
                self._update_residual(x)
            x, _ = descend(problems, x, count, report, MIN_COST_DECREASE)
        return np.asarray(x)

    def _update_residual(self, x: Array) -> None:
        """Take the residual that x (1, 1, P) leaves, and weigh joints by it."""
        values, coordinates = self._unpacked(x)
        links = [self.axes.links(c) for c in coordinates]
        errors = self.whole.rollouts.flat_errors(values, links)
        cost = soft_l1(errors[0] / ERROR_SCALE_RAD)
        self._prior.update_residual(cost, self.whole.rollouts.rows)
        self._weigh()

    def _significant(self, coordinates: Array, covariance: Array) -> Array:
        """Return link coordinates (L · COORDINATES,) with 0 for links that hardly change, and for
        all links where no direction changes by more than noise of this covariance, (K, K).
        """
        by_link = coordinates.reshape(-1, COORDINATES)
        is_small = np.abs(by_link).max(axis=1, keepdims=True) < MIN_CHANGE
        along = np.abs(coordinates @ self.directions)  # (K,)
        is_noise = (along <= MIN_SIGNIFICANCE * np.sqrt(np.diag(covariance))).all()
        return np.where(is_small | is_noise, 0.0, by_link).ravel()

    def _slopes(self, x: Array) -> tuple[Array, Array]:
        """Return errors at x (P,) and their differences over x, (m,) and (m, P)."""
        here, jac = slopes(x[None, None], np.full((1, len(x)), np.inf), self.errors)
        return here[0, 0], jac[0, 0]

    def _covariances(self, x: Array) -> tuple[Array, Array]:
        """Return covariances along the directions at x (P,), (K, K): by noise and prior, and by
        the encoders' zeros.

        A wrong zero turns gravity as another centre of mass does, and no recorded position shows
        which it is.
        """
        errors, jac = self._slopes(x)  # (m,) and (m, P)
        count = self.directions.shape[1]
        weighted = jac / np.sqrt(1 + errors**2)[:, None]
        scatter = self._scatter(jac, weighted * errors[:, None])
        inverse = np.linalg.pinv(jac.T @ weighted, rcond=1e-10, hermitian=True)
        by_zero = self._errors_by_zeros(x) - errors  # (n, m)
        shifted = (inverse @ weighted.T @ by_zero.T)[-count:]
        return (inverse @ scatter @ inverse)[-count:, -count:], shifted @ shifted.T

    def _scatter(self, jac: Array, gradient: Array) -> Array:
        """Return the scatter of the cost's gradient over windows, and that of the prior, (P, P);
        see `_covariance` of problem.py.

        Args:
            jac, gradient: Slopes of all errors and of their costs, (m, P).
        """
        count = self.directions.shape[1]
        own = len(jac) - count  # errors of joints; those of the directions' prior follow
        jac_by_joint = jac[:own].reshape(self._n, own // self._n, -1)
        gradient_by_joint = gradient[:own].reshape(jac_by_joint.shape)
        window = self.whole.rollouts.window
        by_joint, _ = cluster_sums(gradient_by_joint[:, :-PRIORS], window)
        by_window = by_joint.sum(axis=0)  # (windows, P)
        by_window -= by_window.mean(axis=0)
        correction = len(by_window) / max(len(by_window) - count, 1)
        of_prior = np.concatenate([*jac_by_joint[:, -PRIORS:], jac[own:]])
        of_windows = by_window.T @ by_window * correction**2
        return np.asarray(of_windows + self._level**2 * of_prior.T @ of_prior)

    def _errors_by_zeros(self, x: Array) -> Array:
        """Return the errors at x (P,) with each joint's encoder zero off by its standard deviation,
        (n, m).
        """
        zero = self.whole.robot.servo.zero[self.whole.rollouts.op]
        zeros = zero + ENCODER_ZERO_STD_RAD * np.eye(self._n)
        return self.errors(np.repeat(x[None, None], self._n, axis=0), zero=zeros)[:, 0]

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
