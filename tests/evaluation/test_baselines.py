"""The command itself and the nominal simulation, later and shifted: what any simulator must do
better than.
"""

import numpy as np
import pytest

from gaponet.data.sequence import SequenceMeta
from gaponet.evaluation.baselines import baseline_errors, delayed, fit_delay_offset
from gaponet.evaluation.verdict import verdict
from gaponet.sim.metrics import Run

DT = 0.01


def swing(motion, delay=0.0, offset=0.0, recorded=(0, 1)):
    """A run in which two joints follow their commands later and elsewhere, but for their own
    frequency alike.
    """
    t = np.arange(400)[:, None] * DT
    rate = 0.7 + 0.1 * motion
    command = np.sin(2 * np.pi * rate * t + [0.0, 1.0])
    real = np.sin(2 * np.pi * rate * (t - delay) + [0.0, 1.0]) + offset
    return Run(SequenceMeta("arm", "a", f"m{motion}", 0.0), DT, real, command, recorded)


def test_a_delay_and_an_offset_are_found():
    delay, offset = fit_delay_offset([swing(0, 0.05, 0.02), swing(1, 0.05, 0.02)])
    np.testing.assert_allclose(delay, 0.05, atol=DT)
    np.testing.assert_allclose(offset, 0.02, atol=2e-3)


def test_a_delayed_path_holds_its_first_row():
    path = np.arange(5.0)[:, None]
    assert delayed(path, np.array([0.02]), DT)[:, 0].tolist() == [0.0, 0.0, 0.0, 1.0, 2.0]


def test_a_motion_is_measured_with_what_was_fitted_to_others():
    one_offset = [swing(0, offset=0.02), swing(1, offset=0.02)]
    two_offsets = [swing(0, offset=0.02), swing(1, offset=-0.02)]
    assert baseline_errors(one_offset, one_offset)["command"] == pytest.approx(0.0, abs=1e-6)
    assert baseline_errors(two_offsets, two_offsets)["command"] == pytest.approx(0.04, rel=0.05)


def test_a_joint_that_no_motion_holds_does_not_count():
    runs = [swing(0, 0.05, recorded=(0,)), swing(1, 0.05, recorded=(0,))]
    assert baseline_errors(runs, runs)["delay_offset"] < 0.01


@pytest.mark.parametrize(("command", "adds_nothing"), [(0.4e-3, True), (2e-3, False)])
def test_the_verdict_says_where_a_simulator_adds_nothing(command, adds_nothing):
    joint = {"shoulder": {"mpjae": 10e-3}}
    motions = {"m": {"mpjae": 10e-3}, "n": {"mpjae": 12e-3}}
    nominal = {"mpjae": 10e-3, "by_joint": joint, "by_independent_motion": motions}
    methods = {"nominal": nominal, "identified": nominal | {"mpjae": 0.7e-3}}
    said = verdict(methods, {"command": command, "delay_offset": 5e-3})
    assert ("adds nothing" in said[-1]) == adds_nothing
