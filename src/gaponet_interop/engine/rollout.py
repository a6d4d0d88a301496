"""What a robot would have done under a rollout's targets, and how sure that is."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from typing import Any

import numpy as np

from gaponet.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.robot import FITTED, RobotSpec
from gaponet.sim.replay import replay

SHARE = 0.9  # of recorded rows that a band holds
WIDTH = 1.645  # standard errors on either side that hold as much
DRAWS = 16  # robots
SIGNED = ("offset", "zero")
Std = Mapping[str, Mapping[str, float | None]]  # joint → field → standard error


@dataclass(frozen=True)
class Answer:
    """One rollout, (T, n) rad over the operated joints.

    Attributes:
        name: Of the rollout.
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


def drawn_robots(robot: RobotSpec, std: Std, draws: int = DRAWS, seed: int = 0) -> list[RobotSpec]:
    """Robots whose servos differ by their standard errors, joint by joint and field by field.

    Fields are drawn one by one though a fit knows some of them as a set alone (kp and friction): a wide range, for
    training as for a band. What the recordings do not determine, with an error beyond its value, moves by its value.
    """
    rng, made = np.random.default_rng(seed), []
    for _ in range(draws):
        servos: dict[str, dict[str, float]] = {}
        for joint, errors in std.items():
            i, servo = robot.joint_names.index(joint), servos.setdefault(joint, {})
            for name in ("kp", "kd", *FITTED):
                value, error = float(np.broadcast_to(getattr(robot, name), robot.kp.shape)[i]), errors.get(name)
                if not error or not np.isfinite(value):
                    continue
                if name in SIGNED:
                    servo[name] = value + error * rng.standard_normal()
                else:
                    servo[name] = value * float(np.exp(min(error / max(value, 1e-12), 1.0) * rng.standard_normal()))
        made.append(robot.with_servos({j: s for j, s in servos.items() if s}))
    return made


def validation_error(robot: RobotSpec, recordings: ListOf[Sequence]) -> Array:
    """|error| that SHARE of the rows of every recording stay below, for each operated joint, (n,) rad.

    Of all rows together it would be too narrow: motions differ, and there are few of them.
    """
    op = robot.operated_index
    twins = replay(recordings, robot, lock_idle=True)
    errors = [np.abs(s.qpos - t.qpos)[1:, op] for s, t in zip(recordings, twins, strict=True)]
    return np.asarray(np.max([np.quantile(e, SHARE, axis=0) for e in errors], axis=0))


def answers(robot: RobotSpec, rollouts: ListOf[Sequence], known: Array, std: Std | None = None) -> list[Answer]:
    """Play the targets of rollouts on the robot from their first states.

    Args:
        robot: Identified.
        rollouts: With the targets as ctrl and the simulator's states.
        known: (n,) rad, as of `validation_error`: how far the robot was from its own recordings.
        std: Standard errors of its servos; what they do here is added to the band.
    """
    op = robot.operated_index
    played = [t.qpos[:, op] for t in replay(rollouts, robot, lock_idle=True)]
    spread = [np.zeros_like(q) for q in played]
    if std:
        others = [replay(rollouts, other, lock_idle=True) for other in drawn_robots(robot, std)]
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
