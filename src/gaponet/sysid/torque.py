"""Identification from recorded torque, for windows so short that positions do not tell a gain from a load.

A servo's own law says its gains: torque = kp (command − position) − kd velocity. What the model does not ask for says
where payloads hang and what hand it lacks, by least squares. Positions say damping, friction, armature, zero and delay,
near that. How near, and which of it is believed, is chosen on motions that were not fitted.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import replace
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.optimize import least_squares

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.data.signals import differentiate, lowpass
from gaponet.robot.spec import RobotSpec
from gaponet.sim.dynamics import CUTOFF
from gaponet.sim.metrics import metrics, runs
from gaponet.sim.model import build_model
from gaponet.sim.replay import replay, whole_errors
from gaponet.sysid.axes import CLASSIC, MAX_DELAY, Bounds
from gaponet.sysid.fit import Fit, Identified, Tried
from gaponet.sysid.joint_rollouts import SOFT, JointRollouts
from gaponet.sysid.least_squares import descend
from gaponet.sysid.refit import PRIOR
from gaponet.sysid.robot_rollouts import cut

WINDOWS = 80  # at most, since they may be short
EVERY, MOST = 5, 6000  # rows between those that tell where a payload hangs, and how many
PRIOR_MOUNT = 3.0  # N·m for a metre
MOVES = 0.05  # rad: of a command that asks something of a joint
EXPLAINED = 0.9  # of a torque's variance, from which gains are read off it
PAST = 12  # periods whose commands stand for what the servo measured
LATE, ITERATIONS = 0.25, 10  # a first delay, of 20 ms; of the fit near what torque says
SLIPS = 0.02  # rad/s: friction turns its sign within this
HAND = 5.0  # kg, at most

How = tuple[bool, bool, float]  # payload's place from torque; friction, too; rad per scale of leaving what it says
HOWS: tuple[How, ...] = ((True, False, 2.0), (True, False, PRIOR), (True, True, 2.0), (False, False, PRIOR))


def rival(
    made: Identified, sequences: ListOf[Sequence], validation: ListOf[Sequence], given: RobotSpec, nthread: int
) -> Identified:
    """What torque says, where that is better for motions that were not fitted, by more than its standard error over
    them; then fitted once more, to these too, which must follow them no worse.

    Args:
        made: What positions say.
        sequences: Recordings that were fitted.
        validation: Others, which judge.
        given: Where the fit starts.
        nthread: Threads, 0 for all cores.
    """
    said = TorqueFit(sequences, given)
    if not said.trusted or any(s.tau is None for s in validation):
        return made
    how, judged = said.best(validation)
    before, after = (said.errors(validation, robot) for robot in (made.robot, judged))
    tried = Tried("torque", before, after)
    if not tried.kept:
        return replace(made, tried=(*made.tried, tried))
    every = [*sequences, *validation]
    robot = TorqueFit(every, given).fit(how)
    again = bool(said.errors(validation, robot).mean() <= after.mean())
    robot = robot if again else judged
    bounds = Bounds(robot, every)
    fit = Fit(JointRollouts(cut(every, WINDOWS), robot, nthread=nthread), robot, bounds).whole(nthread)
    values = {f: bounds.first[f] for f in CLASSIC}
    std, over_kp = fit.uncertainty(values)
    unknown = fit.undetermined(values, std, over_kp)
    part = runs(validation, [t.qpos for t in replay(validation, judged, nthread=nthread, lock_idle=True)], judged)
    left = {j: metrics(part, [i]).get("mpjae", 0.0) for i, j in enumerate(given.operated)}
    return Identified(
        robot, made.before, float(after.mean()), "torque", tuple(text for _, text in unknown.values()), std,
        (*made.tried, tried), None, (), {j: (was, left[j]) for j, (was, _) in (made.by_joint or {}).items()},
        fit.covariance, {joint: fields for joint, (fields, _) in unknown.items()},
        judged if again else None,
    )  # fmt: skip


class Gains(NamedTuple):
    """kp, N·m/rad, and its standard error over recordings; kd, N·m·s/rad; which share of the torque's variance they
    explain."""

    kp: float
    error: float
    kd: float
    explained: float

    @property
    def trusted(self) -> bool:
        """Whether torque is the servo's own."""
        return self.explained > EXPLAINED and self.kp > 0 <= self.kd


def servo_gains(recordings: ListOf[Array], last: int = 0) -> Gains:
    """A servo's gains from its own law, torque = kp (command of the period before − position) − kd velocity.

    Rows are means of five. Noise of measured position and speed would soften a gain, so by two-stage least squares,
    with the commands of PAST periods as instruments (Janot, Vandanjon & Gautier 2014).

    Args:
        recordings: Command, position, velocity and torque of the joint, (4, T) each.
        last: Only so many rows at each end count, as their mean, by plain least squares; 0 for all.
    """
    sums, rows = [], []
    for ctrl, qpos, qvel, tau in recordings:
        t = np.arange(len(tau) - 1)
        past = [ctrl[np.maximum(t - k, 0)] for k in range(PAST)]
        channels = [ctrl[:-1] - qpos[1:], -qvel[1:], tau[1:], *past]
        error, speed, torque, *told = (np.convolve(x, np.ones(5) / 5, "valid") for x in np.array(channels, float))
        one = np.ones_like(torque)
        x, z = np.stack([error, speed, one], axis=1), np.stack([*told, one], axis=1)
        if last:
            x, torque = x[-last:].mean(axis=0, keepdims=True), torque[-last:].mean(keepdims=True)
            z = x
        sums.append(np.concatenate([z.T @ z, z.T @ x, z.T @ torque[:, None]], axis=1))
        rows.append(np.concatenate([x, torque[:, None]], axis=1))

    def solved(s: Array) -> Array:
        first = np.linalg.lstsq(s[:, :-4], s[:, -4:-1])[0]
        return np.asarray(np.linalg.lstsq(first.T @ s[:, -4:-1], first.T @ s[:, -1])[0])

    every, n = np.concatenate(rows), len(sums)
    kp, kd, constant = solved(np.sum(sums, axis=0))
    without = np.array([solved(np.sum(sums, axis=0) - one)[0] for one in sums])
    left = every[:, 3] - every[:, :3] @ [kp, kd, constant]
    explained = 1 - float(left.var() / max(every[:, 3].var(), 1e-12))
    error = np.sqrt((n - 1) / n * np.square(without - without.mean()).sum())
    return Gains(float(kp), float(error), float(kd), explained)


class TorqueFit:
    """What recordings with torque say of a robot."""

    def __init__(self, sequences: ListOf[Sequence], robot: RobotSpec) -> None:
        """
        Args:
            sequences: Recordings; those whose gains are stated need no torque to say them.
            robot: What is not told stays its own; its payloads' masses are taken as true.
        """
        self.robot, self.nominal = robot, robot
        self.sequences = [s for s in sequences if s.tau is not None and s.meta.known_gains[0] is None]
        trusted = {joint: {"kp": g.kp, "kd": g.kd} for joint, g in self.gains().items() if g.trusted}
        self.trusted = len(self.sequences) == len(sequences) and bool(trusted)
        if self.trusted:
            self.robot = robot.with_servos(trusted)
        masses = {s.meta.payload_mass for s in self.sequences}
        self.hangs = bool(robot.payload_mounts) and len(masses) > 1

    def gains(self) -> dict[str, Gains]:
        """Joint → gains; joints whose command never moves are left out."""
        parts: dict[int, list[Array]] = {}
        for s in self.sequences:
            assert s.tau is not None
            for j in _moved(s, self.nominal):
                parts.setdefault(j, []).append(np.stack([x[:, j] for x in (s.ctrl, s.qpos, s.qvel, s.tau)]))
        return {self.nominal.joint_names[j]: servo_gains(each) for j, each in parts.items()}

    def hanging(self, friction: bool = False) -> RobotSpec:
        """Where the payload hangs, and what hangs there always, by least squares on recorded torque.

        Torque of a joint, in some rows, is what the model asks for, what (payload + hand) at the mount asks for, and
        what the joint's own friction, armature and damping do. Every mount is moved alike, mirrored to the other side.

        Args:
            friction: Whether that friction, armature and damping are taken, too.
        """
        robot, mount = self.robot, self.robot.payload_mounts[0]
        joints, column, tau, qacc, qvel, asked = self._balance()
        own = np.stack([np.tanh(qvel / SLIPS), qacc, qvel])  # friction, armature, damping
        n = 3 * len(joints)
        start = np.r_[mount.pos, mount.mass, np.zeros(n)]
        low, high = (np.r_[np.array(mount.pos) + a, m, np.full(n, z)] for a, m, z in ((-0.3, 0, 0), (0.3, HAND, 20)))

        def left(x: Array) -> Array:  # what torque does not tell stays where it was
            mine = (x[4:].reshape(3, -1)[:, column] * own).sum(axis=0)
            return np.r_[asked(x) + mine - tau, PRIOR_MOUNT * (x[:3] - start[:3])]

        scale, first = np.r_[0.1 * np.ones(3), 1.0, np.ones(n)], np.clip(start, low + 1e-6, high - 1e-6)
        found = least_squares(left, first, bounds=(low, high), x_scale=scale, loss="soft_l1").x
        x, y, z, hand = (round(float(v), 3) for v in found[:4])
        mounts = tuple(replace(m, pos=(x, y if m is mount else -y, z), mass=hand) for m in robot.payload_mounts)
        armature = build_model(robot).dof_armature
        said = {
            robot.joint_names[j]: {"frictionloss": v[0], "armature": float(armature[j]) + v[1], "damping": v[2]}
            for j, v in zip(joints, found[4:].reshape(3, -1).T.round(4).tolist(), strict=True)
        }
        return replace(robot.with_servos(said if friction else {}), payload_mounts=mounts)

    def _balance(self) -> tuple[list[int], Array, Array, Array, Array, Callable[[Array], Array]]:
        """Joints; of rows which of them, torque, acceleration and speed; and the torque that is asked for where payload
        and hand x (place, kg) hang."""
        robot, mount, rows = self.robot, self.robot.payload_mounts[0], []
        model = build_model(replace(robot, payload_mounts=tuple(replace(m, mass=0.0) for m in robot.payload_mounts)))
        data, body, full = mujoco.MjData(model), model.body(mount.body).id, np.empty((model.nv, model.nv))
        every = max(EVERY, sum(map(len, self.sequences)) // MOST)
        for s in self.sequences:
            assert s.tau is not None
            qacc = differentiate(differentiate(lowpass(s.qpos.astype(float), s.dt, CUTOFF), s.dt), s.dt)
            moved = _moved(s, robot)
            for t in range(every, len(s) - 1, every) if moved else ():
                data.qpos[:], data.qvel[:] = s.qpos[t], 0.0
                mujoco.mj_forward(model, data)
                mujoco.mj_fullM(model, data, full)
                frame = data.xmat[body].reshape(3, 3)
                rows += [
                    (j, s.meta.payload_mass, data.qfrc_bias[j] + full[j, j] * qacc[t, j], data.xaxis[j].copy(),
                     frame.copy(), data.xpos[body] - data.xanchor[j], float(s.tau[t, j]), qacc[t, j],
                     float(s.qvel[t, j]))
                    for j in moved
                ]  # fmt: skip
        joints = sorted({r[0] for r in rows})
        column = np.array([joints.index(r[0]) for r in rows])
        mass, bias, axis, frame, arm, tau, qacc, qvel = (np.array([r[i] for r in rows]) for i in range(1, 9))

        def asked(x: Array) -> Array:
            point = np.cross(axis, arm + frame @ x[:3])  # (k, 3) m: how far the payload goes for a radian
            there = 9.81 * point[:, 2] + np.square(point).sum(axis=1) * qacc
            return np.asarray(bias + (mass + x[3]) * there)

        return joints, column, tau, qacc, qvel, asked

    def fit(self, how: How) -> RobotSpec:
        """The robot with what torque says, and near that with what positions say."""
        start = self.hanging(how[1]) if how[0] else self.robot
        alone = JointRollouts(cut(self.sequences, WINDOWS), start)
        first = Bounds(start, alone.parts).first
        kp, one = first["kp"], np.ones(len(first["kp"]))
        scale = {
            "damping": np.maximum(first["damping"], 0.01 * kp), "armature": np.maximum(first["armature"], 1e-3),
            "frictionloss": np.maximum(first["frictionloss"], 0.005 * kp), "offset": 0.02 * one, "delay": 0.02 * one,
        }  # fmt: skip
        least = {f: -first[f] / x for f, x in scale.items()} | {"offset": -10 * one}
        most = dict.fromkeys(scale, 200 * one) | {"offset": 10 * one, "delay": (MAX_DELAY - first["delay"]) / 0.02}
        low, high = (np.stack([ends[f] for f in scale], axis=1) for ends in (least, most))

        def values(x: Array) -> dict[str, Array]:
            moved = {f: first[f] + x[..., i] * scale[f] for i, f in enumerate(scale)}  # at the least 0, or −1e-20
            known = {f: np.broadcast_to(v, x.shape[:2]) for f, v in first.items()}
            return known | {f: v if f == "offset" else np.maximum(v, 0) for f, v in moved.items()}

        def errors(x: Array) -> Array:
            return np.concatenate([alone.errors(values(x)).reshape(*x.shape[:2], -1), how[2] * x], axis=2) / SOFT

        x, _ = descend(
            np.zeros((1, *low.shape)) + LATE * (np.array([*scale]) == "delay"), low, high, errors, ITERATIONS
        )
        found = {f: values(x)[f][0] for f in scale}
        joints = enumerate(start.operated)
        return start.with_servos({j: {f: float(f"{v[i]:.6g}") for f, v in found.items()} for i, j in joints})

    def best(self, validation: ListOf[Sequence]) -> tuple[How, RobotSpec]:
        """What follows these recordings best, and how it was fitted."""
        fits = [(how, self.fit(how)) for how in HOWS if self.hangs or not how[0]]
        return min(fits, key=lambda one: float(self.errors(validation, one[1]).mean()))

    @staticmethod
    def errors(sequences: ListOf[Sequence], robot: RobotSpec) -> Array:
        """Mean |error| of each motion, its recordings averaged, (motions,) rad."""
        each, motions = whole_errors(sequences, robot), np.array([s.meta.motion for s in sequences])
        return np.array([each[motions == motion].mean() for motion in dict.fromkeys(motions.tolist())])


def _moved(sequence: Sequence, robot: RobotSpec) -> list[int]:
    """Operated joints that a recording holds, and whose command moves."""
    moved = np.ptp(sequence.ctrl, axis=0) > MOVES
    return [int(i) for i in robot.operated_index if moved[i] and robot.joint_names[i] not in sequence.meta.unrecorded]
