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
from gaponet.sysid.axes import CLASSIC, Axes, Values, first_candidate
from gaponet.sysid.joint_rollouts import ERROR_SCALE_RAD, SLIP_SPEED
from gaponet.sysid.least_squares import (
    DIFFERENCE_STEP,
    Problems,
    Progress,
    descend,
    slopes,
    soft_l1,
)
from gaponet.sysid.problem import MIN_COST_DECREASE, PRIOR_LOG_STD, PRIORS, RobotFit
from gaponet.sysid.standard_errors import cluster_sums

DYNAMICS_ROWS = 400  # of recordings, about, whose torques choose directions
MIN_INFORMATION = 1.0  # of a direction that is fitted, over the prior's
MAX_DIRECTIONS = 12
# Of a kp from recorded torque, whose scale is a motor constant.
MIN_KP_LOG_STD = 0.05
FIRST_ITERATIONS = 1  # with the first residual
LATER_ITERATIONS = 2  # with the residual that these leave
# Of the servos' residual, which wrong links may have caused.
FIRST_RESIDUAL_SHARE = 0.25
# Of a joint's errors, over those of a joint of mean residual.
JOINT_WEIGHT_BOUNDS = (0.3, 3.0)
# That are fitted with the links; of robots with more, only FEW_FIELDS are.
MAX_SERVO_NUMBERS = 36
FEW_FIELDS = ("kp", "armature")
# Of a link's coordinates, in standard deviations of the prior: a smaller change is none.
MIN_CHANGE = 0.1
MAX_CHANGE = 6.0
# A third of a degree, as a joint's zero at its stop is set by hand.
ENCODER_ZERO_STD_RAD = 0.006
PINV_RCOND = 1e-10  # eigenvalues that are smaller by this count as none
# Standard errors, of the change along some direction; else all links stay.
MIN_SIGNIFICANCE = 2.0


class _DynamicsRows(NamedTuple):
    """Rows of recordings, with what the links' inertias do in them."""

    qvel: Array  # of operated joints, (rows, n) rad/s
    qacc: Array  # (rows, n) rad/s²
    torque: Array  # that the motion requires, (rows, n) N·m
    moved: Array  # angle over kp by which each link coordinate moves joints, (10 L, rows, n) rad


class LinkFit:
    """Fit of the coordinates of L links (sim/links.py, 10 of each link) and of n servos.

    A candidate x, (P,), holds the servos' numbers in large changes, joint by joint, and then a
    change along each direction, in standard deviations of the prior.

    Attributes:
        whole: Fit of the servos in the simulator of the whole robot.
        axes: The links' coordinates.
        directions: Directions of coordinates that recordings determine, orthonormal columns,
            (10 L, K).
    """

    def __init__(
        self,
        whole: RobotFit,
        values: Values,
        torque_kp: dict[str, tuple[float, float]],
    ) -> None:
        """
        Args:
            whole: Fit of the servos.
            values: Its values, (n,).
            torque_kp: Joint → kp from recorded torque, N·m/rad, and its standard error.
        """
        self.whole = whole
        self.axes = LinkAxes(whole.robot)
        self._n = whole.bounds.n
        self._first = values
        fields: tuple[str, ...] = CLASSIC
        if self._n * len(CLASSIC) > MAX_SERVO_NUMBERS:
            fields = FEW_FIELDS
        self._servos = Axes(whole.bounds, fields, values)
        self._servo_numbers = self._n * len(self._servos.names)
        self._prior = copy.copy(whole.prior)
        self._prior.log_std = dict(PRIOR_LOG_STD)  # a stated kp would shift all masses
        self._prior.residual = FIRST_RESIDUAL_SHARE * whole.prior.residual
        self._kp_std = self._state_kp(torque_kp)
        self.directions: Array = np.zeros((0, 0))
        self._rest: Array = np.zeros((0, 0))  # covariance along all other directions, (10 L, 10 L)
        if self.axes.names:
            self.directions, self._rest = self._determined()

    def _state_kp(self, torque_kp: dict[str, tuple[float, float]]) -> Array:
        """Let the prior hold a kp from torque; return the standard deviation of its logarithm,
        (n,), nan where torque does not state it.
        """
        kp = np.full(self._n, np.nan)
        error = np.full(self._n, np.nan)
        for i, joint in enumerate(self.whole.robot.operated):
            if joint in torque_kp:
                kp[i], error[i] = torque_kp[joint]
        std = np.asarray(np.maximum(error / kp, MIN_KP_LOG_STD))
        self._prior.state_kp(kp, std)
        return std

    @property
    def _prior_scale(self) -> float:
        """Root mean square over joints of the standard deviation of one row's error beside the
        prior, in ERROR_SCALE_RAD: the prior weighs as much as errors of the mean residual.
        """
        return float(np.sqrt(np.mean(self._prior.error_std() ** 2)))

    @property
    def _joint_weights(self) -> Array:
        """Weight of each joint's errors by its residual, (n,)."""
        return np.clip(self._prior_scale / self._prior.error_std(), *JOINT_WEIGHT_BOUNDS)

    def _determined(self) -> tuple[Array, Array]:
        """Return directions with more information than the prior's, (10 L, K), and the covariance
        along others, (10 L, 10 L).

        They come from inverse dynamics. A change of torque moves a joint by itself over kp. What
        gains, offsets, damping, friction and armature of the joint explain as well does not count,
        so without payloads or recorded torque all masses do not change together.
        """
        rows = self._dynamics_rows()
        coordinates = self.axes.scale.size  # 10 L
        information = np.zeros((coordinates, coordinates))
        for joint in range(self._n):
            information += self._information_beyond_servo(joint, rows)
        strength, vectors = np.linalg.eigh(information)  # the weakest first
        strongest_first = np.flatnonzero(strength > MIN_INFORMATION)[::-1]
        chosen = strongest_first[:MAX_DIRECTIONS]
        by_std = vectors / np.sqrt(np.maximum(strength, MIN_INFORMATION))
        rest = np.delete(by_std, chosen, axis=1)
        return vectors[:, chosen], rest @ rest.T

    def _dynamics_rows(self) -> _DynamicsRows:
        """Return some rows of the recordings, about DYNAMICS_ROWS, those of one payload after
        another.
        """
        parts = self.whole.rollouts.parts
        stride = max(1, sum(map(len, parts)) // DYNAMICS_ROWS)
        motions_by_payload: dict[tuple[float, str], list[Array]] = {}
        for part in parts:
            payload = (part.meta.payload_mass, part.meta.payload_side)
            motions_by_payload.setdefault(payload, []).append(_smooth_motion(part)[:, ::stride])
        motions = []
        torques = []
        changes = []
        for payload, motions_with_it in motions_by_payload.items():
            motion = np.concatenate(motions_with_it, axis=1)
            torque, torque_changes = self._torques_by_link(motion, payload)
            motions.append(motion)
            torques.append(torque)
            changes.append(torque_changes)
        _, qvel, qacc = np.concatenate(motions, axis=1)
        op = self.whole.rollouts.op
        torque_slopes = np.concatenate(changes, axis=1) / DIFFERENCE_STEP  # (10 L, rows, n) N·m
        return _DynamicsRows(
            qvel=qvel[:, op],
            qacc=qacc[:, op],
            torque=np.concatenate(torques),
            moved=torque_slopes / self._first["kp"],
        )

    def _information_beyond_servo(self, joint: int, rows: _DynamicsRows) -> Array:
        """Return the information that errors of a joint hold about link coordinates and that its
        servo does not explain as well, (10 L, 10 L): the Schur complement.
        """
        qvel = rows.qvel[:, joint]
        seconds = sum(part.duration for part in self.whole.rollouts.parts)
        measurements = seconds / self._prior.correlation_time[joint]
        weight = np.sqrt(measurements / len(qvel)) / self._prior.residual[joint]
        by_gain = rows.torque[:, joint] / self._first["kp"][joint]
        by_offset = np.ones(len(qvel))
        by_friction = np.tanh(qvel / SLIP_SPEED)
        columns = [by_gain, by_offset, qvel, rows.qacc[:, joint], by_friction]
        by_servo = weight * np.stack(columns, axis=1)  # (rows, 5)
        by_link = weight * rows.moved[:, :, joint].T  # (rows, 10 L)
        known_gain = np.nan_to_num(self._kp_std[joint] ** -2)
        servo_information = by_servo.T @ by_servo + np.diag([known_gain, 0, 0, 0, 0])
        servo_covariance = np.linalg.pinv(servo_information)
        explained = by_link.T @ by_servo @ servo_covariance @ by_servo.T @ by_link
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
            other_robot = replace(robot, links=self.axes.links(x))
            other_model = with_links(model, other_robot)
            changed.append(inverse_dynamics(other_model, *motion)[:, op])
        return torque, np.array(changed) - torque

    def _servo_values(self, x: Array) -> Values:
        """Return servo values (k, n) of candidates x (k, 1, P)."""
        numbers = x[:, 0, : self._servo_numbers]
        return self._servos.values(numbers.reshape(len(x), self._n, -1))

    def _coordinates(self, x: Array) -> Array:
        """Return link coordinates (k, 10 L) of candidates x (k, 1, P)."""
        along_directions = x[:, 0, self._servo_numbers :]
        return np.asarray(along_directions @ self.directions.T)

    def _rollout_errors(self, x: Array, values: Values) -> Array:
        """Return errors of rollouts with the links of candidates x (k, 1, P) and servo values (k,
        n), (k, n, rows) rad.
        """
        links = [self.axes.links(coordinates) for coordinates in self._coordinates(x)]
        return self.whole.rollouts.flat_errors(values, links)

    def errors(self, x: Array, **other: Array) -> Array:
        """Return errors of candidates (k, 1, P), (k, 1, n · (rows + PRIORS) + K) in
        ERROR_SCALE_RAD; `other` values (k, n) hold instead of those of x.
        """
        values = self._servo_values(x)
        of_rollouts = self._rollout_errors(x, values | other) / ERROR_SCALE_RAD
        of_prior = self._prior.errors(values)
        of_joints = np.concatenate([of_rollouts, of_prior], axis=2) * self._joint_weights[:, None]
        of_directions = self._prior_scale * x[:, 0, self._servo_numbers :]
        every = np.concatenate([of_joints.reshape(len(x), -1), of_directions], axis=1)
        return every[:, None]

    def descend(self, report: Progress) -> LinkResult:
        """Fit links and servos together; return them with the links' covariance."""
        if not self.directions.size:
            unchanged = np.zeros(self.axes.scale.size)
            return LinkResult(self.axes, unchanged, np.eye(len(unchanged)), self._first)
        x = self._searched(report)  # (1, 1, P)
        by_noise, by_zeros = self._covariances(x[0, 0])
        changed = self._significant(self._coordinates(x)[0], by_noise)
        covariance = self.directions @ (by_noise + by_zeros) @ self.directions.T + self._rest
        fitted = first_candidate(self._servo_values(x))
        return LinkResult(self.axes, changed, covariance, fitted)

    def _searched(self, report: Progress) -> Array:
        """Return servos and links that follow the recordings best, (1, 1, P)."""
        servos = self._servos.normalize(self._first).ravel()
        no_change = np.zeros(self.directions.shape[1])
        most = np.full(len(no_change), MAX_CHANGE)
        low = np.concatenate([self._servos.low.ravel(), -most])
        high = np.concatenate([self._servos.high.ravel(), most])
        problems = Problems(self.errors, low[None], high[None])
        start = np.concatenate([servos, no_change])[None, None]
        x, _ = descend(problems, start, FIRST_ITERATIONS, report, MIN_COST_DECREASE)
        self._update_residual(x)
        x, _ = descend(problems, x, LATER_ITERATIONS, report, MIN_COST_DECREASE)
        return np.asarray(x)

    def _update_residual(self, x: Array) -> None:
        """Take the residual that x (1, 1, P) leaves, by which joints are weighed."""
        errors = self._rollout_errors(x, self._servo_values(x))[0]  # (n, rows) rad
        cost = soft_l1(errors / ERROR_SCALE_RAD)
        self._prior.update_residual(cost, self.whole.rollouts.rows)

    def _significant(self, coordinates: Array, covariance: Array) -> Array:
        """Return link coordinates (10 L,) with 0 for links that hardly change, and for all links
        where no direction changes by more than noise of this covariance, (K, K).
        """
        along = np.abs(coordinates @ self.directions)  # (K,)
        noise = np.sqrt(np.diag(covariance))
        if (along <= MIN_SIGNIFICANCE * noise).all():
            return np.zeros_like(coordinates)
        by_link = coordinates.reshape(-1, COORDINATES).copy()
        hardly_changes = np.abs(by_link).max(axis=1) < MIN_CHANGE
        by_link[hardly_changes] = 0.0
        return by_link.ravel()

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
        weighted = _weighted(jac, errors)
        scatter = self._scatter(jac, weighted * errors[:, None])
        inverse = np.linalg.pinv(jac.T @ weighted, rcond=PINV_RCOND, hermitian=True)
        by_noise = inverse @ scatter @ inverse  # (P, P)
        by_zero = self._errors_by_zeros(x) - errors  # (n, m)
        shifted = inverse @ weighted.T @ by_zero.T  # (P, n)
        of_links = slice(-self.directions.shape[1], None)
        return by_noise[of_links, of_links], shifted[of_links] @ shifted[of_links].T

    def _scatter(self, jac: Array, gradient: Array) -> Array:
        """Return the scatter of the cost's gradient over windows, and that of the prior, (P, P);
        see `_covariance` of standard_errors.py.

        Args:
            jac, gradient: Slopes of all errors and of their costs, (m, P).
        """
        count = self.directions.shape[1]
        own = len(jac) - count  # errors of joints; those of the directions' prior follow
        jac_by_joint = jac[:own].reshape(self._n, own // self._n, -1)  # (n, rows + PRIORS, P)
        gradient_by_joint = gradient[:own].reshape(jac_by_joint.shape)
        of_rollouts = gradient_by_joint[:, :-PRIORS]
        by_joint, _ = cluster_sums(of_rollouts, self.whole.rollouts.window)  # (n, clusters, P)
        by_cluster = by_joint.sum(axis=0)
        by_cluster -= by_cluster.mean(axis=0)
        clusters = len(by_cluster)
        correction = clusters / max(clusters - count, 1)
        of_windows = by_cluster.T @ by_cluster * correction**2
        prior_slopes = np.concatenate([*jac_by_joint[:, -PRIORS:], jac[own:]])
        return np.asarray(of_windows + self._prior_scale**2 * prior_slopes.T @ prior_slopes)

    def _errors_by_zeros(self, x: Array) -> Array:
        """Return the errors at x (P,) with each joint's encoder zero off by its standard deviation,
        (n, m).
        """
        zero = self.whole.robot.servo.zero[self.whole.rollouts.op]
        zeros = zero + ENCODER_ZERO_STD_RAD * np.eye(self._n)
        return self.errors(np.repeat(x[None, None], self._n, axis=0), zero=zeros)[:, 0]

    def servo_slopes(self, result: LinkResult) -> dict[str, Array]:
        """Return how the servos follow the links: field → its change on its axis for one of each
        link coordinate, (n, 10 L).
        """
        of_all_coordinates = copy.copy(self)
        of_all_coordinates.directions = np.eye(len(result.x))
        servos = self._servos.normalize(result.values).ravel()
        errors, jac = of_all_coordinates._slopes(np.concatenate([servos, result.x]))
        normal = jac.T @ _weighted(jac, errors)
        count = self._servo_numbers
        of_servos = np.linalg.pinv(normal[:count, :count], rcond=PINV_RCOND, hermitian=True)
        in_large_changes = -of_servos @ normal[:count, count:]  # (n · P, 10 L)
        unit = self._servos.unit  # (n, P)
        on_axes = in_large_changes.reshape(*unit.shape, -1) * unit[..., None]
        by_field = dict(zip(self._servos.names, np.moveaxis(on_axes, 1, 0), strict=True))
        if "damping" in by_field:
            # The fitted sum with kd over kp keeps its value, and kd does not change with kp.
            kd_over_kp = self.whole.bounds.kd / result.values["kp"]
            by_field["damping"] += kd_over_kp[:, None] * by_field["kp"]
        return by_field


def _weighted(jac: Array, errors: Array) -> Array:
    """Return slopes (m, P) of errors (m,) with the weights of soft L1."""
    return np.asarray(jac / np.sqrt(1 + errors**2)[:, None])


def _smooth_motion(s: Sequence) -> Array:
    """Return smooth positions, velocities and accelerations of a recording, (3, T, joints)."""
    qpos = lowpass(s.qpos.astype(float), s.dt, CUTOFF_HZ)
    qvel = differentiate(qpos, s.dt)
    qacc = differentiate(qvel, s.dt)
    return np.stack([qpos, qvel, qacc])
