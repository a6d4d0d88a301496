"""Where hands are sent: goals spread over the space that they reach and can hold, and the way from one to the next."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.robot.spec import RobotSpec
from gaponet.sysid.motion.arm import Arm, HandIK
from gaponet.sysid.motion.feasible import Feasibility
from gaponet.sysid.motion.minjerk import move_time, through
from gaponet.sysid.motion.motion import GRID
from gaponet.sysid.motion.posture import carriers
from gaponet.sysid.motion.upper_body import Kit

STOPS = 2  # goals on one trajectory, held one after the other
REST = 1.5  # s at the start: time for a compensator to blend in
SPEED = 1.5  # rad/s of the fastest joint on the way, about that of the recipe's reaching motions
SHORTEST = 1.0  # s of a way
VOXEL = 0.05  # m: space is covered evenly, not joint space
APART = 0.1  # m: least way of a hand to its goal
POSTURES = 3000  # drawn to find out what is reached
PRECISION = 1e-3  # m of the inverse kinematics


@dataclass(frozen=True)
class Plan:
    """One trajectory of all hands at once.

    Attributes:
        ctrl: Joint targets at the robot's control period, (T, n) rad.
        goals: Where each hand holds, (STOPS, hands, 3) m in the frame of the robot's base.
        start, arrive, leave: Rows at which the way to a goal begins, ends, and its hold ends, (STOPS,).
        rise: Height gained on the way, (STOPS, hands) m.
    """

    ctrl: Array
    goals: Array
    start: Array
    arrive: Array
    leave: Array
    rise: Array


def hands(robot: RobotSpec, model: mujoco.MjModel) -> list[Arm]:
    """One for each payload mount: the operated joints that carry it.

    Raises:
        UsageError: The robot carries nothing.
    """
    found = []
    for mount in robot.payload_mounts:
        chain = carriers(model, model.body(f"payload_{mount.side}").id)
        names = [name for name in robot.operated if int(model.joint(name).bodyid[0]) in chain]
        found.append(Arm(mount.side, 1.0, robot.index(names), f"payload_{mount.side}"))
    if not found:
        raise UsageError(f"{robot.name} has no [[payload_mount]]: it has no hand that could deliver anything")
    return found


class HandPlaces:
    """Where the hands are at given joint positions, by forward kinematics."""

    def __init__(self, model: mujoco.MjModel, arms: list[Arm]) -> None:
        self.model, self.data = model, mujoco.MjData(model)
        self.bodies = np.array([model.body(arm.hand).id for arm in arms])

    def __call__(self, qpos: Array) -> Array:
        """(…, n) rad → (…, hands, 3) m."""
        rows = np.asarray(qpos, float).reshape(-1, qpos.shape[-1])
        out = np.empty((len(rows), len(self.bodies), 3))
        for row, place in zip(rows, out, strict=True):
            self.data.qpos = row
            mujoco.mj_kinematics(self.model, self.data)
            place[:] = self.data.xpos[self.bodies]
        return out.reshape(*qpos.shape[:-1], len(self.bodies), 3)


class Planner:
    """Draws trajectories for one robot; the same seed draws the same ones."""

    def __init__(self, robot: RobotSpec, max_payload: float, seed: int, hold: float = 3.0, front: float = 0.1) -> None:
        """
        Args:
            max_payload: What must be held everywhere, kg per hand.
            hold: At each goal, s.
            front: Goals lie at least so far in front of the base, m.
        """
        self.robot, self.hold = robot, hold
        self.limits = Feasibility(robot, max_payload)
        self.rng = np.random.default_rng([seed, 7])
        self.model = self.limits.models[0]
        self.arms = hands(robot, self.model)
        self.places = HandPlaces(self.model, self.arms)
        self.ik = [HandIK(self.limits, arm) for arm in self.arms]
        self.ready = Kit(self.limits).ready
        self.reached = [self._reached(i, front) for i in range(len(self.arms))]

    def plans(self, count: int) -> list[Plan]:
        """So many trajectories.

        Raises:
            UsageError: Hardly any goal can be reached and held.
        """
        found: list[Plan] = []
        for _ in range(20 * count):
            plan = self._plan()
            if plan is not None:
                found.append(plan)
            if len(found) == count:
                return found
        raise UsageError(
            f"{self.robot.name}: {len(found)} of {count} trajectories can be held with {self.limits.max_payload:g} kg; "
            "ask for a lighter payload"
        )

    def _reached(self, hand: int, front: float) -> Array:
        """Places of one hand, (k, 3) m, one for each voxel that some posture reaches."""
        columns = self.arms[hand].columns
        q = np.repeat(self.ready[None], POSTURES, axis=0)
        q[:, columns] = self.rng.uniform(self.limits.low[columns], self.limits.high[columns], (POSTURES, len(columns)))
        places = self.places(q)[:, hand]
        first = np.unique(np.floor(places / VOXEL).astype(int), axis=0, return_index=True)[1]
        kept = first[places[first, 0] >= front]
        if not len(kept):
            raise UsageError(f"{self.robot.name}: no hand reaches {front:g} m in front of the base; lower --front")
        return places[kept]

    def _plan(self) -> Plan | None:
        """One trajectory, or None where a goal drawn is too near, cannot be held, or the way to it meets the body."""
        postures, goals = [self.ready], []
        for _ in range(STOPS):
            goal = np.array([places[self.rng.integers(len(places))] for places in self.reached])
            q = postures[-1]
            if np.linalg.norm(goal - self.places(q), axis=1).min() < APART:
                return None
            for ik, place in zip(self.ik, goal, strict=True):
                q = ik.solve(q, place)
            if np.abs(self.places(q) - goal).max() > PRECISION or not self.limits.still(q):
                return None
            postures.append(q)
            goals.append(goal)
        points = np.array(postures)
        moves = move_time(np.abs(np.diff(points, axis=0)).max(axis=1), SPEED, SHORTEST)
        moves = np.ceil(moves / self.robot.dt) * self.robot.dt
        holds = np.array([REST, *[self.hold] * STOPS])
        if not self.limits.demand(through(points, moves, holds, GRID), GRID).met:
            return None
        ctrl = through(points, moves, holds, self.robot.dt)
        rows = [round(x / self.robot.dt) for x in (REST, *moves, self.hold)]
        start = rows[0] + np.cumsum([0, *(m + rows[-1] for m in rows[1:-2])])
        arrive = start + np.array(rows[1:-1])
        before = [self.places(self.ready), *goals[:-1]]
        rise = np.array([g[:, 2] - b[:, 2] for g, b in zip(goals, before, strict=True)])
        return Plan(ctrl, np.array(goals), start, arrive, arrive + rows[-1], rise)
