"""Goals of the hands, spread evenly over the space in which they can hold a payload, and
trajectories to them.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.motion.coordinated import Arm, HandIK, Kit
from gaponet.motion.feasible import Feasibility, carriers
from gaponet.motion.motion import GRID, move_time, through
from gaponet.robot.spec import RobotSpec

GOALS_PER_TRAJECTORY = 2  # held one after the other
REST_S = 1.5  # at the start, for the compensator to blend in
MAX_JOINT_SPEED = 1.5  # rad/s, about that of the recipe's reaching motions
MIN_MOVE_S = 1.0
VOXEL_M = 0.05  # goals cover space evenly, not joint space
MIN_DISTANCE_M = 0.1  # between a hand and its next goal
MIN_FRONT_M = 0.1  # of the goals, in front of the base
SAMPLED_POSTURES = 3000  # for the reachable space
IK_TOLERANCE_M = 1e-3


@dataclass(frozen=True)
class Plan:
    """A trajectory of all hands to G goals each.

    Attributes:
        ctrl: Joint targets at the robot's control period, (T, n) rad.
        goals: Goals of each hand, (G, hands, 3) m in the frame of the robot's base.
        start, arrive, leave: Rows at which the move to a goal begins, the move ends, and its hold
            ends, (G,).
    """

    ctrl: Array
    goals: Array
    start: Array
    arrive: Array
    leave: Array


def find_hands(robot: RobotSpec, model: mujoco.MjModel) -> list[Arm]:
    """Return an arm for each payload mount: the operated joints that carry it.

    Raises:
        UsageError: The robot has no payload mount.
    """
    arms = []
    for mount in robot.payload_mounts:
        chain = carriers(model, model.body(f"payload_{mount.side}").id)
        names = [name for name in robot.operated if int(model.joint(name).bodyid[0]) in chain]
        arms.append(Arm(mount.side, 1.0, robot.index(names), f"payload_{mount.side}"))
    if not arms:
        raise UsageError(
            f"{robot.name} has no [[payload_mount]]: it has no hand that could deliver anything"
        )
    return arms


class HandPositions:
    """Forward kinematics of the hands."""

    def __init__(self, model: mujoco.MjModel, arms: list[Arm]) -> None:
        self.model = model
        self.data = mujoco.MjData(model)
        self.bodies = np.array([model.body(arm.hand).id for arm in arms])

    def __call__(self, qpos: Array) -> Array:
        """Return the hand positions at joint positions, (…, n) rad → (…, hands, 3) m."""
        rows = np.asarray(qpos, float).reshape(-1, qpos.shape[-1])
        out = np.empty((len(rows), len(self.bodies), 3))
        for row, positions in zip(rows, out, strict=True):
            self.data.qpos = row
            mujoco.mj_kinematics(self.model, self.data)
            positions[:] = self.data.xpos[self.bodies]
        return out.reshape(*qpos.shape[:-1], len(self.bodies), 3)


class GoalPlanner:
    """Random trajectories for one robot, fixed by a seed."""

    def __init__(
        self,
        robot: RobotSpec,
        max_payload: float,
        seed: int,
        hold: float = 3.0,
        dt: float | None = None,
    ) -> None:
        """
        Args:
            max_payload: Payload that can be held at every goal, kg per hand.
            hold: Time at each goal, s.
            dt: Control period, s; default robot.dt.
        """
        self.robot = robot
        self.dt = robot.dt if dt is None else dt
        self.hold = hold
        self.limits = Feasibility(robot, max_payload)
        self.rng = np.random.default_rng([seed, 7])
        self.model = self.limits.models[0]
        self.arms = find_hands(robot, self.model)
        self.hand_positions = HandPositions(self.model, self.arms)
        self.ik = [HandIK(self.limits, arm) for arm in self.arms]
        self.ready = Kit(self.limits).ready
        self.reachable = [self._reachable(i) for i in range(len(self.arms))]

    def plans(self, count: int) -> list[Plan]:
        """Return `count` trajectories.

        Raises:
            UsageError: Hardly any goal can be reached and held.
        """
        plans: list[Plan] = []
        for _ in range(20 * count):
            plan = self._plan()
            if plan is not None:
                plans.append(plan)
            if len(plans) == count:
                return plans
        raise UsageError(
            f"{self.robot.name}: {len(plans)} of {count} trajectories can be held with "
            f"{self.limits.max_payload:g} kg; give a lighter payload"
        )

    def _reachable(self, hand: int) -> Array:
        """Return positions of one hand, (k, 3) m, one for each voxel that a sampled posture
        reaches.
        """
        columns = self.arms[hand].columns
        q = np.repeat(self.ready[None], SAMPLED_POSTURES, axis=0)
        q[:, columns] = self.rng.uniform(
            self.limits.low[columns], self.limits.high[columns], (SAMPLED_POSTURES, len(columns))
        )
        positions = self.hand_positions(q)[:, hand]
        first = np.unique(np.floor(positions / VOXEL_M).astype(int), axis=0, return_index=True)[1]
        chosen = first[positions[first, 0] >= MIN_FRONT_M]
        if not len(chosen):
            raise UsageError(
                f"{self.robot.name}: no hand reaches {MIN_FRONT_M:g} m in front of the base"
            )
        result: Array = positions[chosen]
        return result

    def _random_goal(self) -> Array:
        """Return a reachable position for each hand, (hands, 3) m."""
        positions = []
        for reachable in self.reachable:
            positions.append(reachable[self.rng.integers(len(reachable))])
        return np.array(positions)

    def _plan(self) -> Plan | None:
        """Return a random trajectory; None if a goal is too near, cannot be held, or the move to
        it meets the body.
        """
        postures = [self.ready]
        goals = []
        for _ in range(GOALS_PER_TRAJECTORY):
            goal = self._random_goal()
            q = postures[-1]
            if np.linalg.norm(goal - self.hand_positions(q), axis=1).min() < MIN_DISTANCE_M:
                return None
            for ik, place in zip(self.ik, goal, strict=True):
                q = ik.solve(q, place)
            away = np.abs(self.hand_positions(q) - goal).max()
            if away > IK_TOLERANCE_M or not self.limits.can_hold(q):
                return None
            postures.append(q)
            goals.append(goal)
        points = np.array(postures)  # (G + 1, n) rad
        moves = move_time(np.abs(np.diff(points, axis=0)).max(axis=1), MAX_JOINT_SPEED, MIN_MOVE_S)
        moves = np.ceil(moves / self.dt) * self.dt  # (G,) s, whole control periods
        holds = np.array([REST_S, *[self.hold] * GOALS_PER_TRAJECTORY])
        if not self.limits.demand(through(points, moves, holds, GRID), GRID).met:
            return None
        ctrl = through(points, moves, holds, self.dt)
        rest_rows = round(REST_S / self.dt)
        hold_rows = round(self.hold / self.dt)
        move_rows = np.array([round(move / self.dt) for move in moves])
        before = np.concatenate([[0], move_rows[:-1] + hold_rows])  # rows of the goal before
        start = rest_rows + np.cumsum(before)
        arrive = start + move_rows
        leave = arrive + hold_rows
        return Plan(ctrl, np.array(goals), start, arrive, leave)
