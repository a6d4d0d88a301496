"""Names of joints in findings."""

import numpy as np
import pytest

from gaponet.robot.finding import masked_names
from gaponet.robot.spec import load_robot


def test_a_mask_selects_joints_by_their_place():
    robot = load_robot("so101")
    assert masked_names(robot, np.arange(6) == 2) == (robot.joint_names[2],)


def test_a_mask_of_other_joints_is_an_error():
    with pytest.raises(ValueError, match="shorter"):
        masked_names(load_robot("so101"), np.ones(3, bool))
