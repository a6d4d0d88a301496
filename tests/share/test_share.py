"""Push and pull: what comes back is what was sent, by every hash, and nothing is sent twice."""

import json
import os
import shutil
from dataclasses import replace
from datetime import UTC, datetime
from types import SimpleNamespace

import pytest
from runs import untrained

from gaponet.base.errors import DatasetError, UsageError
from gaponet.cli.main import main
from gaponet.data.store import Dataset, dataset_hash
from gaponet.nn.artifact import GapModel
from gaponet.share.bucket import Bucket
from gaponet.share.hub import Hub
from gaponet.share.push_pull import pull, push
from gaponet.share.remote import FileRecord, Index, RemoteError, network_errors

from .conftest import add, same


@pytest.fixture
def run(arm, dataset, tmp_path):
    folder = untrained(
        tmp_path / "run", arm, dataset, train=("wave 0",), val=("wave 1",), test=("wave 2",)
    )
    config = {"model": {"kind": "gaponet"}, "ppo": {"num_envs": 1, "epochs": 1, "std": 0.1}, "seed": 0, "robot": "arm",
              "dataset": "arm_logs", "dataset_hash": dataset_hash(dataset.entries)}  # fmt: skip
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "report.html").write_text("<script>alert(1)</script>")
    return folder


def test_a_dataset_comes_back_by_every_hash_with_split_and_licence(dataset, place, tmp_path):
    assert main(["push", str(dataset.path), place, "--json"]) == 0
    assert main(["pull", place, str(tmp_path / "back")]) == 0
    back = Dataset(tmp_path / "back")
    same(dataset, back)
    assert back.header["licence"] == "CC-BY-4.0"
    split = "splits/motion.json"
    assert (back.path / split).read_bytes() == (dataset.path / split).read_bytes()
    assert list(tmp_path.glob(".gaponet-*")) == []


def test_a_run_comes_back_with_the_same_network_and_without_what_a_browser_would_run(
    run, place, tmp_path
):
    push(run, place)
    pull(place, tmp_path / "back")
    assert GapModel.load(tmp_path / "back").weights_hash() == GapModel.load(run).weights_hash()
    files = lambda folder: {  # noqa: E731
        f.relative_to(folder).as_posix() for f in folder.rglob("[!.]*") if f.is_file()
    }
    assert files(tmp_path / "back") == files(run) - {"report.html"} | {"README.md"}
    push(tmp_path / "back", place)


def test_what_would_be_lost_is_replaced_only_when_asked(dataset, arm, run, disk, tmp_path):
    shutil.copytree(dataset.path, tmp_path / "small")
    add(dataset, arm, ["new"])
    push(dataset.path, disk)
    with pytest.raises(RemoteError, match="holds 1 sequences that would be lost"):
        push(tmp_path / "small", disk)
    push(tmp_path / "small", disk, replace=True)
    pull(disk, tmp_path / "back")
    same(Dataset(tmp_path / "small"), Dataset(tmp_path / "back"))


def test_a_pull_into_a_dataset_brings_what_it_lacks_and_touches_nothing_else(
    dataset, arm, place, tmp_path, capsys
):
    back, split = tmp_path / "back", tmp_path / "back" / "splits" / "motion.json"
    push(dataset.path, place)
    pull(place, back)
    add(Dataset(back), arm, ["mine"], unit_id="mine")
    split.write_text("mine")
    add(dataset, arm, ["new", "newer"])
    push(dataset.path, place)
    pull(place, back)
    assert split.read_text() == "mine"
    assert {e.hash for e in Dataset(back).entries} > {e.hash for e in dataset.entries}
    assert len(Dataset(back)) == len(dataset) + 1
    assert main(["pull", place, str(back)]) == 0
    assert "nothing is there that" in capsys.readouterr().out


@pytest.fixture
def many_files(monkeypatch):
    """A data file holds one recording."""
    monkeypatch.setattr("gaponet.data.writers.lerobot.USUAL_MB", 1e-9)
    monkeypatch.setattr("gaponet.data.writers.lerobot.SHARE", 0.0)


def test_of_a_dataset_that_grew_the_new_files_are_sent_and_fetched(
    many_files, dataset, arm, hub, bucket, tmp_path
):
    bucket_place, objects = f"file://{bucket}", bucket / "sha256"
    for place in ("me/arm", bucket_place):
        push(dataset.path, place)
    pull(bucket_place, tmp_path / "back")
    sent, before = len(hub.sent), {file: file.stat().st_mtime_ns for file in objects.iterdir()}
    add(dataset, arm, ["new"])
    for place in ("me/arm", bucket_place):
        push(dataset.path, place)
    assert len(hub.sent) == sent + 3  # its data file, the lists of episodes and of tasks
    assert set(hub.sent.values()) == {1}
    assert before.items() < {file: file.stat().st_mtime_ns for file in objects.iterdir()}.items()
    moved = pull(bucket_place, tmp_path / "back")
    files = json.loads((bucket / "gaponet.json").read_text())["files"]
    assert moved.files == 1 + sum("/data/" not in name for name in files)


def test_on_the_hub_a_push_is_a_set_that_lerobot_reads_with_a_card_and_its_tag(hub, dataset, arm):
    push(dataset.path, "me/arm")
    files = hub.files("datasets/me/arm")
    readme = files["README.md"].decode()
    assert readme.startswith('---\ntask_categories: ["robotics"]\ntags: ["LeRobot", "gaponet"')
    assert 'license: "cc-by-4.0"' in readme
    assert "5 sequences" in readme
    assert len([name for name in files if name.endswith("meta/info.json")]) == 2  # one set per rate
    add(dataset, arm, ["new"])
    push(dataset.path, "me/arm")
    assert hub.tags["datasets/me/arm"] == {"v3.0": hub.repos["datasets/me/arm"][-1][0]}
    assert len(hub.repos["datasets/me/arm"]) == 3  # made, pushed, pushed


def test_a_push_mends_a_damaged_object_and_a_pull_continues_with_the_files_that_an_earlier_one_left(
    dataset, bucket, tmp_path
):
    place, folder = f"file://{bucket}", tmp_path / ".gaponet-pull-back"
    push(dataset.path, place)
    largest = max((bucket / "sha256").iterdir(), key=lambda file: file.stat().st_size)
    content = largest.read_bytes()
    largest.write_bytes(bytes([content[0] ^ 1]) + content[1:])
    with pytest.raises(RemoteError, match="is not the file that was pushed"):
        pull(place, tmp_path / "back")
    assert not (tmp_path / "back").exists()
    arrived = {file: file.stat().st_mtime_ns for file in folder.rglob("[!.]*.*") if file.is_file()}
    assert arrived
    push(dataset.path, place)
    assert largest.read_bytes() == content
    opened = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            shutil, "copyfile", lambda a, b, copy=shutil.copyfile: opened.append(b) or copy(a, b)
        )
        pull(place, tmp_path / "back")
    assert not {str(file) for file in arrived} & set(map(str, opened))
    same(dataset, Dataset(tmp_path / "back"))


def test_an_object_that_was_cut_short_is_sent_again(dataset, bucket, tmp_path):
    push(dataset.path, f"file://{bucket}")
    for file in (bucket / "sha256").iterdir():
        file.write_bytes(file.read_bytes()[:100])
    push(dataset.path, f"file://{bucket}")
    pull(f"file://{bucket}", tmp_path / "back")


def test_an_object_in_s3_is_sent_again_if_it_is_younger_than_the_index_that_lists_it(tmp_path):
    bucket, record = Bucket(f"file://{tmp_path}"), FileRecord(3, "0" * 64)
    bucket.scheme, bucket._index_info = "s3", {"LastModified": datetime(2026, 1, 2, tzinfo=UTC)}
    for day, listed, intact in ((1, True, True), (3, True, False), (3, False, True)):
        info = {"size": 3, "type": "file", "LastModified": datetime(2026, 1, day, tzinfo=UTC)}
        assert bucket._intact(info, record, listed) == intact


def test_an_index_is_replaced_on_condition_of_the_one_that_was_read(tmp_path):
    bucket, calls = Bucket(f"file://{tmp_path}"), []
    bucket.fs = SimpleNamespace(
        pipe_file=lambda path, data, **condition: calls.append(condition), _location="http://gcs",
        call=lambda method, url, **how: calls.append(how),
    )  # fmt: skip
    bucket._index_info = {"ETag": "tag", "generation": "7"}
    for bucket.scheme, before in (("s3", None), ("s3", b"1"), ("gs", b"1")):
        bucket._replace_index(before, "new text")
    assert calls[:2] == [{"IfNoneMatch": "*"}, {"IfMatch": "tag"}]
    assert calls[2]["ifGenerationMatch"] == "7"
    assert b"new text" in calls[2]["data"]


@pytest.mark.parametrize(
    ("written", "error"),
    [("", "server is down"), ("mine", ""), ("theirs", "somebody else pushed at the same time")],
)
def test_a_write_without_an_answer_counts_by_the_index_that_is_there(
    dataset, bucket, monkeypatch, written, error
):
    place, replace_index = f"file://{bucket}", Bucket._replace_index

    def fails(self, before, text):
        if written:
            replace_index(self, before, text if written == "mine" else "{}")
        raise OSError("server is down")

    monkeypatch.setattr(Bucket, "_replace_index", fails)
    if not error:
        push(dataset.path, place)
        return
    with pytest.raises(RemoteError, match=error):
        push(dataset.path, place)


def test_a_dataset_appears_under_its_name_when_it_is_complete(
    dataset, bucket, tmp_path, monkeypatch
):
    push(dataset.path, place := f"file://{bucket}")
    append = Dataset.append

    def killed(self, *given):
        if len(self) == 2:
            raise KeyboardInterrupt
        return append(self, *given)

    monkeypatch.setattr(Dataset, "append", killed)
    with pytest.raises(KeyboardInterrupt):
        pull(place, tmp_path / "back")
    assert not (tmp_path / "back").exists()
    monkeypatch.setattr(Dataset, "append", append)
    pull(place, tmp_path / "back")
    same(dataset, back := Dataset(tmp_path / "back"))
    assert back.header["licence"] == "CC-BY-4.0"


def test_a_push_with_nothing_new_reads_no_recording(dataset, place, tmp_path, monkeypatch):
    first = push(dataset.path, place)
    with monkeypatch.context() as patch:
        patch.setattr("gaponet.share.dataset.write", None)
        assert push(dataset.path, place) == first
    dataset.set_provenance(licence="MIT")
    push(dataset.path, place)
    pull(place, tmp_path / "back")
    assert Dataset(tmp_path / "back").header["licence"] == "MIT"


def test_prune_deletes_what_neither_this_push_nor_the_last_names_once_it_is_a_day_old(
    dataset, arm, bucket, tmp_path
):
    place, objects, states = f"file://{bucket}", bucket / "sha256", []
    for name in ("new", "newer", "newest"):
        for file in objects.glob("*") if name == "newest" else ():
            os.utime(file, (0, 0))
        add(dataset, arm, [name])
        moved = push(dataset.path, place, prune=True)
        states.append(
            {
                part["sha256"]
                for part in json.loads((bucket / "gaponet.json").read_text())["files"].values()
            }
        )
        assert moved.pruned == (len(states[0] - states[1]) if name == "newest" else 0)
    assert {file.name for file in objects.iterdir()} == states[1] | states[2]
    pull(place, tmp_path / "back")
    same(dataset, Dataset(tmp_path / "back"))


@pytest.mark.parametrize(
    ("remote", "step"),
    [(Bucket, "store"), (Bucket, "_replace_index"), (Hub, "store")],
    ids=lambda x: str(x),
)
def test_of_two_simultaneous_pushes_the_slower_one_gets_one_error_and_replaces_nothing(
    hub, dataset, arm, bucket, tmp_path, monkeypatch, capsys, remote, step
):
    place, own = {Bucket: f"file://{bucket}", Hub: "me/arm"}[remote], getattr(remote, step)
    other = Dataset.create(tmp_path / "other", arm)
    add(other, arm, ["elsewhere"], unit_id="another")
    if step != "_replace_index":  # otherwise both are the first push
        push(dataset.path, place)
        add(dataset, arm, ["new"])

    def after_another_push(self, *given):
        monkeypatch.setattr(remote, step, own)
        push(other.path, place, replace=True)
        return own(self, *given)

    monkeypatch.setattr(remote, step, after_another_push)
    assert main(["push", str(dataset.path), place]) == 2
    said = capsys.readouterr().err.splitlines()
    assert (
        said[-1]
        == f"Remote: {place}: somebody else pushed at the same time, and nothing was replaced; push again"
    )
    pull(place, tmp_path / "theirs")
    same(other, Dataset(tmp_path / "theirs"))


def test_of_two_first_pushes_to_the_hub_the_slower_one_gets_the_error_too(
    hub, dataset, arm, tmp_path
):
    other = Dataset.create(tmp_path / "other", arm)
    add(other, arm, ["elsewhere"])
    remote = Hub("me/arm")
    assert remote.index("dataset") is None
    push(other.path, "me/arm")
    with pytest.raises(RemoteError, match="somebody else pushed at the same time"):
        remote.store(
            tmp_path,
            Index(1, "dataset", "arm", ("a",), {"x": FileRecord(1, "0" * 64)}),
            ["x"],
            False,
        )


def test_the_same_recording_under_another_name_is_the_one_that_is_there(
    dataset, arm, disk, tmp_path
):
    renamed = Dataset.create(tmp_path / "renamed", arm)
    for entry in dataset.entries:
        sequence = dataset.read(entry)
        renamed.append(
            replace(sequence, meta=replace(sequence.meta, motion=f"my {entry.meta.motion}"))
        )
    push(dataset.path, disk)
    pull(disk, tmp_path / "theirs")
    push(renamed.path, disk)
    assert pull(disk, tmp_path / "theirs").files == 0


@pytest.mark.parametrize(
    ("address", "error"),
    [
        ("me/none", "no dataset or run there"),
        ("not a repo/x y", "Repo id"),
        ("ftp://x/y", "no such place"),
        ("s3:///", "no such place"),
        ("file:///tmp/x::s3://y", "no such place"),
        ("file:///nowhere/at/all", "nothing was pushed there"),
        ("s3://KEY:SEC/RET@robots/arm", "an address holds no keys"),
    ],
)
def test_an_address_of_nothing_is_one_line_without_keys(hub, tmp_path, capsys, address, error):
    for command in (["pull", address, str(tmp_path / "back")], ["doctor", address]):
        if command[0] == "pull" or "://" in address:
            assert main(command) == 2
            line = capsys.readouterr().err
            assert line.startswith(f"Remote: {address.replace('KEY:SEC/RET@', '')}: ")
            assert error in line
            assert line.count("\n") == 1
    assert list(tmp_path.glob("*back*")) == []


def test_no_error_shows_keys_or_the_signature_of_a_link():
    link = "https://KEY:SECRET@host/file?X-Amz-Signature=SECRET"
    with (
        pytest.raises(RemoteError, match=r"^me/arm: 403 for https://host/file\?…$"),
        network_errors("me/arm"),
    ):
        raise OSError(f"403 for {link}")


def test_a_mistake_in_the_program_is_not_reported_as_an_error_of_the_network():
    with pytest.raises(AttributeError), network_errors("me/arm"):
        None.nothing  # noqa: B018


def test_a_hub_that_does_not_answer_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    assert main(["pull", "me/arm", str(tmp_path / "back")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_what_gaponet_did_not_push_is_neither_written_over_nor_read(hub, dataset, bucket, tmp_path):
    hub.commit("datasets/me/stock", {"meta/info.json": b"{}"})
    bucket.mkdir(parents=True)
    (bucket / "thesis.txt").touch()
    for place in ("me/stock", f"file://{bucket}"):
        for move in (lambda: push(dataset.path, place), lambda: pull(place, tmp_path / "back")):  # noqa: B023
            with pytest.raises(RemoteError, match="gaponet did not push it"):
                move()
    assert set(hub.files("datasets/me/stock")) == {"meta/info.json"}
    with pytest.raises(UsageError, match="not an empty folder"):
        pull("me/stock", bucket)
    with pytest.raises(UsageError, match="neither a dataset"):
        push(bucket, "me/stock")


def test_a_damaged_recording_is_not_pushed(dataset, bucket):
    first, *_, last = sorted((dataset.path / "sequences").iterdir())
    shutil.copyfile(last, first)
    with pytest.raises(DatasetError, match=r"by its hash|rows"):
        push(dataset.path, f"file://{bucket}")


def test_more_than_the_disk_holds_is_refused_before_anything_is_fetched(
    hub, dataset, tmp_path, monkeypatch
):
    push(dataset.path, "me/arm")
    usage = shutil.disk_usage(tmp_path)._replace(free=1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: usage)
    with pytest.raises(RemoteError, match="GB of the disk are free"):
        pull("me/arm", tmp_path / "back")
    assert set(hub.got) == {"gaponet.json"}


GOOD = {"size": 1, "sha256": "0" * 64}
NAMES = (
    "../x",
    "/x",
    "a/../../x",
    "a//x",
    ".ssh/x",
    "a\\x",
    "C:x",
    "x\n",
    "a/" * 9 + "x",
    "gaponet.json",
    "a" * 401,
)
DIGESTS = ("../" * 19 + "etc/pwd", "A" * 64, "0" * 63 + " ", "0" * 65)
HOSTILE = [
    *(({"files": {name: GOOD}}, "is not the name of a file inside a folder") for name in NAMES),
    *(
        ({"files": {"x": GOOD | {"sha256": text}}}, "should be the 64 lowercase hex digits")
        for text in DIGESTS
    ),
    ({"files": {"arm/y": GOOD, "ARM/y": GOOD}}, "differ in capitals"),
    ({"files": {"arm": GOOD, "arm/y": GOOD}}, "'arm' is a file and a folder"),
    ({"files": {str(i): GOOD for i in range(20_001)}}, "files: "),
    ({"files": {}}, "files: "),
    ({"files": [["x", GOOD]]}, "files: "),
    ({"files": {"x": GOOD | {"size": 1 << 41}}}, "size: "),
    ({"files": {"x": GOOD | {"size": "1"}}}, "size: "),
    ({"files": {"x": GOOD | {"size": -1}}}, "size: "),
    ({"contents": ["a"] * 1_000_001}, "contents: "),
    ({"contents": "a"}, "contents: "),
    ({"contents": [1]}, "contents"),
    ({"name": "../x"}, "name: "),
    ({"name": None}, "name: "),
    ({"kind": "model"}, "kind: "),
    ({"format": "1"}, "format: "),
    ({"format": 2}, "is newer than this gaponet reads"),
    ({"more": 1}, "more: "),
]


@pytest.mark.parametrize(("change", "error"), HOSTILE, ids=range(len(HOSTILE)))
def test_a_hostile_index_is_refused_in_one_line(bucket, tmp_path, capsys, change, error):
    index = {"format": 1, "kind": "dataset", "name": "arm", "contents": ["a"], "files": {"x": GOOD}}
    bucket.mkdir(parents=True)
    (bucket / "gaponet.json").write_text(json.dumps(index | change))
    assert main(["pull", f"file://{bucket}", str(tmp_path / "back")]) == 2
    line = capsys.readouterr().err
    assert line.startswith(f"Remote: file://{bucket}: ")
    assert error in line
    assert line.count("\n") == 1
    assert list(tmp_path.glob("*back*")) == []


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="Windows has no named pipes")
@pytest.mark.parametrize(
    "make", [os.mkfifo, lambda path: path.symlink_to("/dev/zero")], ids=["pipe", "device"]
)
def test_an_index_that_is_a_pipe_or_a_device_is_not_read(bucket, tmp_path, make):
    bucket.mkdir(parents=True)
    make(bucket / "gaponet.json")
    with pytest.raises(RemoteError, match=r"nothing was pushed there|gaponet did not push it"):
        pull(f"file://{bucket}", tmp_path / "back")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="Windows has no named pipes")
@pytest.mark.parametrize(
    "make", [os.mkfifo, lambda path: path.symlink_to("/etc/hostname")], ids=["pipe", "link"]
)
def test_an_object_that_is_a_pipe_or_a_link_is_not_read(bucket, tmp_path, make):
    size = 0 if make is os.mkfifo else os.stat("/etc/hostname").st_size
    index = {
        "format": 1,
        "kind": "dataset",
        "name": "arm",
        "contents": ["a"],
        "files": {"x": GOOD | {"size": size}},
    }
    (bucket / "sha256").mkdir(parents=True)
    (bucket / "gaponet.json").write_text(json.dumps(index))
    make(bucket / "sha256" / GOOD["sha256"])
    with pytest.raises(RemoteError, match="is not the file that was pushed"):
        pull(f"file://{bucket}", tmp_path / "back")


def test_a_run_with_a_file_that_no_run_has_or_another_network_is_refused(
    run, bucket, forge, tmp_path
):
    push(run, place := f"file://{bucket}")
    forge(lambda index, put, read: put("report.html", b"<script>"))
    with pytest.raises(RemoteError, match=r"report\.html: a run has no such file"):
        pull(place, tmp_path / "back")
    forge(
        lambda index, put, read: (
            index["files"].pop("report.html"),
            put("model/model.onnx", b"no network"),
        )
    )
    with pytest.raises(RemoteError, match="not the network that was pushed"):
        pull(place, tmp_path / "back")
    assert not (tmp_path / "back").exists()
