"""Resampling, derivatives and delays on numbers worked by hand."""

import numpy as np
import pytest

from gaponet.data.signals import (
    Response,
    busiest_window,
    differentiate,
    estimate_delay,
    fast_speed,
    lowpass,
    resample_linear,
    resample_zoh,
)

TIME = np.array([0.0, 0.1, 0.4])
VALUES = np.array([[0.0], [1.0], [4.0]])
DT = 0.02


def smooth_noise(rows: int, seed: int = 0) -> np.ndarray:
    """Band-limited motion that repeats nowhere, (rows,)."""
    return lowpass(np.random.default_rng(seed).normal(size=(rows, 1)), DT, 2.0)[:, 0]


def test_a_state_between_two_samples_lies_on_the_line():
    assert resample_linear(TIME, VALUES, np.array([0.05, 0.1, 0.2, 0.4]))[
        :, 0
    ].tolist() == pytest.approx([0.5, 1, 2, 4])


def test_a_command_holds_until_the_next_arrives():
    assert resample_zoh(TIME, VALUES, np.linspace(0.0, 0.4, 9))[:, 0].tolist() == [
        0,
        0,
        1,
        1,
        1,
        1,
        1,
        1,
        4,
    ]
    assert resample_zoh(TIME, VALUES, np.array([0.08, 0.12]))[:, 0].tolist() == [0, 1]


@pytest.mark.parametrize("jitter", [0.0, 4e-4])
def test_commands_that_share_a_loops_stamps_with_faster_states_are_of_their_instant(jitter):
    states = (
        1_700_000_000.123
        + 0.01 * np.arange(3001)
        + jitter * np.random.default_rng(0).uniform(-1, 1, 3001)
    )
    sent = np.arange(1501.0)[:, None]
    grid = states[0] + 0.01 * np.arange(3001)
    held = resample_zoh(states[::2], sent, grid)[:, 0]
    late = held != np.arange(3001) // 2
    assert late.sum() == 0


def test_the_derivative_of_a_ramp_is_its_slope_up_to_the_ends():
    ramp = 3.0 * DT * np.arange(10)[:, None]
    assert np.allclose(differentiate(ramp, DT), 3.0)


def test_the_lowpass_filter_shifts_nothing():
    t = np.arange(500) * DT
    slow = np.sin(2 * np.pi * 0.5 * t)[:, None]
    assert np.abs(lowpass(slow, DT, 6.0) - slow)[50:-50].max() < 0.002


@pytest.mark.parametrize("steps", [0, 3, 7])
def test_a_state_that_follows_k_periods_later_has_a_delay_of_k_periods(steps):
    u = smooth_noise(1000)
    qpos = np.concatenate([np.full(steps, u[0]), u[: len(u) - steps]])
    sagging = qpos + 0.3 + 1e-4 * np.arange(1000)  # sag and drift do not matter
    delay = estimate_delay(np.stack([u] * 2, 1), np.stack([qpos, sagging], 1), DT)
    assert delay == pytest.approx([steps * DT] * 2, abs=0.003)


def test_half_a_period_of_delay_is_seen():
    u = smooth_noise(2000)
    qpos = (u[:-4] + u[1:-3]) / 2  # between the commands of four and of three rows ago
    assert estimate_delay(u[4:, None], qpos[:, None], DT)[0] == pytest.approx(3.5 * DT, abs=0.003)


def test_a_joint_that_is_not_commanded_or_does_not_follow_has_no_delay():
    u = smooth_noise(500)
    assert np.isnan(estimate_delay(np.stack([0.001 * u, u], 1), np.stack([u, 0 * u], 1), DT)).all()


def test_a_best_shift_at_the_limit_of_the_search_is_no_delay():
    u = smooth_noise(1000)
    qpos = np.concatenate([np.full(20, u[0]), u[:-20]])
    assert np.isnan(estimate_delay(u[:, None], qpos[:, None], DT, max_delay=0.4)[0])
    assert estimate_delay(u[:, None], qpos[:, None], DT, max_delay=0.6)[0] == pytest.approx(
        0.4, abs=0.003
    )


def test_fast_speed_is_what_a_joint_does_in_its_fastest_twentieth():
    ctrl = np.zeros((101, 1))
    ctrl[90:, 0] = 2.0 * DT * np.arange(11)
    assert fast_speed(ctrl, DT)[0] == pytest.approx(2.0)


def test_a_response_that_is_not_late_stays_as_it_is():
    found = Response.of(*np.random.default_rng(0).normal(size=(2, 400, 2)).cumsum(axis=1), 0.02)
    assert found.later(0.0) is found
    assert found.later(float("nan")) is found
    assert not np.array_equal(found.later(0.02).cross, found.cross)


def test_the_busiest_window_is_where_joints_move_most():
    qpos = np.zeros((100, 2))
    qpos[60:70, 1] = np.linspace(0, 1, 10)
    assert 50 <= busiest_window(qpos, 20) <= 60
    assert busiest_window(qpos, 100) == 0
