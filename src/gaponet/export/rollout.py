"""Predict what an identified robot does under a policy's targets, with an error band."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.export.drawn_robots import robots_of
from gaponet.export.randomization import sample_units
from gaponet.robot.spec import RobotSpec
from gaponet.sim.replay import replay

BAND_SHARE = 0.9  # of recorded rows inside the band
BAND_STD = 1.645  # standard deviations on either side that hold as much
SAMPLED_ROBOTS = 16


@dataclass(frozen=True)
class RolloutPrediction:
    """One rollout, (T, n) rad over the operated joints."""

    name: str  # name of the rollout
    dt: float  # s
    target: Array  # targets of the policy
    rollout: Array  # motion in the policy's simulator
    robot: Array  # predicted motion of the robot
    half_width: Array  # half the width of the band around the prediction

    @property
    def inside(self) -> Array:
        """True where the rollout lies in the band, (T, n)."""
        return np.asarray(np.abs(self.rollout - self.robot) <= self.half_width)


def sample_robots(robot: RobotSpec) -> list[RobotSpec]:
    """Sample robots from the uncertainty of this robot's values today (export/randomization.py).

    Raises:
        UsageError: The robot folder has no uncertainties.
    """
    return robots_of(robot, sample_units(robot, samples=SAMPLED_ROBOTS, seed=0).units)


def validation_error(robot: RobotSpec, recordings: ListOf[Sequence]) -> Array:
    """Return an |error| that BAND_SHARE of the rows of every recording stay below, (n,) rad for the
    operated joints.

    The quantile over all rows together would be too narrow: motions differ, and there are few of
    them.
    """
    op = robot.operated_index
    rollouts = replay(recordings, robot, lock_idle=True)
    quantiles = []
    for recording, rollout in zip(recordings, rollouts, strict=True):
        error = np.abs(recording.qpos - rollout.qpos)[1:, op]
        quantiles.append(np.quantile(error, BAND_SHARE, axis=0))
    return np.asarray(np.max(quantiles, axis=0))


def predict(
    robot: RobotSpec, rollouts: ListOf[Sequence], error: Array, sampled: ListOf[RobotSpec] = ()
) -> list[RolloutPrediction]:
    """Play the targets of rollouts on the robot from their first states.

    Args:
        robot: Identified.
        rollouts: Sequences with the targets as ctrl and the states of the policy's simulator.
        error: (n,) rad, as of `validation_error`.
        sampled: Robots as of `sample_robots`; their deviation from the prediction is added to the
            band.
    """
    op = robot.operated_index
    played = [r.qpos[:, op] for r in replay(rollouts, robot, lock_idle=True)]
    others = [replay(rollouts, other, lock_idle=True) for other in sampled]
    predictions = []
    for k, rollout in enumerate(rollouts):
        spread = np.zeros_like(played[k])
        if others:
            squared = [(other[k].qpos[:, op] - played[k]) ** 2 for other in others]
            spread = BAND_STD * np.sqrt(np.mean(squared, axis=0))
        half_width = np.sqrt(error**2 + spread**2)
        target = rollout.ctrl[:, op]
        simulated = rollout.qpos[:, op]
        predictions.append(
            RolloutPrediction(
                rollout.meta.motion, rollout.dt, target, simulated, played[k], half_width
            )
        )
    return predictions


def summary(
    predictions: ListOf[RolloutPrediction], joints: ListOf[str]
) -> dict[str, dict[str, Any]]:
    """Return mean and largest differences of each joint over all rollouts, in rad, and the share of
    time inside the band.
    """

    def rows(values: Any) -> Array:
        """All rows but the first ones, which are given."""
        return np.concatenate([values(p)[1:] for p in predictions])

    difference = rows(lambda p: np.abs(p.rollout - p.robot))
    inside = rows(lambda p: p.inside)
    band = rows(lambda p: p.half_width)
    rollout_behind = rows(lambda p: np.abs(p.rollout - p.target))
    robot_behind = rows(lambda p: np.abs(p.robot - p.target))
    apart = []  # (T, n) rad each
    first_seconds = []  # the rows of it that are in the first second
    maxima = []  # (n,) rad each
    for prediction in predictions:
        distance = np.abs(prediction.rollout - prediction.robot)
        apart.append(distance)
        first_seconds.append(distance[1 : 1 + round(1 / prediction.dt)])
        maxima.append(distance.max(axis=0))
    first = np.concatenate(first_seconds)
    largest = np.array(maxima)
    worst = largest.argmax(axis=0)  # prediction with the largest difference of each joint
    by_joint = {}
    for j, joint in enumerate(joints):
        by_joint[joint] = {
            "rollout_behind": float(rollout_behind[:, j].mean()),
            "robot_behind": float(robot_behind[:, j].mean()),
            "apart": float(difference[:, j].mean()),
            "apart_first_second": float(first[:, j].mean()),
            "band": float(band[:, j].mean()),
            "inside": float(inside[:, j].mean()),
            "worst": float(largest[:, j].max()),
            "worst_in": predictions[worst[j]].name,
            "worst_at": float(apart[worst[j]][:, j].argmax() * predictions[worst[j]].dt),
        }
    return by_joint
