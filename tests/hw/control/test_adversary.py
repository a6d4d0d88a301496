"""A slice of make adversary: no command outside the limits, judged against the true state; and the
judge can say no.
"""

import pytest
from hw.control import adversary

from gaponet.hw.control import output
from gaponet.robot.spec import load_robot


@pytest.fixture(scope="module")
def robot():
    return load_robot("h1_2")


def test_no_command_leaves_the_limits_of_the_true_state_whatever_happens(robot):
    count = adversary.attack(robot, 1500, seed=7)
    assert not count.wrong, count.example
    assert count.commands > 700
    assert count.stops
    assert 0.9 < count.share <= 0.95 + 1e-9


def test_a_controller_that_takes_old_states_for_new_would_be_found_out(robot, monkeypatch):
    real = output.limit_command
    monkeypatch.setattr(output, "limit_command", lambda *a: real(*a[:6]))
    assert adversary.attack(robot, 1500, seed=7).wrong["torque"]
