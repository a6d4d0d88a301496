"""The unit and the motions that no network may see are not in what networks are trained on."""

import pytest
from arm import commands, record, write_dataset

from gaponet.base.errors import UsageError
from gaponet.experiments.paper.experiment import prepare
from gaponet.experiments.paper.options import PaperOptions
from gaponet.experiments.paper.study import Study
from gaponet.experiments.paper.unseen_motions import make_unseen_motions

UNSEEN = "virtual-2"
OPTIONS = PaperOptions(unit=UNSEEN, fleet="easy", quick=True, motions=1)


def no_bar(text):
    raise AssertionError("the recordings are looked at before the motions are")


def test_the_unseen_unit_is_in_no_recording_of_training_or_validation(robot, tmp_path):
    sequences = []
    for motion in range(6):
        for unit in ("virtual-1", UNSEEN):
            ctrl = commands(60, motion)
            sequences.append(record(robot, ctrl, f"motion{motion}", unit=unit))
    dataset = write_dataset(tmp_path / "data", robot, sequences)
    splits = Study(str(dataset.path), robot, tmp_path, OPTIONS).splits()
    fitted = splits["train"] + splits["val"]
    assert {entry.meta.unit_id for entry in fitted} == {"virtual-1"}


def test_a_dataset_that_holds_a_motion_of_the_experiment_is_refused(robot, tmp_path):
    (unseen,) = make_unseen_motions(robot, 1, max_payload=0.0, dt=0.02)
    sequences = [record(robot, unseen.ctrl, "same", unit="virtual-1")]
    for motion in range(5):
        sequences.append(record(robot, commands(60, motion), f"motion{motion}", unit="virtual-1"))
    dataset = write_dataset(tmp_path / "data", robot, sequences)
    with pytest.raises(UsageError, match="seen"):
        prepare(dataset, robot, tmp_path / "out", OPTIONS, no_bar)
