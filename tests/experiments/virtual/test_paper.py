"""The paper's tables beside ours: what each row means, and what the printed numbers give."""

from dataclasses import replace

import numpy as np
import pytest

from gaponet.experiments.variant import parse_variant
from gaponet.experiments.virtual.delivery import HoldError
from gaponet.experiments.virtual.paper import TABLE_2, Paper, claim_table, table_2_rows
from gaponet.experiments.virtual.tracking import Score
from gaponet.nn.training.config import TrainConfig

PAPER = replace(
    TrainConfig(), model=replace(TrainConfig().model, kind="paper", payload_input=False)
)


def test_each_row_of_table_2_observes_as_many_values_as_the_paper_prints_for_ten_joints():
    printed = [(change, row.obs_dim) for rows in TABLE_2.values() for _, change, row in rows if row]
    ours = [
        parse_variant(f"paper:{c}" if c else "paper", PAPER).config.model.observation_dim(10)
        for c, _ in printed
    ]
    assert ours == [dim for _, dim in printed]


def placed(method, offset, payload=3.0):
    return HoldError(method, None if method == "raw" else 0, payload, np.array(offset), True, 1.0)


def test_claims_are_reductions_at_all_payloads_and_at_the_heaviest():
    def score(part, method, payload, value):
        seed = None if method == "nominal" else 0
        return Score(method, seed, payload, part, "m", np.full(2, value))

    scores = [score(*s) for s in (("alignment", "nominal", 0.0, 0.2), ("alignment", "nominal", 3.0, 0.4),
                                  ("alignment", "gaponet", 0.0, 0.2), ("alignment", "gaponet", 3.0, 0.1))]  # fmt: skip
    table = claim_table(
        scores,
        [placed("mlp", (0.01, 0.01, 0.01)), placed("gaponet", (0.02, 0.01, 0.001))],
        ("2 joints", [0, 1]),
    )
    assert [row[1] for row in table.rows] == [40, 50, 40, 40, 70]
    assert [row[2].mean for row in table.rows] == pytest.approx([50, 75, -100, 0, 90])


def test_our_network_has_the_rows_of_table_2_that_it_supports(make_study):
    study = make_study(payloads=(0.0, 0.1), units=("a",))
    words = [row.word for row in table_2_rows(study)]
    assert words == [
        "gaponet",
        "gaponet:payload_input=off",
        "gaponet:history=2",
        "gaponet",
        "gaponet:history=6",
        "gaponet:history=8",
    ]
    own = Paper().paper_study(study)
    assert (own.config.ppo.std, own.config.pretraining.rounds) == (0.02, 0)
    assert {row.word for row in table_2_rows(own)} >= {
        "paper",
        "paper:payload_input=on",
        "paper:sensor_hold=5",
    }
