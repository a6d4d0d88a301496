"""The dataset folder: what is listed is complete, what is not listed does not exist."""

import errno
import json
import os
import pickle
import sys
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from arm import write_arm
from logs import arm_sequence, late, wave

from gaponet.base.errors import DatasetError, FolderError
from gaponet.data.pair import SimulatedReplay
from gaponet.data.store import Dataset, dataset_hash


@pytest.fixture
def sequence(arm):
    ctrl = wave(40, 2)
    return arm_sequence(arm, ctrl, late(ctrl, 2), tau=np.ones((40, 2)))


@pytest.fixture
def dataset(arm, sequence, tmp_path):
    data = Dataset.create(tmp_path / "data", arm)
    data.append(sequence, {"delay_s": {"shoulder": 0.04}})
    return data


def test_what_was_appended_is_read_back_bit_by_bit(dataset, sequence):
    back = Dataset(dataset.path)
    read = back.read(back.entries[0])
    for name in ("ctrl", "qpos", "qvel", "tau"):
        assert np.array_equal(getattr(read, name), getattr(sequence, name))
    assert read.qacc is None
    assert list(back.channels(back.entries[0], ("tau", "ctrl"))) == ["tau", "ctrl"]
    assert read.meta == sequence.meta
    assert read.content_hash() == sequence.content_hash() == back.entries[0].hash
    assert back.entries[0].findings == {"delay_s": {"shoulder": 0.04}}


def test_what_was_appended_is_on_the_disk_before_append_returns(dataset, sequence, monkeypatch):
    synced: dict[int, int] = {}  # size of a file when it was last synced, by inode
    fsync = os.fsync

    def noted(descriptor):
        fsync(descriptor)
        synced[os.fstat(descriptor).st_ino] = os.fstat(descriptor).st_size

    monkeypatch.setattr(os, "fsync", noted)
    entry = dataset.append(replace(sequence, meta=replace(sequence.meta, payload_mass=1.0)))
    for file in (
        dataset.path / "sequences.jsonl",
        dataset.path / "sequences" / f"{entry.id}.parquet",
    ):
        assert synced.get(file.stat().st_ino) == file.stat().st_size, file
    assert (dataset.path / "sequences").stat().st_ino in synced, "its name too"


def test_a_removal_that_is_cut_short_leaves_the_dataset_as_it_was(dataset, sequence, monkeypatch):
    dataset.append(replace(sequence, meta=replace(sequence.meta, payload_mass=1.0)))
    before = {file: file.read_bytes() for file in dataset.path.rglob("*") if file.is_file()}
    monkeypatch.setattr(os, "replace", no_space)
    with pytest.raises(OSError, match="space"):
        dataset.remove(("*-1kg-*",))
    assert {file: file.read_bytes() for file in dataset.path.rglob("*") if file.is_file()} == before


def no_space(*_):
    raise OSError(errno.ENOSPC, "No space left on device")


def test_what_is_removed_leaves_no_file_and_the_rest_stays_as_it_is(dataset, sequence):
    other = dataset.append(replace(sequence, meta=replace(sequence.meta, payload_mass=1.0)))
    simulated = dataset.path / "replays/abc" / f"{other.id}.parquet"
    simulated.parent.mkdir(parents=True)
    simulated.touch()
    with pytest.raises(DatasetError, match=r"\*-3kg-\*"):
        dataset.remove(("*-1kg-*", "*-3kg-*"))
    assert dataset.remove(("*-1kg-*",)) == [other]
    assert not simulated.exists()
    (left,) = Dataset(dataset.path).entries
    assert [f.stem for f in (dataset.path / "sequences").iterdir()] == [left.id]
    assert Dataset(dataset.path).read(left).content_hash() == left.hash


def test_of_many_none_is_listed_twice_or_lost_where_the_block_ends_badly(dataset, sequence):
    masses = [float(mass) for mass in range(1, 6)]
    some = [replace(sequence, meta=replace(sequence.meta, payload_mass=mass)) for mass in masses]
    with suppress(KeyboardInterrupt), dataset.appending():
        for s in some[:3]:
            dataset.append(s)
        with pytest.raises(DatasetError, match="already"):
            dataset.append(some[2])
        raise KeyboardInterrupt
    again = Dataset(dataset.path)
    assert len(again) < 4
    assert len(list((dataset.path / "sequences").iterdir())) == len(dataset) == len(again)
    with again.appending():
        for s in some:
            if again.find(s.content_hash()) is None:
                again.append(s)
    assert [e.meta.payload_mass for e in Dataset(dataset.path).entries] == [0.0, *masses]
    assert len(Dataset(dataset.path).sequences()) == 6


def test_a_line_cut_short_by_a_crash_is_not_there_and_reading_leaves_it_alone(dataset, sequence):
    """It may be one that another process is just writing."""
    journal = dataset.path / "sequences.jsonl"
    whole = journal.read_bytes()
    journal.write_bytes(whole + whole[: len(whole) // 2])
    assert len(Dataset(dataset.path)) == 1
    assert len(journal.read_bytes()) > len(whole)
    Dataset(dataset.path).append(replace(sequence, meta=replace(sequence.meta, payload_mass=1.0)))
    assert journal.read_bytes().startswith(whole)
    assert [e.meta.payload_mass for e in Dataset(dataset.path).entries] == [0.0, 1.0]


def test_what_another_writer_appended_meanwhile_is_known(dataset, sequence):
    other = Dataset(dataset.path)
    other.append(replace(sequence, meta=replace(sequence.meta, payload_mass=1.0)))
    with pytest.raises(DatasetError, match="already"):
        dataset.append(replace(sequence, meta=replace(sequence.meta, payload_mass=1.0)))
    dataset.append(replace(sequence, meta=replace(sequence.meta, payload_mass=2.0)))
    assert [e.meta.payload_mass for e in Dataset(dataset.path).entries] == [0.0, 1.0, 2.0]


def test_a_damaged_line_is_named(dataset):
    journal = dataset.path / "sequences.jsonl"
    journal.write_text("{}\n" + journal.read_text())
    with pytest.raises(DatasetError, match=r"sequences\.jsonl:1: id"):
        Dataset(dataset.path)


def test_a_listed_file_that_is_gone_is_named(dataset):
    next((dataset.path / "sequences").iterdir()).unlink()
    with pytest.raises(DatasetError, match=r"\.parquet"):
        Dataset(dataset.path)


def test_a_dataset_belongs_to_one_robot(dataset, so101):
    with pytest.raises(DatasetError, match="so101"):
        Dataset.create(dataset.path, so101)


def test_peeking_makes_nothing(arm, tmp_path):
    assert Dataset.open_existing(tmp_path / "new", arm) is None
    assert not (tmp_path / "new").exists()
    (tmp_path / "file").touch()
    with pytest.raises(FolderError, match="folder"):
        Dataset.open_existing(tmp_path / "file", arm)


def test_a_half_written_file_is_named(dataset):
    file = next((dataset.path / "sequences").iterdir())
    file.write_bytes(file.read_bytes()[:200])
    with pytest.raises(DatasetError, match=r"\.parquet"):
        dataset.read(dataset.entries[0])


def test_a_newer_format_asks_for_an_upgrade_and_another_folder_says_how_to_make_a_dataset(
    dataset, tmp_path
):
    header = dataset.path / "dataset.json"
    header.write_text(json.dumps(json.loads(header.read_text()) | {"format": 99}))
    with pytest.raises(DatasetError, match="99"):
        Dataset(dataset.path)
    with pytest.raises(DatasetError, match=r"dataset\.json"):
        Dataset(tmp_path)


def test_a_motion_that_is_not_there_names_those_that_are(dataset):
    assert len(dataset.select(("m",))) == len(dataset.select("m")) == 1
    with pytest.raises(DatasetError, match="dance"):
        dataset.select(("dance",))


def test_a_replay_belongs_to_one_simulator(dataset, sequence):
    entry = dataset.entries[0]
    simulated = SimulatedReplay("abc", sequence.qpos, sequence.qvel, sequence.tau)
    dataset.write_replay(entry, simulated)
    assert dataset.has_replay(entry, "abc")
    assert np.array_equal(dataset.pair(entry, "abc").sim.tau, sequence.tau)
    with pytest.raises(DatasetError, match="xyz"):
        dataset.pair(entry, "xyz")


def test_files_of_earlier_versions_are_read_as_before(dataset, sequence):
    file = next((dataset.path / "sequences").iterdir())
    n, columns = 2, ("ctrl", "qpos", "qvel", "tau")
    arrays = [pa.array(np.arange(40) * 0.02)]
    arrays += [
        pa.FixedSizeListArray.from_arrays(pa.array(getattr(sequence, c).ravel()), n)
        for c in columns
    ]
    pq.write_table(
        pa.table(arrays, names=["time", *columns]), file, compression="zstd"
    )  # nullable, other compression
    assert dataset.read(dataset.entries[0]).content_hash() == sequence.content_hash()


def test_the_identity_of_a_set_does_not_depend_on_its_order(dataset, sequence):
    dataset.append(replace(sequence, meta=replace(sequence.meta, payload_mass=1.0)))
    assert dataset_hash(dataset.entries) == dataset_hash(dataset.entries[::-1])
    assert dataset_hash(dataset.entries) != dataset_hash(dataset.entries[:1])


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("id", "../../../etc/passwd", "id:"),
        ("dt", float("nan"), "dt:"),
        ("rows", 10**12, "rows:"),
        ("channels", ["qpos", "qvel", "qacc"], "channels:"),
        ("meta", {"robot": "arm"}, r"meta\.unit_id:"),
        ("findings", {"delay_s": {"a": float("inf")}}, "findings"),
    ],
)
def test_a_journal_line_of_another_kind_is_refused_with_line_and_field(dataset, field, value, said):
    journal = dataset.path / "sequences.jsonl"
    journal.write_text(json.dumps(json.loads(journal.read_text()) | {field: value}) + "\n")
    with pytest.raises(DatasetError, match=rf"sequences\.jsonl:1: {said}"):
        _ = Dataset(dataset.path).entries[0].meta


def test_opening_parses_only_how_a_line_begins_and_the_rest_when_it_is_asked_for(dataset):
    journal = dataset.path / "sequences.jsonl"
    (here,), (opened,), whole = dataset.entries, Dataset(dataset.path).entries, journal.read_bytes()
    assert opened.line == here.line == whole[:-1]
    assert pickle.loads(pickle.dumps(opened)) == opened == here
    assert opened.meta == here.meta
    journal.write_bytes(whole[:-9] + b"\n")  # its end is gone, its line is not
    again = Dataset(dataset.path)
    assert again.find(here.hash).rows == here.rows
    with pytest.raises(DatasetError, match=r"sequences\.jsonl:1:"):
        again.read(again.entries[0])


def test_a_line_that_another_program_wrote_is_the_same_entry(dataset):
    journal = dataset.path / "sequences.jsonl"
    line = json.loads(journal.read_text())
    journal.write_text(
        json.dumps(dict(reversed(line.items())), indent=None, separators=(",", ":")) + "\n"
    )
    assert Dataset(dataset.path).entries == dataset.entries


def test_a_line_listed_twice_is_refused(dataset):
    journal = dataset.path / "sequences.jsonl"
    journal.write_text(2 * journal.read_text())
    with pytest.raises(DatasetError, match=r"sequences\.jsonl:2:"):
        Dataset(dataset.path)


@pytest.mark.parametrize("text", ["", "null", '{"format": 1}', '{"format": 1, "robot": "../x"}'])
def test_a_damaged_header_is_named(dataset, text):
    (dataset.path / "dataset.json").write_text(text)
    with pytest.raises(DatasetError, match=r"dataset\.json"):
        Dataset(dataset.path)


def columns(rows=40, n=2, kind="float32", value=0.0):
    array = pa.array(np.full(rows * n, value), kind)
    column = pa.FixedSizeListArray.from_arrays(array, n)
    return pa.table(dict.fromkeys(("ctrl", "qpos", "qvel", "tau"), column))


@pytest.mark.parametrize(
    ("table", "said"),
    [
        (columns(rows=39), "39"),
        (columns(n=3), "fixed_size_list"),
        (columns(value=np.nan), "NaN"),
        (pa.table({"ctrl": [1.0] * 40}), "double"),
        (pa.table({"time": [1.0] * 40}), "readable"),
    ],
)
def test_samples_of_another_shape_are_refused(dataset, table, said):
    pq.write_table(table, next((dataset.path / "sequences").iterdir()))
    with pytest.raises(DatasetError, match=rf"\.parquet: .*{said}.*restore the file"):
        dataset.read(dataset.entries[0])


def test_a_name_that_is_not_text_is_written_and_read_with_its_bytes_escaped(dataset, sequence):
    odd = replace(
        sequence.meta, motion="\udcff\n[red]", source="/logs/\u2028\udcff.csv", payload_mass=2.0
    )
    dataset.append(replace(sequence, meta=odd))
    assert Dataset(dataset.path).entries[1].meta.motion == "\\udcff\n[red]"


def test_where_a_recording_came_from_is_words_and_is_never_opened(dataset, monkeypatch):
    """Mutant 410 of make fuzz --only journal (seed 0): a source outside the folder."""
    journal = dataset.path / "sequences.jsonl"
    line = json.loads(journal.read_text())
    line["meta"]["source"] = "../../secret.csv#3"
    journal.write_text(json.dumps(line) + "\n")
    opened = []
    sys.addaudithook(lambda event, args: opened.append(str(args[0])) if event == "open" else None)
    data = Dataset(dataset.path)
    data.sequences()
    assert [name for name in opened if "secret" in name] == []
    assert any("sequences.jsonl" in name for name in opened)


def test_a_robot_with_other_joints_and_the_same_name_is_another_robot(dataset, tmp_path):
    swapped = write_arm(tmp_path / "swapped")
    object.__setattr__(swapped, "joint_names", ("elbow", "shoulder"))
    with pytest.raises(DatasetError, match=r"\(elbow, shoulder\)"):
        dataset.require_robot(swapped)


def test_a_unit_that_is_not_there_names_those_that_are(dataset):
    assert len(dataset.select(units=("a",))) == 1
    with pytest.raises(DatasetError, match="holds: a"):
        dataset.select(units=("b",))


def test_replays_of_a_dataset_that_cannot_be_written_lie_elsewhere(dataset, sequence, monkeypatch):
    monkeypatch.setattr(os, "access", lambda *_: False)
    (entry,) = dataset.entries
    before = sorted(dataset.path.rglob("*"))
    for digest in ("abc", "xyz"):
        simulated = SimulatedReplay(digest, sequence.qpos, sequence.qvel, sequence.tau)
        with dataset.writing_replays():
            dataset.write_replay(entry, simulated)
    assert np.array_equal(dataset.pair(entry, "abc").sim.qpos, sequence.qpos)
    assert np.array_equal(dataset.pair(entry, "xyz").sim.qpos, sequence.qpos)
    assert sorted(dataset.path.rglob("*")) == before
