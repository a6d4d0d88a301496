"""Push and pull against SeaweedFS (S3) and a stand-in of GCS, both on loopback: make buckets."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from bucket_servers import BUCKET, KEY, SECRET, Wire, google, seaweed
from logs import arm_sequence, late

from gaponet.data.store import Dataset
from gaponet.share.bucket import Bucket

pytestmark = pytest.mark.peers

ROWS = (1_100_000, 300_000, 500_000)  # 84 and 30 MB before packing, so two files
BOUND = 200  # s after which a command that is still running fails the test
ENDPOINT = {"s3": "AWS_ENDPOINT_URL", "gs": "STORAGE_EMULATOR_HOST"}


@pytest.fixture(scope="module", params=["s3", "gs"])
def wire(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Wire]:
    start = {"s3": seaweed, "gs": google}[request.param]
    with (
        start(tmp_path_factory.mktemp(request.param)) as wire,
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setenv("AWS_ACCESS_KEY_ID", KEY)
        patch.setenv("AWS_SECRET_ACCESS_KEY", SECRET)
        patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        patch.setenv(ENDPOINT[request.param], f"http://127.0.0.1:{wire.port}")
        wire.scheme = request.param
        yield wire


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
    return subprocess.run(
        words, capture_output=True, text=True, timeout=BOUND, env=os.environ | env
    )


def killed_on_the_wire(wire: Wire, *command: str | Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "gaponet", *map(str, command)], stderr=subprocess.PIPE
    )
    assert wire.holding.wait(BOUND), process.communicate()
    process.send_signal(signal.SIGKILL)
    process.wait()
    wire.let_all_pass()


def test_killed_in_the_middle_push_and_pull_go_on_and_every_hash_is_right(wire, dataset, tmp_path):
    address, back = f"{wire.scheme}://{BUCKET}/walks", tmp_path / "back"
    wire.let_all_pass()
    wire.hold_up = 68e6  # of about 80: within the last file
    killed_on_the_wire(wire, "push", dataset.path, address)
    assert "nothing was pushed there" in gaponet("pull", address, back).stderr
    sizes = lambda: {path: info["size"] for path, info in Bucket(address)._objects().items()}  # noqa: E731
    left = sizes()
    done = gaponet("push", dataset.path, address)
    assert not done.returncode, done.stderr
    there = sizes()
    assert left.items() <= there.items()
    assert wire.up < sum(there.values()) - sum(left.values()) + 2e6
    wire.let_all_pass()
    wire.hold_down = 60e6
    killed_on_the_wire(wire, "pull", address, back)
    files = (
        f
        for f in (tmp_path / ".gaponet-pull-back").rglob("*.parquet")
        if f.stat().st_size in there.values()
    )
    arrived = sum(file.stat().st_size for file in files)
    done = gaponet("pull", address, back)
    assert not done.returncode, done.stderr
    assert wire.down < sum(there.values()) - arrived + 2e6
    assert {e.hash for e in Dataset(back).entries} == {e.hash for e in dataset.entries}
    assert (
        "\n0 files of earlier pushes were deleted"
        in gaponet("push", dataset.path, address, "--prune").stdout
    )


def test_of_two_indexes_written_at_the_same_time_the_server_takes_the_first(wire):
    wire.let_all_pass()
    first, second = (Bucket(f"{wire.scheme}://{BUCKET}/race") for _ in range(2))
    for text in ("1", "2"):  # a new index, then the next one
        before = first.index()
        assert second.index() == before
        first._replace_index(before, text)
        with pytest.raises(OSError):  # noqa: PT011
            second._replace_index(before, "lost")
        assert second.index() == text.encode()


def test_a_place_that_cannot_be_read_is_one_line_in_a_bounded_time(wire, tmp_path):
    def refused(word: str, bucket: str = BUCKET, **env: str) -> None:
        address = f"{wire.scheme}://{bucket}/walks"
        done = gaponet("pull", address, tmp_path / "x", **env)
        assert done.returncode == 2, done.stderr
        last = done.stderr.splitlines()[-1]
        assert re.match(rf"Remote: {address}: .*{word}", last), last
        assert not (tmp_path / "x").exists()

    wire.let_all_pass()
    refused("no bucket 'nobody'", "nobody")
    refused("[Cc]onnect", **{ENDPOINT[wire.scheme]: "http://127.0.0.1:9"})
    with socket.create_server(("127.0.0.1", 0), backlog=100) as silent:
        refused(
            "[Tt]imeout", **{ENDPOINT[wire.scheme]: f"http://127.0.0.1:{silent.getsockname()[1]}"}
        )
    if wire.scheme == "s3":  # the stand-in of GCS lets in anybody
        refused("no permission", AWS_SECRET_ACCESS_KEY="wrong")
        refused("no permission", AWS_ACCESS_KEY_ID="nobody")
