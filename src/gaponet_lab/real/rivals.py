"""Methods of the benchmark: each is given a question and answers with a simulator (docs/benchmark.md adds one)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from scipy.optimize import least_squares

from gaponet.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.data.signals import differentiate, lowpass
from gaponet.errors import UsageError
from gaponet.model.baselines.delay_offset import DelayOffset
from gaponet.robot import RobotSpec
from gaponet.sim.axes import MAX_DELAY, Bounds
from gaponet.sim.dynamics import CUTOFF
from gaponet.sim.free_runs import WINDOW, cut
from gaponet.sim.identify import identify
from gaponet.sim.joint_runs import SOFT, JointRuns
from gaponet.sim.model import build_model
from gaponet.sim.multistart import descend
from gaponet.sim.refit import PRIOR, refit
from gaponet.sim.replay import Corrector, replay
from gaponet_lab.real.questions import Question, recorded, rehearsal

SECONDS = 30.0  # of the test's own session that calibration may use
WINDOWS = 80  # at most, where recordings are shorter than half of an ordinary window
EVERY = 5  # rows between those that tell where a payload hangs
PRIOR_MOUNT = 3.0  # N·m for a metre
EXPLAINED = 0.9  # of a torque's variance, from which gains are read off it
BELIEVED = ((False, PRIOR), (False, 2.0), (True, 2.0))  # friction by torque, too; rad per scale of leaving what it says
LATE, ITERATIONS = 0.25, 10  # a first delay, of 20 ms; of the fit near what torque says
WALK = 0.02  # rad/s: friction turns its sign within this


Load = Callable[[Sequence], Sequence]


@dataclass(frozen=True)
class Answer:
    """A simulator: robot, what corrects its targets, what a recording is taken for, what is added to positions.

    `corrector` is reset and asked as gaponet.sim.replay.Corrector says; `load` returns the recording as it should be
    simulated; `shift` returns (n,) rad of all joints.
    """

    robot: RobotSpec
    corrector: Corrector | None = None
    load: Load = lambda s: s
    shift: Callable[[Sequence], Array] | None = None

    def positions(self, sequences: list[Sequence]) -> list[Array]:
        """Free runs, (T, n) rad each."""
        twins = replay([self.load(s) for s in sequences], self.robot, self.corrector, lock_idle=True)
        return [t.qpos + (self.shift(s) if self.shift else 0.0) for s, t in zip(sequences, twins, strict=True)]

    def errors(self, sequences: list[Sequence]) -> list[float]:
        """Mean |error| of each free run, over the joints that were recorded, rad."""
        runs = self.positions(sequences)
        return [
            float(np.abs((q - s.qpos)[1:, recorded(s, self.robot)]).mean())
            for s, q in zip(sequences, runs, strict=True)
        ]


Method = Callable[[Question], Answer]


def nominal(question: Question) -> Answer:
    """The robot folder as it is."""
    return Answer(question.robot)


def delay_offset(question: Question) -> Answer:
    """A delay and an offset of each joint."""
    return Answer(question.robot, DelayOffset.fit(question.known, question.robot).corrector(question.robot))


def constant(question: Question) -> Answer:
    """An adversary: what the nominal simulator is off by in the mean, for each joint, payload and unit; it sees what
    calibration sees."""
    robot, n, seen = question.robot, len(question.robot.joint_names), question.known + question.few
    off: dict[tuple[object, ...], list[Array]] = {}
    for s, q in zip(seen, Answer(robot).positions(seen), strict=True):
        mine, bias = recorded(s, robot), np.full(n, np.nan)
        bias[mine] = (s.qpos - q)[1:, mine].mean(axis=0)
        for key in ((s.meta.payload_mass, s.meta.unit_id), (s.meta.payload_mass,), ()):
            off.setdefault(key, []).append(bias)

    def shift(s: Sequence) -> Array:
        found = np.zeros(n)
        for key in ((), (s.meta.payload_mass,), (s.meta.payload_mass, s.meta.unit_id)):
            rows = np.array(off.get(key, np.full((1, n), np.nan)))
            known = np.isfinite(rows).any(axis=0)
            found[known] = np.nanmean(rows[:, known], axis=0)
        return found

    return Answer(robot, shift=shift)


def identified(question: Question) -> Answer:
    """gaponet identify; torque is not looked at."""
    return Answer(question.once("identified", lambda: _identify(question.train, question.val, question.robot)))


def from_torque(question: Question) -> Answer:
    """Torque says gains, where the payload hangs and what hand the model lacks; positions the rest, near that."""
    robot, load = question.once("from torque", lambda: _from_torque(question))
    return Answer(robot, load=load)


def best(question: Question) -> Answer:
    """Where others begin: from torque where recordings tell it, else gaponet identify."""
    return from_torque(question) if can_hang(question) else identified(question)


def calibrated(question: Question) -> Answer:
    """The robot identified elsewhere (or on the others), fitted to a little of what is tested."""
    if not question.few:
        raise UsageError(f"{question.name}: there is nothing of the test's own to calibrate with")
    start = best(question) if question.before is None else Answer(question.before())
    few = [start.load(s) for s in question.few]
    seconds = len(few) * WINDOW if few[0].duration < WINDOW else SECONDS  # all windows that are shorter than one
    return replace(start, robot=refit(few, start.robot, seconds).robot)


def elsewhere(question: Question) -> Answer:
    """The robot as it was identified in another session, as it is."""
    if question.before is None:
        raise UsageError(f"{question.name}: the robot was identified nowhere else")
    return Answer(question.before())


METHODS: dict[str, tuple[str, Method]] = {
    "nominal": ("nominal simulator", nominal),
    "constant": ("constant offset by joint, payload, unit", constant),
    "delay_offset": ("delay + offset", delay_offset),
    "elsewhere": ("identified elsewhere", elsewhere),
    "identified": ("identification", identified),
    "from_torque": ("identification from torque", from_torque),
    "calibrated": ("identified elsewhere, calibrated", calibrated),
}


def _identify(train: list[Sequence], val: list[Sequence], robot: RobotSpec) -> RobotSpec:
    short = float(np.median([s.duration for s in train])) < WINDOW / 2
    return identify(train, robot, val, WINDOWS if short else 24, table=bool(robot.tips)).robot


def _from_torque(question: Question) -> tuple[RobotSpec, Load]:
    """How much is believed is chosen on commands that a fit has not seen; then all is fitted."""
    learn, judge = rehearsal(question.known)
    found = [_near_torque(learn, question.robot, how) for how in BELIEVED] if judge else []
    costs = [np.mean(Answer(robot, load=load).errors(judge)) for robot, load in found]
    return _near_torque(question.known, question.robot, BELIEVED[int(np.argmin(costs))] if judge else BELIEVED[0])


def _near_torque(known: list[Sequence], robot: RobotSpec, how: tuple[bool, float]) -> tuple[RobotSpec, Load]:
    start, load = hanging(known, with_gains_of_torque(known, robot), how[0])
    runs = JointRuns(cut([load(s) for s in known], WINDOWS), start)
    first = Bounds(start, runs.parts).first
    kp, one = first["kp"], np.ones(len(first["kp"]))
    scale = {
        "damping": np.maximum(first["damping"], 0.01 * kp), "armature": np.maximum(first["armature"], 1e-3),
        "frictionloss": np.maximum(first["frictionloss"], 0.005 * kp), "offset": 0.02 * one, "delay": 0.02 * one,
    }  # fmt: skip
    least = {f: -first[f] / x for f, x in scale.items()} | {"offset": -10 * one}
    most = dict.fromkeys(scale, 200 * one) | {"offset": 10 * one, "delay": (MAX_DELAY - first["delay"]) / 0.02}
    low, high = (np.stack([ends[f] for f in scale], axis=1) for ends in (least, most))

    def values(x: Array) -> dict[str, Array]:
        moved = {f: first[f] + x[..., i] * scale[f] for i, f in enumerate(scale)}
        return {f: np.broadcast_to(v, x.shape[:2]) for f, v in first.items()} | moved

    def errors(x: Array) -> Array:
        own = runs.errors(values(x)).reshape(*x.shape[:2], -1)
        return np.concatenate([own, how[1] * x], axis=2) / SOFT

    x, _ = descend(np.zeros((1, *low.shape)) + LATE * (np.array([*scale]) == "delay"), low, high, errors, ITERATIONS)
    found = {f: values(x)[f][0] for f in scale}
    joints = enumerate(start.operated)
    return start.with_servos({j: {f: float(v[i]) for f, v in found.items()} for i, j in joints}), load


def can_hang(question: Question) -> bool:
    """Whether recordings hold torque, and several payloads."""
    masses = {s.meta.payload_mass for s in question.train}
    return bool(question.robot.payload_mounts) and len(masses) > 1 and all(s.tau is not None for s in question.train)


def gains_of_torque(train: list[Sequence], robot: RobotSpec) -> dict[str, tuple[float, float, float]]:
    """Joint → kp N·m/rad, kd N·m·s/rad, and the share of the torque's variance that they explain.

    Torque of a servo is kp (command − position) − kd velocity, the command a period before; means of five rows, since
    noise of a small error softens a gain. Joints whose command never moves are left out.
    """
    parts: dict[int, list[Array]] = {}
    for s in train:
        if s.tau is None:
            continue
        for j in recorded(s, robot):
            if np.ptp(s.ctrl[:, j]) > 0.05:
                rows = np.stack([s.ctrl[:-1, j] - s.qpos[1:, j], -s.qvel[1:, j], s.tau[1:, j]], axis=1)
                parts.setdefault(j, []).append(np.stack([np.convolve(x, np.ones(5) / 5, "valid") for x in rows.T]))
    found = {}
    for j, each in parts.items():
        error, speed, tau = np.concatenate(each, axis=1).astype(float)
        columns = np.stack([error, speed, np.ones_like(error)], axis=1)
        x = np.linalg.lstsq(columns, tau)[0]
        found[robot.joint_names[j]] = float(x[0]), float(x[1]), 1 - float((tau - columns @ x).var() / tau.var())
    return found


def with_gains_of_torque(train: list[Sequence], robot: RobotSpec) -> RobotSpec:
    """The robot with them, where torque is the servo's own law."""
    kp, kd = robot.kp.copy(), robot.kd.copy()
    for joint, (stiff, damped, explained) in gains_of_torque(train, robot).items():
        if explained > EXPLAINED and stiff > 0 <= damped:
            kp[robot.joint_names.index(joint)], kd[robot.joint_names.index(joint)] = stiff, damped
    return robot.with_gains(tuple(kp), tuple(kd))


def hanging(train: list[Sequence], robot: RobotSpec, servos: bool = False) -> tuple[RobotSpec, Load]:
    """Where the payload hangs, and what hangs there always, by least squares on recorded torque.

    Torque of a joint, in every fifth row, is what the model asks for, what (m + hand) at the mount asks for, and what
    the joint's own friction, armature and damping do. Every mount is moved alike, mirrored to the other side.

    Returns:
        The robot with that mount, with `servos` also with that friction, armature and damping, and what adds the hand
        to a recording's payload.
    """
    mount, rows = robot.payload_mounts[0], []
    model = build_model(robot)
    data, body, full = mujoco.MjData(model), model.body(mount.body).id, np.empty((model.nv, model.nv))
    for s in train:
        assert s.tau is not None
        qacc = differentiate(differentiate(lowpass(s.qpos.astype(float), s.dt, CUTOFF), s.dt), s.dt)
        for j in recorded(s, robot):
            if np.ptp(s.ctrl[:, j]) < 0.05:
                continue
            for t in range(EVERY, len(s) - 1, EVERY):
                data.qpos[:], data.qvel[:] = s.qpos[t], 0.0
                mujoco.mj_forward(model, data)
                mujoco.mj_fullM(model, data, full)
                frame, place = data.xmat[body].reshape(3, 3).copy(), data.xpos[body] - data.xanchor[j]
                rows.append((j, s.meta.payload_mass, data.qfrc_bias[j] + full[j, j] * qacc[t, j], data.xaxis[j].copy(),
                             frame, place, float(s.tau[t, j]), qacc[t, j], float(s.qvel[t, j])))  # fmt: skip
    joints = sorted({r[0] for r in rows})
    column = np.array([joints.index(r[0]) for r in rows])
    mass, bias, axis, frame, arm, tau, qacc, qvel = (np.array([r[i] for r in rows]) for i in range(1, 9))
    own = np.stack([np.tanh(qvel / WALK), qacc, qvel])  # friction, armature, damping

    def asked(x: Array) -> Array:
        point = np.cross(axis, arm + frame @ x[:3])  # (k, 3) m: how far the payload goes for a radian
        there = 9.81 * point[:, 2] + np.square(point).sum(axis=1) * qacc
        return np.asarray(bias + (mass + x[3]) * there + (x[4:].reshape(3, -1)[:, column] * own).sum(axis=0))

    n = 3 * len(joints)
    start, low = np.r_[mount.pos, 0.0, np.zeros(n)], np.r_[np.array(mount.pos) - 0.3, 0.0, np.zeros(n)]
    high = np.r_[np.array(mount.pos) + 0.3, 5.0, np.full(n, 20.0)]
    scale = np.r_[0.1 * np.ones(3), 1.0, np.ones(n)]

    def left(x: Array) -> Array:  # what torque does not tell stays where it was
        return np.r_[asked(x) - tau, PRIOR_MOUNT * (x[:3] - start[:3])]

    first = np.clip(start, low + 1e-6, high - 1e-6)
    found = least_squares(left, first, bounds=(low, high), x_scale=scale, loss="soft_l1").x
    pos = (round(float(found[0]), 3), round(float(found[1]), 3), round(float(found[2]), 3))
    mounts = tuple(replace(m, pos=pos if m is mount else (pos[0], -pos[1], pos[2])) for m in robot.payload_mounts)
    hand = round(float(found[3]), 2)
    said = {
        robot.joint_names[j]: {"frictionloss": x[0], "armature": float(model.dof_armature[j]) + x[1], "damping": x[2]}
        for j, x in zip(joints, found[4:].reshape(3, -1).T.round(4).tolist(), strict=True)
    }
    moved = replace(robot.with_servos(said) if servos else robot, payload_mounts=mounts)
    return moved, lambda s: replace(s, meta=replace(s.meta, payload_mass=s.meta.payload_mass + hand))
