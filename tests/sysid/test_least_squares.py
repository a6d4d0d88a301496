"""Small problems at once, each from several starts."""

import numpy as np
import pytest

from gaponet.sysid.least_squares import Problems, agreed_slopes, better_half, descend, step

POINTS = np.linspace(-1, 1, 60)


def valley(x):
    """Errors of a·exp(−b·t) + c·t beside known curves: products of parameters bend the valley, (k,
    n, m).
    """
    made = lambda p: p[..., :1] * np.exp(-p[..., 1:2] * POINTS) + p[..., 2:] * POINTS  # noqa: E731
    return made(x) - made(ENDS)


ENDS = np.array([[0.3, 1.2, 0.5], [1.5, 0.2, 2.0]])


def test_problems_that_share_candidates_have_separate_minima():
    tried = []
    starts = np.random.default_rng(0).uniform(0, 2, (4, 2, 3))
    low = np.full((2, 3), -3.0)
    high = np.full((2, 3), 3.0)
    problems = Problems(lambda x: tried.append(x.shape) or valley(x), low, high)
    x, cost = descend(problems, starts, 40)
    best = better_half(x, cost)
    assert best.shape == (2, 2, 3)
    np.testing.assert_allclose(best[0], ENDS, atol=1e-3)
    assert {shape[1:] for shape in tried} == {(2, 3)}


def test_several_starts_find_the_deeper_minimum():
    waves = lambda x: np.concatenate([0.3 * x, 2 * np.sin(3 * x)], axis=-1)  # noqa: E731
    problems = Problems(waves, np.full((1, 1), -9.0), np.full((1, 1), 9.0))
    one, worse = descend(problems, np.full((1, 1, 1), 6.0), 30)
    many, cost = descend(problems, np.array([6.0, 4.0, 0.4, 0.1]).reshape(4, 1, 1), 30)
    assert cost.min() < 0.5 * worse.min()
    assert abs(better_half(many, cost)[0].item()) < 1e-2 < abs(one.item())


def test_a_bounded_step_solves_the_free_parameters_again():
    normal = np.array([[2.0, 1.0], [1.0, 2.0]])
    found = step(
        normal, np.array([-4.0, 0.0]), np.array([-9.0, -9.0]), np.array([1.0, 9.0]), np.array(0.0)
    )
    assert found == pytest.approx([1.0, -0.5], abs=1e-6)


def test_agreed_slopes_are_zero_where_the_two_sides_differ_in_sign():
    """A joint at the edge of breaking loose goes far to one side: it does not tell the
    parameter.
    """

    def errors(x):
        return np.concatenate([3 * x, 50 * np.maximum(x, 0), -np.abs(x)], axis=-1)

    at = np.zeros((1, 1, 1))
    low = np.full((1, 1), -9.0)
    high = np.full((1, 1), 9.0)
    _, slopes = agreed_slopes(at, low, high, errors)
    np.testing.assert_allclose(slopes[0, 0, :, 0], [3, 0, 0], atol=1e-6)
    for edge in ((np.zeros((1, 1)), high), (low, np.zeros((1, 1)))):  # at a bound there is one side
        _, slopes = agreed_slopes(at, *edge, errors)
        assert abs(slopes[0, 0, 2, 0]) == pytest.approx(1)
