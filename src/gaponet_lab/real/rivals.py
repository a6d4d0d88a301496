"""Methods of the benchmark: each is given a question and answers with a simulator (docs/benchmark.md adds one)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from scipy.optimize import least_squares

from gaponet.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.errors import UsageError
from gaponet.model.baselines.delay_offset import DelayOffset
from gaponet.robot import RobotSpec
from gaponet.sim.free_runs import WINDOW
from gaponet.sim.identify import Identified, identify
from gaponet.sim.model import build_model
from gaponet.sim.refit import refit
from gaponet.sim.replay import Corrector, replay
from gaponet_lab.real.questions import Question, recorded

SECONDS = 30.0  # of the test's own session that calibration may use
WINDOWS = 80  # at most, where recordings are shorter than half of an ordinary window
EVERY = 5  # rows between those that tell where a payload hangs
PRIOR_MOUNT = 3.0  # N·m for a metre
EXPLAINED = 0.9  # of a torque's variance, from which gains are read off it
WALK = 0.02  # rad/s: friction turns its sign within this


@dataclass(frozen=True)
class Answer:
    """A simulator: robot, what corrects its targets, what a recording is taken for, what is added to positions.

    `corrector` is reset and asked as gaponet.sim.replay.Corrector says; `load` returns the recording as it should be
    simulated; `shift` returns (n,) rad of all joints.
    """

    robot: RobotSpec
    corrector: Corrector | None = None
    load: Callable[[Sequence], Sequence] = lambda s: s
    shift: Callable[[Sequence], Array] | None = None

    def positions(self, sequences: list[Sequence]) -> list[Array]:
        """Free runs, (T, n) rad each."""
        twins = replay([self.load(s) for s in sequences], self.robot, self.corrector, lock_idle=True)
        return [t.qpos + (self.shift(s) if self.shift else 0.0) for s, t in zip(sequences, twins, strict=True)]


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


def plain(question: Question) -> Answer:
    """gaponet identify, payloads where the robot folder has them."""
    return Answer(question.once("plain", lambda: _identify(question.train, question.val, question.robot)).robot)


def with_torque(question: Question) -> Answer:
    """gaponet identify, after torque has said the gains, where the payload hangs and what hand the model lacks."""
    found, load = question.once("with torque", lambda: _with_torque(question))
    return Answer(found.robot, load=load)


def identified(question: Question) -> Answer:
    """gaponet identify; torque is believed where validation recordings come out better for it."""
    if not can_hang(question):
        return plain(question)
    question.once("plain", lambda: _identify(question.train, question.val, question.robot))
    found, _ = question.once("with torque", lambda: _with_torque(question))
    return with_torque(question) if found.after < question.made["plain"].after else plain(question)  # type: ignore[attr-defined]


def calibrated(question: Question) -> Answer:
    """The robot identified elsewhere (or on the others), fitted to a little of what is tested."""
    if not question.few:
        raise UsageError(f"{question.name}: there is nothing of the test's own to calibrate with")
    start = identified(question) if question.before is None else Answer(question.before())
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
    "plain": ("identification, payload at the palm, torque not looked at", plain),
    "identified": ("identification", identified),
    "calibrated": ("identified elsewhere, calibrated", calibrated),
}


def _identify(train: list[Sequence], val: list[Sequence], robot: RobotSpec) -> Identified:
    short = float(np.median([s.duration for s in train])) < WINDOW / 2
    return identify(train, robot, val, WINDOWS if short else 24, table=bool(robot.tips))


def _with_torque(question: Question) -> tuple[Identified, Callable[[Sequence], Sequence]]:
    robot, load = hanging(question.train, with_gains_of_torque(question.train, question.robot))
    return _identify([load(s) for s in question.train], [load(s) for s in question.val], robot), load


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


def hanging(train: list[Sequence], robot: RobotSpec) -> tuple[RobotSpec, Callable[[Sequence], Sequence]]:
    """Where the payload hangs, and what hangs there always, by least squares on recorded torque.

    Torque of a joint, in every fifth row, is what the model asks for, what (m + hand) at the mount asks for, and
    friction of its own. Every mount is moved alike, mirrored to the other side.

    Returns:
        The robot with that mount, and what adds the hand to a recording's payload.
    """
    mount, rows = robot.payload_mounts[0], []
    model = build_model(robot)
    data, body = mujoco.MjData(model), model.body(mount.body).id
    for s in train:
        assert s.tau is not None
        for j in recorded(s, robot):
            if np.ptp(s.ctrl[:, j]) < 0.05:
                continue
            for t in range(EVERY, len(s), EVERY):
                data.qpos[:], data.qvel[:] = s.qpos[t], 0.0
                mujoco.mj_forward(model, data)
                frame, place = data.xmat[body].reshape(3, 3).copy(), data.xpos[body] - data.xanchor[j]
                rows.append((j, s.meta.payload_mass, data.qfrc_bias[j], data.xaxis[j].copy(), frame, place,
                             float(s.tau[t, j]), np.tanh(float(s.qvel[t, j]) / WALK)))  # fmt: skip
    joints = sorted({r[0] for r in rows})
    column = np.array([joints.index(r[0]) for r in rows])
    mass, bias, axis, frame, arm, tau, way = (np.array([r[i] for r in rows]) for i in range(1, 8))

    def asked(x: Array) -> Array:
        point = arm + frame @ x[:3]  # (k, 3)
        lever = -np.cross(point, np.array([0.0, 0.0, -9.81]))
        return np.asarray(bias + (mass + x[3]) * (axis * lever).sum(axis=1) + x[4:][column] * way)

    start = np.r_[mount.pos, 0.0, np.zeros(len(joints))]
    low = np.r_[np.array(mount.pos) - 0.3, 0.0, np.zeros(len(joints))]
    high = np.r_[np.array(mount.pos) + 0.3, 5.0, np.full(len(joints), 20.0)]
    scale = np.r_[0.1 * np.ones(3), 1.0, np.ones(len(joints))]

    def left(x: Array) -> Array:  # what torque does not tell stays where it was
        return np.r_[asked(x) - tau, PRIOR_MOUNT * (x[:3] - start[:3])]

    first = np.clip(start, low + 1e-6, high - 1e-6)
    found = least_squares(left, first, bounds=(low, high), x_scale=scale, loss="soft_l1").x
    pos = (round(float(found[0]), 3), round(float(found[1]), 3), round(float(found[2]), 3))
    mounts = tuple(replace(m, pos=pos if m is mount else (pos[0], -pos[1], pos[2])) for m in robot.payload_mounts)
    hand = round(float(found[3]), 2)
    moved = replace(robot, payload_mounts=mounts)
    return moved, lambda s: replace(s, meta=replace(s.meta, payload_mass=s.meta.payload_mass + hand))
