"""The observation, number by number."""

import numpy as np
import pytest

from gaponet.model.config import ModelConfig
from gaponet.model.inputs import Inputs
from gaponet.model.observation import History, frames_before
from gaponet.robot import load_robot


@pytest.mark.parametrize(("history", "dim"), [(2, 80), (4, 140), (6, 200), (8, 260)])
def test_dimensions_are_the_papers(history, dim):
    assert ModelConfig(history=history, payload_input=False).observation_dim(10) == dim
    assert ModelConfig(history=4, payload_input=True).observation_dim(10) == 141


@pytest.mark.parametrize(("history", "dim"), [(2, 80), (4, 140), (6, 200), (8, 260)])
def test_so_they_are_of_the_h1_2(history, dim):
    n = len(load_robot("h1_2").operated)
    for payload in (0, 1):
        config = ModelConfig(history=history, payload_input=bool(payload))
        empty = History(config, 1, n)
        state = np.zeros((1, n))
        assert empty.observe(state, state, np.zeros(1)).shape == (1, dim + payload)
        assert Inputs(config, 1, np.arange(n)).layout.dim == dim + payload + n


def test_layout_is_state_then_frames_newest_first_then_payload():
    history = History(ModelConfig(history=2, payload_max=2.0), num_envs=1, n=1)
    history.reset(slice(None), np.full((1, 2, 1), 9.0), np.full((1, 2, 1), 9.0), np.full((1, 2, 1), 9.0))
    history.push([[1.0]], [[2.0]], [[3.0]])
    history.push([[4.0]], [[5.0]], [[6.0]])
    o = history.observe([[7.0]], [[8.0]], np.array([1.0]))
    np.testing.assert_array_equal(o, [[7, 8, 4, 5, 6, 1, 2, 3, 0.5]])


def test_a_stride_skips_frames():
    history = History(ModelConfig(history=2, stride=3, payload_input=False), num_envs=1, n=1)
    history.reset(slice(None), np.zeros((1, 4, 1)), np.zeros((1, 4, 1)), np.zeros((1, 4, 1)))
    for k in range(1, 6):
        history.push([[k]], [[0.0]], [[0.0]])
    assert history.observe([[6.0]], [[0.0]], np.zeros(1))[0, [2, 5]].tolist() == [5.0, 2.0]


def test_history_at_the_start_is_the_first_frame_repeated():
    assert frames_before(np.array([0, 2]), 3).tolist() == [[0, 0, 0], [1, 0, 0]]
