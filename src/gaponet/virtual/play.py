"""Record takes on virtual robots: takes in, sequences of sensor readings out."""

from __future__ import annotations

import hashlib
import pickle
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.data.signals import differentiate, lowpass
from gaponet.motion.library import Library
from gaponet.motion.motion import Motion, extended
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


_LIBRARIES: dict[tuple[str, int, float], Library] = {}  # the last one of this process


def library(robot: RobotSpec, seed: int, recipe: Recipe, files: tuple[Motion, ...]) -> Library:
    """Return the motions that a recipe chooses from, made again where robot or files changed."""
    key = (_digest(robot, files), seed, max(recipe.payloads))
    if key not in _LIBRARIES:
        _LIBRARIES.clear()
        motions = Library(robot, seed, max(recipe.payloads))
        for motion in files:
            motions.add(motion)
        _LIBRARIES[key] = motions
    return _LIBRARIES[key]


def _digest(robot: RobotSpec, files: tuple[Motion, ...]) -> str:
    """Return what the motions of a robot depend on, as hexadecimal digits."""
    as_loaded = replace(robot)  # without what it has computed since
    digest = hashlib.sha256(pickle.dumps((as_loaded, files)))
    for path in (robot.mjcf, robot.folder / "collision.toml"):
        if path.is_file():
            digest.update(path.read_bytes())
    return digest.hexdigest()


def play(job: Job) -> list[Sequence]:
    """Record the takes of a job, in order."""
    source = library(job.robot, job.seed, job.recipe, job.files)
    names = dict.fromkeys(take.motion for take in job.takes)
    motions = {name: source.make(name) for name in names}
    locked = {name: _resting_joints(job.robot, motion) for name, motion in motions.items()}
    done: dict[Take, Sequence] = {}
    for joints in dict.fromkeys(locked.values()):
        group = [take for take in job.takes if locked[take.motion] == joints]
        group.sort(key=lambda take: -len(motions[take.motion].ctrl))
        done |= zip(group, _record(job, group, motions, joints), strict=True)
    return [done[take] for take in job.takes]


def _resting_joints(robot: RobotSpec, motion: Motion) -> tuple[str, ...]:
    """Return the joints of kinematic chains that stay at home during a motion."""
    moves = np.abs(motion.ctrl - robot.qpos_home).max(axis=0) > 1e-9
    moved = tuple(robot.joint_names[i] for i in np.flatnonzero(moves))
    return idle_joints(robot, moved)


def _record(
    job: Job, group: list[Take], motions: dict[str, Motion], locked: tuple[str, ...]
) -> list[Sequence]:
    """Record takes in parallel, longest first: the running ones are always the first rows."""
    dt = 1.0 / group[0].rate
    ctrl = [motions[take.motion].sample(dt) for take in group]  # (rows, n) rad each
    units = [job.fleet.unit(take.unit) for take in group]
    payloads = [(take.payload, job.recipe.payload_side) for take in group]
    seeds = [take.seed(job.seed) for take in group]
    warmth = np.array([_warmth(u, seed) for u, seed in zip(units, seeds, strict=True)])  # (k,) K
    robots = VirtualRobot(job.robot, units, payloads, dt, locked=locked)
    readings = _readings(robots, ctrl, seeds, warmth)
    models = {}
    for payload in dict.fromkeys(payloads):
        models[payload] = build_model(job.robot, *payload, dt, physics_only=True)
    sequences = []
    for i, take in enumerate(group):
        notes = {"rate_hz": take.rate, "warmth_K": round(float(warmth[i]), 2), "seed": job.seed}
        meta = _meta(job, take, motions[take.motion].level, notes)
        measured = readings[:, : len(ctrl[i]), i]
        sequences.append(_sequence(meta, job.robot, dt, ctrl[i], measured, models[payloads[i]]))
    return sequences


def _sequence(
    meta: SequenceMeta,
    robot: RobotSpec,
    dt: float,
    ctrl: Array,
    measured: Array,
    model: mujoco.MjModel,
) -> Sequence:
    """Return a recording.

    Args:
        ctrl: Targets, (T, n) rad.
        measured: qpos, qvel, tau, temperature, (4, T, n).
        model: Nominal simulator with the payload.
    """
    qpos, qvel, tau, temperature = measured
    torque, qacc = equivalent_torque(model, qpos, dt)
    return Sequence(
        meta=meta,
        joint_names=robot.joint_names,
        dt=dt,
        ctrl=ctrl,
        qpos=qpos,
        qvel=qvel,
        qacc=qacc,
        tau=tau,
        tau_eq=torque,
        temperature=temperature,
    )


def _readings(robots: VirtualRobot, ctrl: list[Array], seeds: list[int], warmth: Array) -> Array:
    """Play targets, the longest first; return qpos, qvel, tau, temperature, (4, rows, k, n).

    Row t has the state at t·dt, then the command of [t·dt, (t+1)·dt). Rows after the end of a take
    mean nothing.
    """
    lengths = np.array([len(targets) for targets in ctrl])
    targets = np.stack([extended(c, lengths[0]) for c in ctrl], axis=1)  # (rows, k, n) rad
    robots.reset(targets[0], seeds, warmth)
    readings = np.empty((4, *targets.shape), np.float32)
    for t in range(lengths[0]):
        reading = robots.read()
        readings[:, t] = reading.qpos, reading.qvel, reading.tau, reading.temperature
        running = int((lengths > t).sum())
        robots.step(targets[t], rows=np.arange(running))
    return readings


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
        kp=tuple(job.robot.servo.kp.tolist()),
        kd=tuple(job.robot.servo.kd.tolist()),
    )


def equivalent_torque(model: mujoco.MjModel, qpos: Array, dt: float) -> tuple[Array, Array]:
    """Return the torque that the nominal model with the payload needs for a recorded motion.

    Args:
        model: Nominal simulator with the recording's payload (sim.model.build_model).
        qpos: Recorded, (T, n) rad.
        dt: s.

    Returns:
        Torque (T, n) N·m, and the accelerations (T, n) rad/s² in it.
    """
    smooth = lowpass(qpos.astype(float), dt, CUTOFF_HZ)
    qvel = differentiate(smooth, dt)
    qacc = differentiate(qvel, dt)
    return inverse_dynamics(model, smooth, qvel, qacc), qacc
