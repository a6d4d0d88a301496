"""A dataset that was pushed is read where it lies, in the memory of one recording, and nothing is written there."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from logs import arm_sequence, late, wave

import gaponet as gp
from gaponet.base.errors import DatasetError
from gaponet.cli.main import main
from gaponet.data.sequence import ARRAYS
from gaponet.data.split import make_split, write_split
from gaponet.data.store import Dataset
from gaponet.share.errors import RemoteError
from gaponet.share.move import push
from gaponet.share.target import part_of


@pytest.fixture
def dataset(arm, tmp_path):
    """Motions at two rates, two payloads, with torques in some, a licence and a split."""
    data = Dataset.create(tmp_path / "arm_logs", arm)
    for i in range(5):
        ctrl = wave(60, 2, hertz=0.3 + 0.11 * i)
        sequence = arm_sequence(arm, ctrl, late(ctrl, 2), f"wave {i}", 0.1 * (i % 2), tau=2 * ctrl if i < 3 else None)
        data.append(replace(sequence, dt=0.05) if i == 4 else sequence)
    data.state(licence="CC-BY-4.0")
    write_split(data, make_split(data, "motion"), "motion")
    return data


@pytest.fixture
def address(dataset, tmp_path):
    place = f"file://{tmp_path}/bucket/arm"
    push(dataset.path, place)
    return place


def test_what_is_read_from_afar_is_what_was_recorded_in_any_order(dataset, address):
    far, robot = gp.open_dataset(address)
    assert robot.joint_names == dataset.joint_names
    assert far.header["licence"] == "CC-BY-4.0"
    assert (far.path / "splits" / "motion.json").is_file()
    bare = lambda e: replace(e, findings={}, command=None)  # noqa: E731
    assert sorted(map(repr, map(bare, far.entries))) == sorted(map(repr, map(bare, dataset.entries)))
    for entry in dataset.entries[::-1]:
        here, there = dataset.read(entry), far.read(far.find(entry.hash))
        assert here.meta == there.meta
        for name in ARRAYS:
            assert np.array_equal(getattr(here, name), getattr(there, name)) or getattr(here, name) is None
        assert (far.channels(entry, ("qpos",))["qpos"] == here.qpos).all()


def test_doctor_gap_and_export_say_of_an_address_what_they_say_of_the_folder(dataset, address, tmp_path, capsys):
    before = {f: f.stat().st_mtime_ns for f in tmp_path.joinpath("bucket").rglob("*")}
    told = {}
    for place in (str(dataset.path), address):
        for command in ("doctor", "gap"):
            assert main([command, place, "--json"]) == 0
            found = json.loads(capsys.readouterr().out)
            told.setdefault(command, []).append(found)
        assert main(["data", "export", place, "--out", str(tmp_path / f"out{len(told['gap'])}"), "--to", "npz"]) == 0
        capsys.readouterr()
    found = [{(f["level"], f["check"], tuple(f["joints"])) for f in one["findings"]} for one in told["doctor"]]
    assert found[0] == found[1] != set()
    assert told["gap"][0]["methods"]["nominal"]["mpjae"] == pytest.approx(told["gap"][1]["methods"]["nominal"]["mpjae"])
    names = [sorted(f.name for f in (tmp_path / out).rglob("*.npz")) for out in ("out1", "out2")]
    assert names[0] == names[1] != []
    assert {f: f.stat().st_mtime_ns for f in tmp_path.joinpath("bucket").rglob("*")} == before


def test_a_model_trained_and_judged_from_afar_is_that_of_the_folder(arm, tmp_path, capsys):
    data = Dataset.create(tmp_path / "arm_logs", arm)
    for i in range(8):
        ctrl = wave(60, 2, hertz=0.3 + 0.11 * i)
        data.append(arm_sequence(arm, ctrl, late(ctrl, 2), f"wave {i}"))
    address, found = f"file://{tmp_path}/bucket/arm", []
    push(data.path, address)
    small = ["--budget", "640", "--model.history", "2", "--warm-start.rounds", "1", "--warm-start.num-envs", "16"]
    small += ["--warm-start.steps", "40", "--warm-start.gradient-steps", "20"]
    study = ["experiment", "compare", "--models", "mlp", "--seeds", "1", "--workers", "1", *small]
    for place in (str(data.path), address):
        run = tmp_path / f"run{len(found)}"
        assert main(["train", place, "--out", str(run), "--model", "mlp", *small]) == 0
        assert main(["eval", str(run), place]) == 0
        assert main(["identify", place, "--out", str(run / "identified"), "--windows", "2"]) == 0
        card, config = (json.loads((run / name).read_text()) for name in ("model/card.json", "config.json"))
        error = json.loads((run / "metrics.json").read_text())["methods"]["nominal"]["mpjae"]
        kp = gp.load_robot(run / "identified").kp
        found.append([card["val_mpjae"], error, *kp])
        assert config["dataset"] == (address if found[1:] else "../arm_logs")
        capsys.readouterr()
    assert found[0] == found[1]
    assert main([*study, address, "--out", str(tmp_path / "study")]) == 0
    assert len(list((tmp_path / "study" / "cells").glob("*/cell.json"))) == 1


def test_the_folder_of_what_is_read_goes_with_it(address):
    far, _ = gp.open_dataset(address)
    folder = far.path
    assert folder.is_dir()
    del far
    assert not folder.exists()


def test_what_lies_in_a_bucket_is_not_changed_from_here(dataset, address):
    far, _ = gp.open_dataset(address)
    for change in (lambda: far.append(dataset.read(dataset.entries[0])), lambda: far.state(licence="mine")):
        with pytest.raises(DatasetError, match=r"arm: is only read; .* gaponet pull"):
            change()


def forge(tmp_path, change):
    """A new index, by somebody who knows how one is made; change gets it and a function that replaces a file."""
    place = tmp_path / "bucket" / "arm"
    index = json.loads((place / "gaponet.json").read_text())

    def put(name, content):
        (tmp_path / "forged").write_bytes(content)
        part = vars(part_of(tmp_path / "forged"))
        shutil.copyfile(tmp_path / "forged", place / "sha256" / part["sha256"])
        index["files"][name] = part

    read = lambda name: (place / "sha256" / index["files"][name]["sha256"]).read_bytes()  # noqa: E731
    change(index, put, read)
    (place / "gaponet.json").write_text(json.dumps(index))


def test_samples_that_were_changed_are_refused_when_they_are_read(address, dataset, tmp_path):
    import pyarrow.parquet as pq

    def change(index, put, read):
        name = next(n for n in index["files"] if "/data/" in n and n.startswith("20hz"))
        (tmp_path / "x").write_bytes(read(name))
        table = pq.read_table(tmp_path / "x")
        column = table.schema.get_field_index("action")
        table = table.set_column(
            column, table.schema.field(column), table["action"].take(list(range(len(table)))[::-1])
        )
        pq.write_table(table, tmp_path / "x")
        put(name, (tmp_path / "x").read_bytes())

    forge(tmp_path, change)
    far, _ = gp.open_dataset(address)
    slow = next(e for e in far.entries if e.dt == 0.05)
    with pytest.raises(RemoteError, match=r"bucket/arm: 'wave_4.* is not what was pushed"):
        far.read(slow)
    for entry in far.entries:
        if entry is not slow:
            far.read(entry)


@pytest.mark.parametrize("what", ["contents", "shard", "robot", "own", "cut"])
def test_a_place_that_does_not_hold_what_it_says_is_one_line(address, tmp_path, capsys, what):
    def change(index, put, read):
        data = next(n for n in index["files"] if "/data/" in n)
        if what == "contents":
            index["contents"][0] = "0" * 64
        if what == "shard":
            del index["files"][data]
        if what == "robot":
            put("gaponet/robot/robot.xml", b'<mujoco><include file="/etc/passwd"/></mujoco>')
        if what == "own":
            del index["files"][next(n for n in index["files"] if n.endswith("meta/gaponet.json"))]
        if what == "cut":
            put(data, read(data)[:-100])

    forge(tmp_path, change)
    assert main(["doctor", address]) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith(f"Remote: {address}: ")
    assert "/gaponet-" not in line


@pytest.mark.parametrize("address", ["file:///nowhere/at/all", "s3:///x", "ftp://x/y", "arm://x"])
def test_an_address_of_nothing_is_one_line(capsys, address):
    assert main(["doctor", address]) == 2
    assert capsys.readouterr().err.startswith(f"Remote: {address}")


def test_a_run_is_no_dataset(tmp_path):
    index = {"format": 1, "kind": "run", "name": "run", "contents": ["0" * 64],
             "files": {"model/model.onnx": {"size": 1, "sha256": "0" * 64}}}  # fmt: skip
    (tmp_path / "gaponet.json").write_text(json.dumps(index))
    with pytest.raises(RemoteError, match="holds a run, not a dataset"):
        gp.open_dataset(f"file://{tmp_path}")


READ = """
import resource, sys
import gaponet as gp
dataset, _ = gp.open_dataset(sys.argv[1])
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for entry in dataset.entries:
    assert dataset.read(entry).content_hash() == entry.hash
print(len(dataset), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no getrusage")
def test_memory_does_not_grow_with_what_is_read(arm, tmp_path):
    rng, data = np.random.default_rng(0), Dataset.create(tmp_path / "walks", arm)
    for i in range(24):
        ctrl = np.cumsum(rng.normal(0, 1e-3, (20_000, 2)), axis=0)
        data.append(arm_sequence(arm, ctrl, late(ctrl, 1), f"walk {i}", 0.0))
    push(data.path, place := f"file://{tmp_path}/bucket")
    done = subprocess.run([sys.executable, "-c", READ, place], capture_output=True, text=True, check=True)
    read, grown = map(int, done.stdout.split())
    assert read == 24
    assert grown < 60_000  # kB: 23 MB, of which one recording has 4; 97 MB where the whole file is read
