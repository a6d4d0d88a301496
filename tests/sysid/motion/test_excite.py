import numpy as np
import pytest

from gaponet.sysid.motion.library import SIGNALS

DT = 0.01


@pytest.mark.parametrize("name", SIGNALS)
@pytest.mark.parametrize("span", [(-1.0, 2.0), (-0.2, 0.25)])
def test_every_signal_stays_inside_and_starts_and_ends_at_rest(name, span):
    y = SIGNALS[name](*span, np.random.default_rng(1), DT)
    assert y.min() >= span[0] - 1e-9
    assert y.max() <= span[1] + 1e-9
    assert np.ptp(y) > 0.05
    assert np.abs(np.diff(y)[[0, -1]]).max() < 1e-9


@pytest.mark.parametrize("name", SIGNALS)
def test_a_seed_is_a_signal(name):
    first, again, other = (SIGNALS[name](-1.0, 1.0, np.random.default_rng(s), DT) for s in (1, 1, 2))
    assert np.array_equal(first, again)
    assert name == "sweep" or first.shape != other.shape or not np.array_equal(first, other)


def test_a_sweep_covers_the_interval():
    y = SIGNALS["sweep"](-1.0, 2.0, np.random.default_rng(0), DT)
    assert y.min() == -1.0
    assert y.max() == 2.0


def test_a_creep_is_slow():
    y = SIGNALS["creep"](-1.0, 2.0, np.random.default_rng(0), DT)
    assert np.abs(np.diff(y) / DT).max() < 0.101


def test_a_chirp_gets_faster():
    y = SIGNALS["chirp"](-1.0, 1.0, np.random.default_rng(0), DT)
    moving = y[50:-50] - y[0]
    crossings = np.flatnonzero(np.diff(np.sign(moving)))
    gaps = np.diff(crossings) * DT
    assert gaps[0] > 3 * gaps[-1]


def test_trapezoids_cruise_at_constant_speeds():
    y = SIGNALS["trapezoids"](-2.0, 2.0, np.random.default_rng(3), DT)
    speed = np.abs(np.diff(y)) / DT
    cruising = sorted({round(float(v), 1) for v in speed if (np.abs(speed - v) < 0.01).sum() > 30 and v > 0.1})
    assert cruising == [0.4, 0.7, 1.0, 1.4]
