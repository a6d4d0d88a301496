"""The weak arm as the unit that no network has seen."""

import pytest
from arm import commands, write_arm
from weak_arm import weak_unit

from gaponet.experiments.paper.measure import VirtualUnit
from gaponet.experiments.paper.unseen_motions import UnseenMotion


@pytest.fixture(scope="package")
def robot(tmp_path_factory):
    return write_arm(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="package")
def unit(robot):
    motions = [UnseenMotion(f"motion{i}", commands(60 + 20 * i, i)) for i in range(2)]
    return VirtualUnit("weak", weak_unit(), robot, motions, (0.0, 0.4), goal_count=2, dt=0.02)
