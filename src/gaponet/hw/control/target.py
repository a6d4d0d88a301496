"""Targets of one run: readiness for the first command, then for each period the target or the end
of the phase.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.hw.control.driver import Fault, State
from gaponet.hw.control.following import FollowingMonitor
from gaponet.hw.control.output import Context, Output
from gaponet.hw.control.phases import MOVING, Phase, Trigger
from gaponet.hw.control.plan import (
    MAX_START_DRIFT_RAD,
    MIN_SEARCH_PERIOD_S,
    CollisionGuard,
    Plan,
    PostureMonitor,
    advance,
    way_speed,
)
from gaponet.hw.targets.policy import NotYet, Policy
from gaponet.motion.motion import blend
from gaponet.motion.path_planner import Search, Trajectory

MIN_GOOD_STATES = 5  # periods in a row without a fault before anything is commanded
MAX_WAIT_S = 5.0  # for so many good states
NO_STATE = Fault("stale", "no fresh state")
SEARCH_SHARE = 0.3  # of a period in which a search for a clear path is continued
# Weight until a joint has followed, where one goes FAR_RAD to the first target: at this weight that
# is more than friction may hide.
MAX_UNPROVEN_WEIGHT = 0.3
FAR_RAD = 0.4
FULL_WEIGHT = 1.0 - 1e-9
# Time of the run after which the estimated payload is compared with the stated one.
PAYLOAD_CHECK_S = 2.0
END_TEXTS = {  # by Driver.at_end
    "hand_over": "held while it is handed over",
    "hold": "hold",
    "damp": "damp",
}


class Readiness:
    """Waits for good states in a row, a prepared compensator, a first target, and a clear path to
    it.

    Attributes:
        since: Start of the wait for the robot, s.
        plan: May be given until the run begins: its motion is played.
    """

    def __init__(self, context: Context, output: Output) -> None:
        self.context = context
        self.output = output
        self.since = 0.0
        self.plan: Plan | None = None
        self._search: Search[Plan] | None = None
        self._prepared = context.compensator is None
        self._good_states = 0
        self._fault = NO_STATE

    def count(self, fault: Fault | None) -> None:
        """Count a state; a fault begins anew."""
        if fault:
            self._good_states = 0
            self._fault = fault
        else:
            self._good_states += 1
            self._fault = NO_STATE

    def first_target(self, now: float, state: State, policy: Policy) -> Array | Fault | None:
        """Return the first target, (n) rad, if the robot may go there now.

        None: wait. A fault: the robot may not go there.
        """
        if self._good_states < MIN_GOOD_STATES:
            if self._waits_too_long(now):
                return Fault(self._fault.kind, f"never ready: {self._fault.text}")
            return None
        if not self._prepared:
            self._prepare(state)
            return None
        first = policy(0, state)
        if isinstance(first, Fault):
            return self._without_target(first, now)
        if first is None or not np.isfinite(first[self.context.joints]).all():
            return Fault("target", "the motion has no first target, or it is not a number")
        return self._admitted(first, state, now)

    def _waits_too_long(self, now: float) -> bool:
        return now - self.since > MAX_WAIT_S

    def _without_target(self, fault: Fault, now: float) -> Fault | None:
        """Return the fault in place of a first target, or None to wait.

        A sender of live targets may be silent while the robot plans: it waits for the robot, and
        goes on afterwards.
        """
        if isinstance(fault, NotYet):
            self.since = now  # all else is well
            return None
        if fault.kind != "silence":
            return fault
        if self._search is not None:
            return self._continue_search(now)
        if self.plan is None or self._waits_too_long(now):
            return fault
        return None

    def _admitted(self, first: Array, state: State, now: float) -> Array | Fault | None:
        """Return the first target if the robot may go there from this state; None: wait."""
        plan_before = self.plan
        fault = self._update_plan(first, state, now) or self.output.admit(state.qpos)
        if fault:
            return fault
        searched = plan_before is None or self.plan is not plan_before
        if self.context.planner and searched:
            return None  # the search goes on, or took time: look at a fresh state
        return first

    def _prepare(self, state: State) -> None:
        """Prepare the compensator. This takes longer than a period: fresh states must follow."""
        if self.context.compensator:
            self.context.compensator.reset(state.qpos, self.context.payload_mass)
        self._prepared = True
        self._good_states = 0

    def _update_plan(self, first: Array, state: State, now: float) -> Fault | None:
        """Let a plan begin where the robot is, if there is a planner.

        The search may take several periods.
        """
        context = self.context
        if self.plan is not None:
            moved = np.abs(state.qpos - self.plan.start)[context.joints]
            is_live = self.plan.motion is None
            if moved.max() <= MAX_START_DRIFT_RAD:
                # With live targets, the collision guard measures the other joints.
                return None if is_live else self._posture_fault(self.plan, state)
            if not is_live:
                joint = context.driver.commanded[int(moved.argmax())]
                return Fault(
                    "plan",
                    f"{joint} moved by {moved.max():.2f} rad since the plan was made; run it again",
                )
            self.plan = None
        if context.planner is None:
            return None
        if self._search is None:
            self._search = context.planner.begin(first, state.qpos)
        return self._continue_search(now)

    def _posture_fault(self, plan: Plan, state: State) -> Fault | None:
        """Return a fault if a joint that is not commanded has left the posture of the plan."""
        if self.context.planner is None:
            return None
        moved = PostureMonitor(self.context.planner, plan).check(state)
        if moved is None:
            return None
        return replace(moved, kind="plan")

    def _continue_search(self, now: float) -> Fault | None:
        """Search for a part of a period; the plan is there when the search ends."""
        assert self._search is not None
        context = self.context
        try:
            self.plan = advance(self._search, context.clock, SEARCH_SHARE * context.dt)
        except UsageError as error:
            return Fault("plan", str(error))
        if self.plan:
            self._search = None
        self.since = now
        return None


class PhaseChange(NamedTuple):
    """End of a phase: its event, and text and kind for the recording."""

    trigger: Trigger
    text: str
    kind: str = ""


class Approach:
    """The way to the first target, on which the robot is handed over to us.

    Attributes:
        path: From where the robot was found to about its goal.
        handed: Weight that was reached.
    """

    def __init__(
        self, context: Context, following: FollowingMonitor, path: Trajectory, start: Array
    ) -> None:
        """start: Where the robot was found, rad."""
        self.path = path
        self.handed = 0.0
        self._context = context
        self._following = following
        self._start = start
        self._progress = 0.0  # s on the path

    def is_over(self) -> bool:
        """Return True at the goal and settled, with weight 1."""
        return self._has_arrived() and self.handed > FULL_WEIGHT

    def _has_arrived(self) -> bool:
        return self._progress >= self.path.duration + self._context.config.settle

    def step(self, goal: Array) -> Array | Fault:
        """Return the place in this period on the way to the first target, rad, or why the robot
        may not be handed over. Go on by a period.
        """
        distance = np.abs(goal - self._start)
        is_far = bool(distance.max() >= FAR_RAD)
        unproven = is_far and self._is_unproven()
        if unproven and self._has_arrived():
            return self._following.fault(int(distance.argmax()))
        place = _on_path(self.path, self._progress, self._start, goal, self._context.joints)
        self._hand_over(MAX_UNPROVEN_WEIGHT if unproven else 1.0)
        # While it is handed over joints lag, each in its own way: on a far way it stands meanwhile,
        # unless the joints must move to show that they follow.
        stands = is_far and not unproven and self._is_partly_handed_over()
        if not stands:
            self._progress += self._context.dt
        return place

    def _is_unproven(self) -> bool:
        """Return true if joints must show that they follow, and none has."""
        return bool(self._following.share) and not self._following.shown.any()

    def _is_partly_handed_over(self) -> bool:
        return self._context.driver.at_end == "hand_over" and self.handed < FULL_WEIGHT

    def _hand_over(self, max_weight: float) -> None:
        """Raise the weight by a period of the blend, up to max_weight; never lower it."""
        step = self._context.dt / self._context.config.blend
        self.handed = max(self.handed, min(self.handed + step, max_weight))


class WayBack:
    """The way back to where the robot was found."""

    def __init__(
        self,
        context: Context,
        path: Trajectory,
        start: Array,
        goal: Array,
        search: Search[Trajectory] | None,
    ) -> None:
        """
        Args:
            path: It is taken if nothing is searched.
            start, goal: Its ends, rad.
            search: For a path that keeps clear; it may take several periods.
        """
        self._context = context
        self._path = path
        self._start = start
        self._goal = goal
        self._search = search
        self._since = 0  # period of the phase in which it begins

    def find(self, n: int) -> bool:
        """Go on searching in the n-th period of the phase; return True once there is a path.

        Raises:
            UsageError: There is none.
        """
        if self._search is None:
            return True
        path = advance(self._search, self._context.clock, SEARCH_SHARE * self._context.dt)
        if path is None:
            return False
        self._search = None
        self._since = n
        self._path = path
        return True

    def place(self, n: int) -> Array | None:
        """Return the place in the n-th period of the phase; None at the end."""
        passed = (n - self._since) * self._context.dt
        if passed > self._path.duration + self._context.config.settle:
            return None
        return _on_path(self._path, passed, self._start, self._goal, self._context.joints)


class TargetGenerator:
    """Generates the targets of one run. Arrays are of the commanded joints, rad.

    Attributes:
        weight: Weight of the last target: how far the robot is handed over.
        start: Where the robot was found.
        approach: To the first target.
        remarks: Sentences for the recording; the controller takes them out.
    """

    def __init__(
        self,
        context: Context,
        following: FollowingMonitor,
        plan: Plan | None,
        state: State,
        first: Array,
    ) -> None:
        """Begin where the robot is and go to the first target, (n) rad: by the paths of a plan, or
        straight.
        """
        self.context = context
        self.plan = plan
        self.start = state.qpos[context.joints]
        self.weight = 0.0
        self.remarks: list[str] = []
        self._last: Array = self.start
        if plan:
            path = plan.approach
        else:
            path = self._straight(self.start, first[context.joints], state)
        self.approach = Approach(context, following, path, self.start)
        self._way_back: WayBack | None = None
        self._guard: CollisionGuard | None = None
        self._posture: PostureMonitor | None = None
        if context.planner and plan:
            if plan.motion is None:  # targets are live
                self._guard = CollisionGuard(context.planner, state.qpos)
            else:
                self._posture = PostureMonitor(context.planner, plan)
        self._obstacle = ""
        self._checked_payload = False

    def step(
        self, phase: Phase, n: int, state: State, policy: Policy
    ) -> Array | PhaseChange | Fault:
        """Return the target of the n-th period of a phase, or the end of the phase."""
        if self._posture and phase in MOVING:
            moved = self._posture.check(state)
            if moved:
                return moved
        if phase is Phase.BLEND_IN:
            out = self._blend_in(state, policy)
        elif phase is Phase.RUN:
            out = self._run(n, state, policy)
        elif phase is Phase.BLEND_OUT:
            out = self._blend_out(n, state)
        else:
            out = self._release(n)
        if self._guard and isinstance(out, np.ndarray) and np.isfinite(out).all():
            return self._clear(self._guard, out, state)
        return out

    def _blend_in(self, state: State, policy: Policy) -> Array | PhaseChange | Fault:
        """Go to the first target, and raise the weight to 1."""
        if self.approach.is_over():
            return PhaseChange(Trigger.ARRIVED, "motion")
        first = policy(0, state)
        self._take_remarks(policy)
        if isinstance(first, Fault):
            return first
        goal = self.start if first is None else first[self.context.joints]
        if not np.isfinite(goal).all():
            return Fault("target", "the first target is not a number any more")
        place = self.approach.step(goal)
        if isinstance(place, Fault):
            return place
        self._last = place
        self.weight = self.approach.handed
        return place

    def _take_remarks(self, policy: Policy) -> None:
        """Take over what a policy has to remark; only that of live targets has remarks."""
        remarks = getattr(policy, "remarks", [])
        self.remarks.extend(remarks)
        remarks.clear()

    def _run(self, n: int, state: State, policy: Policy) -> Array | PhaseChange | Fault:
        target = policy(n, state)
        self.weight = 1.0
        self._take_remarks(policy)
        if isinstance(target, Fault):
            return target
        if not self._checked_payload and n * self.context.dt >= PAYLOAD_CHECK_S:
            self._checked_payload = True
            # Not every compensator estimates the payload.
            doubt = getattr(self.context.compensator, "doubt", "")
            if doubt:
                self.remarks.append(f"compensation: {doubt}")
        if target is not None:
            self._last = np.array(target[self.context.joints], float)
            return self._last
        if self.context.config.blend_out:
            return PhaseChange(Trigger.RETURN, "end of the motion", "end")
        return self._end("end of the motion")

    def _blend_out(self, n: int, state: State) -> Array | PhaseChange:
        """Go back to the start."""
        if self._way_back is None:
            self._way_back = self._begin_way_back(state)
        try:
            is_found = self._way_back.find(n)
        except UsageError as error:
            return self._end(f"where it is: {error}")
        if not is_found:
            return self._last
        place = self._way_back.place(n)
        if place is not None:
            return place
        if self._guard and np.abs(self._last - self.start).max() > MAX_START_DRIFT_RAD:
            return self._end(
                f"where it is: {self._guard.obstacle} would come too near on the way back"
            )
        self._last = self.start
        return self._end("back where it was found")

    def _begin_way_back(self, state: State) -> WayBack:
        """Return the way from the last target to the start; with live targets it is searched."""
        planner = self.context.planner
        joints = self.context.joints
        retreat = self.plan.retreat if self.plan else None
        path = retreat or self._straight(self._last, self.start, state)
        search = None
        if self._guard and planner:
            self._guard.allow_start_clearance()
            if self.context.dt >= MIN_SEARCH_PERIOD_S:
                last = state.qpos_with(joints, self._last)
                start = state.qpos_with(joints, self.start)
                search = planner.back(last, start)
        return WayBack(self.context, path, self._last, self.start, search)

    def _release(self, n: int) -> Array | PhaseChange:
        if self.weight == 0.0:
            return PhaseChange(Trigger.RELEASED, "handed over")
        left = max(1.0 - n * self.context.dt / self.context.config.damp, 0.0)
        self.weight = left * self.approach.handed
        return self._last

    def _end(self, text: str) -> PhaseChange:
        """Return the end of a run without fault, as the driver's robot can have it."""
        at_end = self.context.driver.at_end
        return PhaseChange(Trigger[at_end.upper()], f"{text}; {END_TEXTS[at_end]}", "end")

    def _clear(self, guard: CollisionGuard, target: Array, state: State) -> Array:
        """Return the target as far as limbs and plane leave the way free."""
        joints = self.context.joints
        guard.qpos = state.qpos_with(joints, guard.qpos[joints])
        wanted = state.qpos_with(joints, target)
        self._last = guard.step(wanted, state.qpos, self.context.dt)[joints]
        if guard.obstacle and guard.obstacle != self._obstacle:
            self.remarks.append(f"targets are cut: {guard.obstacle} would come too near")
        self._obstacle = guard.obstacle or self._obstacle
        return self._last

    def _straight(self, start: Array, goal: Array, state: State) -> Trajectory:
        config = self.context.config
        joints = self.context.joints
        points = np.stack([state.qpos_with(joints, start), state.qpos_with(joints, goal)])
        speed = way_speed(config, self.context.safety)
        return Trajectory.minimum_jerk(points, speed, np.inf, config.blend)


def _on_path(path: Trajectory, passed: float, start: Array, goal: Array, joints: Array) -> Array:
    """Return the place of the joints on a path after `passed` s, rad, with its ends moved to the
    true start and goal.

    Args:
        path: Of all joints, from about the start to about the goal.
        passed: s since its beginning.
        start, goal: Of `joints`, rad.
        joints: Indices of the commanded joints.
    """
    share = float(blend(np.array(passed / path.duration)))  # of the way, 0 to 1
    shift_of_start = start - path.points[0][joints]
    shift_of_goal = goal - path.points[-1][joints]
    shift = (1 - share) * shift_of_start + share * shift_of_goal
    place: Array = path.at(passed)[joints] + shift
    return place
