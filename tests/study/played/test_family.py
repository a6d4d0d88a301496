"""Models of a family beside rivals, from errors that are known."""

from dataclasses import fields

import numpy as np

from gaponet.study.ablation import Ablation
from gaponet.study.compare import Compare
from gaponet.study.data import Data
from gaponet.study.options import Options
from gaponet.study.payload import Payload
from gaponet.study.played.delivery import Delivery
from gaponet.study.played.family import told, words
from gaponet.study.played.simulators import CHANGES
from gaponet.study.played.tracking import Tracking
from gaponet.study.simulators import Simulators
from gaponet.study.unit import Unit
from gaponet.training.config import TrainConfig


def test_a_family_that_is_better_than_transfer_nowhere_is_said_to_be_so():
    uncorrected = [10.0, 20.0, 30.0]
    rivals = {at: {"uncorrected": uncorrected, "transferred": [2.0, 4.0, 6.0]} for at in (*CHANGES, "100 Hz")}
    shares = dict(zip(words("wide"), (0.6, 0.5, 0.55, 0.4, 0.3), strict=True))
    seeds = {w: [[s * x * f for x in uncorrected] for f in (0.9, 1.1)] for w, s in shares.items()}
    table, said = told(dict.fromkeys(rivals, seeds), rivals, "wide")
    mean, over = (next(r for r in table.rows if r[0].startswith(name)) for name in ("mean", "the same"))
    np.testing.assert_allclose([x.mean for x in mean[1:]], [0.2, *shares.values()])
    np.testing.assert_allclose([x.std / x.mean for x in over[2:]], [np.sqrt(2) / 10] * 5)
    assert "told its parameters: 0.30" in said[0]
    assert "transferred: 0.20" in said[0]
    assert "ahead in 0 of 12" in said[0]


def test_no_question_asks_for_what_all_trainings_are_told():
    shared = {f.name for kind in (Options, TrainConfig) for f in fields(kind)}
    for kind in (Compare, Ablation, Payload, Unit, Data, Simulators, Tracking, Delivery):
        assert not shared & {f.name for f in fields(kind)}, kind  # the command line would have both
