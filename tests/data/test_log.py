"""A log that cannot be learned from cannot be constructed."""

import numpy as np
import pytest

from gaponet.base.errors import LogError
from gaponet.data.log import Channel, Log

TIME = np.array([0.0, 0.1, 0.2])
VALUES = np.zeros((3, 2))
META = {"files": {"ctrl": "control.csv", "qpos": "state.csv"}, "first_line": 2}


def log(**channels: Channel) -> Log:
    default = {"ctrl": Channel(TIME, VALUES), "qpos": Channel(TIME, VALUES)}
    return Log("arm", ("a", "b"), default | channels, "folder", META)


def test_a_log_holds_its_channels_untouched():
    assert log().channels["qpos"].values is VALUES


def test_a_log_without_commands_is_refused():
    with pytest.raises(LogError, match="ctrl"):
        Log("arm", ("a", "b"), {"qpos": Channel(TIME, VALUES)}, "folder")


def test_a_value_that_is_not_finite_is_named_by_file_line_and_joint():
    values = VALUES.copy()
    values[1, 1] = np.nan
    with pytest.raises(LogError, match=r"state\.csv:3:"):
        log(qpos=Channel(TIME, values))


@pytest.mark.parametrize("third", [0.1, 0.05])
def test_time_that_stands_or_goes_back_is_named_by_file_and_line(third):
    with pytest.raises(LogError, match=r"control\.csv:4:"):
        log(ctrl=Channel(np.array([0.0, 0.1, third]), VALUES))


def test_one_row_is_nothing_to_learn_from():
    with pytest.raises(LogError, match="qpos"):
        log(qpos=Channel(TIME[:1], VALUES[:1]))


def test_columns_must_match_the_joints():
    with pytest.raises(LogError, match="tau"):
        log(tau=Channel(TIME, VALUES[:, :1]))


def test_a_channel_nobody_knows_is_refused():
    with pytest.raises(LogError, match="current"):
        log(current=Channel(TIME, VALUES))
