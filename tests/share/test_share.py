"""Push and pull: what comes back is what was sent, by every hash, and nothing is sent twice."""

import json
import shutil
from dataclasses import replace

import pyarrow.parquet as pq
import pytest
from runs import untrained

from gaponet.base.errors import DatasetError, UsageError
from gaponet.base.network import RemoteError, network_errors
from gaponet.cli.main import main
from gaponet.data.store import Dataset, dataset_hash
from gaponet.nn.artifact import GapModel
from gaponet.share import dataset as datasets
from gaponet.share.hub import Hub
from gaponet.share.push_pull import pull, push
from gaponet.share.remote import FileRecord, Index

from .conftest import add, same


@pytest.fixture
def run(arm, dataset, tmp_path):
    folder = untrained(
        tmp_path / "run", arm, dataset, train=("wave 0",), val=("wave 1",), test=("wave 2",)
    )
    config = {
        "model": {"kind": "gaponet"},
        "ppo": {"num_envs": 1, "epochs": 1, "std": 0.1},
        "seed": 0,
        "robot": "arm",
        "dataset": "arm_logs",
        "dataset_hash": dataset_hash(dataset.entries),
    }
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


def test_what_would_be_lost_is_replaced_only_when_asked(dataset, arm, run, place, tmp_path):
    shutil.copytree(dataset.path, tmp_path / "small")
    add(dataset, arm, ["new"])
    push(dataset.path, place)
    with pytest.raises(RemoteError, match="lost"):
        push(tmp_path / "small", place)
    push(tmp_path / "small", place, replace=True)
    pull(place, tmp_path / "back")
    same(Dataset(tmp_path / "small"), Dataset(tmp_path / "back"))


def test_a_pull_into_a_dataset_brings_what_it_lacks_and_touches_nothing_else(
    dataset, arm, place, tmp_path, capsys
):
    back = tmp_path / "back"
    split = back / "splits" / "motion.json"
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
    monkeypatch.setattr("gaponet.data.writers.lerobot.USUAL_SHARE", 0.0)


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


def test_a_pushed_dataset_does_not_say_where_its_robots_recordings_lie(hub, dataset, tmp_path):
    (tmp_path / "anna" / "logs").mkdir(parents=True)
    origin = {
        "dataset": "../../anna/logs",
        "parts": {"train": {}, "val": {}, "test": {}},
        "motions": {},
        "val_mpjae": {},
    }
    (dataset.path / "robot" / "identified.json").write_text(json.dumps(origin))
    push(dataset.path, "me/arm")
    pushed = json.loads(hub.files("datasets/me/arm")["gaponet/robot/identified.json"])
    assert pushed["dataset"] == "logs"


def test_a_dataset_appears_under_its_name_when_it_is_complete(
    dataset, place, tmp_path, monkeypatch
):
    push(dataset.path, place)
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


def test_the_same_recording_under_another_name_is_the_one_that_is_there(
    dataset, arm, place, tmp_path
):
    renamed = Dataset.create(tmp_path / "renamed", arm)
    for entry in dataset.entries:
        sequence = dataset.read(entry)
        renamed.append(
            replace(sequence, meta=replace(sequence.meta, motion=f"my {entry.meta.motion}"))
        )
    push(dataset.path, place)
    pull(place, tmp_path / "theirs")
    push(renamed.path, place)
    assert pull(place, tmp_path / "theirs").files == 0


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


def test_a_damaged_recording_is_not_pushed(dataset, place):
    first, *_, last = sorted((dataset.path / "sequences").iterdir())
    shutil.copyfile(last, first)
    with pytest.raises(DatasetError, match=r"by its hash|rows"):
        push(dataset.path, place)


def test_more_than_the_disk_holds_is_refused_before_anything_is_fetched(
    hub, dataset, tmp_path, monkeypatch
):
    push(dataset.path, "me/arm")
    usage = shutil.disk_usage(tmp_path)._replace(free=1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: usage)
    with pytest.raises(RemoteError, match="disk"):
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


def test_of_a_dataset_that_grew_only_the_new_files_are_sent_and_fetched(
    many_files, dataset, arm, hub, tmp_path
):
    push(dataset.path, "me/arm")
    pull("me/arm", tmp_path / "back")
    sent = len(hub.sent)
    hub.got.clear()
    add(dataset, arm, ["new"])
    push(dataset.path, "me/arm")
    pull("me/arm", tmp_path / "back")
    assert len(hub.sent) == sent + 3  # its data file, the lists of episodes and of tasks
    assert set(hub.sent.values()) == {1}
    assert sum("/data/" in name for name in hub.got) == 1
    assert len(Dataset(tmp_path / "back")) == len(dataset)


def test_a_pull_that_was_killed_goes_on_with_the_files_that_arrived(
    many_files, dataset, hub, tmp_path, monkeypatch
):
    push(dataset.path, "me/arm")
    missing_files = datasets.missing_files

    def killed(*given):
        raise KeyboardInterrupt

    monkeypatch.setattr(datasets, "missing_files", killed)
    with pytest.raises(KeyboardInterrupt):
        pull("me/arm", tmp_path / "back")
    arrived = set(hub.got)
    hub.got.clear()
    monkeypatch.setattr(datasets, "missing_files", missing_files)
    pull("me/arm", tmp_path / "back")
    assert arrived
    assert arrived & set(hub.got) <= {"gaponet.json"}
    same(dataset, Dataset(tmp_path / "back"))


def test_of_two_simultaneous_pushes_the_slower_one_gets_one_error_and_replaces_nothing(
    place, dataset, arm, tmp_path, monkeypatch, capsys
):
    store = Hub.store
    other = Dataset.create(tmp_path / "other", arm)
    add(other, arm, ["elsewhere"], unit_id="another")
    push(dataset.path, place)
    add(dataset, arm, ["new"])

    def after_another_push(self, *given):
        monkeypatch.setattr(Hub, "store", store)
        push(other.path, place, replace=True)
        return store(self, *given)

    monkeypatch.setattr(Hub, "store", after_another_push)
    assert main(["push", str(dataset.path), place]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith(f"Remote: {place}: somebody else pushed at the same time")
    pull(place, tmp_path / "theirs")
    same(other, Dataset(tmp_path / "theirs"))


def test_of_two_first_pushes_to_the_hub_the_slower_one_gets_the_error_too(
    hub, dataset, arm, tmp_path
):
    other = Dataset.create(tmp_path / "other", arm)
    add(other, arm, ["elsewhere"])
    remote = Hub("me/arm")
    assert remote.pushed_index("dataset") is None
    push(other.path, "me/arm")
    index = Index(1, "dataset", "arm", ("a",), {"x": FileRecord(1, "0" * 64)})
    with pytest.raises(RemoteError, match="time"):
        remote.store(tmp_path, index, False)


@pytest.mark.parametrize(
    ("address", "error"),
    [
        ("me/none", "no dataset, run or robot there"),
        ("not a repo/x y", "Repo id"),
        ("ftp://x/y", "not on the Hub"),
        ("s3://robots/arm", "aws s3 sync"),
    ],
)
def test_an_address_of_nothing_is_one_line(hub, tmp_path, capsys, address, error):
    assert main(["pull", address, str(tmp_path / "back")]) == 2
    line = capsys.readouterr().err
    assert line.startswith(f"Remote: {address}: ")
    assert error in line
    assert line.count("\n") == 1
    assert list(tmp_path.glob("*back*")) == []


def test_what_gaponet_did_not_push_is_neither_written_over_nor_read(hub, dataset, tmp_path):
    hub.commit("datasets/me/stock", {"meta/info.json": b"{}"})
    for move in (
        lambda: push(dataset.path, "me/stock"),
        lambda: pull("me/stock", tmp_path / "back"),
    ):
        with pytest.raises(RemoteError, match="push"):
            move()
    assert set(hub.files("datasets/me/stock")) == {"meta/info.json"}


def test_a_folder_of_something_else_is_neither_pushed_nor_filled(hub, tmp_path):
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "thesis.txt").touch()
    with pytest.raises(UsageError, match="empty"):
        pull("me/arm", folder)
    with pytest.raises(UsageError, match="dataset"):
        push(folder, "me/arm")


@pytest.mark.parametrize(("change", "error"), HOSTILE, ids=range(len(HOSTILE)))
def test_a_hostile_index_is_refused_in_one_line(hub, place, tmp_path, capsys, change, error):
    index = {"format": 1, "kind": "dataset", "name": "arm", "contents": ["a"], "files": {"x": GOOD}}
    hub.commit("datasets/me/arm", {"gaponet.json": json.dumps(index | change).encode()})
    assert main(["pull", place, str(tmp_path / "back")]) == 2
    line = capsys.readouterr().err
    assert line.startswith(f"Remote: {place}: ")
    assert error in line
    assert line.count("\n") == 1
    assert list(tmp_path.glob("*back*")) == []


def test_a_run_with_a_file_that_no_run_has_or_another_network_is_refused(
    run, place, forge, tmp_path
):
    push(run, place)
    forge(lambda index, put, read: put("report.html", b"<script>"), "models/me/arm")
    with pytest.raises(RemoteError, match=r"report\.html"):
        pull(place, tmp_path / "back")
    forge(
        lambda index, put, read: (
            index["files"].pop("report.html"),
            put("model/model.onnx", b"no network"),
        ),
        "models/me/arm",
    )
    with pytest.raises(RemoteError, match="network"):
        pull(place, tmp_path / "back")
    assert not (tmp_path / "back").exists()


def test_samples_that_were_changed_are_refused(dataset, place, forge, tmp_path):
    push(dataset.path, place)

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
    with pytest.raises(RemoteError, match="slow"):
        pull(place, tmp_path / "back")
    assert not (tmp_path / "back").exists()


def file_with(index, part):
    return next(name for name in index["files"] if part in name)


def another_content(index, put, read):
    index["contents"][0] = "0" * 64


def no_shard(index, put, read):
    del index["files"][file_with(index, "/data/")]


def a_robot_that_includes(index, put, read):
    put("gaponet/robot/robot.xml", b'<mujoco><include file="/etc/passwd"/></mujoco>')


def no_robot(index, put, read):
    put("gaponet/robot/robot.xml", b"<mujoco>")


def no_file_of_ours(index, put, read):
    del index["files"][file_with(index, "meta/gaponet.json")]


def a_cut_file(index, put, read):
    data = file_with(index, "/data/")
    put(data, read(data)[:-100])


def another_kind(index, put, read):
    index["kind"] = "run"


def another_file(index, put, read):
    index["files"][file_with(index, "/data/")]["sha256"] = "0" * 64


CHANGES = [
    another_content,
    no_shard,
    a_robot_that_includes,
    no_robot,
    no_file_of_ours,
    a_cut_file,
    another_kind,
    another_file,
]


def assert_pull_refuses_in_one_line(place, back, capsys):
    assert main(["pull", place, str(back)]) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith(f"Remote: {place}: ")
    assert ".gaponet-" not in line
    assert not back.exists()


@pytest.mark.parametrize("change", CHANGES)
def test_a_place_with_other_content_than_its_index_says_is_one_line(
    dataset, place, forge, tmp_path, capsys, change
):
    push(dataset.path, place)
    forge(change)
    assert_pull_refuses_in_one_line(place, tmp_path / "back", capsys)


def test_a_place_with_half_an_index_is_one_line(dataset, place, hub, tmp_path, capsys):
    push(dataset.path, place)
    files = hub.files("datasets/me/arm")
    hub.commit("datasets/me/arm", files | {"gaponet.json": files["gaponet.json"][:300]})
    assert_pull_refuses_in_one_line(place, tmp_path / "back", capsys)
