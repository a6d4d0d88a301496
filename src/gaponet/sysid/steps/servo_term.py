"""A term of the servo model: friction at rest, friction by load, a torque limit, …"""

from __future__ import annotations

from dataclasses import replace

from gaponet.base.arrays import Array
from gaponet.robot.servo_fields import SERVO_FIELDS, TERMS, Term
from gaponet.sysid.axes import Values
from gaponet.sysid.problem import JointFit, RobotFit, robot_fields
from gaponet.sysid.search_progress import POLISH_ITERATIONS
from gaponet.sysid.steps import backlash
from gaponet.sysid.steps.step import Fits, FitState


class ServoTerm:
    """Fit of a term with all that the base has: each joint alone, then all together where that
    helps.
    """

    def __init__(self, term: Term, fits: Fits) -> None:
        self.name = str(term)
        self._fields = TERMS[term]
        self._strength = self._fields[0]  # without it the term's other fields have no effect
        self._fits = fits

    def applies(self, state: FitState) -> bool:
        """Return True; a subclass may look first."""
        return True

    def propose(self, state: FitState) -> FitState:
        """Return the state with the term."""
        alone = self._fit_alone(state)
        return self._with_values(state, self._improved(state, alone))

    def warnings(self, state: FitState) -> list[str]:
        """Return no warning: `Bounds.warnings` has those of all values."""
        return []

    def _fit_alone(self, state: FitState) -> list[Values]:
        """Return the fit of each set of recordings, every joint by itself."""
        fitted = []
        for joints, base in zip(self._fits.joints, state.base, strict=True):
            fitted.append(self._fit_joints(joints, base))
        return fitted

    def _fit_joints(self, joints: JointFit, values: Values) -> Values:
        """Fit the term from values (n,), each joint by itself."""
        start = values.copy()
        for field in self._fields:
            start[field] = joints.bounds.guess[field]
        progress = self._fits.progress
        progress.begin_search()
        report = progress.reporter(self.name, joints.robot.operated, joints.rollouts.rows)
        return joints.search(start, report=report)

    def _improved(self, state: FitState, alone: list[Values]) -> list[Values]:
        """Return fits of single joints, polished where that helps, with 0 where the term cannot be
        seen.
        """
        improved = []
        for joints, values in zip(self._fits.joints, self._polished(state, alone), strict=True):
            visible: Array = joints.bounds.visible(self._strength, values)
            improved.append(values | {self._strength: visible})
        return improved

    def _polished(self, state: FitState, alone: list[Values]) -> list[Values]:
        """Return the values after a fit of all joints together, if the motions that judge are then
        followed better; else those of single joints.
        """
        if not state.together or self._fits.progress.search_is_over():
            return alone
        if any(SERVO_FIELDS[field].single_joint for field in self._fields):
            return alone
        polished = []
        for robot, values in zip(state.robots, alone, strict=True):
            polished.append(self._polish(robot, values))
        judge = self._fits.judge
        if judge.errors(polished).mean() < judge.errors(alone).mean():
            return polished
        return alone

    def _polish(self, robot: RobotFit, values: Values) -> Values:
        """Fit values (n,) with the term once more, all joints together."""
        what = f"{self.name}, whole robot"
        rows = robot.rollouts.rows
        report = self._fits.progress.reporter(what, robot.robot.operated, rows)
        search = robot.search(robot_fields(values), values, (values,))
        search.iterate(POLISH_ITERATIONS, report)
        return search.values

    def _with_values(self, state: FitState, values: list[Values]) -> FitState:
        """Return the state with values, without the term if it is zero in every joint: then it only
        gave the others more iterations.
        """
        is_used = any(of_set[self._strength].any() for of_set in values)
        if not is_used:
            values = [self._without_term(of_set) for of_set in values]
        return replace(state, values=values, base=values)

    def _without_term(self, values: Values) -> Values:
        """Return values without the fields of the term."""
        return {field: value for field, value in values.items() if field not in self._fields}


class Backlash(ServoTerm):
    """Backlash that the robot lacks, where a gap makes rollouts better at otherwise equal
    values.
    """

    def __init__(self, fits: Fits) -> None:
        super().__init__("backlash", fits)

    def applies(self, state: FitState) -> bool:
        """Return whether a joint's rollouts are better with some gap."""
        base = state.base[-1]
        if "backlash" in base:
            return False
        return backlash.worth_a_search(self._fits.joints[-1], base)

    def propose(self, state: FitState) -> FitState:
        """Return the state with backlash at the joints where it is probable."""
        alone = self._fit_alone(state)
        values = self._improved(state, alone)
        chance = self._probability(state.base[-1], alone[-1])
        width = values[-1]["backlash"]
        probable = backlash.only_probable(state.values, values, chance)
        return replace(self._with_values(state, probable), gaps=(width, chance))

    def _probability(self, base: Values, with_gap: Values) -> Array:
        """Return the probability of backlash in the last set of recordings, (n,).

        The base is searched once more, so that both fits have had equally many iterations.
        """
        joints = self._fits.joints[-1]
        progress = self._fits.progress
        without_gap = joints.search(base, report=lambda cost: progress.search_is_over())
        return backlash.probability(joints, without_gap, with_gap)
