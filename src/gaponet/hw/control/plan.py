"""What a robot will do, as one trajectory from where it was found and back, checked before the first command.

`Planner.plan` takes a motion, `Planner.begin` the first of targets that are not known in advance; these `Fence` keeps
clear while the robot moves. With a compensator, `Planner.judge_commands` runs it over the whole motion, because its
commands differ from the targets. Checked are free space between the robot's own limbs and above floor or table
(motion.collision), range, speed, acceleration and torque (motion.feasible). A robot found nearer to something than the
clearance may go away from it, but no nearer.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.hw.control.clock import Clock
from gaponet.hw.control.phases import ControlConfig
from gaponet.hw.control.safety import Limits, SafetyConfig, limit_delta
from gaponet.robot.spec import RobotSpec
from gaponet.sim.dynamics import static_torque
from gaponet.sysid.motion.feasible import STILL_SHARE, Feasibility, stretch
from gaponet.sysid.motion.motion import GRID, Motion
from gaponet.sysid.motion.path_planner import Search, Trajectory, find_points, finish_search

_T = TypeVar("_T")

MOVED = 0.02  # rad by which the robot may have moved since the plan was made
TOUCH = 0.001  # m by which what was found near may come nearer
DEEPEST = 0.03  # m into each other that shells may be found: they are generous, and an arm rests on its table
STILL = 1e-3  # rad, or m of free space, that count as no movement
CALM = 0.1  # s in which a live target may use up what is left of the free space, but for a third
MOST_SAG = 0.05  # m that it counts
SHARES = (1.0, 0.5, 0.2)  # of a step towards a live target that are tried
SLOW = 0.005  # s: shorter control periods have no time for going around
COMMAND_SHARE = 0.5  # of the clearance that commands keep: they lead the joints by what these sag


class Compensates(Protocol):
    """Changes a target so that the robot ends up where the target says (deploy.compensator). All joints, (n)."""

    def reset(self, target: Array, payload_mass: float | None = None) -> None:
        """Begin at rest at `target` (n) rad, with a payload in kg or an unknown one; may take a while."""

    def step(self, target: Array, qpos: Array | None, qvel: Array | None = None) -> Array:
        """What to command so that the robot gets to `target`, (n) rad; qpos None: no state was measured."""


@dataclass(frozen=True)
class Plan:
    """From where a robot was found to the first target, through the motion, and back.

    Attributes:
        found: Posture at which it begins and ends, (n,) rad.
        into: The way to the first target.
        motion: Fitted, with the joints that it does not name, or that are not commanded, where they were found; None
            where targets are not known in advance.
        back: The way from its last row; None without a motion, or where the robot stays at its end.
        clearance: Least free space on all of it, m; inf for a robot without shapes.
        nearest: What comes as near as that.
        torque: Largest share of the usable torque.
        joint: The joint that needs it.
        changed: How the motion was changed so that it fits, in words; empty if it was not.
        correction: Largest |command − target| of a compensator, rad, at corrected_joint; 0 without one.
        command_clearance: Least free space of the commands, m.
    """

    found: Array
    into: Trajectory
    motion: Motion | None = None
    back: Trajectory | None = None
    clearance: float = np.inf
    nearest: str = ""
    torque: float = 0.0
    joint: str = ""
    changed: str = ""
    correction: float = 0.0
    corrected_joint: str = ""
    command_clearance: float = np.inf

    @property
    def rows(self) -> Array:
        """All of it, (T, n) rad at GRID s."""
        return self.sample(GRID)

    def sample(self, dt: float) -> Array:
        """All of it at a period of dt s, (T, n) rad."""
        parts = [self.into.rows(dt)]
        parts += [self.motion.sample(dt)] if self.motion else []
        return np.concatenate([*parts, self.back.rows(dt)] if self.back else parts)

    @property
    def duration(self) -> float:
        """s."""
        return sum(part.duration for part in (self.into, self.motion, self.back) if part)


class Planner:
    """Plans for the commanded joints of one robot."""

    def __init__(
        self,
        robot: RobotSpec,
        commanded: tuple[str, ...],
        config: ControlConfig | None = None,
        safety: SafetyConfig | None = None,
        limits: Feasibility | None = None,
    ) -> None:
        """
        Args:
            config: How fast it goes to the first target and back.
            safety: Speed and acceleration of commands.
            limits: Range, torque and shapes; default without payload.
        """
        self.robot, self.commanded = robot, commanded
        self.config, self.safety = config or ControlConfig(), safety or SafetyConfig()
        self.limits = limits or Feasibility(robot, 0.0)
        self.collision = self.limits.collision

    def plan(self, motion: Motion, found: Array) -> Plan:
        """The whole trajectory of a motion from where the robot was found, (n,) rad.

        Raises:
            UsageError: There is none that keeps within all limits; the message says which, and what is in the way.
        """
        robot = self.robot
        named = tuple(name for name in motion.named(robot) if name in self.commanded)
        wanted = Motion(motion.name, motion.level, motion.dt, motion.ctrl, named).held_at(found, robot)
        near = self._near(found)
        start, here = self.collision.along(wanted.ctrl[:1]), self.collision.along(found[None])
        need = np.where(np.abs(start - here) < STILL, near, self.collision.clearance)
        if (start < np.minimum(need, 0.0)).any():
            raise UsageError(f"motion '{motion.name}' begins with {self._said(start)}. Begin it elsewhere")
        fitted = self._calm(self.limits.fit(wanted, need=need))
        columns = robot.index(named)
        place = "where the robot is (bring it nearer by hand, or name more joints)"
        into = finish_search(self._way(found, fitted.ctrl[0], columns, near, f"to the motion's begin from {place}"))
        way = self._way(fitted.ctrl[-1], found, columns, near, f"back to {place}")
        back = finish_search(way) if self.config.blend_out else None
        return self._judged(Plan(found, into, fitted, back, changed=_changes(wanted, fitted)), near)

    def begin(self, first: Array, found: Array) -> Search[Plan]:
        """The way from where the robot was found to the first of targets that come as it moves, both (n,) rad; looks
        for it step by step.

        Raises:
            UsageError: As `plan`.
        """
        columns = self.robot.index(self.commanded)
        goal = found.copy()
        goal[columns] = first[columns]
        moved = columns[np.abs(goal - found)[columns] > 0]
        near = self._near(found)
        free = self.collision.along(goal[None])
        if (free < np.minimum(near, 0.0)).any():
            raise UsageError(f"the first target brings {self._said(free)}")
        shares = np.linspace(1.0, 0.0, 41)[:, None]  # one that is only too near is not gone to as far as that
        clear = (self.collision.distances(found + shares * (goal - found)) >= near).all(axis=1)
        goal = found + float(shares[int(clear.argmax()), 0]) * (goal - found)
        into = yield from self._way(found, goal, moved, near, "to the first target")
        return self._judged(Plan(found, into), near)

    def judge_commands(self, plan: Plan, compensator: Compensates, masses: tuple[float, ...]) -> Plan:
        """Return the plan with its largest correction and the clearance of the commands, for all `masses` (kg).

        The compensator is causal and is run without measured states. Its feedback is not included: that adds at most
        CompensatorConfig.feedback_limit.

        Raises:
            UsageError: A command is not a number or brings shells too near to each other.
        """
        config, at = self.safety, self.robot.index(self.commanded)
        limits, dt = Limits.of(self.robot, self.commanded, config), 1.0 / self.config.rate
        targets = plan.sample(dt)
        floor = self._near(plan.found) - COMMAND_SHARE * self.collision.clearance
        correction, joint, least = 0.0, "", np.inf
        for mass in masses:
            compensator.reset(plan.found, mass)
            delta, commands = np.zeros(len(at)), targets.copy()
            for k, target in enumerate(targets):
                wanted = compensator.step(target, None)[at]
                if not np.isfinite(wanted).all():
                    joint = self.commanded[int(np.argmax(~np.isfinite(wanted)))]
                    raise UsageError(f"compensation commands no number to {joint}; check the identified values")
                delta = limit_delta(wanted - target[at], delta, dt, limits)
                commands[k, at] = np.clip(target[at] + delta, limits.low, limits.high)
            free = self.collision.along(commands)
            if (free < floor).any():
                raise UsageError(
                    f"compensation with {mass:g} kg brings {self._said(np.where(free < floor, free, np.inf))}. The "
                    "targets keep clear. State the payload (--payload-mass), check the identified values, or "
                    "leave out --compensate and --model"
                )
            far = np.abs(commands - targets).max(axis=0)
            if far.max() > correction:
                correction, joint = float(far.max()), self.robot.joint_names[int(far.argmax())]
            least = min(least, float(free.min(initial=np.inf)))
        return replace(plan, correction=correction, corrected_joint=joint, command_clearance=least)

    def _calm(self, motion: Motion) -> Motion:
        """The motion, slowed where it accelerates more than joints can."""
        rows = motion.sample(1 / self.config.rate)
        most = np.abs(np.diff(rows, 2, axis=0)).max(initial=0.0) * self.config.rate**2
        if most <= self.safety.acceleration:
            return motion
        return replace(motion, ctrl=stretch(motion.ctrl, 1.02 * np.sqrt(most / self.safety.acceleration)))

    def _near(self, found: Array) -> Array:
        """Free space (pairs + shells,) m to be kept by a robot found in a posture."""
        free = self.collision.along(found[None])
        if free.min(initial=np.inf) < -DEEPEST:
            raise UsageError(
                f"the robot was found with {self.collision.nearest(free)} {-100 * free.min():.0f} cm in each other: "
                "its zero, or the height of what it stands on, is not what collision.toml says (--plane HEIGHT)"
            )
        return np.minimum(free - TOUCH, self.collision.clearance)

    def _said(self, free: Array) -> str:
        at = float(free.min())
        near = f"{100 * at:.1f} cm from each other" if at > 0 else f"{-100 * at:.1f} cm into each other"
        return f"{self.collision.nearest(free)} {near}; {100 * self.collision.clearance:g} cm are kept"

    def back(self, start: Array, found: Array) -> Search[Trajectory]:
        """The way from where targets ended to where the robot was found, both (n,) rad; looks for it step by step.

        Raises:
            UsageError: There is none that keeps clear.
        """
        near = np.minimum(self._near(found), self.collision.along(start[None]) - 1e-9)
        return self._way(start, found, self.robot.index(self.commanded), near, "back to where it was found")

    def _way(self, start: Array, goal: Array, columns: Array, near: Array, what: str) -> Search[Trajectory]:
        """From a posture (n,) rad to another by moving these joints."""
        low, high = start.copy(), start.copy()
        low[columns], high[columns] = self.limits.low[columns], self.limits.high[columns]
        home = np.clip(self.robot.qpos_home, low, high)
        heavy = [np.abs(static_torque(m, np.stack([start, goal]))).max(axis=0) for m in self.limits.models]
        most = np.maximum(self.limits.limit * STILL_SHARE, np.max(heavy, axis=0) + 1e-6)

        def free(rows: Array) -> bool:
            if (self.collision.distances(rows) < near).any():
                return False
            return all((np.abs(static_torque(m, rows[::4])) <= most).all() for m in self.limits.models)

        points = yield from find_points(free, start, goal, low, high, home)
        if points is None:
            straight = self.collision.along(np.linspace(start, goal, 200))
            raise UsageError(f"no clear way was found {what}: the straight one brings {self._said(straight)}")
        return Trajectory.minimum_jerk(points, self.config.blend_speed, self.safety.acceleration, self.config.blend)

    def _judged(self, plan: Plan, near: Array) -> Plan:
        """The plan with what it asks for; whatever was found on the way, this is the last word."""
        rows = plan.rows
        free = self.collision.along(rows)
        if (free < near).any():
            raise UsageError(f"the plan brings {self._said(np.where(free < near, free, np.inf))}")
        demand = self.limits.demand(rows, GRID)
        here = self.limits.demand(np.stack([plan.found] * 2), GRID)
        if demand.torque > 1.1 * max(1.0, here.torque):
            raise UsageError(
                f"the plan asks {demand.worst_joint} for {demand.torque:.2f} of the torque that may be used; go slower "
                "(--blend-speed), or from a posture that is easier to hold"
            )
        nearest = self.collision.nearest(free) if len(free) else ""
        clearance = float(free.min(initial=np.inf))
        return replace(plan, clearance=clearance, nearest=nearest, torque=demand.torque, joint=demand.worst_joint)


def advance(search: Search[_T], clock: Clock, seconds: float) -> _T | None:
    """Continue a search for some seconds; its result, or None where it is not over. UsageError: there is none."""
    until = clock.now() + seconds
    try:
        while clock.now() <= until:
            next(search)
    except StopIteration as end:
        return end.value
    return None


class Fence:
    """Keeps targets that are not known in advance clear of limbs and plane: a step that leads into one is cut.

    What is left of the free space above the clearance may be used up only so fast, so that the robot can stop; where
    the robot itself is nearer than it was told, by its weight say, that much more is kept. A step along an obstacle
    goes along it, where the control period leaves the time to find out.

    Attributes:
        near: What is in the way, in words, while a target is cut; empty otherwise.
    """

    def __init__(self, planner: Planner, posture: Array) -> None:
        """
        Args:
            posture: Where it begins, (n,) rad.
        """
        self.collision, self.config, self.safety = planner.collision, planner.config, planner.safety
        self.at = np.array(posture, float)
        self._free = self._found = self.collision.along(self.at[None])
        self._keep = np.full_like(self._free, self.collision.clearance)
        self.near, self._held, self._calm, self._sagging, self._sag = "", False, CALM, 1.0, np.zeros_like(self._free)

    def homeward(self) -> None:
        """From now on it goes back slowly: it may come as near to everything as it was where it began."""
        self._calm, self._sagging = 1e-6, 0.0
        self._keep = np.minimum(self._keep, self._found - TOUCH)

    def step(self, target: Array, qpos: Array, dt: float) -> Array:
        """Where to go in this period of dt s on the way to a target, all (n,) rad, with the robot measured at qpos."""
        self._sag = self._sagging * np.clip(self._free - self.collision.along(qpos[None]), 0.0, MOST_SAG)
        speed = self.config.blend_speed if self._held else self.safety.speed
        move = np.clip(target - self.at, -speed * dt, speed * dt)
        if self._try(move, SHARES[:1], dt):
            self.near, self._held = "", self._held and bool(np.abs(target - self.at).max() > speed * dt)
            return self.at
        self._held = True
        free = self.collision.along((self.at + move)[None])
        self.near = self.collision.nearest(np.where(free < self._floor(dt), free, np.inf))
        if not self._try(move, SHARES[1:], dt) and dt >= SLOW:
            self._try(self._aside(move, dt), SHARES, dt)
        return self.at

    def _floor(self, dt: float) -> Array:
        """Free space that the next posture must leave, (pairs + shells,) m."""
        keep = self._keep + self._sag
        return np.where(self._free > keep, keep + (self._free - keep) * np.exp(-dt / self._calm), self._free - 1e-9)

    def _try(self, move: Array, shares: tuple[float, ...], dt: float) -> bool:
        for share in shares:
            posture = self.at + share * move
            free = self.collision.along(posture[None])
            if (free >= self._floor(dt)).all():
                self.at, self._free = posture, free
                return True
        return False

    def _aside(self, move: Array, dt: float) -> Array:
        """The step (n,) rad without what leads into the obstacles, each in turn."""
        small, floor = 1e-4, self._floor(dt)
        moved = np.flatnonzero(move)
        rows = self.at + small * np.eye(len(move))[moved]
        slope = (self.collision.distances(rows) - self._free) / small  # (moved, pairs + shells)
        step = move[moved]
        for _ in range(3):
            short = floor - self._free - step @ slope
            worst = int(short.argmax())
            if short[worst] <= 0:
                break
            along = slope[:, worst]
            step = step + along * short[worst] / max(float(along @ along), 1e-9)
        aside = np.zeros_like(move)
        aside[moved] = np.clip(step, -np.abs(move).max(), np.abs(move).max())
        return aside


def _changes(wanted: Motion, fitted: Motion) -> str:
    """How a motion was changed to fit, in words."""
    said = []
    slower = fitted.duration / wanted.duration
    if slower > 1.01:
        said.append(f"played {slower:.2f} times slower")
    span, was = np.ptp(fitted.ctrl, axis=0), np.ptp(wanted.ctrl, axis=0)
    share = float((span[was > STILL] / was[was > STILL]).min(initial=1.0))
    if share < 0.99:
        said.append(f"brought down to {share:.2f} of its size")
    return " and ".join(said)
