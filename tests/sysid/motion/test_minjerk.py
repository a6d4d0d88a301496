import numpy as np

from gaponet.sysid.motion.motion import PEAK_SPEED, blend, fade, move_time, through


def test_a_move_starts_and_ends_at_rest_and_passes_the_middle_in_the_middle():
    s = np.linspace(0, 1, 1001)
    y = blend(s)
    speed = np.gradient(y, s)
    assert y[0] == 0
    assert y[-1] == 1
    assert y[500] == 0.5
    assert abs(speed[0]) < 1e-4
    assert abs(speed[-1]) < 1e-4
    assert abs(speed.max() - PEAK_SPEED) < 1e-4


def test_via_points_are_reached_and_held():
    path = through(
        np.array([[0.0, 1.0], [2.0, -1.0], [0.5, 0.5]]), np.array([1.0, 0.5]), np.array([0.2, 0.3, 0.1]), 0.1
    )
    assert path.shape == (2 + 10 + 3 + 5 + 1, 2)
    assert (path[:2] == [0.0, 1.0]).all()
    assert np.allclose(path[11:15], [2.0, -1.0])
    assert np.allclose(path[-1], [0.5, 0.5])


def test_move_time_keeps_peak_speed():
    # 1 rad at 1.5 rad/s peak: 1.875 · 1 / 1.5 = 1.25 s
    assert move_time(np.array([1.0, 0.01]), 1.5).tolist() == [1.25, 0.5]


def test_a_faded_wave_starts_and_ends_at_zero():
    window = fade(500, 0.01, 1.0)
    assert window[0] == 0
    assert window[-1] == 0
    assert window[250] == 1
