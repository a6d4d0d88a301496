"""Push and pull: what comes back is what was sent, by every hash; whoever is killed goes on; strangers are refused."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import pyarrow.parquet as pq
import pytest
from logs import arm_sequence, late, wave
from runs import untrained

from gaponet.base.errors import DatasetError, UsageError
from gaponet.cli.main import main
from gaponet.data.split import make_split, write_split
from gaponet.data.store import Dataset, dataset_hash
from gaponet.data.writers import lerobot
from gaponet.nn.artifact import GapModel
from gaponet.share.bucket import Bucket
from gaponet.share.errors import RemoteError
from gaponet.share.move import pull, push
from gaponet.share.target import part_of

pytest.importorskip("huggingface_hub", reason="pip install 'gaponet[hub]'")
from hub_server import LARGE, FakeHub


@pytest.fixture
def hub(monkeypatch, tmp_path):
    """The stand-in of the Hub, where huggingface_hub now looks, in this process and in those that it starts."""
    server = FakeHub()
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_DISABLE_XET", True)
    for name, text in {"HF_ENDPOINT": server.url, "HF_HUB_DISABLE_XET": "1", "HF_TOKEN": "hf_nobody",
                       "HF_HOME": str(tmp_path / "hf")}.items():  # fmt: skip
        monkeypatch.setenv(name, text)
    yield server
    server.go_on.set()
    server.shutdown()
    server.server_close()


def add(data, arm, names, **meta):
    for i, name in enumerate(names):
        ctrl = wave(60, 2, hertz=0.3 + 0.11 * i + 0.01 * len(data))
        sequence = arm_sequence(arm, ctrl, late(ctrl, 2), name, 0.1 * (i % 2), tau=2 * ctrl)
        data.append(replace(sequence, meta=replace(sequence.meta, **meta)))


@pytest.fixture
def dataset(arm, tmp_path):
    """Motions at two rates, with a licence and a split."""
    data = Dataset.create(tmp_path / "arm_logs", arm)
    add(data, arm, [f"wave {i}" for i in range(4)], virtual=True)
    ctrl = wave(60, 2, hertz=0.9)
    data.append(replace(arm_sequence(arm, ctrl, late(ctrl, 1), "slow", 0.0), dt=0.05))
    data.state(licence="CC-BY-4.0")
    write_split(data, make_split(data, "motion"), "motion")
    return data


@pytest.fixture
def run(arm, dataset, tmp_path):
    folder = untrained(tmp_path / "run", arm, dataset, train=("wave 0",), val=("wave 1",), test=("wave 2",))
    config = {"model": {"kind": "gaponet"}, "ppo": {"num_envs": 1, "epochs": 1, "std": 0.1}, "seed": 0, "robot": "arm",
              "dataset": "arm_logs", "dataset_hash": dataset_hash(dataset.entries)}  # fmt: skip
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "report.html").write_text("<script>alert(1)</script>")
    return folder


@pytest.fixture(params=["hub", "bucket"])
def place(request, tmp_path):
    """Addresses by name, on the Hub and on a disk as object storage."""
    if request.param == "hub":
        request.getfixturevalue("hub")
        return lambda name: f"me/{name}"
    return lambda name: f"file://{tmp_path}/bucket/{name}"


def same(one, other):
    """All samples of all channels, metadata and ids; in any order."""
    assert {e.id: replace(e, findings={}) for e in one.entries} == {
        e.id: replace(e, findings={}) for e in other.entries
    }
    for entry in one.entries:
        a, b = one.read(entry), other.read(other.find(entry.hash))
        assert a.content_hash() == b.content_hash() == entry.hash
        for name in entry.channels:
            assert (getattr(a, name) == getattr(b, name)).all()


def test_a_dataset_comes_back_by_every_hash_with_split_licence_robot_and_card(dataset, place, tmp_path, capsys):
    assert main(["push", str(dataset.path), place("arm"), "--json"]) == 0
    assert main(["pull", place("arm"), str(tmp_path / "back")]) == 0
    back = Dataset(tmp_path / "back")
    same(dataset, back)
    assert back.header["licence"] == "CC-BY-4.0"
    split = "splits/motion.json"
    assert (back.path / split).read_bytes() == (dataset.path / split).read_bytes()
    assert sorted(f.name for f in back.path.parent.glob(".gaponet-*")) == []
    assert not list(back.path.rglob("*.cache*"))


def test_a_run_comes_back_with_the_same_network_and_without_what_a_browser_would_run(run, place, tmp_path):
    push(run, place("model"))
    pull(place("model"), tmp_path / "back")
    assert GapModel.load(tmp_path / "back").weights_hash() == GapModel.load(run).weights_hash()
    there = {f.relative_to(run).as_posix() for f in run.rglob("*") if f.is_file() and not f.name.startswith(".")}
    back = {f.relative_to(tmp_path / "back").as_posix() for f in (tmp_path / "back").rglob("*") if f.is_file()}
    assert back - {".gaponet", "robot/.gaponet", "model/.gaponet"} == there - {"report.html"}


def test_a_dataset_that_grew_sends_what_is_new_and_one_that_shrank_is_refused(dataset, arm, place, tmp_path, capsys):
    shutil.copytree(dataset.path, tmp_path / "small")
    push(dataset.path, place("arm"))
    add(dataset, arm, ["new"])
    push(dataset.path, place("arm"))
    pull(place("arm"), tmp_path / "back")
    same(dataset, Dataset(tmp_path / "back"))
    with pytest.raises(RemoteError, match="holds 1 sequences that would be lost"):
        push(tmp_path / "small", place("arm"))
    push(tmp_path / "small", place("arm"), replace=True)


def test_on_the_hub_a_set_is_one_that_lerobot_reads_with_a_card_and_each_large_file_is_sent_once(
    hub, dataset, tmp_path
):
    push(dataset.path, "me/arm")
    files = hub.files("datasets/me/arm")
    readme = files["README.md"].decode()
    assert readme.startswith('---\ntask_categories: ["robotics"]\ntags: ["LeRobot", "gaponet"')
    assert 'license: "cc-by-4.0"' in readme
    assert "5 sequences" in readme
    assert {"50hz/meta/info.json", "20hz/meta/info.json"} <= {f.replace("49.8504hz", "50hz") for f in files}
    push(dataset.path, "me/arm")
    assert set(hub.sent.values()) == {1}
    assert len(hub.repos["datasets/me/arm"]) <= 3  # born, pushed; at most the card anew


def killed_while_holding(hub, command, after, arrived=lambda: True):
    """Run a command until the hub holds it and what passed has arrived, then kill -9."""
    hub.hold_after = after
    process = subprocess.Popen(
        [sys.executable, "-m", "gaponet", *command], stderr=subprocess.PIPE, env=dict(os.environ)
    )
    assert hub.holding.wait(120), process.communicate()
    while not arrived():
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    hub.let_all_pass()


def test_a_push_that_was_killed_changed_nothing_and_goes_on_with_what_is_missing(hub, dataset, tmp_path):
    killed_while_holding(hub, ["push", str(dataset.path), "me/arm"], after=2)
    assert set(hub.files("datasets/me/arm")) == {".gitattributes"}
    assert sum(hub.sent.values()) == 2
    push(dataset.path, "me/arm")
    assert set(hub.sent.values()) == {1}
    assert len(hub.sent) == sum(name.endswith(LARGE) for name in hub.files("datasets/me/arm"))
    pull("me/arm", tmp_path / "back")
    same(dataset, Dataset(tmp_path / "back"))
    assert sorted(f.name for f in tmp_path.glob(".gaponet-*")) == []


def test_a_pull_that_was_killed_left_nothing_under_its_name_and_goes_on(hub, dataset, tmp_path):
    push(dataset.path, "me/arm")
    names = json.loads(hub.files("datasets/me/arm")["gaponet.json"])["files"]
    there = lambda: {name for name in names if (tmp_path / ".gaponet-pull-back" / "files" / name).is_file()}  # noqa: E731
    killed_while_holding(hub, ["pull", "me/arm", str(tmp_path / "back")], 2, lambda: len(there()) >= 2)
    assert not (tmp_path / "back").exists()
    arrived = there()
    hub.got.clear()
    pull("me/arm", tmp_path / "back")
    assert not arrived & hub.got.keys()
    same(dataset, Dataset(tmp_path / "back"))


def test_keys_in_an_address_stand_in_no_error_and_no_card():
    assert Bucket("s3://KEY:SECRET@robots/arm?region=us-east-1").address == "s3://robots/arm"
    assert Bucket("gs://anonymous@robots/arm?scheme=http").address == "gs://robots/arm"
    with pytest.raises(RemoteError, match=r"^s3://robots/arm: Cannot parse URI: 's3://robots/arm'"):
        Bucket("s3://KEY:SEC/RET@robots/arm")


def test_a_push_to_a_disk_that_was_cut_short_is_mended(dataset, tmp_path):
    address = f"file://{tmp_path}/bucket"
    push(dataset.path, address)
    objects = sorted((tmp_path / "bucket" / "sha256").iterdir(), key=lambda f: f.stat().st_size)
    objects[-1].write_bytes(objects[-1].read_bytes()[:100])
    push(dataset.path, address)
    pull(address, tmp_path / "back")
    same(dataset, Dataset(tmp_path / "back"))


def largest(folder):
    return max((folder / "bucket" / "sha256").iterdir(), key=lambda file: file.stat().st_size)


def test_what_earlier_pushes_left_is_pruned_once_it_is_a_day_old(dataset, arm, tmp_path):
    place, objects = f"file://{tmp_path}/bucket", tmp_path / "bucket" / "sha256"
    push(dataset.path, place)
    add(dataset, arm, ["new"])
    push(dataset.path, place)
    grown = len(list(objects.iterdir()))
    young = push(dataset.path, place, prune=True)
    assert young.facts["pruned"] == 0
    for file in objects.iterdir():
        os.utime(file, (0, 0))
    assert push(dataset.path, place, prune=True).facts["pruned"] == 0  # somebody may pull what was there till now
    os.utime(tmp_path / "bucket" / "gaponet.json", (0, 0))
    old = push(dataset.path, place, prune=True)
    assert old.facts["pruned"] == grown - len(list(objects.iterdir())) > 0
    pull(place, tmp_path / "back")
    same(dataset, Dataset(tmp_path / "back"))


@pytest.fixture
def blocks(monkeypatch):
    """A file holds one recording, a block two."""
    monkeypatch.setattr(lerobot, "USUAL_MB", 1e-9)
    monkeypatch.setattr(lerobot, "SHARE", 0.0)
    monkeypatch.setattr(lerobot, "BLOCK_EPISODES", 2)


@pytest.fixture
def was_read(monkeypatch):
    """The motions that are read of any dataset, as it goes."""
    motions, channels = [], Dataset.channels
    monkeypatch.setattr(
        Dataset, "channels", lambda self, e, names: motions.append(e.meta.motion) or channels(self, e, names)
    )
    return motions


def test_what_an_earlier_push_laid_out_is_not_read_again_wherever_it_goes(blocks, was_read, dataset, arm, tmp_path):
    place, objects = f"file://{tmp_path}/bucket", tmp_path / "bucket" / "sha256"
    push(dataset.path, place)
    assert len(was_read) == len(dataset)
    was_read.clear()
    push(dataset.path, place)
    assert was_read == []
    add(dataset, arm, ["new", "newer", "newest"])
    before = {file: file.stat().st_mtime_ns for file in objects.iterdir()}
    push(dataset.path, place)
    assert was_read == ["new", "newer", "newest"]
    assert before.items() <= {file: file.stat().st_mtime_ns for file in objects.iterdir()}.items()
    was_read.clear()
    notes = dataset.path / "pushed.jsonl"
    notes.write_text(notes.read_text()[:-40])  # cut short by a kill: its block is laid out again, to the same bytes
    push(dataset.path, place)
    assert was_read == ["newest"]
    push(dataset.path, f"file://{tmp_path}/another")
    assert len(was_read) == 1 + len(dataset)
    notes.unlink()
    push(dataset.path, f"file://{tmp_path}/third")
    assert len({(tmp_path / name / "gaponet.json").read_text() for name in ("another", "third")}) == 2  # their cards
    assert {file.name for file in (tmp_path / "another/sha256").iterdir()} ^ {
        file.name for file in (tmp_path / "third/sha256").iterdir()
    } == {json.loads((tmp_path / name / "gaponet.json").read_text())["files"]["README.md"]["sha256"]
          for name in ("another", "third")}  # fmt: skip
    pull(place, tmp_path / "back")
    same(dataset, Dataset(tmp_path / "back"))


def test_of_a_damaged_file_its_block_alone_is_laid_out_again(blocks, was_read, dataset, tmp_path):
    push(dataset.path, f"file://{tmp_path}/bucket")
    was_read.clear()
    files = json.loads((tmp_path / "bucket" / "gaponet.json").read_text())["files"]
    name = next(name for name in files if name.endswith("data/chunk-000/file-001.parquet"))
    (tmp_path / "bucket" / "sha256" / files[name]["sha256"]).write_bytes(b"x" * files[name]["size"])
    push(dataset.path, f"file://{tmp_path}/bucket")
    assert was_read == ["wave 0", "wave 1"]
    pull(f"file://{tmp_path}/bucket", tmp_path / "back")
    same(dataset, Dataset(tmp_path / "back"))


def test_a_pull_into_a_dataset_brings_what_it_lacks_and_touches_nothing_else(
    blocks, dataset, arm, place, tmp_path, capsys
):
    push(dataset.path, place("arm"))
    back, split = tmp_path / "back", tmp_path / "back" / "splits" / "motion.json"
    pull(place("arm"), back)
    assert pull(place("arm"), back).files == 0
    add(Dataset(back), arm, ["mine"], unit_id="mine")
    split.write_text("mine")
    add(dataset, arm, ["new", "newer"])
    push(dataset.path, place("arm"))
    moved = pull(place("arm"), back)
    data = [name for name in (tmp_path / "back" / "sequences").iterdir() if name.name.startswith("new")]
    assert moved.facts == {"sequences": 2}
    assert len(data) == 2
    assert split.read_text() == "mine"
    assert {e.meta.motion for e in Dataset(back).entries} - {e.meta.motion for e in dataset.entries} == {"mine"}
    assert main(["pull", place("arm"), str(back)]) == 0
    assert "nothing is there that" in capsys.readouterr().out


def test_the_same_recording_under_another_name_is_the_one_that_is_there(dataset, arm, tmp_path):
    renamed = Dataset.create(tmp_path / "renamed", arm)
    for entry in dataset.entries:
        sequence = dataset.read(entry)
        renamed.append(replace(sequence, meta=replace(sequence.meta, motion=f"my {entry.meta.motion}")))
    push(dataset.path, place := f"file://{tmp_path}/bucket")
    pull(place, tmp_path / "theirs")
    push(renamed.path, place)
    assert pull(place, tmp_path / "theirs").files == 0
    pull(place, tmp_path / "mine")
    same(dataset, Dataset(tmp_path / "theirs"))
    same(renamed, Dataset(tmp_path / "mine"))


def test_what_was_pushed_before_there_were_blocks_is_pulled(dataset, tmp_path):
    """One file of meta/episodes, without findings; no offsets beside."""
    push(dataset.path, place := f"file://{tmp_path}/bucket")
    bucket, index = tmp_path / "bucket", json.loads((tmp_path / "bucket" / "gaponet.json").read_text())
    for name in [name for name in index["files"] if "meta/episodes/" in name]:
        table = pq.read_table(bucket / "sha256" / index["files"][name]["sha256"]).drop_columns("findings")
        pq.write_table(table, tmp_path / "old")
        index["files"][name] = vars(part_of(tmp_path / "old"))
        (tmp_path / "old").rename(bucket / "sha256" / index["files"][name]["sha256"])
    (bucket / "gaponet.json").write_text(json.dumps(index))
    pull(place, tmp_path / "back")
    same(dataset, back := Dataset(tmp_path / "back"))
    assert all(entry.findings["delay_s"].keys() == {"shoulder", "elbow"} for entry in back.entries)


def test_prune_lists_first_and_spares_what_may_be_in_use(dataset, arm, tmp_path, capsys):
    place, bucket = f"file://{tmp_path}/bucket", tmp_path / "bucket"
    push(dataset.path, place)
    first = set((bucket / "sha256").iterdir())
    add(dataset, arm, ["new"])
    push(dataset.path, place)
    assert main(["prune", place, "--json"]) == 0
    young = json.loads(capsys.readouterr().out)
    assert young["files"] == []
    assert young["young"] > 0
    for file in (bucket / "gaponet.json", *first):
        os.utime(file, (0, 0))
    assert main(["prune", place]) == 0
    assert f"gaponet prune {place} --delete" in " ".join(capsys.readouterr().out.split())
    assert first <= set((bucket / "sha256").iterdir())
    assert main(["prune", place, "--delete", "--json"]) == 0
    gone = json.loads(capsys.readouterr().out)["files"]
    assert len(gone) == young["young"]
    assert {file.name for file in first - set((bucket / "sha256").iterdir())} == set(gone)
    pull(place, tmp_path / "back")
    same(dataset, Dataset(tmp_path / "back"))


@pytest.mark.parametrize("index", [None, 300])
def test_a_place_without_a_whole_index_is_not_pruned(dataset, tmp_path, capsys, index):
    push(dataset.path, place := f"file://{tmp_path}/bucket")
    file = tmp_path / "bucket" / "gaponet.json"
    file.write_bytes(file.read_bytes()[:index]) if index else file.unlink()
    capsys.readouterr()
    assert main(["prune", place, "--delete", "--hours", "0"]) == 2
    assert capsys.readouterr().err.startswith(f"Remote: {place}: ")
    with pytest.raises(RemoteError, match=r"gaponet\.json" if index else "nothing was pushed"):
        pull(place, tmp_path / "back")
    assert len(list((tmp_path / "bucket" / "sha256").iterdir())) > 9
    push(dataset.path, place, replace=True)
    pull(place, tmp_path / "back")


def test_what_is_pruned_while_a_push_counts_on_it_is_missed_before_it_is_named(dataset, tmp_path, monkeypatch):
    push(dataset.path, place := f"file://{tmp_path}/bucket")
    dataset.state(source="another card")
    store = Bucket.store

    def meanwhile(self, *given):
        monkeypatch.setattr(Bucket, "store", store)
        largest(tmp_path).unlink()
        return store(self, *given)

    monkeypatch.setattr(Bucket, "store", meanwhile)
    before = (tmp_path / "bucket" / "gaponet.json").read_bytes()
    with pytest.raises(RemoteError, match="was removed meanwhile; push again"):
        push(dataset.path, place)
    assert (tmp_path / "bucket" / "gaponet.json").read_bytes() == before
    push(dataset.path, place)
    pull(place, tmp_path / "back")


def test_what_has_had_no_name_for_long_is_sent_again_as_it_may_be_pruned_now(dataset, tmp_path):
    push(dataset.path, place := f"file://{tmp_path}/bucket")
    (tmp_path / "bucket" / "gaponet.json").unlink()
    for file in (tmp_path / "bucket" / "sha256").iterdir():
        os.utime(file, (0, 0))
    push(dataset.path, place)
    assert all(file.stat().st_mtime > 0 for file in (tmp_path / "bucket" / "sha256").iterdir())


def test_a_damaged_object_is_mended_by_pushing_again_and_by_replace(dataset, arm, tmp_path):
    address, whole = f"file://{tmp_path}/bucket", {}
    push(dataset.path, address)
    for again in (False, True):
        file = largest(tmp_path)
        whole = whole or {file: file.read_bytes()}
        file.write_bytes(bytes([file.read_bytes()[0] ^ 1]) + file.read_bytes()[1:])  # one bit, the size as it was
        with pytest.raises(RemoteError, match="came with another size or hash"):
            pull(address, tmp_path / "back")
        push(dataset.path, address, replace=again)
        assert file.read_bytes() == whole[file]
    pull(address, tmp_path / "back")
    same(dataset, Dataset(tmp_path / "back"))


def test_who_pushed_to_a_bucket_meanwhile_loses_nothing(dataset, arm, tmp_path, monkeypatch):
    """Another set: refused, as it would have been a moment later. A state that ours goes on from: ours is stored."""
    address, holds = f"file://{tmp_path}/bucket", Bucket.holds
    shutil.copytree(dataset.path, tmp_path / "before")
    other = Dataset.create(tmp_path / "other", arm)
    add(other, arm, ["elsewhere"], unit_id="another")

    def while_storing(what):
        def meanwhile(self, *given):
            monkeypatch.setattr(Bucket, "holds", holds)
            push(what, address)
            return holds(self, *given)

        monkeypatch.setattr(Bucket, "holds", meanwhile)

    while_storing(other.path)
    with pytest.raises(RemoteError, match="holds 1 sequences that would be lost"):
        push(dataset.path, address)
    pull(address, tmp_path / "theirs")
    same(other, Dataset(tmp_path / "theirs"))
    shutil.rmtree(tmp_path / "bucket")
    add(dataset, arm, ["new"])
    while_storing(tmp_path / "before")
    push(dataset.path, address)
    pull(address, tmp_path / "ours")
    same(dataset, Dataset(tmp_path / "ours"))


@pytest.mark.parametrize("digest", ["../" * 19 + "etc/pwd", "A" * 64, "0" * 63 + " ", "0" * 65])
def test_a_hash_is_64_hex_digits_and_never_a_path(dataset, tmp_path, digest):
    push(dataset.path, f"file://{tmp_path}/bucket")
    index = json.loads((tmp_path / "bucket" / "gaponet.json").read_text())
    next(iter(index["files"].values()))["sha256"] = digest
    (tmp_path / "bucket" / "gaponet.json").write_text(json.dumps(index))
    with pytest.raises(RemoteError, match="should be the 64 lowercase hex digits"):
        pull(f"file://{tmp_path}/bucket", tmp_path / "back")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="Windows has no named pipes")
@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("/dev/zero")])
def test_an_object_that_is_a_pipe_or_a_device_is_not_read(dataset, tmp_path, make):
    push(dataset.path, f"file://{tmp_path}/bucket")
    file = largest(tmp_path)
    file.unlink()
    make(file)
    with pytest.raises(RemoteError, match="is not there with"):
        pull(f"file://{tmp_path}/bucket", tmp_path / "back")


def test_a_file_that_came_with_another_content_is_refused_and_fetched_again(hub, dataset, tmp_path):
    push(dataset.path, "me/arm")
    name = next(name for name in hub.files("datasets/me/arm") if name.endswith("info.json"))
    content = hub.files("datasets/me/arm")[name]
    hub.lie[name] = content.replace(b"v3.0", b"v3.1")
    with pytest.raises(RemoteError, match="came with another size or hash"):
        pull("me/arm", tmp_path / "back")
    assert not (tmp_path / "back").exists()
    hub.lie.clear()
    pull("me/arm", tmp_path / "back")


def forge(hub, repo, change):
    """A new commit, by somebody who knows how an index is made: hashes and sizes are right."""
    files = dict(hub.files(repo))
    index = json.loads(files["gaponet.json"])
    change(files, index)
    files["gaponet.json"] = json.dumps(index).encode()
    hub.commit(repo, files)


def put(files, index, name, content, folder):
    (folder / "forged").write_bytes(content)
    files[name] = content
    index["files"][name] = vars(part_of(folder / "forged"))


@pytest.mark.parametrize(
    "name", ["../x", "/x", "a/../../x", "a//x", ".ssh/x", "a\\x", "C:x", "x\n", "a/" * 9 + "x", "gaponet.json", "ARM/y"]
)
def test_an_index_that_names_a_place_outside_or_twice_is_refused_before_anything_is_fetched(
    hub, dataset, tmp_path, name
):
    push(dataset.path, "me/arm")

    def change(files, index):
        put(files, index, name, b"x", tmp_path)
        put(files, index, "arm/y", b"x", tmp_path)

    forge(hub, "datasets/me/arm", change)
    hub.got.clear()
    with pytest.raises(RemoteError, match=r"is not the name of a file inside a folder|differ in capitals"):
        pull("me/arm", tmp_path / "back")
    assert set(hub.got) == {"gaponet.json"}
    assert not (tmp_path / "x").exists()


def test_sequences_that_are_not_those_of_the_index_are_refused(hub, dataset, tmp_path):
    push(dataset.path, "me/arm")
    forge(hub, "datasets/me/arm", lambda files, index: index.update(contents=["0" * 64, *index["contents"][1:]]))
    with pytest.raises(RemoteError, match=r"sequences listed are not those of gaponet\.json"):
        pull("me/arm", tmp_path / "back")
    assert not (tmp_path / "back").exists()
    assert not (tmp_path / ".gaponet-pull-back").exists()


@pytest.mark.parametrize("xml", [b'<mujoco><include file="/etc/passwd"/></mujoco>', b"<mujoco>"])
def test_a_robot_that_names_other_files_or_is_none_is_refused(hub, dataset, tmp_path, xml):
    push(dataset.path, "me/arm")
    forge(hub, "datasets/me/arm", lambda files, index: put(files, index, "gaponet/robot/robot.xml", xml, tmp_path))
    with pytest.raises(RemoteError, match=r"me/arm: .*robot"):
        pull("me/arm", tmp_path / "back")
    assert not (tmp_path / "back").exists()


def test_a_run_with_a_file_that_no_run_has_or_another_network_is_refused(hub, run, tmp_path):
    push(run, "me/model")
    forge(hub, "models/me/model", lambda files, index: put(files, index, "report.html", b"<script>", tmp_path))
    with pytest.raises(RemoteError, match=r"report\.html: a run has no such file"):
        pull("me/model", tmp_path / "back")
    forge(hub, "models/me/model", lambda files, index: index["files"].pop("report.html"))
    forge(hub, "models/me/model", lambda files, index: put(files, index, "model/model.onnx", b"no network", tmp_path))
    with pytest.raises(RemoteError, match="not the network that was pushed"):
        pull("me/model", tmp_path / "back")
    assert not (tmp_path / "back").exists()


def test_more_than_the_disk_holds_is_refused_before_anything_is_fetched(hub, dataset, tmp_path, monkeypatch):
    push(dataset.path, "me/arm")
    usage = shutil.disk_usage(tmp_path)._replace(free=1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: usage)
    with pytest.raises(RemoteError, match="GB of the disk are free"):
        pull("me/arm", tmp_path / "back")


@pytest.mark.parametrize("address", ["me/none", "me", "not a repo/x y", "s3:/x", "ftp://x/y", "file:///nowhere/at/all"])
def test_a_place_that_is_none_is_one_line(hub, tmp_path, capsys, address):
    assert main(["pull", address, str(tmp_path / "back")]) == 2
    assert capsys.readouterr().err.startswith(f"Remote: {address}")
    assert list(tmp_path.glob("*back*")) == []


def test_a_hub_that_does_not_answer_is_one_line(hub, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    assert main(["pull", "me/arm", str(tmp_path / "back")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_somebody_elses_repository_is_not_written_over_nor_read(hub, dataset, tmp_path):
    hub.commit("datasets/me/stock", {"meta/info.json": b"{}"})
    for move in (lambda: push(dataset.path, "me/stock"), lambda: pull("me/stock", tmp_path / "back")):
        with pytest.raises(RemoteError, match="gaponet did not push it"):
            move()
    assert set(hub.files("datasets/me/stock")) == {"meta/info.json"}


def test_lerobots_tag_is_of_the_newest_push(hub, dataset, arm):
    push(dataset.path, "me/arm")
    first = dict(hub.tags["datasets/me/arm"])
    add(dataset, arm, ["new"])
    push(dataset.path, "me/arm")
    assert list(first) == ["v3.0"] == list(hub.tags["datasets/me/arm"])
    tagged = hub.tags["datasets/me/arm"]["v3.0"]
    assert tagged == hub.repos["datasets/me/arm"][-1][0] != first["v3.0"]


def test_who_pushed_meanwhile_is_not_written_over(hub, dataset, arm, monkeypatch):
    push(dataset.path, "me/arm")
    add(dataset, arm, ["new"])
    from gaponet.share.hub import Hub

    index = Hub.index

    def then_somebody_else(self, kind=None):
        found = index(self, kind)
        hub.commit("datasets/me/arm", hub.files("datasets/me/arm"))
        return found

    monkeypatch.setattr(Hub, "index", then_somebody_else)
    with pytest.raises(RemoteError, match="412"):
        push(dataset.path, "me/arm")


def test_a_folder_that_holds_something_and_one_that_is_neither_are_refused(dataset, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").touch()
    with pytest.raises(UsageError, match="not an empty folder"):
        pull("me/arm", tmp_path / "mine")
    with pytest.raises(UsageError, match="neither a dataset"):
        push(tmp_path / "mine", "me/arm")
    file = next((dataset.path / "sequences").iterdir())
    other = max((dataset.path / "sequences").iterdir())
    shutil.copyfile(other, file)
    with pytest.raises(DatasetError, match=r"by its hash|rows"):
        push(dataset.path, f"file://{tmp_path}/bucket")
