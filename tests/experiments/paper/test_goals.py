"""Goals: reached by the inverse kinematics, held for as long as is asked, the same every time."""

import numpy as np
import pytest
from arm import TOML, write_arm

from gaponet.base.errors import UsageError
from gaponet.experiments.paper import goals
from gaponet.experiments.paper.goals import (
    GOALS_PER_TRAJECTORY,
    IK_TOLERANCE_M,
    MIN_FRONT_M,
    GoalPlanner,
)


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return write_arm(tmp_path_factory.mktemp("arm"))


def test_targets_bring_the_hand_to_its_goals_and_keep_it_there(robot):
    planner = GoalPlanner(robot, 0.4, 0, hold=1.0)
    for plan in planner.plans(3):
        places = planner.hand_positions(plan.ctrl)
        for k in range(GOALS_PER_TRAJECTORY):
            held = places[plan.arrive[k] : plan.leave[k]]
            assert len(held) == 50  # 1 s
            assert np.abs(held - plan.goals[k]).max() < IK_TOLERANCE_M
            moved = np.abs(np.diff(places[plan.start[k] : plan.arrive[k]], axis=0)).max()
            assert 1e-3 < moved < 0.05
        assert plan.leave[-1] == len(plan.ctrl)


def test_a_trajectory_takes_as_long_at_another_control_rate(robot):
    (slow,) = GoalPlanner(robot, 0.4, 0).plans(1)
    (fast,) = GoalPlanner(robot, 0.4, 0, dt=0.01).plans(1)
    np.testing.assert_array_equal(fast.goals, slow.goals)
    assert len(fast.ctrl) * 0.01 == pytest.approx(len(slow.ctrl) * 0.02, abs=0.02 * len(slow.goals))


def test_goals_lie_in_front_and_apart(robot):
    planner = GoalPlanner(robot, 0.4, 0)
    places = np.array([plan.goals for plan in planner.plans(6)]).reshape(-1, 3)
    assert places[:, 0].min() >= MIN_FRONT_M
    assert np.ptp(places[:, 2]) > 0.1


def test_the_same_seed_gives_the_same_goals(robot):
    (first,) = GoalPlanner(robot, 0.4, 1).plans(1)
    (again,) = GoalPlanner(robot, 0.4, 1).plans(1)
    (other,) = GoalPlanner(robot, 0.4, 2).plans(1)
    np.testing.assert_array_equal(first.goals, again.goals)
    assert not np.array_equal(first.goals, other.goals)


def test_a_robot_without_hands_and_a_place_out_of_reach_are_refused(robot, tmp_path, monkeypatch):
    with pytest.raises(UsageError, match="hand"):
        GoalPlanner(write_arm(tmp_path, TOML.split("[[payload_mount]]")[0]), 0.0, 0)
    monkeypatch.setattr(goals, "MIN_FRONT_M", 0.5)
    with pytest.raises(UsageError, match="reaches"):
        GoalPlanner(robot, 0.4, 0)
