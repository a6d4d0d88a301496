"""A term of the servo model: friction at rest, friction by load, a torque limit, …"""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import replace

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
        self._term: Term = term
        self._fits = fits

    def applies(self, state: FitState) -> bool:
        """Return True; a subclass may look first."""
        return True

    def propose(self, state: FitState) -> FitState:
        """Return the state with the term."""
        return self._with_values(state, self._fitted(state, self._alone(state)))

    def warnings(self, state: FitState) -> list[str]:
        """Return no warning: `Bounds.warnings` has those of all values."""
        return []

    def _alone(self, state: FitState) -> list[Values]:
        """Return the fits of single joints."""
        return [self._fit_joints(*one) for one in zip(self._fits.joints, state.base, strict=True)]

    def _fitted(self, state: FitState, alone: list[Values]) -> list[Values]:
        """Return values from fits of single joints, polished in the whole robot's simulator where
        that helps.
        """
        values = alone
        fields = TERMS[self._term]
        is_of_single_joints = any(SERVO_FIELDS[field].single_joint for field in fields)
        has_time = not self._fits.progress.search_is_over()
        if state.together and not is_of_single_joints and has_time:
            polished = [self._polish(*one) for one in zip(state.robots, alone, strict=True)]
            judge = self._fits.judge
            if judge.errors(polished).mean() < judge.errors(alone).mean():
                values = polished
        strength = fields[0]  # without it the others of the term have no effect
        visible = []
        for fit, of_set in zip(self._fits.joints, values, strict=True):
            visible.append(of_set | {strength: fit.bounds.visible(strength, of_set)})
        return visible

    def _with_values(self, state: FitState, values: list[Values]) -> FitState:
        """Return the state with values, without the term if it is zero in every joint: then it only
        gave the others more iterations.
        """
        fields = TERMS[self._term]
        if not any(of_set[fields[0]].any() for of_set in values):
            values = [_without(fields, of_set) for of_set in values]
        return replace(state, values=values, base=values)

    def _fit_joints(self, joints: JointFit, values: Values) -> Values:
        """Fit the term from values (n,), each joint by itself."""
        progress = self._fits.progress
        progress.begin_search()
        report = progress.reporter(self.name, joints.robot.operated, joints.rollouts.rows)
        start = values | {f: joints.bounds.guess[f] for f in TERMS[self._term]}
        return joints.search(start, report=report)

    def _polish(self, robot: RobotFit, values: Values) -> Values:
        """Fit values (n,) with the term once more, all joints together."""
        report = self._fits.progress.reporter(
            f"{self.name}, whole robot", robot.robot.operated, robot.rollouts.rows
        )
        search = robot.search(robot_fields(values), values, (values,))
        search.iterate(POLISH_ITERATIONS, report)
        return search.values


class Backlash(ServoTerm):
    """Backlash that the robot lacks, where a gap makes rollouts better at otherwise equal
    values.
    """

    def __init__(self, fits: Fits) -> None:
        super().__init__("backlash", fits)

    def applies(self, state: FitState) -> bool:
        """Return whether a joint's rollouts are better with some gap."""
        base = state.base[-1]
        return "backlash" not in base and backlash.worth_a_search(self._fits.joints[-1], base)

    def propose(self, state: FitState) -> FitState:
        """Return the state with backlash at the joints where it is probable."""
        fit = self._fits.joints[-1]
        over = self._fits.progress.search_is_over
        alone = self._alone(state)
        values = self._fitted(state, alone)
        without = fit.search(state.base[-1], report=lambda cost: over())
        chance = backlash.probability(fit, without, alone[-1])
        width = values[-1]["backlash"]
        probable = backlash.only_probable(state.values, values, chance)
        return replace(self._with_values(state, probable), gaps=(width, chance))


def _without(fields: ListOf[str], values: Values) -> Values:
    """Return values without these fields."""
    return {field: value for field, value in values.items() if field not in fields}
