"""Repositories of the Hugging Face Hub: datasets as dataset repositories, runs as model repositories.

A push is one commit: large files go first, by their hash, and those that are there already are not sent again; nothing
changes before all are there. Everything on the network is huggingface_hub's own work.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import islice
from pathlib import Path
from typing import Any

from gaponet.data.formats.lerobot_set import VERSION as LEROBOT_TAG
from gaponet.share.errors import RemoteError
from gaponet.share.target import INDEX, LARGEST_INDEX, Anew, Index, Kind, Part, Pruned, reaching, written

TYPES: dict[Kind, str] = {"dataset": "dataset", "run": "model"}
MOST = 50_000  # files of a repository that are listed
BORN_WITH = {".gitattributes", "README.md"}  # files of a new repository


class Hub:
    """A `Target` on the Hub, or wherever HF_ENDPOINT points; HF_TOKEN or `hf auth login` says who pushes."""

    at_once = False

    def __init__(self, address: str) -> None:
        """
        Args:
            address: USER/NAME, with @REVISION behind it for another branch, tag or commit than main.
        """
        from huggingface_hub import HfApi

        self.address = address
        self.repo, _, revision = address.partition("@")
        self.api, self.revision = HfApi(os.environ.get("HF_ENDPOINT")), revision or "main"
        self.type, self.commit = "", ""
        self.sizes: dict[str, int] = {}
        self.large: dict[str, str] = {}  # SHA-256 of files that are stored by it
        self.adds: list[Any] = []

    def index(self, kind: Kind | None = None) -> bytes | None:
        from huggingface_hub.errors import RepositoryNotFoundError

        for wanted in TYPES.values() if kind is None else (TYPES[kind],):
            try:
                with self._reaching(RepositoryNotFoundError):
                    info = self.api.repo_info(self.repo, repo_type=wanted, revision=self.revision)
                    tree = self.api.list_repo_tree(self.repo, recursive=True, repo_type=wanted, revision=info.sha)
                    listed: list[Any] = [entry for entry in islice(tree, MOST) if hasattr(entry, "size")]
                    sizes = {entry.path: entry.size for entry in listed}
            except RepositoryNotFoundError:
                continue
            self.type, self.commit, self.sizes = wanted, str(info.sha), sizes
            self.large = {entry.path: entry.lfs.sha256 for entry in listed if entry.lfs}
            if INDEX in sizes:
                return self._small()
            if sizes.keys() - BORN_WITH:
                raise RemoteError(
                    f"{self.address}: the {wanted} repository holds files but no {INDEX}: gaponet did not push it; a "
                    "LeRobot set is fetched with: hf download --repo-type dataset, and read by gaponet import"
                )
            if kind is not None:
                return None
        if kind is None:
            raise RemoteError(
                f"{self.address}: no dataset or run there that may be read; private ones need hf auth login"
            )
        return None

    def _small(self) -> bytes:
        if self.sizes[INDEX] > LARGEST_INDEX:
            raise RemoteError(f"{self.address}: {INDEX} has more than {LARGEST_INDEX >> 20} MiB")
        with tempfile.TemporaryDirectory() as folder, self._reaching():
            return Path(self._download(INDEX, folder)).read_bytes()

    def holds(self, path: str, part: Part, anew: Anew) -> bool:
        return anew != "all" and self.large.get(path) == part.sha256  # the Hub looked at that itself

    def send(self, path: str, file: Path, part: Part) -> None:
        from huggingface_hub import CommitOperationAdd

        self.adds.append(CommitOperationAdd(path, str(file)))

    def store(self, kind: Kind, index: Index, private: bool, there: bytes | None) -> None:
        from huggingface_hub import CommitOperationAdd, CommitOperationDelete
        from huggingface_hub.errors import RevisionNotFoundError

        adds = [*self.adds, CommitOperationAdd(INDEX, written(index))]
        gone = self.sizes.keys() - index.files.keys() - {INDEX} - BORN_WITH
        with self._reaching():
            if not self.type:
                self.api.create_repo(self.repo, repo_type=TYPES[kind], private=private or None, exist_ok=True)
            self.api.create_commit(
                self.repo,
                adds + [CommitOperationDelete(path) for path in sorted(gone)],
                commit_message=f"gaponet push: {kind} of {len(index.files)} files",
                repo_type=TYPES[kind],
                revision=self.revision,
                parent_commit=self.commit or None,  # whoever pushed meanwhile is not overwritten
            )
            if kind == "dataset" and self.revision == "main":  # LeRobot opens the newest tag of its version, not main
                with suppress(RevisionNotFoundError):
                    self.api.delete_tag(self.repo, tag=LEROBOT_TAG, repo_type=TYPES[kind])
                self.api.create_tag(self.repo, tag=LEROBOT_TAG, repo_type=TYPES[kind])

    def prune(self, named: set[str], hours: float, delete: bool) -> Pruned:
        return Pruned([], 0, 0)  # a commit takes files away, and the repository's history keeps them

    def fetch(self, path: str, part: Part, folder: Path) -> None:
        if self.sizes.get(path) != part.size:
            raise RemoteError(f"{self.address}: {path} is not there with {part.size:,} bytes as {INDEX} says")
        with self._reaching():
            self._download(path, folder)

    def _download(self, path: str, folder: str | Path) -> str:
        return self.api.hf_hub_download(self.repo, path, repo_type=self.type, revision=self.commit, local_dir=folder)

    @contextmanager
    def _reaching(self, *but: type[Exception]) -> Iterator[None]:
        from huggingface_hub import errors

        http: type[Exception] = errors.HTTPError  # of the client's HTTP library
        with reaching(self.address, http, errors.HFValidationError, RuntimeError, ValueError, but=but):
            yield
