"""Separable CMA-ES of problems tried out together."""

import numpy as np

from gaponet.sim.evolve import CANDIDATES, evolve


def test_problems_that_share_candidates_find_minima_of_their_own():
    ends = np.array([[0.3, -0.2, 0.5, 1.0, 2.0], [0.0, 1.0, 2.0, -1.0, 0.5]])
    slopes, tried = np.array([1.0, 10.0, 100.0, 3.0, 0.3]), []

    def cost(x):
        tried.append(x.shape)
        return (slopes * np.square(x - ends)).sum(axis=-1)

    found = evolve(np.zeros((2, 5)), np.full(5, -5.0), np.full(5, 5.0), cost, 150)
    np.testing.assert_allclose(found, ends, atol=0.02)
    assert set(tried) == {(CANDIDATES, 2, 5)}


def test_a_minimum_beyond_a_bound_ends_at_the_bound():
    found = evolve(np.zeros((1, 2)), np.array([-1.0, -1.0]), np.array([1.0, 0.5]), lambda x: ((x - 2) ** 2).sum(-1), 80)
    np.testing.assert_allclose(found, [[1.0, 0.5]], atol=1e-3)
