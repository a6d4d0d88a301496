"""Recordings as arrays of rows, and which environment plays which recordings."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.data.sequence import Sequence
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import Condition
from gaponet.sim.replay import idle_limbs


class RecordedRows:
    """Recordings below each other, as arrays of rows. All arrays are numpy's.

    Attributes:
        locked: Joints of limbs that no recording commands; they are clamped at home.
        operated: Operated joints among those that are not locked, (n,).
        ctrl, qpos, qvel: Joints that are not locked, (rows, n_free) rad, rad, rad/s.
        track: [q | q̇ | a] of the operated joints, (rows, 3n) float32.
        first, last: First and last row of each recording.
    """

    def __init__(self, sequences: ListOf[Sequence], robot: RobotSpec, min_rows: int) -> None:
        """
        Args:
            min_rows: Least number of rows of a recording.

        Raises:
            UsageError: No recording, or one that is too short.
        """
        _require_rows(sequences, min_rows)
        self.locked = idle_limbs(sequences, robot)
        free = [joint for joint in robot.joint_names if joint not in self.locked]
        self.operated = np.array([free.index(joint) for joint in robot.operated])

        columns = robot.index(free)
        self.ctrl = _joined([s.ctrl for s in sequences], columns)
        self.qpos = _joined([s.qpos for s in sequences], columns)
        self.qvel = _joined([s.qvel for s in sequences], columns)
        op = self.operated
        track = np.concatenate([self.qpos[:, op], self.qvel[:, op], self.ctrl[:, op]], axis=1)
        # take() copies an array that is neither contiguous nor float32.
        self.track = np.ascontiguousarray(track, np.float32)

        length = np.array([len(s) for s in sequences])
        self.last = np.cumsum(length) - 1
        self.first = self.last - length + 1


class EnvGroups:
    """Groups of environments that play the same recordings. All arrays are numpy's.

    Environments are divided into groups in proportion to the recorded rows. A group has one
    payload, rate, gains and set of recorded joints.

    Attributes:
        conditions: Condition of each group.
        unobserved: Joints without recorded positions, (groups, n_free).
        of_env: Group of each environment, (num_envs,).
    """

    def __init__(
        self, sequences: ListOf[Sequence], robot: RobotSpec, rows: RecordedRows, num_envs: int
    ) -> None:
        """
        Args:
            sequences: The recordings of `rows`.

        Raises:
            UsageError: Fewer environments than groups.
        """
        keys = [(Condition.of(s, robot), s.meta.unrecorded) for s in sequences]
        groups = list(dict.fromkeys(keys))
        group_of_sequence = np.array([groups.index(key) for key in keys])
        self.conditions = [condition for condition, _ in groups]
        free = [joint for joint in robot.joint_names if joint not in rows.locked]
        unobserved = []
        for _, unrecorded in groups:
            unobserved.append([joint in unrecorded for joint in free])
        self.unobserved = np.array(unobserved)
        length = rows.last - rows.first + 1
        self.of_env = _groups_of_environments(np.bincount(group_of_sequence, length), num_envs)

        members, self._cumulative = _shares_of_groups(group_of_sequence, length)
        self._first = rows.first[members]
        self._last = rows.last[members]

    @property
    def conditions_of_envs(self) -> list[Condition]:
        """Condition of each environment."""
        return [self.conditions[group] for group in self.of_env]

    def sample(self, group: Array, rng: Any) -> tuple[Array, Array]:
        """Draw a recording for each of these groups, in proportion to its rows.

        Returns:
            First and last row of the recordings, (k,) each.
        """
        end_of_group = np.nextafter(group + 1.0, 0.0)
        drawn = np.minimum(group + rng.random(len(group)), end_of_group)
        member = np.searchsorted(self._cumulative, drawn, side="right")
        return self._first[member], self._last[member]


def _require_rows(sequences: ListOf[Sequence], min_rows: int) -> None:
    """Refuse a training set without recordings, or with one that is shorter than one step."""
    if not sequences:
        raise UsageError("no sequences to train on; the split left the training set empty")
    shortest = min(sequences, key=len)
    if len(shortest) < min_rows:
        raise UsageError(
            f"motion {shortest.meta.motion} has {len(shortest)} of the {min_rows} rows that a step "
            "needs: drop the motion"
        )


def _joined(parts: list[Array], columns: Array) -> Array:
    """Return columns of all recordings below each other, contiguous in memory."""
    return np.ascontiguousarray(np.concatenate([part[:, columns] for part in parts]))


def _shares_of_groups(group_of_sequence: Array, length: Array) -> tuple[Array, Array]:
    """Return recordings by group, and group number plus cumulative share of rows in the group.

    Both are (recordings,), in the same order.
    """
    members = []
    cumulative = []
    for group in range(group_of_sequence.max() + 1):
        in_group = np.flatnonzero(group_of_sequence == group)
        share = np.cumsum(length[in_group] / length[in_group].sum())
        members.append(in_group)
        cumulative.append(group + share / share[-1])
    return np.concatenate(members), np.concatenate(cumulative)


def _groups_of_environments(rows: Array, num_envs: int) -> Array:
    """Divide environments among groups in proportion to their rows, (groups,) → (num_envs,)."""
    if num_envs < len(rows):
        raise UsageError(
            f"{num_envs} environments for {len(rows)} conditions of payload, rate and gains; use "
            "more"
        )
    quota = np.cumsum(rows) / rows.sum() * num_envs
    return np.searchsorted(quota, np.arange(num_envs) + 0.5).astype(int)
