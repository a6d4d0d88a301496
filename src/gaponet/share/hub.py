"""Repositories of the Hugging Face Hub: datasets as dataset repositories, runs as model repositories.

A push is one commit. huggingface_hub uploads the files that the Hub does not have, and retries and resumes transfers.
"""

from __future__ import annotations

import glob
import os
from contextlib import suppress
from pathlib import Path

from gaponet.data.formats.lerobot_set import VERSION as LEROBOT_TAG
from gaponet.share.errors import RemoteError
from gaponet.share.target import INDEX, MAX_INDEX_BYTES, Index, Kind, reaching

TYPES: dict[Kind, str] = {"dataset": "dataset", "run": "model"}
BORN_WITH = {".gitattributes", "README.md"}  # files of a new repository


class Hub:
    """A `Target` on the Hub, or wherever HF_ENDPOINT points; HF_TOKEN or `hf auth login` says who pushes."""

    def __init__(self, address: str) -> None:
        """
        Args:
            address: USER/NAME, with @REVISION behind it for another branch, tag or commit than main.
        """
        from huggingface_hub import HfApi

        self.address = address
        self.repo, _, revision = address.removeprefix("hf://").removeprefix("datasets/").partition("@")
        self.api, self.revision = HfApi(os.environ.get("HF_ENDPOINT")), revision or "main"
        self.type = self.commit = ""
        self._sizes: dict[str, int | None] = {}

    def index(self, kind: Kind | None = None) -> bytes | None:
        from huggingface_hub.errors import RepositoryNotFoundError

        for wanted in TYPES.values() if kind is None else (TYPES[kind],):
            with suppress(RepositoryNotFoundError), reaching(self.address, RepositoryNotFoundError):
                info = self.api.repo_info(self.repo, repo_type=wanted, revision=self.revision, files_metadata=True)
                self.type, self.commit = wanted, str(info.sha)
                self._sizes = {file.rfilename: file.size for file in getattr(info, "siblings", None) or ()}
                if (self._sizes.get(INDEX) or 0) > MAX_INDEX_BYTES:
                    raise RemoteError(f"{self.address}: {INDEX} has more than {MAX_INDEX_BYTES >> 20} MiB")
                if INDEX in self._sizes:
                    file = self.api.hf_hub_download(self.repo, INDEX, repo_type=wanted, revision=self.commit)
                    return Path(file).read_bytes()
                if self._sizes.keys() - BORN_WITH:
                    raise RemoteError(
                        f"{self.address}: the {wanted} repository holds files but no {INDEX}: gaponet did not push it; "
                        "a LeRobot set is fetched with: hf download --repo-type dataset, and read by gaponet import"
                    )
        if kind is None and not self.type:
            raise RemoteError(f"{self.address}: no dataset or run there that may be read; see hf auth login")
        return None

    def sizes(self, places: list[str], index: Index) -> list[int | None]:
        return [self._sizes.get(place) for place in places]

    def fetch(self, places: list[str], index: Index, folder: Path) -> None:
        names = [glob.escape(place) for place in places]
        with reaching(self.address):
            self.api.snapshot_download(
                self.repo, repo_type=self.type, revision=self.commit, local_dir=folder, allow_patterns=names
            )

    def store(self, folder: Path, index: Index, private: bool, replace: bool, prune: bool) -> int:
        from huggingface_hub import CommitOperationAdd, CommitOperationDelete
        from huggingface_hub.errors import RevisionNotFoundError

        kind, now = TYPES[index.kind], {*index.files, INDEX}
        gone = sorted(self._sizes.keys() - now - BORN_WITH)
        with reaching(self.address):
            if not self.type:
                self.api.create_repo(self.repo, repo_type=kind, private=private or None, exist_ok=True)
            self.api.create_commit(  # upload_folder may make several, and a reader would see a part
                self.repo,
                [CommitOperationAdd(place, str(folder / place)) for place in sorted(now)]
                + [CommitOperationDelete(place) for place in gone],
                commit_message=f"gaponet push: {index.kind} of {len(index.files)} files",
                repo_type=kind,
                revision=self.revision,
                parent_commit=self.commit or None,
            )
            if index.kind == "dataset" and self.revision == "main":  # LeRobot opens the tag of its version, not main
                with suppress(RevisionNotFoundError):
                    self.api.delete_tag(self.repo, tag=LEROBOT_TAG, repo_type=kind)
                self.api.create_tag(self.repo, tag=LEROBOT_TAG, repo_type=kind)
        return 0  # files that a commit deletes stay in the repository's history
