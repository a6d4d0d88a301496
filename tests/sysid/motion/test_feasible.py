import numpy as np
import pytest

from gaponet.base.errors import UsageError
from gaponet.sysid.motion.feasible import MAX_SPEED, TORQUE_SHARE, Feasibility, stretch
from gaponet.sysid.motion.motion import GRID, Motion


def still(robot, shoulder, elbow=0.0, rows=50):
    return np.repeat(np.array([[shoulder, elbow]]), rows, axis=0)


def test_holding_an_arm_level_asks_for_its_weight(arm):
    # upper 0.3 kg at 0.1 m, fore 0.2 kg at 0.3 m, payload 0.5 kg at 0.4 m, the fore arm's frame turned level
    need = Feasibility(arm, 0.5).demand(still(arm, 0.0), GRID)
    weight = 9.81 * (0.3 * 0.1 + 0.2 * 0.3 + 0.5 * 0.4)
    assert need.gravity == pytest.approx(weight / (TORQUE_SHARE * 5.0), rel=1e-6)
    assert need.worst_joint == "shoulder"
    assert need.met


def test_speed_and_range_are_limits(arm):
    limits = Feasibility(arm, 0.0)
    fast = still(arm, 0.0)
    fast[:, 1] = np.linspace(0, 2 * MAX_SPEED * GRID * 49, 50)
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


def test_what_cannot_be_fitted_says_why(arm):
    limits = Feasibility(arm, 5.0)
    with pytest.raises(UsageError, match=r"'hold' does not fit arm .* shoulder needs .* at 5 kg, .* lighter payload"):
        limits.fit(Motion("hold", "joint", GRID, still(arm, 0.0)))


def test_demand_at_payloads_between_is_between(arm):
    ctrl = np.stack([0.5 * np.sin(np.linspace(0, 6, 300)), 0.3 * np.cos(np.linspace(0, 4, 300))], axis=1)
    torque = [Feasibility(arm, p).demand(ctrl, GRID).torque for p in (0.0, 0.2, 0.4)]
    assert torque[0] < torque[1] < torque[2]


def test_stretch_keeps_ends():
    ctrl = np.linspace([0.0, 1.0], [1.0, 3.0], 101)
    slow = stretch(ctrl, 2.0)
    assert len(slow) == 201
    assert np.allclose(slow[[0, 100, -1]], [[0, 1], [0.5, 2], [1, 3]])
