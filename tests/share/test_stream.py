"""A dataset that was pushed is read where it lies, and refused where it is not what was pushed."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest

import gaponet as gp
from gaponet.base.errors import DatasetError
from gaponet.cli.main import main
from gaponet.share.push_pull import push
from gaponet.share.remote import RemoteError

from .conftest import same


@pytest.fixture
def address(dataset, bucket):
    push(dataset.path, f"file://{bucket}")
    return f"file://{bucket}"


def test_what_is_read_from_afar_is_what_was_recorded(dataset, place):
    push(dataset.path, place)
    far, robot = gp.open_dataset(place)
    same(dataset, far)
    assert robot.joint_names == dataset.joint_names
    assert far.header["licence"] == "CC-BY-4.0"
    assert (far.path / "splits" / "motion.json").is_file()
    entry = far.entries[0]
    assert np.array_equal(far.channels(entry, ("qpos",))["qpos"], far.read(entry).qpos)
    folder = far.files
    del far
    assert not folder.exists()


def test_the_files_of_the_recordings_that_are_read_are_fetched_and_no_others(dataset, address):
    far, _ = gp.open_dataset(address)
    data = lambda: sorted(file.parts[-4] for file in far.files.glob("*/data/*/*.parquet"))  # noqa: E731
    assert data() == []
    far.read(next(e for e in far.entries if e.dt == 0.05))
    assert data() == ["20hz"]


def test_a_command_says_of_an_address_what_it_says_of_the_folder(dataset, address, bucket, capsys):
    before = {file: file.stat().st_mtime_ns for file in bucket.rglob("*")}
    found = []
    for place in (str(dataset.path), address):
        assert main(["gap", place, "--json"]) == 0
        found.append(json.loads(capsys.readouterr().out)["methods"]["nominal"]["mpjae"])
    assert found[0] == pytest.approx(found[1])
    assert {file: file.stat().st_mtime_ns for file in bucket.rglob("*")} == before


def test_what_lies_in_a_bucket_is_not_changed_from_here(dataset, address):
    far, _ = gp.open_dataset(address)
    for change in (
        lambda: far.append(dataset.read(dataset.entries[0])),
        lambda: far.set_provenance(licence="mine"),
    ):
        with pytest.raises(DatasetError, match=r"arm: is only read; .* gaponet pull"):
            change()


def test_samples_that_were_changed_are_refused_when_they_are_read(address, forge, tmp_path):
    def change(index, put, read):
        name = next(n for n in index["files"] if "/data/" in n and n.startswith("20hz"))
        (tmp_path / "x").write_bytes(read(name))
        table = pq.read_table(tmp_path / "x")
        column = table.schema.get_field_index("action")
        reversed_rows = table["action"].take(list(range(len(table)))[::-1])
        pq.write_table(
            table.set_column(column, table.schema.field(column), reversed_rows), tmp_path / "x"
        )
        put(name, (tmp_path / "x").read_bytes())

    forge(change)
    far, _ = gp.open_dataset(address)
    for entry in far.entries:
        if entry.dt != 0.05:
            far.read(entry)
            continue
        with pytest.raises(RemoteError, match=r"bucket/arm: 'slow.* is not what was pushed"):
            far.read(entry)


@pytest.mark.parametrize(
    "what", ["contents", "shard", "robot", "no robot", "own", "cut", "kind", "half"]
)
def test_a_place_with_other_content_than_its_index_says_is_one_line(
    address, bucket, forge, tmp_path, capsys, what
):
    def change(index, put, read):
        data = next(name for name in index["files"] if "/data/" in name)
        if what == "contents":
            index["contents"][0] = "0" * 64
        if what == "shard":
            del index["files"][data]
        if what == "robot":
            put("gaponet/robot/robot.xml", b'<mujoco><include file="/etc/passwd"/></mujoco>')
        if what == "no robot":
            put("gaponet/robot/robot.xml", b"<mujoco>")
        if what == "own":
            del index["files"][
                next(name for name in index["files"] if name.endswith("meta/gaponet.json"))
            ]
        if what == "cut":
            put(data, read(data)[:-100])
        if what == "kind":
            index["kind"] = "run"

    forge(change)
    if what == "half":
        (bucket / "gaponet.json").write_bytes((bucket / "gaponet.json").read_bytes()[:300])
    for command in (["doctor", address], ["pull", address, str(tmp_path / "back")]):
        assert main(command) == 2
        line = capsys.readouterr().err.splitlines()[-1]
        assert line.startswith(f"Remote: {address}: ")
        assert "/gaponet-" not in line
    assert not (tmp_path / "back").exists()
