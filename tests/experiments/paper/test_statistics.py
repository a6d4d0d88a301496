"""Reductions of an error, worked by hand."""

import numpy as np
import pytest

from gaponet.experiments.paper.statistics import Reduction, reduction

MOTIONS = ["a", "a", "b"]


def test_a_reduction_is_of_the_sums_and_averaged_over_seeds():
    baseline = np.array([1.0, 1.0, 2.0])
    found = reduction([baseline / 2, baseline / 4], [baseline], MOTIONS)
    assert found.mean == pytest.approx(62.5)  # 50 and 75 %
    assert found.seed_error == pytest.approx(12.5)  # 17.7 / √2
    assert (found.seeds, found.motions) == (2, 2)


def test_a_trained_baseline_is_compared_seed_by_seed():
    whole = np.array([1.0, 1.0, 2.0])
    found = reduction([whole / 2, whole], [whole, 2 * whole], MOTIONS)
    assert found.mean == pytest.approx(50.0)
    assert found.seed_error == pytest.approx(0.0)


def test_the_error_over_motions_leaves_out_one_motion_at_a_time():
    baseline = np.array([1.0, 1.0, 2.0])
    error = np.array([0.5, 0.5, 0.5])
    found = reduction([error], [baseline], MOTIONS)
    # Without b: 50 %. Without a: 75 %. Jackknife of two: √(1/2 · Σ (x − 62.5)²) = 12.5
    assert found.motion_error == pytest.approx(12.5)
    assert found.seed_error == 0.0


@pytest.mark.parametrize(
    ("mean", "verdict"), [(45.0, "reached"), (41.0, "not decided"), (35.0, "not reached")]
)
def test_a_claim_of_40_percent_is_judged_by_two_standard_errors(mean, verdict):
    assert Reduction(mean, 0.0, 2.0, 3, 10).verdict(40) == verdict


def test_one_motion_decides_nothing():
    baseline = np.array([1.0, 1.2])
    found = reduction([baseline / 4], [baseline], ["a", "a"])
    assert found.verdict(40) == "not decided"
    assert str(found) == "75"


def test_no_correction_is_no_reduction():
    baseline = np.array([1.0, 3.0, 2.0])
    assert reduction([baseline], [baseline], MOTIONS).mean == 0.0


def test_where_there_is_no_error_nothing_is_reduced():
    nothing = np.zeros(3)
    assert reduction([nothing], [nothing], MOTIONS).mean == 0.0
