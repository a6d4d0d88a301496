"""Record takes on virtual robots: takes in, sequences of sensor readings out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.data.signals import differentiate, lowpass
from gaponet.motion.library import Library
from gaponet.motion.motion import Motion
from gaponet.motion.recipe import Recipe, Take
from gaponet.robot.spec import RobotSpec
from gaponet.sim.dynamics import CUTOFF_HZ, inverse_dynamics
from gaponet.sim.model import build_model, idle_joints
from gaponet.virtual.fleet import Fleet
from gaponet.virtual.physics import Physics
from gaponet.virtual.virtual_robot import VirtualRobot


@dataclass(frozen=True)
class Job:
    """Takes to be recorded together, all at one rate.

    The result of a take does not depend on the others.
    """

    robot: RobotSpec
    fleet: Fleet
    recipe: Recipe
    files: tuple[Motion, ...]  # motions of the recipe's files
    seed: int
    takes: tuple[Take, ...]


_LIBRARIES: dict[tuple[str, int, float, tuple[str, ...]], Library] = {}  # of this process


def library(robot: RobotSpec, seed: int, recipe: Recipe, files: tuple[Motion, ...]) -> Library:
    """Return the motions that a recipe chooses from, made once per process."""
    key = (str(robot.mjcf), seed, max(recipe.payloads), recipe.files)
    if key not in _LIBRARIES:
        motions = Library(robot, seed, max(recipe.payloads))
        for motion in files:
            motions.add(motion)
        _LIBRARIES[key] = motions
    return _LIBRARIES[key]


def play(job: Job) -> list[Sequence]:
    """Record the takes of a job, in order."""
    source = library(job.robot, job.seed, job.recipe, job.files)
    motions = {name: source.make(name) for name in dict.fromkeys(t.motion for t in job.takes)}
    locked = {name: _resting_joints(job.robot, motion) for name, motion in motions.items()}
    done: dict[Take, Sequence] = {}
    for joints in dict.fromkeys(locked.values()):
        group = [t for t in job.takes if locked[t.motion] == joints]
        group.sort(key=lambda t: -len(motions[t.motion].ctrl))
        done |= zip(group, _record(job, group, motions, joints), strict=True)
    return [done[t] for t in job.takes]


def _resting_joints(robot: RobotSpec, motion: Motion) -> tuple[str, ...]:
    """Return the joints of kinematic chains that stay at home during a motion."""
    away = np.abs(motion.ctrl - robot.qpos_home).max(axis=0) > 1e-9
    return idle_joints(
        robot, tuple(name for name, a in zip(robot.joint_names, away, strict=True) if a)
    )


def _record(
    job: Job, group: list[Take], motions: dict[str, Motion], locked: tuple[str, ...]
) -> list[Sequence]:
    """Record takes in parallel, longest first, so that the running ones are always the first
    rows.
    """
    dt = 1.0 / group[0].rate
    ctrl = [motions[t.motion].sample(dt) for t in group]
    lengths = np.array([len(c) for c in ctrl])
    longest = len(ctrl[0])
    targets = np.stack(
        [np.concatenate([c, np.repeat(c[-1:], longest - len(c), axis=0)]) for c in ctrl], axis=1
    )
    payloads = [(t.payload, job.recipe.payload_side) for t in group]
    robots = VirtualRobot(
        job.robot, [job.fleet.unit(t.unit) for t in group], payloads, dt, locked=locked
    )
    seeds = [t.seed(job.seed) for t in group]
    warmth = np.array(
        [_warmth(job.fleet.unit(t.unit), s) for t, s in zip(group, seeds, strict=True)]
    )
    robots.reset(targets[0], seeds, warmth)
    readings = np.empty((4, *targets.shape), np.float32)
    for t in range(longest):  # row t: the state at t·dt, then the command of [t·dt, (t+1)·dt)
        reading = robots.read()
        readings[:, t] = reading.qpos, reading.qvel, reading.tau, reading.temperature
        robots.step(targets[t], rows=np.arange(int((lengths > t).sum())))
    models = {p: build_model(job.robot, *p, dt, physics_only=True) for p in dict.fromkeys(payloads)}
    sequences = []
    for i, (take, c) in enumerate(zip(group, ctrl, strict=True)):
        qpos, qvel, tau, temperature = readings[:, : len(c), i]
        torque, qacc = equivalent_torque(models[payloads[i]], qpos, dt)
        notes = {"rate_hz": take.rate, "warmth_K": round(float(warmth[i]), 2), "seed": job.seed}
        meta = _meta(job, take, motions[take.motion].level, notes)
        sequences.append(
            Sequence(meta, job.robot.joint_names, dt, c, qpos, qvel, qacc, tau, torque, temperature)
        )
    return sequences


def _warmth(unit: Physics, seed: int) -> float:
    """Return the temperature above ambient at the start of a recording, K."""
    deviation = np.random.default_rng([seed, 1]).standard_normal()
    return max(0.0, float(unit.warmth[0] + unit.warmth_spread[0] * deviation))


def _meta(job: Job, take: Take, level: str, notes: dict[str, Any]) -> SequenceMeta:
    return SequenceMeta(
        robot=job.robot.name,
        unit_id=take.unit,
        motion=take.motion,
        payload_mass=take.payload,
        payload_side=job.recipe.payload_side,
        level=level,
        repetition=take.repetition,
        virtual=True,
        source=f"virtual fleet '{job.fleet.name}'",
        notes=notes,
        kp=tuple(job.robot.kp.tolist()),
        kd=tuple(job.robot.kd.tolist()),
    )


def equivalent_torque(
    model: mujoco.MjModel, qpos: Array, dt: float, cutoff: float = CUTOFF_HZ
) -> tuple[Array, Array]:
    """Return the torque that the nominal model with the payload needs for a recorded motion.

    Args:
        model: Nominal simulator with the recording's payload (sim.model.build_model).
        qpos: Recorded, (T, n) rad.
        dt: s.
        cutoff: Cut-off of the zero-phase filter before differentiating, Hz.

    Returns:
        Torque (T, n) N·m, and the accelerations (T, n) rad/s² in it.
    """
    smooth = lowpass(qpos.astype(float), dt, cutoff)
    qvel = differentiate(smooth, dt)
    qacc = differentiate(qvel, dt)
    return inverse_dynamics(model, smooth, qvel, qacc), qacc
