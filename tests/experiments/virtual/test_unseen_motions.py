"""Motions that were never trained on, and the check that it is so."""

import json
from pathlib import Path

import numpy as np
import pytest
from arm import commands, record
from motion_files import write_motion
from weak_arm import trained

from gaponet.base.errors import UsageError
from gaponet.data.store import Dataset
from gaponet.experiments.virtual.unseen_motions import UnseenMotion, from_files, generated, require_unseen
from gaponet.sysid.motion.motion import Motion


@pytest.fixture
def used(arm, tmp_path):
    """A dataset of three motions, and runs that trained on the first two."""
    data = Dataset.create(tmp_path / "data", arm)
    entries = [data.append(record(arm, commands(100, i), f"m{i}")) for i in range(3)]
    split = {"train": {"m0": entries[0].hash}, "val": {"m1": entries[1].hash}, "test": {"m2": entries[2].hash}}
    run = tmp_path / "run"
    run.mkdir()
    (run / "split.json").write_text(json.dumps(split))
    return data, [type(t)(t.method, t.seed, run, t.model, t.robot) for t in trained(arm)]


def test_a_training_motion_under_another_name_is_refused(arm, used):
    again = UnseenMotion("new", "generated", commands(140, 0))  # as m0, and goes on
    with pytest.raises(UsageError, match="'new' is motion 'm0' of training"):
        require_unseen([again], used[0], arm, used[1])
    chosen = UnseenMotion("new", "generated", commands(100, 1))
    with pytest.raises(UsageError, match="'m1'"):
        require_unseen([chosen], used[0], arm, used[1])


def test_a_test_motion_is_unseen_and_gets_its_nearest_training_motion(arm, used):
    (motion,) = require_unseen([UnseenMotion("m2", "files", commands(100, 2))], used[0], arm, used[1])
    away = [np.sqrt(((commands(100, 2) - commands(100, i)) ** 2).mean()) for i in (0, 1)]
    assert motion.nearest[0] == f"m{int(np.argmin(away))}"
    assert motion.nearest[1] == pytest.approx(min(away), rel=1e-4)


def test_motions_are_generated_and_read_from_files(arm, tmp_path):
    made = generated(arm, 3, 0.2)
    assert len({m.name for m in made}) == 3
    assert all(m.source == "generated" and m.ctrl.shape[1] == 2 for m in made)
    folder = tmp_path / "motions" / "arm"
    folder.mkdir(parents=True)
    write_motion(folder / "swing.csv", Motion("swing", "upper_body", 0.02, commands(100, 5)), arm)
    (read,) = from_files(arm, folder.parent, 0.2)
    assert (read.name, read.source) == ("swing", "files")
    assert np.abs(read.ctrl[: len(commands(100, 5))] - commands(100, 5)).max() < 0.2
    with pytest.raises(UsageError, match="no motion file there"):
        from_files(arm, Path(tmp_path / "data"), 0.2)
