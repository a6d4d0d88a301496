"""One controller per robot on a computer, whoever uses it."""

import os
import subprocess
import sys

import pytest

from gaponet.base.errors import UsageError
from gaponet.hw.control import publisher
from gaponet.hw.control.publisher import sole_publisher

TRY = """
import fcntl, os, sys
sys.path[:0] = sys.argv[2:]
from gaponet.hw.control.publisher import sole_publisher
from gaponet.base.errors import UsageError
os.setgid(65534), os.setuid(65534)
try:
    with sole_publisher(sys.argv[1]):
        print("held")
except UsageError as error:
    print(error)
"""


def as_another_user(address: str) -> str:
    command = [sys.executable, "-c", TRY, address, *sys.path]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")
@pytest.mark.parametrize("mask", [0o022, 0o077])
def test_the_lock_works_for_the_next_user_of_the_computer(mask):
    address = f"test {os.getpid()} {mask}"
    path = publisher.LOCK_FOLDER / f"gaponet-{address.replace(' ', '-')}.lock"
    before = os.umask(mask)
    try:
        with sole_publisher(address):
            assert "another process commands this robot" in as_another_user(address)
        assert as_another_user(address) == "held\n"
    finally:
        os.umask(before)
        path.unlink()


def test_a_link_or_a_pipe_in_place_of_the_lock_is_refused_at_once(tmp_path, monkeypatch):
    monkeypatch.setattr(publisher, "LOCK_FOLDER", tmp_path)
    lock = tmp_path / "gaponet-arm.lock"
    lock.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UsageError, match="opened"), sole_publisher("arm"):
        pass
    assert not (tmp_path / "elsewhere").exists()
    lock.unlink()
    os.mkfifo(lock)
    with pytest.raises(UsageError, match="regular"), sole_publisher("arm"):
        pass


def test_a_port_has_one_lock_whatever_name_leads_to_it(tmp_path):
    ours, theirs = os.openpty()
    port = os.ttyname(theirs)
    link = tmp_path / "so101"
    link.symlink_to(port)
    try:
        with sole_publisher(str(link)):
            for name in (port, str(link), f"/dev/pts/../pts/{os.path.basename(port)}"):
                with (
                    pytest.raises(UsageError, match="commands"),
                    sole_publisher(name),
                ):
                    pass
    finally:
        os.close(ours), os.close(theirs)
