"""Public recordings from a server of this machine: complete and right, or one clear line."""

import gzip
import hashlib
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from gaponet.base.errors import UsageError
from gaponet.base.network import RemoteError
from gaponet.cli.main import main
from gaponet.share.public_recordings import PublicFiles
from gaponet.share.remote import FileRecord

CONTENT = {f"arm/motion-{i}/control.csv": f"recording {i}\n".encode() * 100 for i in range(5)}


class Server(ThreadingHTTPServer):
    """Serves `content`; `requested` lists the paths that were asked for.

    A path in `cut` ends in the middle.
    """

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.content = dict(CONTENT)
        self.cut = set()
        self.requested = []
        threading.Thread(target=self.serve_forever, daemon=True).start()


class Handler(BaseHTTPRequestHandler):
    def do_GET(self):
        path = self.path.removeprefix("/")
        self.server.requested.append(path)
        if path not in self.server.content:
            self.send_error(404)
            return
        body = gzip.compress(self.server.content[path])
        self.send_response(200)
        self.send_header("Content-Encoding", "gzip")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body[: len(body) // 2] if path in self.server.cut else body)

    def log_message(self, *words):
        pass


@pytest.fixture
def server():
    server = Server()
    yield server
    server.shutdown()
    server.server_close()


@pytest.fixture
def public(server, monkeypatch, tmp_path):
    """A data set of five files at the server, in an empty cache."""
    monkeypatch.delenv("GAPONET_DATA", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    records = {
        path: FileRecord(len(content), hashlib.sha256(content).hexdigest())
        for path, content in CONTENT.items()
    }
    address = f"http://127.0.0.1:{server.server_port}"
    return PublicFiles(folder="set/real", address=address, origin="made for tests", files=records)


def present(folder):
    return {
        file.relative_to(folder).as_posix(): file.read_bytes() for file in folder.rglob("*.csv")
    }


def test_all_files_come_into_the_cache(public, tmp_path):
    folder = public.provide()
    assert folder == tmp_path / "cache/gaponet/set/real"
    assert present(folder) == CONTENT


def test_what_is_there_is_not_fetched_again(public, server):
    public.provide()
    server.requested.clear()
    public.provide()
    assert server.requested == []


def test_an_interrupted_download_goes_on_with_what_is_missing(public, server, tmp_path):
    last = sorted(CONTENT)[-1]
    del server.content[last]
    with pytest.raises(RemoteError):
        public.provide()
    server.content = dict(CONTENT)
    missing = public.missing_in(tmp_path / "cache/gaponet/set/real")
    server.requested.clear()
    public.provide()
    assert last in missing
    assert sorted(server.requested) == sorted(missing)


def test_a_file_that_ends_early_is_not_kept(public, server, tmp_path):
    name = "arm/motion-0/control.csv"
    server.cut = {name}
    with pytest.raises(RemoteError):
        public.provide()
    assert not (tmp_path / "cache/gaponet/set/real" / name).exists()
    server.cut = set()
    assert present(public.provide()) == CONTENT


@pytest.mark.parametrize("other", [b"", b"recording 9\n" * 100, b"x" * 1_000_000])
def test_a_file_with_another_hash_is_refused(public, server, tmp_path, other):
    name = "arm/motion-3/control.csv"
    server.content[name] = other
    with pytest.raises(RemoteError, match="SHA-256"):
        public.provide()
    assert not (tmp_path / "cache/gaponet/set/real" / name).exists()


def test_a_file_that_somebody_changed_in_the_cache_is_fetched_again(public):
    folder = public.provide()
    (folder / "arm/motion-1/control.csv").write_bytes(b"changed")
    assert present(public.provide()) == CONTENT


def test_a_folder_of_the_user_needs_no_network(public, server, monkeypatch, tmp_path):
    for path, content in CONTENT.items():
        file = tmp_path / "mine/set/real" / path
        file.parent.mkdir(parents=True)
        file.write_bytes(content)
    monkeypatch.setenv("GAPONET_DATA", str(tmp_path / "mine"))
    assert public.provide() == tmp_path / "mine/set/real"
    assert server.requested == []


def test_a_folder_of_the_user_with_other_files_is_refused(public, monkeypatch, tmp_path):
    monkeypatch.setenv("GAPONET_DATA", str(tmp_path))
    with pytest.raises(UsageError, match="GAPONET_DATA"):
        public.provide()


def test_the_progress_ends_with_all_bytes(public):
    seen = []
    public.provide(lambda done, total, note: seen.append((done, total)))
    total = sum(map(len, CONTENT.values()))
    assert seen[-1] == (total, total)


def test_without_a_network_the_demo_says_so_in_one_line(
    public, server, monkeypatch, capsys, tmp_path
):
    server.shutdown()
    server.server_close()
    monkeypatch.setattr(PublicFiles, "read", lambda: public)
    assert main(["demo", "--real", "--out", str(tmp_path / "out")]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if "Remote" in line]
    assert len(lines) == 1
    assert "GAPONET_DATA" in lines[0]


def test_the_list_of_the_package_is_that_of_the_public_recordings(sage_so101):
    assert PublicFiles.read().missing_in(sage_so101 / "real") == []
