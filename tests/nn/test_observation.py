"""The observation, number by number."""

import numpy as np
import pytest
import torch

from gaponet.nn.config import ModelConfig
from gaponet.nn.observation import History, Layout, NetworkInput


@pytest.mark.parametrize(("history", "dim"), [(2, 80), (4, 140), (6, 200), (8, 260)])
def test_dimensions_are_the_papers(history, dim):
    assert ModelConfig(history=history, payload_input=False).observation_dim(10) == dim
    assert ModelConfig(history=4, payload_input=True).observation_dim(10) == 141


def test_layout_is_state_then_frames_newest_first_then_payload_and_action():
    made = NetworkInput(ModelConfig(history=2, payload_max=2.0), n=1, num_envs=1)
    made.begin(slice(None), *np.full((3, 1, 1, 1), 9.0))
    one = lambda value: np.array([[value]])  # noqa: E731
    made.push(one(1.0), one(2.0), one(3.0))
    made.push(one(4.0), one(5.0), one(6.0))
    x = made.update(one(7.0), one(8.0), one(10.0), np.array([1.0]))
    np.testing.assert_array_equal(x, [[7, 8, 4, 5, 6, 1, 2, 3, 0.5, 10]])


@pytest.mark.parametrize("make", [np.zeros, torch.zeros], ids=["numpy", "torch"])
@pytest.mark.parametrize("stride", [1, 3])
@pytest.mark.parametrize("seed", range(2))
def test_the_history_equals_a_list_of_past_frames_under_random_pushes_and_resets(
    make, stride, seed
):
    rng = np.random.default_rng(seed)
    n = 2
    num = 4
    config = ModelConfig(history=int(rng.integers(1, 5)), stride=stride)
    x = make((num, config.input_dim(n)))

    def own(values):
        return values if make is np.zeros else torch.from_numpy(values).float()

    history = History(config, n, x)
    past = [[np.zeros(3 * n, np.float32)] * history.depth for _ in range(num)]
    for _ in range(30):
        if rng.random() < 0.3:
            ids = np.flatnonzero(rng.random(num) < 0.5)
            frames = rng.random((len(ids), history.depth, 3 * n)).astype(np.float32)
            history.reset(ids, *(own(part) for part in np.split(frames, 3, axis=2)))
            for i, mine in zip(ids, frames, strict=True):
                past[i] = list(mine)
        else:
            frame = rng.random((num, 3 * n)).astype(np.float32)
            history.push(*(own(part) for part in np.split(frame, 3, axis=1)))
            past = [[new, *old[:-1]] for new, old in zip(frame, past, strict=True)]
        history.write()
        want = [np.concatenate(frames[::stride]) for frames in past]
        np.testing.assert_array_equal(np.asarray(x)[:, Layout(config, n).past], want)


def test_history_at_the_start_is_the_first_frame_repeated():
    assert History.rows_before(np.array([0, 2]), 3).tolist() == [[0, 0, 0], [1, 0, 0]]
