"""What a robot would have done under a rollout's targets, and how sure that is."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.export.ranges import ranges
from gaponet.robot.spec import RobotSpec
from gaponet.sim.replay import replay

SHARE = 0.9  # of recorded rows that a band holds
WIDTH = 1.645  # standard errors on either side that hold as much
DRAWS = 16  # robots


@dataclass(frozen=True)
class Answer:
    """One rollout, (T, n) rad over the operated joints.

    Attributes:
        name: The rollout's.
        dt: s.
        target: What the policy asked for.
        rollout: What its simulator did.
        robot: What the robot would do.
        half: Half the width of the band around that.
    """

    name: str
    dt: float
    target: Array
    rollout: Array
    robot: Array
    half: Array

    @property
    def inside(self) -> Array:
        """Where the rollout lies in the band, (T, n)."""
        return np.asarray(np.abs(self.rollout - self.robot) <= self.half)


def drawn_robots(robot: RobotSpec, draws: int = DRAWS, seed: int = 0) -> list[RobotSpec]:
    """Robots that differ by what is not known of this one today, whole servos at a time (export/ranges.py).

    Raises:
        UsageError: Its folder keeps values alone.
    """
    units = ranges(robot, samples=draws, seed=seed).units
    return [
        robot.with_servos({j: {f: float(v[k, i]) for f, v in units.items()} for i, j in enumerate(robot.operated)})
        for k in range(draws)
    ]


def validation_error(robot: RobotSpec, recordings: ListOf[Sequence]) -> Array:
    """|error| that SHARE of the rows of every recording stay below, for each operated joint, (n,) rad.

    Of all rows together it would be too narrow: motions differ, and there are few of them.
    """
    op = robot.operated_index
    twins = replay(recordings, robot, lock_idle=True)
    errors = [np.abs(s.qpos - t.qpos)[1:, op] for s, t in zip(recordings, twins, strict=True)]
    return np.asarray(np.max([np.quantile(e, SHARE, axis=0) for e in errors], axis=0))


def answers(robot: RobotSpec, rollouts: ListOf[Sequence], known: Array, drawn: ListOf[RobotSpec] = ()) -> list[Answer]:
    """Play the targets of rollouts on the robot from their first states.

    Args:
        robot: Identified.
        rollouts: Sequences with the targets as ctrl and the simulator's states.
        known: (n,) rad, as of `validation_error`: how far the robot was from its own recordings.
        drawn: Robots that it may be as well (`drawn_robots`); how far they go from it here is added to the band.
    """
    op = robot.operated_index
    played = [t.qpos[:, op] for t in replay(rollouts, robot, lock_idle=True)]
    spread = [np.zeros_like(q) for q in played]
    if drawn:
        others = [replay(rollouts, other, lock_idle=True) for other in drawn]
        spread = [
            WIDTH * np.sqrt(np.mean([(o[k].qpos[:, op] - q) ** 2 for o in others], axis=0))
            for k, q in enumerate(played)
        ]
    return [
        Answer(s.meta.motion, s.dt, s.ctrl[:, op], s.qpos[:, op], q, np.sqrt(known**2 + wide**2))
        for s, q, wide in zip(rollouts, played, spread, strict=True)
    ]


def summary(found: ListOf[Answer], joints: ListOf[str]) -> dict[str, dict[str, Any]]:
    """Joint → what its rollouts say in all, rad, and shares of time."""
    apart = np.concatenate([np.abs(a.rollout - a.robot)[1:] for a in found])
    inside, half = (
        np.concatenate([x[1:] for x in each]) for each in ([a.inside for a in found], [a.half for a in found])
    )
    behind = [np.concatenate([np.abs(getattr(a, f) - a.target)[1:] for a in found]) for f in ("rollout", "robot")]
    first = np.concatenate([np.abs(a.rollout - a.robot)[1 : 1 + round(1 / a.dt)] for a in found])
    most = np.array([np.abs(a.rollout - a.robot).max(axis=0) for a in found])
    where = [found[i] for i in most.argmax(axis=0)]
    worst_at = [float(np.abs(a.rollout - a.robot)[:, j].argmax() * a.dt) for j, a in enumerate(where)]
    return {
        joint: {
            "rollout_behind": float(behind[0][:, j].mean()), "robot_behind": float(behind[1][:, j].mean()),
            "apart": float(apart[:, j].mean()), "apart_first_second": float(first[:, j].mean()),
            "band": float(half[:, j].mean()), "inside": float(inside[:, j].mean()),
            "worst": float(most[:, j].max()), "worst_in": where[j].name, "worst_at": worst_at[j],
        }
        for j, joint in enumerate(joints)
    }  # fmt: skip
