"""A stand-in of the Hugging Face Hub: the endpoints that huggingface_hub asks for push and pull,
over real HTTP.

Repositories are lists of commits, each a table path → bytes. Large files go through the LFS batch
endpoint.
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
REPO = r"/api/((?:datasets|models)/[^/]+/[^/]+)"
Files = dict[str, bytes]


class FakeHub(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server_port}"
        self.repos: dict[
            str, list[tuple[str, Files]]
        ] = {}  # "datasets/me/x" → commits, newest last
        self.tags: dict[str, dict[str, str]] = {}  # repository → tag → commit
        self.blobs: dict[str, bytes] = {}  # large files that arrived, by SHA-256
        self.sent: Counter[str] = Counter()  # large files uploaded, by SHA-256
        self.got: Counter[str] = Counter()  # files downloaded, by path
        threading.Thread(target=self.serve_forever, daemon=True).start()

    def files(self, repo: str) -> Files:
        return self.repos[repo][-1][1]

    def commit(self, repo: str, files: Files) -> str:
        oid = hashlib.sha1(f"{repo}{len(self.repos.get(repo, []))}".encode()).hexdigest()
        self.repos.setdefault(repo, []).append((oid, files))
        return oid


def upload_mode(path: str) -> dict[str, object]:
    """How the Hub wants to have a file."""
    mode = "lfs" if path.endswith(LARGE) else "regular"
    return {"path": path, "uploadMode": mode, "shouldIgnore": False}


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: FakeHub

    def log_message(self, *args: object) -> None:
        pass

    def answer(
        self, value: object = None, status: int = 200, headers: dict[str, str] | None = None
    ) -> None:
        body = value if isinstance(value, bytes) else json.dumps(value).encode()
        self.send_response(status)
        for name, text in {"Content-Length": str(len(body)), **(headers or {})}.items():
            self.send_header(name, text)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def body(self) -> bytes:
        if self.headers.get("Transfer-Encoding") != "chunked":
            return self.rfile.read(int(self.headers.get("Content-Length", 0)))
        data = b""
        while size := int(self.rfile.readline(), 16):
            data += self.rfile.read(size)
            self.rfile.readline()
        self.rfile.readline()
        return data

    def refuse(self, status: int, code: str) -> None:
        self.answer({"error": code}, status, {"X-Error-Code": code, "X-Error-Message": code})

    def at(self, repo: str, revision: str) -> tuple[str, Files] | None:
        """A commit, by its hash, its tag or the name of its branch; answers where there is none."""
        commits = self.server.repos.get(repo)
        revision = self.server.tags.get(repo, {}).get(revision, revision)
        found = [c for c in commits or () if c[0] == revision] or (commits or [])[-1:] * (
            revision == "main"
        )
        if not found:
            self.refuse(404, "RepoNotFound" if commits is None else "RevisionNotFound")
        return found[0] if found else None

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        path = unquote(urlsplit(self.path).path)
        if m := re.fullmatch(rf"{REPO}(?:/revision/([^/]+))?", path):
            if found := self.at(m[1], m[2] or "main"):
                files = [
                    {"rfilename": name, "size": len(content)} for name, content in found[1].items()
                ]
                self.answer(
                    {
                        "id": m[1].partition("/")[2],
                        "sha": found[0],
                        "siblings": files,
                        "private": False,
                    }
                )
        elif m := re.fullmatch(rf"{REPO}/tree/([^/]+)", path):
            if found := self.at(m[1], m[2]):
                self.answer([entry(name, content) for name, content in sorted(found[1].items())])
        elif m := re.fullmatch(r"/(datasets/)?([^/]+/[^/]+)/resolve/([^/]+)/(.+)", path):
            if found := self.at(f"{m[1] or 'models/'}{m[2]}", m[3]):
                self.resolve(found, m[4])
        else:
            self.refuse(404, "EntryNotFound")

    def resolve(self, commit: tuple[str, Files], name: str) -> None:
        content = commit[1].get(name)
        if content is None:
            self.refuse(404, "EntryNotFound")
            return
        self.server.got[name] += self.command == "GET"
        self.answer(content, 200, {"X-Repo-Commit": commit[0], "ETag": f'"{etag(name, content)}"'})

    def do_DELETE(self) -> None:
        m = re.fullmatch(rf"{REPO}/tag/([^/]+)", unquote(urlsplit(self.path).path))
        if m and self.server.tags.get(m[1], {}).pop(m[2], None):
            self.answer({})
        else:
            self.refuse(404, "RevisionNotFound")

    def do_PUT(self) -> None:
        oid = self.path.rpartition("/")[2]
        data = self.body()
        assert hashlib.sha256(data).hexdigest() == oid
        self.server.blobs[oid] = data
        self.server.sent[oid] += 1
        self.answer({})

    def do_POST(self) -> None:
        path = unquote(urlsplit(self.path).path)
        data = self.body()
        if path == "/api/repos/create":
            self.create(json.loads(data))
        elif path == "/api/validate-yaml":
            self.answer({"errors": [], "warnings": []})
        elif re.fullmatch(rf"{REPO}/preupload/[^/]+", path):
            self.answer({"files": [upload_mode(f["path"]) for f in json.loads(data)["files"]]})
        elif re.fullmatch(r"/(datasets/)?([^/]+/[^/]+)\.git/info/lfs/objects/batch", path):
            objects = [self.batch(o) for o in json.loads(data)["objects"]]
            self.answer({"transfer": "basic", "objects": objects})
        elif m := re.fullmatch(rf"{REPO}/tag/([^/]+)", path):
            if found := self.at(m[1], m[2]):
                self.server.tags.setdefault(m[1], {})[json.loads(data)["tag"]] = found[0]
                self.answer({})
        elif m := re.fullmatch(rf"{REPO}/commit/([^/]+)", path):
            if found := self.at(m[1], m[2]):
                self.commit(m[1], found, [json.loads(line) for line in data.splitlines()])
        else:
            self.refuse(404, "NotFound")

    def create(self, asked: dict[str, str]) -> None:
        repo = f"{asked.get('type', 'model')}s/{asked['organization']}/{asked['name']}"
        there = repo in self.server.repos
        if not there:
            self.server.commit(repo, {".gitattributes": b"*.parquet filter=lfs\n"})
        url = f"{self.server.url}/{repo.removeprefix('models/')}"
        self.answer({"url": url}, 409 if there else 200)

    def batch(self, asked: dict[str, object]) -> dict[str, object]:
        upload = {"upload": {"href": f"{self.server.url}/lfs/{asked['oid']}"}}
        return asked if asked["oid"] in self.server.blobs else asked | {"actions": upload}

    def commit(
        self, repo: str, parent: tuple[str, Files], lines: list[dict[str, dict[str, str]]]
    ) -> None:
        files = dict(parent[1])
        for line in lines:
            key = line["key"]
            value = line["value"]
            if key == "header" and value.get("parentCommit", parent[0]) != parent[0]:
                self.refuse(412, "ParentCommitChanged")
                return
            if key == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            elif key == "lfsFile":
                files[value["path"]] = self.server.blobs[value["oid"]]
            elif key == "deletedFile":
                del files[value["path"]]
        oid = self.server.commit(repo, files)
        self.answer(
            {
                "commitUrl": f"{self.server.url}/{repo}/commit/{oid}",
                "commitOid": oid,
                "hookOutput": "",
            }
        )


def etag(name: str, content: bytes) -> str:
    """As the Hub: a large file's SHA-256, git's hash of any other."""
    if name.endswith(LARGE):
        return hashlib.sha256(content).hexdigest()
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()


def entry(name: str, content: bytes) -> dict[str, object]:
    """A line of a listing."""
    found: dict[str, object] = {
        "type": "file",
        "path": name,
        "size": len(content),
        "oid": etag(name, content),
    }
    if name.endswith(LARGE):
        found["lfs"] = {"oid": etag(name, content), "size": len(content), "pointerSize": 130}
    return found
