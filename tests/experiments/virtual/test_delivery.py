"""Delivery with a virtual arm whose servos are weak."""

import numpy as np
import pytest
from arm import write_arm
from weak_arm import session, trained, weak_unit

from gaponet.base.errors import UsageError
from gaponet.experiments.virtual.delivery import (
    Delivery,
    HoldError,
    deliver,
    offset_table,
    result,
    sentences,
)
from gaponet.experiments.virtual.goals import GoalPlanner
from gaponet.experiments.virtual.session import Session


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return write_arm(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def delivered(robot):
    planner = GoalPlanner(robot, 0.4, 0, hold=1.5)
    return deliver(robot, weak_unit(), planner, planner.plans(1), (0.0, 0.4), trained(robot))


def test_a_loaded_hand_comes_nearer_to_its_goal(delivered):
    off = {
        m: np.mean([d.offset[2] for d in delivered if d.method == m and d.payload == 0.4])
        for m in ("raw", "mlp", "gaponet")
    }
    assert off["gaponet"] < 0.2 * off["raw"]
    assert off["mlp"] < off["raw"]


def test_a_fleet_driven_with_other_gains_than_the_dataset_is_refused(robot):
    session = Session(Delivery(fleet="firm"), None, robot, [])
    with pytest.raises(
        UsageError,
        match=r"fleet 'firm' is driven with gain_scale 9, the robot of the dataset with 1:",
    ):
        session.unit  # noqa: B018


def test_a_hand_within_1_cm_has_settled(delivered):
    assert any(d.near for d in delivered)
    assert all(
        np.isfinite(d.settle) and d.settle <= 0.5 + 1e-9 for d in delivered if d.near
    )  # a hold of 1.5 s, its last 1 s


def score(method, seed, payload, x, z, near=False):
    return HoldError(method, seed, payload, np.array([x, 0.01, z]), near, 0.5 if near else np.nan)


def test_the_table_holds_centimetres_and_shares_worked_by_hand():
    found = [score("raw", None, 0.4, 0.04, 0.1), score("gaponet", 0, 0.4, 0.02, 0.01, True)]
    found += [score("gaponet", 1, 0.4, 0.01, 0.02), score("gaponet", 1, 0.4, 0.01, 0.02, True)]
    rows = offset_table(found).texts()
    assert rows[0][:6] == ["0.4 kg, raw targets", "4.00", "1.00", "10.00", "0.00", ""]
    assert rows[1][:6] == [
        "0.4 kg, GAPONet",
        "1.50 ± 0.71",
        "1.00 ± 0.00",
        "1.50 ± 0.71",
        "75.00 ± 35.36",
        "0.50 ± 0.00",
    ]


def test_sentences_name_improvements_and_deteriorations():
    found = [score("raw", None, p, 0.04, 0.1) for p in (0.0, 0.4)]
    found += [score("gaponet", 0, 0.0, 0.05, 0.01), score("gaponet", 0, 0.4, 0.02, 0.01)]
    said = sentences(found)
    assert "X 50 % less (4.0 → 2.0 cm), Y 0 % less" in said[0]
    assert "Z 90 % less" in said[0]
    assert said[1] == "At 0 kg, GAPONet is WORSE than raw targets along X."


def test_figures_are_drawn(robot, delivered):
    made = result(session(robot), delivered, {})
    assert list(made.figures) == ["offsets"]
    assert [ax.get_title(loc="left") for ax in made.figures["offsets"].axes] == [
        "X, forward",
        "Y, left",
        "Z, up",
    ]
