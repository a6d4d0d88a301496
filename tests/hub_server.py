"""A stand-in of the Hugging Face Hub: the endpoints that huggingface_hub asks for push and pull, over real HTTP.

Repositories are lists of commits, each a table path → bytes; large files go through the LFS batch endpoint and are kept
by hash. It counts what was sent, and can hold a client in the middle of a transfer until it is killed.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
import threading
from collections import Counter
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlsplit

LARGE = (".parquet", ".onnx", ".npz", ".pt")  # as the Hub's .gitattributes of a new repository
Files = dict[str, bytes]


class FakeHub(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server_port}"
        self.repos: dict[str, list[tuple[str, Files]]] = {}  # "datasets/me/x" → commits, newest last
        self.tags: dict[str, dict[str, str]] = {}  # repository → tag → commit
        self.blobs: dict[str, bytes] = {}  # large files that arrived, by SHA-256
        self.sent: Counter[str] = Counter()  # large files uploaded, by SHA-256
        self.got: Counter[str] = Counter()  # files downloaded whole, by path
        self.hold_after = -1  # transfers of large files that pass before the others wait; -1: all pass
        self.holding, self.passed = threading.Event(), 0
        self.go_on, self.lock = threading.Event(), threading.Lock()
        self.lie: dict[str, bytes] = {}  # path → what is served in its place
        threading.Thread(target=self.serve_forever, daemon=True).start()

    def files(self, repo: str) -> Files:
        return self.repos[repo][-1][1]

    def commit(self, repo: str, files: Files) -> str:
        oid = hashlib.sha1(f"{repo}{len(self.repos.get(repo, []))}".encode()).hexdigest()
        self.repos.setdefault(repo, []).append((oid, files))
        return oid

    def may_pass(self) -> None:
        """Wait here if enough has passed."""
        with self.lock:
            held = 0 <= self.hold_after <= self.passed
            self.passed += 1
        if held:  # what is held never arrives
            self.holding.set()
            self.go_on.wait(60)
            raise ConnectionAbortedError

    def let_all_pass(self) -> None:
        self.hold_after, self.passed = -1, 0
        self.go_on.set()


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: FakeHub

    def log_message(self, *args: object) -> None:
        pass

    def handle_one_request(self) -> None:
        try:
            super().handle_one_request()
        except (ConnectionError, ValueError):  # the client was killed
            self.close_connection = True

    def answer(self, value: object = None, status: int = 200, headers: dict[str, str] | None = None) -> None:
        body = value if isinstance(value, bytes) else json.dumps(value).encode()
        self.send_response(status)
        for name, text in {"Content-Length": str(len(body)), **(headers or {})}.items():
            self.send_header(name, text)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def body(self) -> bytes:
        if self.headers.get("Transfer-Encoding") == "chunked":
            data = b""
            while size := int(self.rfile.readline(), 16):
                data += self.rfile.read(size)
                self.rfile.readline()
            self.rfile.readline()
            return data
        return self.rfile.read(int(self.headers.get("Content-Length", 0)))

    def refuse(self, status: int, code: str) -> None:
        self.answer({"error": code}, status, {"X-Error-Code": code, "X-Error-Message": code})

    def at(self, repo: str, revision: str) -> tuple[str, Files] | None:
        """A commit, by its hash, its tag or by the name of its branch."""
        commits = self.server.repos.get(repo)
        revision = self.server.tags.get(repo, {}).get(revision, revision)
        if commits is None:
            self.refuse(404, "RepoNotFound")
            return None
        found = [c for c in commits if c[0] == revision] or (commits[-1:] if revision == "main" else [])
        if not found:
            self.refuse(404, "RevisionNotFound")
            return None
        return found[0]

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        path = unquote(urlsplit(self.path).path)
        if m := re.fullmatch(r"/api/((?:datasets|models)/[^/]+/[^/]+)(?:/revision/([^/]+))?", path):
            if found := self.at(m[1], m[2] or "main"):
                self.answer({"id": m[1].partition("/")[2], "sha": found[0], "siblings": [], "private": False})
        elif m := re.fullmatch(r"/api/((?:datasets|models)/[^/]+/[^/]+)/tree/([^/]+)", path):
            if found := self.at(m[1], m[2]):
                self.answer([entry(name, content) for name, content in sorted(found[1].items())])
        elif m := re.fullmatch(r"/(datasets/)?([^/]+/[^/]+)/resolve/([^/]+)/(.+)", path):
            self.resolve(f"{m[1] or 'models/'}{m[2]}", m[3], m[4])
        else:
            self.refuse(404, "EntryNotFound")

    def resolve(self, repo: str, revision: str, name: str) -> None:
        found = self.at(repo, revision)
        if found is None:
            return
        if name not in found[1]:
            self.refuse(404, "EntryNotFound")
            return
        content = self.server.lie.get(name, found[1][name])
        headers = {"X-Repo-Commit": found[0], "ETag": f'"{etag(name, content)}"', "Accept-Ranges": "bytes"}
        begin = re.fullmatch(r"bytes=(\d+)-", self.headers.get("Range", ""))
        if self.command == "GET":
            if name.endswith(LARGE):
                self.server.may_pass()
            self.server.got[name] += 1
        if begin:
            headers["Content-Range"] = f"bytes {begin[1]}-{len(content) - 1}/{len(content)}"
            self.answer(content[int(begin[1]) :], 206, headers)
        else:
            self.answer(content, 200, headers)

    def do_DELETE(self) -> None:
        m = re.fullmatch(r"/api/((?:datasets|models)/[^/]+/[^/]+)/tag/([^/]+)", unquote(urlsplit(self.path).path))
        if m and self.server.tags.get(m[1], {}).pop(m[2], None):
            self.answer({})
        else:
            self.refuse(404, "RevisionNotFound")

    def do_PUT(self) -> None:
        oid = self.path.rpartition("/")[2]
        data = self.body()
        self.server.may_pass()
        if hashlib.sha256(data).hexdigest() != oid:
            self.refuse(400, "BadHash")
            return
        self.server.blobs[oid] = data
        self.server.sent[oid] += 1
        self.answer({})

    def do_POST(self) -> None:
        path, data = unquote(urlsplit(self.path).path), self.body()
        if path == "/api/repos/create":
            asked = json.loads(data)
            repo = f"{asked.get('type', 'model')}s/{asked['organization']}/{asked['name']}"
            if repo in self.server.repos:
                self.answer({"error": "exists", "url": f"{self.server.url}/{repo}"}, 409)
                return
            self.server.commit(repo, {".gitattributes": b"*.parquet filter=lfs\n"})
            self.answer({"url": f"{self.server.url}/{repo.removeprefix('models/')}"})
        elif path == "/api/validate-yaml":
            self.answer({"errors": [], "warnings": []})
        elif m := re.fullmatch(r"/api/((?:datasets|models)/[^/]+/[^/]+)/preupload/[^/]+", path):
            if self.at(m[1], "main"):
                self.answer({"files": [
                    {"path": f["path"], "uploadMode": "lfs" if f["path"].endswith(LARGE) else "regular",
                     "shouldIgnore": False} for f in json.loads(data)["files"]
                ]})  # fmt: skip
        elif m := re.fullmatch(r"/(datasets/)?([^/]+/[^/]+)\.git/info/lfs/objects/batch", path):
            self.answer({"transfer": "basic", "objects": [self.batch(o) for o in json.loads(data)["objects"]]})
        elif m := re.fullmatch(r"/api/((?:datasets|models)/[^/]+/[^/]+)/tag/([^/]+)", path):
            tags, tag = self.server.tags.setdefault(m[1], {}), json.loads(data)["tag"]
            if tag in tags:
                self.refuse(409, "Conflict")
            elif found := self.at(m[1], m[2]):
                tags[tag] = found[0]
                self.answer({})
        elif m := re.fullmatch(r"/api/((?:datasets|models)/[^/]+/[^/]+)/commit/([^/]+)", path):
            self.commit(m[1], m[2], [json.loads(line) for line in data.splitlines()])
        else:
            self.refuse(404, "NotFound")

    def batch(self, asked: dict[str, object]) -> dict[str, object]:
        oid = str(asked["oid"])
        upload = {"upload": {"href": f"{self.server.url}/lfs/{oid}"}}
        return asked if oid in self.server.blobs else asked | {"actions": upload}

    def commit(self, repo: str, revision: str, lines: list[dict[str, object]]) -> None:
        found = self.at(repo, revision)
        if found is None:
            return
        files = dict(found[1])
        for line in lines:
            value = line["value"]
            assert isinstance(value, dict)
            if line["key"] == "header" and value.get("parentCommit", found[0]) != found[0]:
                self.refuse(412, "ParentCommitChanged")
                return
            if line["key"] == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            elif line["key"] == "lfsFile":
                files[value["path"]] = self.server.blobs[value["oid"]]
            elif line["key"] == "deletedFile":
                del files[value["path"]]
        oid = self.server.commit(repo, files)
        self.answer({"commitUrl": f"{self.server.url}/{repo}/commit/{oid}", "commitOid": oid, "hookOutput": ""})


def etag(name: str, content: bytes) -> str:
    """As the Hub: a large file's SHA-256, git's hash of any other."""
    if name.endswith(LARGE):
        return hashlib.sha256(content).hexdigest()
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()


def entry(name: str, content: bytes) -> dict[str, object]:
    """A line of a listing."""
    found: dict[str, object] = {"type": "file", "path": name, "size": len(content), "oid": "0" * 40}
    if name.endswith(LARGE):
        found["lfs"] = {"oid": etag(name, content), "size": len(content), "pointerSize": 130}
    return found
