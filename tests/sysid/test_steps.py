"""The loop of steps: what is proposed, what the judge does with it, and what no time is left
for.
"""

from types import SimpleNamespace

import numpy as np

from gaponet.base.progress import no_progress
from gaponet.sim.metrics import Comparison
from gaponet.sysid.identify import _makers_of_steps, with_steps
from gaponet.sysid.options import IdentifyOptions
from gaponet.sysid.search_progress import SearchProgress
from gaponet.sysid.steps.servo_term import ServoTerm
from gaponet.sysid.steps.step import Fits, FitState


class ErrorIsFriction:
    """A judge whose three motions have the friction as error, of 1 N·m at first."""

    def errors(self, values):
        return np.full(3, values[-1]["frictionloss"][0])

    def compare(self, name, before, after):
        return Comparison(name, self.errors(before.values), self.errors(after.values))


class Less:
    """A step that changes the friction by a factor."""

    def __init__(self, name, factor, *, applies=True, gaps=None):
        self.name = name
        self._factor = factor
        self._applies = applies
        self._gaps = gaps

    def applies(self, state):
        return self._applies

    def propose(self, state):
        values = [{"frictionloss": self._factor * v["frictionloss"]} for v in state.base]
        return FitState(state.chosen, values, values, [], together=False, gaps=self._gaps)


def start(chosen="joints"):
    values = [{"frictionloss": np.ones(1)}]
    return FitState(chosen, values, values, [], together=False)


def fits(seconds=None, count=3):
    progress = SearchProgress(seconds, count, 1, no_progress)
    return Fits([], None, [], ErrorIsFriction(), progress, 1)


def test_terms_come_in_their_order_and_then_the_masses():
    options = IdentifyOptions(terms=("load", "backlash"), masses=True)
    steps = [make(fits()) for make in _makers_of_steps(options)]
    assert [step.name for step in steps] == ["load", "backlash", "masses"]


def test_each_step_goes_on_from_the_steps_that_were_accepted():
    steps = [Less("half", 0.5), Less("worse", 2.0), Less("half again", 0.5)]
    state, comparisons, untried = with_steps(steps, fits(), start())
    assert state.values[-1]["frictionloss"] == 0.25
    assert [c.accepted for c in comparisons] == [True, False, True]
    assert untried == []


def test_a_step_that_does_not_apply_is_not_compared():
    state, comparisons, _ = with_steps([Less("no", 0.5, applies=False)], fits(), start())
    assert state.values[-1]["frictionloss"] == 1.0
    assert comparisons == ()


def test_what_a_rejected_step_saw_of_backlash_stays_known():
    seen = (np.array([0.004]), np.array([0.6]))
    state, _, _ = with_steps([Less("backlash", 2.0, gaps=seen)], fits(), start())
    assert state.gaps is seen
    assert state.values[-1]["frictionloss"] == 1.0


def test_steps_for_which_no_time_is_left_are_named():
    steps = [Less("stribeck", 0.5), Less("load", 0.5)]
    state, comparisons, untried = with_steps(steps, fits(seconds=0.0), start())
    assert untried == ["stribeck", "load"]
    assert comparisons == ()
    assert state.values[-1]["frictionloss"] == 1.0


def test_the_given_robot_with_an_accepted_step_is_no_longer_the_given_one():
    accepted, _, _ = with_steps([Less("half", 0.5)], fits(), start("given"))
    rejected, _, _ = with_steps([Less("worse", 2.0)], fits(), start("given"))
    assert (accepted.chosen, rejected.chosen) == ("whole", "given")


def term_fit(found):
    """A fit of one joint alone that finds these values, whatever it starts from."""
    bounds = SimpleNamespace(guess={"stribeck": 0.1, "stribeck_speed": 0.05}, visible=dict_value)
    return SimpleNamespace(
        bounds=bounds,
        robot=SimpleNamespace(operated=("elbow",)),
        rollouts=SimpleNamespace(rows=np.ones(1)),
        search=lambda start, report: start | found,
    )


def dict_value(field, values):
    return values[field]


def test_a_term_that_is_zero_in_every_joint_leaves_no_field():
    for friction, left in ((0.0, set()), (0.2, {"stribeck", "stribeck_speed"})):
        found = {"stribeck": np.full(1, friction), "stribeck_speed": np.ones(1)}
        problem = Fits([], None, [term_fit(found)], ErrorIsFriction(), fits().progress, 1)
        proposed = ServoTerm("stribeck", problem).propose(start())
        assert proposed.values[-1].keys() - {"frictionloss"} == left
        assert proposed.base == proposed.values
