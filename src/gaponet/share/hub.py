"""Repositories of the Hugging Face Hub: datasets as dataset repositories, runs and robots as model
repositories.

A push is one commit. huggingface_hub uploads only files that the Hub does not have; it retries and
resumes transfers.
"""

from __future__ import annotations

import glob
import os
from contextlib import suppress
from pathlib import Path

from gaponet.base.network import RemoteError, network_errors
from gaponet.data.formats.lerobot_set import VERSION as LEROBOT_TAG
from gaponet.share.remote import (
    INDEX,
    MAX_INDEX_BYTES,
    Index,
    Kind,
    lost_race,
    require_pushed_files,
    require_space,
)

REPOSITORY_TYPES: dict[Kind, str] = {"dataset": "dataset", "run": "model", "robot": "model"}
INITIAL_FILES = {".gitattributes", "README.md"}  # of a new repository
PARENT_CHANGED = 412  # HTTP status of a commit whose parent is not the newest commit


class Hub:
    """A repository of the Hub, or at HF_ENDPOINT; the token is HF_TOKEN or that of `hf auth login`.

    Its methods raise RemoteError for errors of network and place.

    Attributes:
        repo: USER/NAME.
        revision: Branch, tag or commit.
        type: Type of the repository, a value of REPOSITORY_TYPES; "" until `pushed_index` has found
            it.
        commit: Newest commit of the revision when `pushed_index` was called; "" before.
    """

    def __init__(self, address: str) -> None:
        """
        Args:
            address: USER/NAME, with @REVISION behind it for another branch, tag or commit than
                main.

        Raises:
            RemoteError: It is the address of something else.
        """
        from huggingface_hub import HfApi

        scheme, separator, _ = address.partition("://")
        if separator and scheme != "hf":
            raise RemoteError(
                f"{address}: not on the Hub; a dataset is a folder, which the tools of other "
                "places copy as it is, such as aws s3 sync"
            )

        self.address = address
        self.repo, _, revision = (
            address.removeprefix("hf://").removeprefix("datasets/").partition("@")
        )
        self.api = HfApi(os.environ.get("HF_ENDPOINT"))
        self.revision = revision or "main"
        self.type = ""
        self.commit = ""
        self._sizes: dict[str, int | None] = {}  # file at the commit → bytes

    def pushed_index(self, kind: Kind | None = None) -> bytes | None:
        """Return the content of gaponet.json; None if nothing was pushed.

        The methods below are about the repository and the commit that were found here.

        Args:
            kind: Look in the repository of this kind only; default: in all that have the name.
        """
        from huggingface_hub.errors import RepositoryNotFoundError

        types = ["dataset", "model"]
        if kind is not None:
            types = [REPOSITORY_TYPES[kind]]
        for repo_type in types:
            with network_errors(self.address), suppress(RepositoryNotFoundError):
                self._look_at(repo_type)
                if INDEX in self._sizes:
                    return self._read_index()
                self._require_unused()
        if kind is None and not self.type:
            raise RemoteError(
                f"{self.address}: no dataset, run or robot there that may be read; see hf auth "
                "login"
            )
        return None

    def _look_at(self, repo_type: str) -> None:
        """Find the newest commit of a repository, and the sizes of its files."""
        info = self.api.repo_info(
            self.repo, repo_type=repo_type, revision=self.revision, files_metadata=True
        )
        self.type = repo_type
        self.commit = str(info.sha)
        files = getattr(info, "siblings", None) or ()
        self._sizes = {file.rfilename: file.size for file in files}

    def _read_index(self) -> bytes:
        """Download gaponet.json of the newest commit."""
        if (self._sizes[INDEX] or 0) > MAX_INDEX_BYTES:
            raise RemoteError(f"{self.address}: {INDEX} has more than {MAX_INDEX_BYTES >> 20} MiB")
        file = self.api.hf_hub_download(self.repo, INDEX, repo_type=self.type, revision=self.commit)
        return Path(file).read_bytes()

    def _require_unused(self) -> None:
        """Refuse a repository into which something else was put."""
        if self._sizes.keys() - INITIAL_FILES:
            raise RemoteError(
                f"{self.address}: the {self.type} repository holds files but no {INDEX}: "
                "gaponet did not push it; a LeRobot set is fetched with: hf download "
                "--repo-type dataset, and read by gaponet import"
            )

    def is_outdated(self, index: Index) -> bool:
        """Return True if a file of the index is missing at the Hub or has another size there."""
        return any(self._sizes.get(path) != file.size for path, file in index.files.items())

    def download(self, paths: list[str], index: Index, folder: Path) -> None:
        """Download files of the index into a folder; those that an earlier download left there are
        kept.

        Raises:
            RemoteError: A file is missing or differs, or the disk is too small.
        """
        require_space(self.address, index.size(paths), folder)
        if missing := set(paths) - self._sizes.keys():
            raise RemoteError(f"{self.address}: {min(missing)} is missing; push it again")
        with network_errors(self.address):
            self.api.snapshot_download(
                self.repo,
                repo_type=self.type,
                revision=self.commit,
                local_dir=folder,
                allow_patterns=[glob.escape(path) for path in paths],
            )
        require_pushed_files(self.address, index, paths, folder)

    def store(self, folder: Path, index: Index, private: bool) -> None:
        """Replace the files of the repository by those of the index, in one commit.

        A repository that `pushed_index` did not find is created. The Hub itself knows which files
        are new.

        Args:
            folder: Folder with the files of the index, and with gaponet.json.
            private: Make a new repository readable by its owner only.

        Raises:
            RemoteError: Somebody else pushed since `pushed_index` was called.
        """
        with network_errors(self.address):
            if not self.type:
                self._create(index.kind, private)
            self._commit(folder, index)
            if index.kind == "dataset" and self.revision == "main":
                self._move_lerobot_tag()

    def _create(self, kind: Kind, private: bool) -> None:
        """Create the repository, and look at it: somebody else may have been faster."""
        self.api.create_repo(
            self.repo,
            repo_type=REPOSITORY_TYPES[kind],
            private=private or None,  # None: as the owner's settings say
            exist_ok=True,
        )
        if self.pushed_index(kind) is not None:
            raise lost_race(self.address)

    def _commit(self, folder: Path, index: Index) -> None:
        """Add all files of the index, and delete all others, if nobody has pushed meanwhile."""
        from huggingface_hub import CommitOperationAdd, CommitOperationDelete
        from huggingface_hub.errors import HfHubHTTPError

        files = {*index.files, INDEX}
        removed = sorted(self._sizes.keys() - files - INITIAL_FILES)
        additions = [CommitOperationAdd(path, str(folder / path)) for path in sorted(files)]
        deletions = [CommitOperationDelete(path) for path in removed]
        try:
            # upload_folder and upload_large_folder show readers a part of the new state
            self.api.create_commit(
                self.repo,
                [*additions, *deletions],
                commit_message=f"gaponet push: {index.kind} of {len(index.files)} files",
                repo_type=REPOSITORY_TYPES[index.kind],
                revision=self.revision,
                parent_commit=self.commit or None,
            )
        except HfHubHTTPError as error:
            if error.response.status_code == PARENT_CHANGED:
                raise lost_race(self.address) from None
            raise

    def _move_lerobot_tag(self) -> None:
        """Let the tag of LeRobot's version name the newest commit: LeRobot opens it, not main."""
        from huggingface_hub.errors import RevisionNotFoundError

        with suppress(RevisionNotFoundError):
            self.api.delete_tag(self.repo, tag=LEROBOT_TAG, repo_type="dataset")
        self.api.create_tag(self.repo, tag=LEROBOT_TAG, repo_type="dataset", exist_ok=True)
