"""Tracking on a virtual arm whose servos are weak: what knows that is nearer, in both directions."""

import numpy as np
import pytest
from arm import commands, write_arm
from weak_arm import session, trained, weak_unit

from gaponet.experiments.virtual.tracking import (
    Score,
    by_payload,
    conclusion,
    joint_sets,
    result,
    track,
)
from gaponet.experiments.virtual.unseen_motions import UnseenMotion


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return write_arm(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def tracked(robot):
    motions = [UnseenMotion(f"m{i}", commands(60 + 20 * i, i)) for i in range(2)]
    return track(robot, weak_unit(), "weak", motions, (0.0, 0.4), trained(robot))


def mean(scores, part, method, payload):
    return np.mean(
        [s.q_dis for s in scores if (s.part, s.method, s.payload) == (part, method, payload)]
    )


def test_a_model_of_the_robot_reduces_both_alignment_and_compensation_errors(tracked):
    for payload in (0.0, 0.4):
        q = {m: mean(tracked, "alignment", m, payload) for m in ("nominal", "mlp", "gaponet")}
        assert q["gaponet"] < q["mlp"] < q["nominal"]
        q = {
            m: mean(tracked, "compensation", m, payload)
            for m in ("raw", "feedforward", "mlp", "gaponet")
        }
        assert q["gaponet"] < 0.25 * q["raw"]
        assert max(q["mlp"], q["feedforward"]) < 0.5 * q["raw"]
    assert mean(tracked, "compensation", "gaponet", 0.0) < mean(tracked, "compensation", "mlp", 0.0)


def test_seeds_are_separate(tracked):
    assert {s.seed for s in tracked if s.method == "gaponet"} == {0, 1}
    assert {s.seed for s in tracked if s.method in ("raw", "nominal")} == {None}


def score(method, seed, payload, value, part="alignment"):
    return Score(method, seed, payload, part, "m", np.full(2, value))


def test_the_table_holds_means_deviations_and_reductions_worked_by_hand(robot):
    scores = [score("nominal", None, 0.0, 0.1), score("nominal", None, 0.4, 0.3)]
    scores += [score("mlp", 0, p, v) for p, v in ((0.0, 0.1), (0.4, 0.15))]
    scores += [
        score("gaponet", seed, p, v)
        for seed in (0, 1)
        for p, v in ((0.0, 0.03 + 0.02 * seed), (0.4, 0.06))
    ]
    rows = by_payload(scores, "alignment", joint_sets(robot)).texts()
    assert rows[0] == ["2 joints, 0 kg", "0.1000", "0.1000", "0.0400 ± 0.0141", "0 %", "60 %"]
    assert rows[1][4:] == ["50 %", "80 %"]
    assert rows[2][:2] == ["2 joints, all payloads", "0.2000"]
    said = conclusion(scores, "alignment", joint_sets(robot)[0])
    assert "GAPONet 75 % less (80 % less at 0.4 kg)" in said


def test_a_larger_error_is_reported(robot):
    scores = [score("nominal", None, 0.0, 0.1), score("gaponet", 0, 0.0, 0.2)]
    assert "GAPONet 100 % MORE" in conclusion(scores, "alignment", joint_sets(robot)[0])


def test_figures_show_every_method(robot, tracked):
    made = result(session(robot), tracked, {})
    assert list(made.figures) == ["joints"]
    labels = {t.get_text() for t in made.figures["joints"].legends[0].get_texts()}
    assert labels == {
        "nominal simulator",
        "raw targets",
        "nominal model's feed-forward alone",
        "MLP, full coupling",
        "GAPONet",
    }
    assert [t.name for t in made.tables] == [
        "alignment", "compensation", "alignment-joints", "compensation-joints",
    ]  # fmt: skip
