"""Windows: every stretch of a sequence is as likely as any other, and the cache is what the Parquet files say."""

import numpy as np
import pytest
from arm import recordings

from gaponet.data.store import Dataset
from gaponet.data.windows import Windows
from gaponet.errors import DatasetError, JointMismatchError, UsageError


@pytest.fixture
def dataset(arm, tmp_path):
    """Four sequences of 60 rows, alternately empty-handed and with 0.2 kg."""
    data = Dataset.create(tmp_path / "data", arm)
    for sequence in recordings(arm, 4, rows=60):
        data.append(sequence)
    return data


@pytest.mark.parametrize("resident", [0, 1 << 30], ids=["read piece by piece", "mapped"])
def test_a_window_holds_the_rows_of_its_sequence(dataset, resident):
    windows = Windows(dataset, ("elbow", "shoulder"), resident=resident)
    batch = windows.batch(np.random.default_rng(0), 50, 7)
    assert batch["qpos"].shape == (50, 7, 2)
    for i in range(50):
        entry = windows.entries[batch["entry"][i]]
        sequence = dataset.read(entry)
        rows = slice(batch["row"][i], batch["row"][i] + 7)
        for name in ("ctrl", "qpos", "qvel"):
            assert np.array_equal(batch[name][i], getattr(sequence, name)[rows][:, [1, 0]])
        assert batch["payload_mass"][i] == np.float32(entry.meta.payload_mass)
        assert batch["dt"][i] == np.float32(entry.dt)


def test_all_windows_and_no_others_are_drawn(dataset):
    windows = Windows(dataset, ("elbow",))
    assert windows.count(59) == 4 * 2
    batch = windows.batch(np.random.default_rng(0), 200, 59)
    drawn = {(int(e), int(r)) for e, r in zip(batch["entry"], batch["row"], strict=True)}
    assert drawn == {(entry, row) for entry in range(4) for row in (0, 1)}


def test_the_same_seed_draws_the_same_windows(dataset):
    first, second = (Windows(dataset, ("elbow",)).batch(np.random.default_rng(3), 20, 5)["qpos"] for _ in range(2))
    assert np.array_equal(first, second)


def test_a_part_of_a_split_is_drawn_from_alone(dataset):
    part = dataset.entries[2:3]
    batch = Windows(dataset, ("elbow",), part).batch(np.random.default_rng(0), 30, 60)
    assert (batch["entry"] == 0).all()
    assert np.array_equal(batch["ctrl"][0], dataset.read(part[0]).ctrl[:, [1]])


def test_a_window_longer_than_every_sequence_is_refused(dataset):
    with pytest.raises(UsageError, match=r"windows of 61 rows: the longest of 4 sequences has 60; use between 1"):
        Windows(dataset, ("elbow",)).batch(np.random.default_rng(0), 4, 61)


def test_the_cache_is_made_once_and_again_when_the_dataset_has_grown(dataset, arm):
    told = []
    Windows(dataset, ("elbow",), progress=lambda done, total, motion: told.append((done, total, motion)))
    assert told[-1] == (4, 4, "motion3")
    Windows(Dataset(dataset.path), ("elbow",), progress=lambda *_: pytest.fail("made twice"))
    dataset.append(recordings(arm, 5, rows=60)[4])
    assert Windows(dataset, ("elbow",)).count(60) == 5
    assert len(list((dataset.path / "cache").glob("*/frames.f32"))) == 1  # the outgrown one is gone


def test_caches_of_other_joints_live_beside_each_other(dataset):
    Windows(dataset, ("elbow",))
    Windows(dataset, ("elbow", "shoulder"))
    assert len(list((dataset.path / "cache").glob("*/frames.f32"))) == 2


def test_a_cache_that_was_cut_short_is_made_again(dataset):
    Windows(dataset, ("elbow",))
    file = next((dataset.path / "cache").glob("*/frames.f32"))
    whole = file.read_bytes()
    file.write_bytes(whole[:100])
    Windows(dataset, ("elbow",))
    assert file.read_bytes() == whole


def test_an_interrupted_cache_leaves_nothing_behind(dataset):
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Windows(dataset, ("elbow",), progress=interrupt)
    assert not (dataset.path / "cache").exists()


def test_a_joint_that_is_not_there_names_those_that_are(dataset):
    with pytest.raises(JointMismatchError, match="no joint 'wrist'; it holds shoulder, elbow"):
        Windows(dataset, ("wrist",))


def test_an_empty_dataset_says_what_to_do(arm, tmp_path):
    with pytest.raises(DatasetError, match="holds no sequences yet; import or collect some"):
        Windows(Dataset.create(tmp_path / "none", arm), ("elbow",))
