"""Numbers behind a drift check: evidence of recordings, and what to do about what changed."""

import numpy as np
import pytest
from logs import arm_sequence, wave

from gaponet.sysid.evidence.drift import EVERY_JOINT, ParameterChange, drift_advice
from gaponet.sysid.evidence.evidence import (
    Evidence,
    estimate_uncertainty,
    evidence,
    gradient_covariance,
    inverted,
    no_better_than,
    widened,
)
from gaponet.sysid.uncertainty import PLAY, JointUncertainty

JOINTS = ("pan", "lift", "elbow", "wrist")


def evidence_of(gradients, recording, names):
    """Evidence of one joint about one number, with an information of 1 in each cluster."""
    gradients = np.array(gradients, float)[None, :, None]
    information = np.ones((1, gradients.shape[1], 1, 1))
    rows = np.array([100.0])
    return Evidence(gradients, information, rows, np.array(recording), names, np.zeros((1, 1)))


def test_clusters_of_a_recording_are_summed():
    whole = evidence_of([1, 2, 4], [0, 1, 0], ("a", "b")).by_recording()
    assert whole.gradients.ravel().tolist() == [5, 2]
    assert whole.information.ravel().tolist() == [2, 1]


def test_a_recording_that_is_left_out_takes_its_clusters_and_its_share_of_the_rows():
    rest = evidence_of([1, 2, 4, 8], [0, 1, 0, 2], ("a", "b", "c")).without({"a"})
    assert rest.names == ("b", "c")
    assert rest.gradients.ravel().tolist() == [2, 8]
    assert rest.recording.tolist() == [0, 1]
    assert rest.rows.tolist() == [50]


def test_the_covariance_of_a_sum_follows_from_the_scatter_of_its_parts():
    """Independent parts of variance 4: their sum has 4 for each."""
    rng = np.random.default_rng(0)
    parts = 2 * rng.standard_normal((1, 2000, 1))
    assert gradient_covariance(parts).item() == pytest.approx(4 * 2000, rel=0.1)


def test_recordings_with_other_payloads_are_others(arm):
    made = [arm_sequence(arm, wave(60, 2), wave(60, 2), payload=mass) for mass in (0.0, 0.1, 0.2)]
    uncertainty = estimate_uncertainty(arm, made, [])
    (source,) = uncertainty.sources
    assert list(source["logs"]) == ["m", "m, 0.1 kg", "m, 0.2 kg"]


def test_recordings_of_other_units_are_others(arm):
    made = [arm_sequence(arm, wave(60, 2), wave(60, 2), unit=unit) for unit in ("one", "two")]
    (source,) = estimate_uncertainty(arm, made, []).sources
    assert list(source["logs"]) == ["m, one", "m, two"]
    assert evidence(arm, made, ("kp",), 10).names == ("m, one", "m, two")


def test_overdispersion_of_four_doubles_a_standard_error():
    widths = np.sqrt(np.diag(widened(np.diag([1.0, 9.0]), np.array([4.0, 4.0]))))
    assert widths.tolist() == [2, 6]


def test_information_is_inverted_whatever_its_units():
    information = np.array([[[4.0, 1.0], [1.0, 2.0]]])
    scale = np.diag([1e-4, 1e3])
    expected = np.linalg.inv(information[0])
    found = scale @ inverted(scale @ information @ scale)[0] @ scale
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def joint_uncertainty(residual, repeatability):
    empty = dict.fromkeys(("values", "gauss_newton_step", "overdispersion"), ())
    empty |= dict.fromkeys(("covariance", "gauss_newton_covariance"), ())
    return JointUncertainty(
        **empty,
        parameter_rms=0.0,
        residual_rms=residual,
        residual_p90=2 * residual,
        repeatability=repeatability,
    )


@pytest.mark.parametrize(("of_fit", "residual"), [(True, 0.004), (False, 0.001)])
def test_an_adaptation_keeps_the_larger_error_unless_new_motions_measured_it(of_fit, residual):
    today = joint_uncertainty(0.001, 0.0001)
    old = joint_uncertainty(0.004, 0.002)
    kept = no_better_than(today, old, errors_are_of_fit=of_fit)
    assert (kept.residual_rms, kept.residual_p90) == (residual, 2 * residual)
    assert kept.repeatability == 0.002


def changed(joint, field, by=1.0):
    return ParameterChange(joint, field, by, 0.1, 0.01)


@pytest.mark.parametrize(
    ("moved", "word"),
    [
        ([changed("pan", "offset")], "adapt"),
        ([changed("pan", PLAY)], "screws"),
        ([changed("pan", PLAY, by=-1.0)], "adapt"),
        ([changed(j, "frictionloss", by=-0.3) for j in JOINTS[:3]], "warmer"),
        ([changed(j, "damping") for j in JOINTS[:3]], "colder"),
        ([changed("pan", "damping"), changed("lift", "damping")], "adapt"),
        ([changed("pan", "kp"), changed("lift", "kp")], "same robot"),
        ([changed("pan", "kp")], "adapt"),
        ([changed(EVERY_JOINT, "delay")], "adapt"),
    ],
)
def test_the_advice_follows_from_what_changed(moved, word):
    assert word in drift_advice("drifted", moved, [], JOINTS, {})


def test_errors_that_no_parameter_explains_are_another_robots_or_payloads():
    assert "payload" in drift_advice("drifted", [], [], JOINTS, {"pan": 4.0})
