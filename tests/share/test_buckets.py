"""Push, pull and reading from afar against SeaweedFS (S3) and a stand-in of GCS, both on loopback: make buckets."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from bucket_servers import BUCKET, KEY, SECRET, Wire, google, seaweed
from logs import arm_sequence, late

from gaponet.data.store import Dataset
from gaponet.share.bucket import Bucket

pytestmark = pytest.mark.peers

ROWS = (1_100_000, 300_000, 500_000)  # more than a row group holds; 84 and 30 MB before packing, so two files
BOUND = 400  # s in which whatever fails must have failed


@dataclass(frozen=True)
class Place:
    """A bucket behind a wire."""

    kind: str
    wire: Wire

    def address(self, name: str, bucket: str = BUCKET, port: int = 0) -> str:
        user = "anonymous@" if self.kind == "gs" else ""
        where = f"scheme=http&endpoint_override=127.0.0.1:{port or self.wire.port}"
        return f"{self.kind}://{user}{bucket}/{name}?{where}"


@pytest.fixture(scope="module", params=["s3", "gs"])
def place(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    start = {"s3": seaweed, "gs": google}[request.param]
    with start(tmp_path_factory.mktemp(request.param)) as wire, pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ACCESS_KEY_ID", KEY)
        patch.setenv("AWS_SECRET_ACCESS_KEY", SECRET)
        patch.setenv("AWS_REGION", "us-east-1")
        yield Place(request.param, wire)


@pytest.fixture(autouse=True)
def nothing_held(place: Place) -> None:
    place.wire.let_all_pass()


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Noise, which no compression makes small."""
    from arm import write_arm

    folder, rng = tmp_path_factory.mktemp("logs"), np.random.default_rng(0)
    arm = write_arm(folder / "robots" / "arm")
    data = Dataset.create(folder / "walks", arm)
    for i, rows in enumerate(ROWS):
        ctrl = rng.uniform(-0.5, 0.5, (rows, 2))
        data.append(arm_sequence(arm, ctrl, late(ctrl, 1), f"walk {i}", 0.0))
    return data


def gaponet(*command: str | Path, **env: str) -> subprocess.CompletedProcess[str]:
    """A command in a process of its own, which must end in time."""
    words = [sys.executable, "-m", "gaponet", *map(str, command)]
    return subprocess.run(words, capture_output=True, text=True, timeout=BOUND, env=os.environ | env)


def killed_on_the_wire(wire: Wire, *command: str | Path) -> None:
    process = subprocess.Popen([sys.executable, "-m", "gaponet", *map(str, command)], stderr=subprocess.PIPE)
    assert wire.holding.wait(BOUND), process.communicate()
    process.send_signal(signal.SIGKILL)
    process.wait()
    time.sleep(0.2)
    wire.let_all_pass()


def objects(address: str) -> dict[str, tuple[int, object]]:
    """What is there: size and time by name."""
    from pyarrow.fs import FileSelector

    bucket = Bucket(address)
    found = bucket.files.get_file_info(FileSelector(bucket.root, recursive=True, allow_not_found=True))
    return {one.path: (one.size, one.mtime) for one in found if one.is_file}


def same(one: Dataset, other: Dataset) -> None:
    """Every sequence by its content hash, computed from samples."""
    assert {e.id for e in one.entries} == {e.id for e in other.entries}
    for entry in one.entries:
        assert other.read(other.find(entry.hash)).content_hash() == entry.hash


def test_killed_in_the_middle_push_and_pull_go_on_and_every_hash_is_right(place, dataset, tmp_path):
    address, wire, back = place.address("walks"), place.wire, tmp_path / "back"
    wire.hold_up = 68e6  # of about 80: within the second file
    killed_on_the_wire(wire, "push", dataset.path, address)
    left = objects(address)
    assert left
    assert not [name for name in left if name.endswith("gaponet.json")]
    assert "nothing was pushed there" in gaponet("pull", address, back).stderr
    wire.let_all_pass()
    assert not gaponet("push", dataset.path, address).returncode
    sent, there = wire.up, objects(address)
    assert {name: there[name] for name in left} == left  # not sent again
    sizes = sorted(size for size, _ in there.values())
    assert sent < sum(sizes) - sum(size for size, _ in left.values()) + 2e6
    assert 15e6 < sizes[-2] < sizes[-1] < 105e6
    wire.let_all_pass()
    wire.hold_down = 60e6
    killed_on_the_wire(wire, "pull", address, back)
    assert not back.exists()
    files = (f.stat().st_size for f in (tmp_path / ".gaponet-pull-back" / "files").rglob("*") if f.is_file())
    arrived = sum(size for size in files if size in sizes)
    assert arrived
    assert not gaponet("pull", address, back).returncode
    assert wire.down < sum(sizes) - arrived + 2e6
    same(dataset, Dataset(back))
    assert wire.asked <= {"GET", "HEAD", "PUT", "POST"}  # nothing is deleted, copied (renamed) or composed (appended)


READ = """
import sys
import gaponet as gp
dataset, _ = gp.open_dataset(sys.argv[1])
for entry in dataset.entries:
    if entry.rows <= int(sys.argv[2]):
        assert dataset.read(entry).content_hash() == entry.hash
"""


def test_a_recording_is_read_without_the_others(place, dataset):
    address = place.address("walks")
    assert not gaponet("push", dataset.path, address).returncode
    came = []
    for longest in (0, min(ROWS), max(ROWS)):
        place.wire.let_all_pass()
        subprocess.run([sys.executable, "-c", READ, address, str(longest)], check=True, timeout=BOUND)
        came.append(place.wire.down)
    assert came[0] < 1e6
    assert 28 * min(ROWS) < came[1] - came[0] < 60 * min(ROWS) + 5e6  # what is in a row, packed and not
    assert came[2] - came[0] > 28 * sum(ROWS)


def test_a_place_that_cannot_be_written_or_read_is_one_line_in_a_bounded_time(place, dataset, tmp_path):
    def refused(word: str, address: str, **env: str) -> None:
        for command in (("push", dataset.path, address), ("pull", address, tmp_path / "x"), ("doctor", address)):
            done = gaponet(*command, **env)
            assert done.returncode == 2, done.stderr
            last = done.stderr.splitlines()[-1]
            assert re.match(rf"Remote: {place.kind}://[a-z]+/walks: .*{word}", last), last
        assert not (tmp_path / "x").exists()

    refused("no bucket 'nobody'", place.address("walks", "nobody"))
    refused("[Cc]ould not connect", place.address("walks", port=9))
    if place.kind == "s3":  # the stand-in of GCS lets in anybody
        refused("ACCESS_DENIED", place.address("walks"), AWS_SECRET_ACCESS_KEY="wrong")
        refused("ACCESS_DENIED", place.address("walks"), AWS_ACCESS_KEY_ID="nobody")
    else:
        refused("access token", place.address("walks").replace("anonymous@", ""))


def test_a_server_that_never_answers_is_given_up(place, tmp_path):
    place.wire.hold_up = 0
    done = gaponet("pull", place.address("walks"), tmp_path / "x")
    assert done.returncode == 2
    assert re.search(r"Timeout was reached|too slow", done.stderr)


def test_the_endpoint_may_stand_in_the_environment(place):
    url = f"http://127.0.0.1:{place.wire.port}"
    name = {"s3": "AWS_ENDPOINT_URL", "gs": "CLOUD_STORAGE_EMULATOR_ENDPOINT"}[place.kind]
    done = gaponet("pull", place.address("nothing").partition("?")[0], "x", **{name: url})
    assert "nothing was pushed there" in done.stderr
