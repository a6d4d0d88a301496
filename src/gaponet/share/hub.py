"""Repositories of the Hugging Face Hub: datasets as dataset repositories, runs as model repositories.

A push is one commit. huggingface_hub uploads only files that the Hub does not have; it retries and resumes transfers.
"""

from __future__ import annotations

import glob
import os
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

from gaponet.data.formats.lerobot_set import VERSION as LEROBOT_TAG
from gaponet.share.remote import (
    INDEX,
    MAX_INDEX_BYTES,
    Index,
    Kind,
    RemoteError,
    lost_race,
    network_errors,
)

REPOSITORY_TYPES: dict[Kind, str] = {"dataset": "dataset", "run": "model"}
INITIAL_FILES = {".gitattributes", "README.md"}  # of a new repository
PARENT_CHANGED = 412  # HTTP status of a commit whose parent is not the newest commit


class Hub:
    """A `Remote` on the Hub, or at HF_ENDPOINT; the token is HF_TOKEN or that of `hf auth login`."""

    def __init__(self, address: str) -> None:
        """
        Args:
            address: USER/NAME, with @REVISION behind it for another branch, tag or commit than main.
        """
        from huggingface_hub import HfApi

        self.address = address
        self.repo, _, revision = (
            address.removeprefix("hf://").removeprefix("datasets/").partition("@")
        )
        self.api, self.revision = HfApi(os.environ.get("HF_ENDPOINT")), revision or "main"
        self.type = self.commit = ""
        self._sizes: dict[str, int | None] = {}

    def index(self, kind: Kind | None = None) -> bytes | None:
        from huggingface_hub.errors import RepositoryNotFoundError

        for wanted in REPOSITORY_TYPES.values() if kind is None else (REPOSITORY_TYPES[kind],):
            with network_errors(self.address), suppress(RepositoryNotFoundError):
                info = self.api.repo_info(
                    self.repo, repo_type=wanted, revision=self.revision, files_metadata=True
                )
                self.type, self.commit = wanted, str(info.sha)
                self._sizes = {
                    file.rfilename: file.size for file in getattr(info, "siblings", None) or ()
                }
                if (self._sizes.get(INDEX) or 0) > MAX_INDEX_BYTES:
                    raise RemoteError(
                        f"{self.address}: {INDEX} has more than {MAX_INDEX_BYTES >> 20} MiB"
                    )
                if INDEX in self._sizes:
                    file = self.api.hf_hub_download(
                        self.repo, INDEX, repo_type=wanted, revision=self.commit
                    )
                    return Path(file).read_bytes()
                if self._sizes.keys() - INITIAL_FILES:
                    raise RemoteError(
                        f"{self.address}: the {wanted} repository holds files but no {INDEX}: gaponet did not push it; "
                        "a LeRobot set is fetched with: hf download --repo-type dataset, and read by gaponet import"
                    )
        if kind is None and not self.type:
            raise RemoteError(
                f"{self.address}: no dataset or run there that may be read; see hf auth login"
            )
        return None

    def sizes(self, paths: list[str], index: Index) -> list[int | None]:
        return [self._sizes.get(path) for path in paths]

    def outdated(self, index: Index) -> set[str]:
        return {
            path for path, record in index.files.items() if self._sizes.get(path) != record.size
        }

    def fetch(self, paths: list[str], index: Index, folder: Path) -> None:
        names = [glob.escape(path) for path in paths]
        with network_errors(self.address):
            self.api.snapshot_download(
                self.repo,
                repo_type=self.type,
                revision=self.commit,
                local_dir=folder,
                allow_patterns=names,
            )

    def store(self, folder: Path, index: Index, paths: Collection[str], private: bool) -> None:
        """Commit all files of the index; the Hub itself knows which of them are new (`paths` is not used)."""
        from huggingface_hub import CommitOperationAdd, CommitOperationDelete
        from huggingface_hub.errors import HfHubHTTPError, RevisionNotFoundError

        repo_type, files = REPOSITORY_TYPES[index.kind], {*index.files, INDEX}
        with network_errors(self.address):
            if not self.type:
                self.api.create_repo(
                    self.repo, repo_type=repo_type, private=private or None, exist_ok=True
                )
                if self.index(index.kind) is not None:
                    raise lost_race(self.address)
            removed = sorted(self._sizes.keys() - files - INITIAL_FILES)
            try:
                self.api.create_commit(  # upload_folder and upload_large_folder show readers a part of the new state
                    self.repo,
                    [CommitOperationAdd(path, str(folder / path)) for path in sorted(files)]
                    + [CommitOperationDelete(path) for path in removed],
                    commit_message=f"gaponet push: {index.kind} of {len(index.files)} files",
                    repo_type=repo_type,
                    revision=self.revision,
                    parent_commit=self.commit or None,
                )
            except HfHubHTTPError as error:
                if error.response.status_code == PARENT_CHANGED:
                    raise lost_race(self.address) from None
                raise
            # LeRobot opens the tag of its version, not main
            if index.kind == "dataset" and self.revision == "main":
                with suppress(RevisionNotFoundError):
                    self.api.delete_tag(self.repo, tag=LEROBOT_TAG, repo_type=repo_type)
                self.api.create_tag(self.repo, tag=LEROBOT_TAG, repo_type=repo_type, exist_ok=True)

    def prune(self, index: Index) -> int:
        """Return 0: files that a commit deletes stay in the history of the repository."""
        return 0
