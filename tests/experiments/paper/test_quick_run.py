"""The quick run of the experiment: a few recordings of the dataset."""

from dataclasses import replace

import numpy as np
import pytest
from arm import record, write_dataset

from gaponet.base.errors import UsageError
from gaponet.experiments.paper.experiment import prepare
from gaponet.experiments.paper.options import PaperOptions
from gaponet.robot.spec import load_robot

OPTIONS = PaperOptions(unit="virtual-1", fleet="easy", quick=True, motions=1)


def no_bar(text):
    raise AssertionError("the recordings are looked at, although there are none to train on")


@pytest.fixture
def robot():
    return load_robot("so101")


@pytest.fixture
def dataset(tmp_path, robot):
    rest = np.tile(robot.qpos_home, (50, 1))
    recording = record(robot, rest, "rest", unit="virtual-1")
    return write_dataset(tmp_path / "data", robot, [recording])


def test_a_dataset_that_holds_only_the_unseen_unit_is_refused(tmp_path, robot, dataset):
    with pytest.raises(UsageError, match="unit"):
        prepare(dataset, robot, tmp_path / "out", OPTIONS, no_bar)


@pytest.mark.parametrize("left_out", [{"blocks": ()}, {"methods": (), "blocks": ("labels",)}])
def test_options_that_leave_nothing_to_train_are_refused(tmp_path, robot, dataset, left_out):
    options = replace(OPTIONS, **left_out)
    with pytest.raises(UsageError, match="nothing to train"):
        prepare(dataset, robot, tmp_path / "out", options, no_bar)
