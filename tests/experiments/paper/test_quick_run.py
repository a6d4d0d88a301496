"""The quick run of the experiment: a few recordings of the dataset."""

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


def test_a_dataset_that_holds_only_the_unseen_unit_is_refused(tmp_path):
    robot = load_robot("so101")
    rest = np.tile(robot.qpos_home, (50, 1))
    dataset = write_dataset(
        tmp_path / "data", robot, [record(robot, rest, "rest", unit="virtual-1")]
    )

    with pytest.raises(UsageError, match="unit"):
        prepare(dataset, robot, tmp_path / "out", OPTIONS, no_bar)
