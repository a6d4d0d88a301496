"""Motions that were never trained on, and the check that it is so."""

import json

import pytest
from arm import commands, record
from weak_arm import trained

from gaponet.base.errors import UsageError
from gaponet.data.store import Dataset
from gaponet.experiments.virtual.unseen_motions import UnseenMotion, generated, require_unseen


@pytest.fixture
def used(arm, tmp_path):
    """A dataset of three motions, and runs that trained on the first two."""
    data = Dataset.create(tmp_path / "data", arm)
    entries = [data.append(record(arm, commands(100, i), f"m{i}")) for i in range(3)]
    split = {
        "train": {"m0": entries[0].hash},
        "val": {"m1": entries[1].hash},
        "test": {"m2": entries[2].hash},
    }
    run = tmp_path / "run"
    run.mkdir()
    (run / "split.json").write_text(json.dumps(split))
    return data, [type(t)(t.method, t.seed, run, t.model, t.robot) for t in trained(arm)]


def test_a_training_motion_under_another_name_is_refused(arm, used):
    again = UnseenMotion("new", commands(140, 0))  # as m0, and goes on
    with pytest.raises(UsageError, match="'new' is motion 'm0' of training"):
        require_unseen([again], used[0], arm, used[1])
    chosen = UnseenMotion("new", commands(100, 1))
    with pytest.raises(UsageError, match="'m1'"):
        require_unseen([chosen], used[0], arm, used[1])


def test_a_test_motion_is_unseen(arm, used):
    require_unseen([UnseenMotion("m2", commands(100, 2))], used[0], arm, used[1])


def test_motions_are_generated(arm):
    made = generated(arm, 3, 0.2)
    assert len({m.name for m in made}) == 3
    assert all(m.ctrl.shape[1] == 2 for m in made)
