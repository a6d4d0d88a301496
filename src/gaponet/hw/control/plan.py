"""Plan of a run: a trajectory from where the robot is, through the motion, and back, checked
before the first command.

`Planner.plan` takes a motion, `Planner.begin` the first of live targets, which `CollisionGuard`
keeps clear of obstacles while the robot moves. With a compensator, `Planner.judge_commands` runs it
over the whole motion, because its commands differ from the targets. Checked are free space between
the robot's own limbs and above floor or table (robot.collision), range, speed, acceleration and
torque (motion.feasible). A robot that starts nearer to something than the clearance may go away
from it, but no nearer.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.hw.control.clock import Clock
from gaponet.hw.control.driver import Fault, State
from gaponet.hw.control.phases import ControlConfig
from gaponet.hw.control.safety import Limits, SafetyConfig, limit_delta
from gaponet.motion.feasible import MAX_STATIC_SHARE, TORQUE_SHARE, Feasibility, stretch
from gaponet.motion.motion import GRID, Motion
from gaponet.motion.path_planner import Search, Trajectory, find_points, finish_search
from gaponet.robot.spec import RobotSpec
from gaponet.sim.dynamics import static_torque

_T = TypeVar("_T")

MAX_START_DRIFT_RAD = 0.02  # by which the robot may have moved since the plan was made
# by which a joint that is not commanded, such as a hip, may leave the plan's posture during a
# planned run. Then a thigh 0.3 m from the hip has come 3 cm nearer to a hand, which is the
# clearance. A robot that stands or hangs still sways by hundredths of a radian.
MAX_POSTURE_DRIFT_RAD = 0.1
MAX_APPROACH_M = 0.001  # by which shells that start nearer than the clearance may come nearer
# of shells at the start: they are generous, and an arm rests on its table
MAX_START_OVERLAP_M = 0.03
ROUNDING = 1e-8  # relative, of speeds
NO_MOVEMENT = 1e-3  # rad, or m of free space
# time constant with which a live target may use up the free space beyond the clearance
APPROACH_TIME_S = 0.1
BACK_APPROACH_TIME_S = 1e-6  # the same on the way back, which is slow
MAX_SAG_M = 0.05  # of the measured robot below its command that is added to the clearance
STEP_SHARES = (1.0, 0.5, 0.2)  # of a step towards a live target that are tried
MIN_SEARCH_PERIOD_S = 0.005  # shorter control periods have no time for going around
# of the clearance that commands keep: they lead the joints by what these sag
COMMAND_CLEARANCE_SHARE = 0.5
GRADIENT_STEP_RAD = 1e-4  # of numerical gradients of the free space
GOAL_SHARES = 41  # places on the straight line to a first live target that are tried as its goal
# of a plan's torque over the usable one, or over that of the start if this is larger
MAX_TORQUE_EXCESS = 1.1
# of the speed of commands that a plan uses: a faster one would leave its checked path, each joint
# by its own lag. The rest is for corrections.
PLANNED_SPEED_SHARE = 0.8


class TargetCompensator(Protocol):
    """Changes targets so that the robot reaches them (deploy.compensator). All joints, (n)."""

    def reset(self, target: Array, payload_mass: float | None = None) -> None:
        """Begin at rest at `target` (n) rad, with a payload in kg or an unknown one.

        May take long.
        """

    def step(self, target: Array, qpos: Array | None, qvel: Array | None = None) -> Array:
        """Return the command with which the robot reaches `target`, (n) rad.

        qpos None: no state was measured.
        """


@dataclass(frozen=True)
class Plan:
    """Trajectory from the start to the first target, through the motion, and back.

    Attributes:
        start: Measured posture at which it begins and ends, (n,) rad.
        approach: Path to the first target.
        motion: Adapted to the limits; joints that it does not name, or that are not commanded, stay
            at the start. None with live targets.
        retreat: Path from the motion's last row to the start; None without a motion, or where the
            robot stays.
        clearance: Least free space on all of it, m; inf for a robot without shapes.
        nearest: The two shells at that clearance.
        torque: Largest share of the usable torque.
        joint: The joint that needs it.
        changed: How the motion was changed to fit, in words; empty if it was not.
        correction: Largest |command − target| of a compensator, rad, at corrected_joint; 0 without
            one.
        command_clearance: Least free space of the commands, m.
    """

    start: Array
    approach: Trajectory
    motion: Motion | None = None
    retreat: Trajectory | None = None
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
        """All postures, (T, n) rad at a period of GRID s."""
        return self.sample(GRID)

    def sample(self, dt: float) -> Array:
        """Return all postures at a period of dt s, (T, n) rad."""
        parts = [self.approach.rows(dt)]
        parts += [self.motion.sample(dt)] if self.motion else []
        return np.concatenate([*parts, self.retreat.rows(dt)] if self.retreat else parts)

    @property
    def duration(self) -> float:
        """Duration of all parts, s."""
        return sum(part.duration for part in (self.approach, self.motion, self.retreat) if part)


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
            config: Speed and duration of the moves to the first target and back.
            safety: Speed and acceleration of commands.
            limits: Range, torque and shapes; default without payload.
        """
        self.robot = robot
        self.commanded = commanded
        self.config = config or ControlConfig()
        self.safety = safety or SafetyConfig()
        self.limits = limits or Feasibility(robot, 0.0)
        self.collision = self.limits.collision
        # Joints that are not commanded and on which the collision check depends, indices.
        self.idle = np.setdiff1d(self.collision.joints(), robot.index(commanded))

    def plan(self, motion: Motion, start: Array) -> Plan:
        """Return the whole trajectory of a motion from a measured posture (n,) rad and back.

        Raises:
            UsageError: No trajectory keeps within all limits; the message names the limit and what
                is in the way.
        """
        robot = self.robot
        named = tuple(name for name in motion.named(robot) if name in self.commanded)
        wanted = Motion(motion.name, motion.level, motion.dt, motion.ctrl, named).held_at(
            start, robot
        )
        required = self._required_clearance(start)
        first = self.collision.along(wanted.ctrl[:1])
        here = self.collision.along(start[None])
        need = np.where(np.abs(first - here) < NO_MOVEMENT, required, self.collision.clearance)
        if (first < np.minimum(need, 0.0)).any():
            raise UsageError(
                f"motion '{motion.name}' begins with {self._describe(first)}. Begin it elsewhere"
            )
        fitted = self._slow_down(self.limits.fit(wanted, need=need))
        columns = robot.index(named)
        place = "where the robot is (bring it nearer by hand, or name more joints)"
        to_motion = f"to the motion's begin from {place}"
        approach = finish_search(
            self._find_path(start, fitted.ctrl[0], columns, required, to_motion)
        )
        path = self._find_path(fitted.ctrl[-1], start, columns, required, f"back to {place}")
        retreat = finish_search(path) if self.config.blend_out else None
        plan = Plan(start, approach, fitted, retreat, changed=_describe_changes(wanted, fitted))
        return self._check(plan, required)

    def begin(self, first: Array, start: Array) -> Search[Plan]:
        """Search the path from a measured posture to the first live target, both (n,) rad, step by
        step.

        Raises:
            UsageError: As `plan`.
        """
        columns = self.robot.index(self.commanded)
        goal = start.copy()
        goal[columns] = first[columns]
        moved = columns[np.abs(goal - start)[columns] > 0]
        required = self._required_clearance(start)
        free = self.collision.along(goal[None])
        if (free < np.minimum(required, 0.0)).any():
            raise UsageError(f"the first target brings {self._describe(free)}")
        # A goal within the clearance is not gone to entirely.
        shares = np.linspace(1.0, 0.0, GOAL_SHARES)[:, None]
        clear = (self.collision.distances(start + shares * (goal - start)) >= required).all(axis=1)
        goal = start + float(shares[int(clear.argmax()), 0]) * (goal - start)
        approach = yield from self._find_path(start, goal, moved, required, "to the first target")
        return self._check(Plan(start, approach), required)

    def judge_commands(
        self, plan: Plan, compensator: TargetCompensator, masses: tuple[float, ...]
    ) -> Plan:
        """Return the plan with its largest correction and the clearance of the commands, for all
        `masses` (kg).

        The compensator is causal and is run without measured states. Its feedback is not included:
        that adds at most CompensatorConfig.feedback_limit.

        Raises:
            UsageError: A command is not a number or brings shells too near to each other.
        """
        config = self.safety
        at = self.robot.index(self.commanded)
        limits = Limits.from_robot(self.robot, self.commanded, config)
        dt = 1.0 / self.config.rate
        targets = plan.sample(dt)
        floor = (
            self._required_clearance(plan.start)
            - COMMAND_CLEARANCE_SHARE * self.collision.clearance
        )
        correction = 0.0
        joint = ""
        least = np.inf
        for mass in masses:
            compensator.reset(plan.start, mass)
            delta = np.zeros(len(at))
            commands = targets.copy()
            for k, target in enumerate(targets):
                wanted = compensator.step(target, None)[at]
                if not np.isfinite(wanted).all():
                    joint = self.commanded[int(np.argmax(~np.isfinite(wanted)))]
                    raise UsageError(
                        f"compensation commands no number to {joint}; check the identified values"
                    )
                delta = limit_delta(wanted - target[at], delta, dt, limits)
                commands[k, at] = np.clip(target[at] + delta, limits.low, limits.high)
            free = self.collision.along(commands)
            if (free < floor).any():
                raise UsageError(
                    f"compensation with {mass:g} kg brings "
                    f"{self._describe(np.where(free < floor, free, np.inf))}. The targets keep "
                    "clear. State the payload (--payload-mass), check the identified values, or "
                    "leave out --compensate and --model"
                )
            far = np.abs(commands - targets).max(axis=0)
            if far.max() > correction:
                correction = float(far.max())
                joint = self.robot.joint_names[int(far.argmax())]
            least = min(least, float(free.min(initial=np.inf)))
        return replace(plan, correction=correction, corrected_joint=joint, command_clearance=least)

    def _slow_down(self, motion: Motion) -> Motion:
        """Return the motion, slowed if it is faster than commands may be, or accelerates more than
        joints can.
        """
        rows = motion.sample(1 / self.config.rate)
        speed = np.abs(np.diff(rows, axis=0)).max(initial=0.0) * self.config.rate
        acceleration = np.abs(np.diff(rows, 2, axis=0)).max(initial=0.0) * self.config.rate**2
        slower = max(
            np.sqrt(acceleration / self.safety.acceleration),
            speed / (PLANNED_SPEED_SHARE * self.safety.speed),
        )
        if slower <= 1.0 + ROUNDING:
            return motion
        return replace(motion, ctrl=stretch(motion.ctrl, 1.02 * slower))

    def _required_clearance(self, start: Array) -> Array:
        """Return the free space (pairs + shells,) m that a robot must keep which starts in a
        posture.
        """
        free = self.collision.along(start[None])
        if free.min(initial=np.inf) < -MAX_START_OVERLAP_M:
            raise UsageError(
                f"the robot was found with {self.collision.nearest(free)} {-100 * free.min():.0f} "
                "cm in each other: its zero, or the height of what it stands on, is not what "
                "collision.toml says (--plane HEIGHT)"
            )
        return np.minimum(free - MAX_APPROACH_M, self.collision.clearance)

    def _describe(self, free: Array) -> str:
        distance_cm = 100 * float(free.min())
        near = f"{distance_cm:.1f} cm from each other"
        if distance_cm <= 0:
            near = f"{-distance_cm:.1f} cm into each other"
        kept_cm = 100 * self.collision.clearance
        return f"{self.collision.nearest(free)} {near}; {kept_cm:g} cm are kept"

    def back(self, end: Array, start: Array) -> Search[Trajectory]:
        """Search the path from where live targets ended back to the start, both (n,) rad, step by
        step.

        Raises:
            UsageError: No path keeps clear.
        """
        free_at_end = self.collision.along(end[None]) - 1e-9
        required = np.minimum(self._required_clearance(start), free_at_end)
        columns = self.robot.index(self.commanded)
        return self._find_path(end, start, columns, required, "back to where it was found")

    def _find_path(
        self, start: Array, goal: Array, columns: Array, required: Array, label: str
    ) -> Search[Trajectory]:
        """Search a path from a posture (n,) rad to another by moving these joints."""
        low = start.copy()
        high = start.copy()
        low[columns] = self.limits.low[columns]
        high[columns] = self.limits.high[columns]
        home = np.clip(self.robot.qpos_home, low, high)
        ends = np.stack([start, goal])
        models = self.limits.models
        at_ends = [np.abs(static_torque(model, ends)).max(axis=0) for model in models]  # N·m
        most = np.maximum(self.limits.limit * MAX_STATIC_SHARE, np.max(at_ends, axis=0) + 1e-6)

        def free(rows: Array) -> bool:
            """Return True if postures (rows, n) rad keep clear and need not too much torque."""
            if (self.collision.distances(rows) < required).any():
                return False
            some = rows[::4]
            return all((np.abs(static_torque(model, some)) <= most).all() for model in models)

        points = yield from find_points(free, start, goal, home)
        if points is None:
            straight = self.collision.along(np.linspace(start, goal, 200))
            raise UsageError(
                f"no clear way {label}: straight it brings {self._describe(straight)}, and the way "
                "through the home posture is not clear either. Bring the robot by hand near its "
                "home posture, or to a posture from where the straight way is clear"
            )
        speed = way_speed(self.config, self.safety)
        return Trajectory.minimum_jerk(points, speed, self.safety.acceleration, self.config.blend)

    def _check(self, plan: Plan, required: Array) -> Plan:
        """Check the whole plan again, however it was made.

        Return it with its clearance and torque.
        """
        rows = plan.rows
        free = self.collision.along(rows)
        if (free < required).any():
            raise UsageError(
                f"the plan brings {self._describe(np.where(free < required, free, np.inf))}"
            )
        demand = self.limits.demand(rows, GRID)
        here = self.limits.demand(np.stack([plan.start] * 2), GRID)
        share = self.safety.torque_share
        allowed = min(1.0, share / (MAX_TORQUE_EXCESS * TORQUE_SHARE))
        if demand.torque > MAX_TORQUE_EXCESS * max(allowed, here.torque):
            why = ""
            if allowed < 1.0:
                why = f", and --safety.torque-share {share:g} allows {allowed:.2f}"
            raise UsageError(
                f"the plan asks {demand.worst_joint} for {demand.torque:.2f} of the torque that "
                f"may be used{why}; go slower (--blend-speed), or from a posture that is easier "
                "to hold"
            )
        nearest = self.collision.nearest(free) if len(free) else ""
        clearance = float(free.min(initial=np.inf))
        return replace(
            plan,
            clearance=clearance,
            nearest=nearest,
            torque=demand.torque,
            joint=demand.worst_joint,
        )


def advance(search: Search[_T], clock: Clock, seconds: float) -> _T | None:
    """Continue a search for some seconds; return its result, or None if it is not over.

    Raises:
        UsageError: The search found nothing.
    """
    until = clock.now() + seconds
    try:
        while clock.now() <= until:
            next(search)
    except StopIteration as end:
        result: _T | None = end.value
        return result
    return None


class CollisionGuard:
    """Keeps live targets clear of limbs and plane: a step that leads into one is cut.

    The free space beyond the clearance may be used up only so fast that the robot can stop. Where
    the measured robot is nearer than its command, for instance because it sags, the clearance grows
    by the difference. A step towards an obstacle goes along it if the control period leaves the
    time to find out how.

    Attributes:
        qpos: The last target, (n,) rad.
        obstacle: The two shells that are in the way, in words, while a target is cut; empty
            otherwise.
    """

    def __init__(self, planner: Planner, qpos: Array) -> None:
        """Begin at a posture (n,) rad, with the shapes and speeds of a planner."""
        self.collision = planner.collision
        self.config = planner.config
        self.safety = planner.safety
        self.qpos = np.array(qpos, float)
        self.obstacle = ""
        # Free space, (pairs + shells,) m each.
        self._free = self.collision.along(self.qpos[None])  # now
        self._start_free = self._free
        self._keep = np.full_like(self._free, self.collision.clearance)  # to be kept
        self._sag = np.zeros_like(self._free)  # by how much sagging reduces it
        self._cut = False
        self._approach_time = APPROACH_TIME_S
        self._max_sag = MAX_SAG_M

    def allow_start_clearance(self) -> None:
        """Let the robot go back slowly: it may come as near to everything as it was at the
        start.
        """
        self._approach_time = BACK_APPROACH_TIME_S
        self._max_sag = 0.0
        self._keep = np.minimum(self._keep, self._start_free - MAX_APPROACH_M)

    def step(self, target: Array, qpos: Array, dt: float) -> Array:
        """Return the next posture on the way to a target, all (n,) rad.

        Args:
            target: Wanted.
            qpos: Measured.
            dt: Control period, s.
        """
        self._sag = np.clip(self._free - self.collision.along(qpos[None]), 0.0, self._max_sag)
        speed = way_speed(self.config, self.safety) if self._cut else self.safety.speed
        move = np.clip(target - self.qpos, -speed * dt, speed * dt)
        if self._try(move, STEP_SHARES[:1], dt):
            self.obstacle = ""
            self._cut = self._cut and bool(np.abs(target - self.qpos).max() > speed * dt)
            return self.qpos
        self._cut = True
        free = self.collision.along((self.qpos + move)[None])
        self.obstacle = self.collision.nearest(np.where(free < self._floor(dt), free, np.inf))
        if not self._try(move, STEP_SHARES[1:], dt) and dt >= MIN_SEARCH_PERIOD_S:
            self._try(self._along_obstacle(move, dt), STEP_SHARES, dt)
        return self.qpos

    def _floor(self, dt: float) -> Array:
        """Return the free space that the next posture must leave, (pairs + shells,) m."""
        keep = self._keep + self._sag
        shrunk = keep + (self._free - keep) * np.exp(-dt / self._approach_time)
        return np.where(self._free > keep, shrunk, self._free - 1e-9)

    def _try(self, move: Array, shares: tuple[float, ...], dt: float) -> bool:
        """Make the largest of these shares of a move that leaves enough free space.

        Return False if none does.
        """
        for share in shares:
            posture = self.qpos + share * move
            free = self.collision.along(posture[None])
            if (free >= self._floor(dt)).all():
                self.qpos = posture
                self._free = free
                return True
        return False

    def _along_obstacle(self, move: Array, dt: float) -> Array:
        """Return the step (n,) rad without its parts towards the obstacles, each in turn."""
        floor = self._floor(dt)
        moved = np.flatnonzero(move)
        rows = self.qpos + GRADIENT_STEP_RAD * np.eye(len(move))[moved]
        # (moved, pairs + shells)
        slope = (self.collision.distances(rows) - self._free) / GRADIENT_STEP_RAD
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


class PostureMonitor:
    """Watches the joints that are not commanded during a planned run.

    The plan was checked with these joints where they were found. If one of them moves, its way may
    not be free any more.
    """

    def __init__(self, planner: Planner, plan: Plan) -> None:
        self._names = planner.robot.joint_names
        self._idle = planner.idle
        self._found = plan.start[self._idle]  # rad

    def check(self, state: State) -> Fault | None:
        """Return a fault if a joint has left the posture of the plan."""
        moved = np.abs(state.qpos[self._idle] - self._found)
        if moved.max(initial=0.0) <= MAX_POSTURE_DRIFT_RAD:
            return None
        worst = int(moved.argmax())
        return Fault(
            "tracking",
            f"{self._names[self._idle[worst]]} is not commanded and moved by {moved[worst]:.2f} "
            "rad since the plan was made; the planned way may not be free any more",
        )


def way_speed(config: ControlConfig, safety: SafetyConfig) -> float:
    """Return the speed of the ways to the first target and back, rad/s: commands can follow it."""
    return min(config.blend_speed, PLANNED_SPEED_SHARE * safety.speed)


def _describe_changes(wanted: Motion, fitted: Motion) -> str:
    """Return how a motion was changed to fit, in words."""
    sentences = []
    slower = fitted.duration / wanted.duration
    if slower > 1.01:
        sentences.append(f"played {slower:.2f} times slower")
    span = np.ptp(fitted.ctrl, axis=0)
    was = np.ptp(wanted.ctrl, axis=0)
    share = float((span[was > NO_MOVEMENT] / was[was > NO_MOVEMENT]).min(initial=1.0))
    if share < 0.99:
        sentences.append(f"brought down to {share:.2f} of its size")
    return " and ".join(sentences)
