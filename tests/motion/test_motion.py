import numpy as np
import pytest

from gaponet.base.errors import UsageError
from gaponet.motion.feasible import MAX_SPEED_RAD_S, TORQUE_SHARE, Feasibility
from gaponet.motion.motion import GRID, PEAK_SPEED, Motion, blend, move_time, through


def test_a_move_starts_and_ends_at_rest_and_passes_the_middle_in_the_middle():
    time = np.linspace(0, 1, 1001)
    way = blend(time)
    speed = np.gradient(way, time)
    assert way[[0, 500, -1]].tolist() == [0, 0.5, 1]
    assert np.abs(speed[[0, -1]]).max() < 1e-4
    assert abs(speed.max() - PEAK_SPEED) < 1e-4


def test_via_points_are_reached_and_held():
    path = through(
        np.array([[0.0, 1.0], [2.0, -1.0], [0.5, 0.5]]),
        np.array([1.0, 0.5]),
        np.array([0.2, 0.3, 0.1]),
        0.1,
    )
    assert path.shape == (2 + 10 + 3 + 5 + 1, 2)
    assert (path[:2] == [0.0, 1.0]).all()
    assert np.allclose(path[11:15], [2.0, -1.0])
    assert np.allclose(path[-1], [0.5, 0.5])


def test_move_time_keeps_peak_speed():
    # 1 rad at 1.5 rad/s peak: 1.875 · 1 / 1.5 = 1.25 s
    assert move_time(np.array([1.0, 0.01]), 1.5).tolist() == [1.25, 0.5]


def still(robot, shoulder, elbow=0.0, rows=50):
    return np.repeat(np.array([[shoulder, elbow]]), rows, axis=0)


def test_torque_demand_of_a_level_arm_is_its_weight(arm):
    # upper 0.3 kg at 0.1 m, fore 0.2 kg at 0.3 m, payload 0.5 kg at 0.4 m, the fore arm's frame
    # turned level
    need = Feasibility(arm, 0.5).demand(still(arm, 0.0), GRID)
    weight = 9.81 * (0.3 * 0.1 + 0.2 * 0.3 + 0.5 * 0.4)
    assert need.gravity == pytest.approx(weight / (TORQUE_SHARE * 5.0), rel=1e-6)
    assert need.worst_joint == "shoulder"
    assert need.met


def test_speed_and_range_are_limits(arm):
    limits = Feasibility(arm, 0.0)
    fast = still(arm, 0.0)
    fast[:, 1] = np.linspace(0, 2 * MAX_SPEED_RAD_S * GRID * 49, 50)
    assert limits.demand(fast, GRID).speed == pytest.approx(2.0)
    assert not limits.demand(still(arm, 1.5), GRID).met  # on the stop


def test_a_motion_that_is_too_fast_is_slowed_and_keeps_its_path(arm):
    limits = Feasibility(arm, 0.2)
    time = np.arange(300) * GRID
    ctrl = np.stack([0.8 * np.sin(2 * np.pi * 1.5 * time) ** 3, np.zeros(300)], axis=1)
    assert not limits.demand(ctrl, GRID).met
    fitted = limits.fit(Motion("quick", "joint", GRID, ctrl))
    assert limits.demand(fitted.ctrl, GRID).met
    assert len(fitted.ctrl) > 300
    assert np.ptp(fitted.ctrl[:, 0]) == pytest.approx(np.ptp(ctrl[:, 0]), rel=0.01)


def test_a_motion_that_is_too_heavy_is_brought_nearer_to_its_start(arm):
    limits = Feasibility(arm, 1.2)  # level: 9.81 · (0.09 + 0.48) = 5.6 N·m > 5
    ctrl = np.stack([np.linspace(1.4, 0.0, 400), np.zeros(400)], axis=1)
    fitted = limits.fit(Motion("raise", "joint", GRID, ctrl))
    assert limits.demand(fitted.ctrl, GRID).met
    assert fitted.ctrl[0, 0] == pytest.approx(1.4)
    assert fitted.ctrl[-1, 0] > 0.3


def test_a_motion_that_cannot_be_fitted_is_refused_with_the_reason(arm):
    limits = Feasibility(arm, 5.0)
    with pytest.raises(UsageError, match=r"shoulder.* 5 kg"):
        limits.fit(Motion("hold", "joint", GRID, still(arm, 0.0)))


def test_the_refusal_of_a_robot_without_shapes_names_no_distance(arm):
    limits = Feasibility(arm, 5.0)
    with pytest.raises(UsageError, match=r"of 4 rad/s\. Start it"):
        limits.fit(Motion("hold", "joint", GRID, still(arm, 0.0)))
