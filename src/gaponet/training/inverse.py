"""Inverse labels: the smallest correction that makes the simulator follow the robot's recorded motion.

The position actuator's force is kp·(u + offset − q) − kd·q̇, so the target that produces a torque τ is
u* = q + (τ + kd·q̇)/kp − offset, sent ahead by the servo's delay where one is identified. τ comes from the inverse
dynamics of the payload-carrying model at low-pass filtered (q, q̇, q̈), plus dry friction. A joint that moves has all of
its friction against it; one that rests takes whatever friction is needed, up to the limit, so every target within that
band leads along the recording. The label is the one nearest to the command: where the simulator needs no help, it is 0.

The plant is stable about u*, so the label stays right when the simulated state has drifted from the recorded one: that
is what lets a network be fitted on the states that it visits itself.
"""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from typing import NamedTuple

import numpy as np

from gaponet.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.data.signals import differentiate, lowpass
from gaponet.robot import RobotSpec
from gaponet.sim.dynamics import CUTOFF, inverse_dynamics
from gaponet.sim.model import build_model

FRICTION_SPEED = 0.02  # rad/s: below it, recorded motion is as good as rest


class _Motion(NamedTuple):
    """A recorded motion, smoothed, and what it takes of the joints, arrays (T, n): rad, rad/s, rad/s², N·m."""

    qpos: Array
    qvel: Array
    qacc: Array
    links: Array
    """Inertia, Coriolis and gravity of links and payload."""


class _Plant(NamedTuple):
    """The numbers of a simulator that its inverse takes, each (n)."""

    kp: Array
    kd: Array
    damping: Array
    frictionloss: Array
    armature: Array
    offset: Array
    effort_limit: Array


def _plant_of(robot: RobotSpec) -> _Plant:
    """Of a robot, (n) each."""
    model = build_model(robot)
    damping, friction, armature = model.dof_damping, model.dof_frictionloss, model.dof_armature
    return _Plant(robot.kp, robot.kd, damping, friction, armature, robot.offset, robot.effort_limit)


def _motion_of(sequence: Sequence, robot: RobotSpec, cutoff: float = CUTOFF) -> _Motion:
    """A recording as the robot's inverse dynamics see it."""
    model = build_model(robot, sequence.meta.payload_mass, sequence.meta.payload_side, sequence.dt)
    qpos = lowpass(sequence.qpos.astype(float), sequence.dt, cutoff)
    qvel = differentiate(qpos, sequence.dt)
    qacc = differentiate(qvel, sequence.dt)
    own = model.dof_armature * qacc + model.dof_damping * qvel
    return _Motion(qpos, qvel, qacc, inverse_dynamics(model, qpos, qvel, qacc) - own)


def _band(motion: _Motion, plant: _Plant) -> tuple[Array, Array]:
    """The least and the greatest u* of servos that are not late, rad."""
    tau = motion.links + plant.armature * motion.qacc + plant.damping * motion.qvel
    moving = np.tanh(np.abs(motion.qvel) / FRICTION_SPEED)  # 0 at rest: friction is anything within ±limit; 1: all
    tau = tau + moving * np.sign(motion.qvel) * plant.frictionloss
    free = (1.0 - moving) * plant.frictionloss
    low, high = (_target(tau + part, motion, plant) for part in (-free, free))
    return low, high


def _target(tau: Array, motion: _Motion, plant: _Plant) -> Array:
    """Targets with which the servos produce these torques."""
    tau = np.clip(tau, -plant.effort_limit, plant.effort_limit)
    return np.asarray(motion.qpos + (tau + plant.kd * motion.qvel) / plant.kp - plant.offset)


def inverse_targets(sequence: Sequence, robot: RobotSpec, cutoff: float = CUTOFF) -> tuple[Array, Array]:
    """The least and the greatest u*, (T, n) rad each: held over [t, t+1), they lead the simulator from row t to t+1."""
    robot = robot.with_gains(*sequence.meta.known_gains)
    low, high = _band(_motion_of(sequence, robot, cutoff), _plant_of(robot))
    t = np.arange(len(sequence)) * sequence.dt
    for j in np.flatnonzero(robot.delay):
        for target in (low, high):
            target[:, j] = np.interp(t + robot.delay[j], t, target[:, j])
    return low.astype(np.float32), high.astype(np.float32)


def inverse_labels(sequence: Sequence, robot: RobotSpec, limit: float) -> Array:
    """The Δa* nearest to 0 with a + Δa* between these targets, operated joints, within ±limit rad, (T, n_operated)."""
    low, high = inverse_targets(sequence, robot)
    delta = np.clip(sequence.ctrl, low, high) - sequence.ctrl
    return np.clip(delta[:, robot.operated_index], -limit, limit).astype(np.float32)


def labels_of(sequences: ListOf[Sequence], robot: RobotSpec, limit: float) -> Array:
    """Of every row of recordings, one behind the other."""
    return np.concatenate([inverse_labels(s, robot, limit) for s in sequences])
