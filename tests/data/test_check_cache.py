"""What the doctor found in a recording is kept, and found again where anything is another."""

import json
import os
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from multiprocessing import get_context

import pytest
from arm import recordings

from gaponet.base.errors import WorkerError
from gaponet.data.doctor import Diagnosis
from gaponet.data.store import SURVEYS, Dataset
from gaponet.sim.dynamics import gravity_of


@pytest.fixture
def dataset(arm, tmp_path):
    dataset = Dataset.create(tmp_path / "data", arm)
    for sequence in recordings(arm, 4, rows=600):
        dataset.append(sequence)
    return dataset


@pytest.fixture
def read(monkeypatch):
    """Recordings that were read."""
    ids, whole = [], Dataset.read
    monkeypatch.setattr(Dataset, "read", lambda self, entry: (ids.append(entry.id), whole(self, entry))[1])
    return ids


def told(dataset, arm, **more):
    found = Diagnosis.of(Dataset(dataset.path), arm, gravity_model=gravity_of(arm), **more)
    return json.dumps(found.as_dict())


def test_the_second_time_nothing_is_read_and_of_a_larger_dataset_what_is_new(dataset, arm, read):
    first = told(dataset, arm)
    assert read == [e.id for e in dataset.entries]
    assert told(dataset, arm) == first
    assert len(read) == 4
    dataset.append(recordings(arm, 5, rows=600)[-1])
    more = told(dataset, arm)
    assert len(read) == 5
    for file in (dataset.path / SURVEYS).iterdir():
        file.unlink()
    assert told(dataset, arm) == more
    dataset.remove((dataset.entries[0].id,))
    assert len(list((dataset.path / SURVEYS).iterdir())) == 4


def test_what_is_damaged_or_of_something_else_is_found_again(dataset, arm, read):
    first = told(dataset, arm)
    kept = [dataset.path / SURVEYS / f"{e.id}.npz" for e in dataset.entries]
    whole = [file.read_bytes() for file in kept]
    flipped = bytearray(whole[1])
    flipped[len(flipped) // 2] ^= 1
    for file, content in zip(kept, (b"", bytes(flipped), whole[2][:-1], whole[0]), strict=True):
        file.write_bytes(content)
    assert told(dataset, arm) == first
    assert [file.read_bytes() for file in kept] == whole
    read.clear()
    os.utime(dataset.path / "sequences" / f"{dataset.entries[1].id}.parquet", ns=(0, 0))  # as if written again
    assert told(dataset, arm) == first
    assert read == [dataset.entries[1].id]
    told(dataset, replace(arm, effort_limit=arm.effort_limit / 2))
    assert len(read) == 5


def test_where_nothing_can_be_written_the_report_is_the_same(dataset, arm, tmp_path):
    first = told(dataset, arm)
    for file in (dataset.path / SURVEYS).iterdir():
        file.unlink()
    (dataset.path / SURVEYS).rmdir()
    (dataset.path / SURVEYS).write_text("no folder")
    assert told(dataset, arm) == first
    assert (dataset.path / SURVEYS).read_text() == "no folder"


def test_other_processes_say_the_same(dataset, arm):
    with ProcessPoolExecutor(2, get_context("spawn")) as processes:
        there = told(dataset, arm, executor=processes)
    kept = {file: file.read_bytes() for file in (dataset.path / SURVEYS).iterdir()}
    for file in kept:
        file.unlink()
    assert told(dataset, arm) == there
    assert {file: file.read_bytes() for file in kept} == kept


class Dying(Executor):
    """One whose workers are killed."""

    def submit(self, fn, /, *args, **kwargs):
        future = Future()
        future.set_exception(BrokenProcessPool("killed"))
        return future


def test_workers_that_die_are_an_error_that_says_so_and_cost_nothing_later(dataset, arm):
    with pytest.raises(WorkerError, match="workers died of it"):
        told(dataset, arm, executor=Dying())
    assert "verdict" in told(dataset, arm)
