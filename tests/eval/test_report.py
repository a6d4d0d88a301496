"""What the report says about a card."""

import pytest

from gaponet.eval.report import _r2


@pytest.mark.parametrize(
    ("found", "text"),
    [(None, "–"), (0.925, "0.925 on held-out states"),
     ({"mean": 0.9, "by_joint": {"elbow": 0.8, "wrist": 1.0}}, "0.900 on held-out states (elbow 0.80, wrist 1.00)")],
    ids=["no predictor", "a card of before", "by joint"],
)  # fmt: skip
def test_the_sensor_predictor_is_said_by_joint_where_the_card_knows(found, text):
    assert _r2(found) == text
