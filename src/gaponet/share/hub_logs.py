"""Logs that are a dataset of the Hugging Face Hub, such as LeRobot's: downloaded without videos."""

from __future__ import annotations

import os
import re
from pathlib import Path

from gaponet.base.network import network_errors

# A Path has one slash less than what was typed.
ADDRESS = re.compile(r"hf:/+(?:datasets/)?([^/@]+/[^/@]+)(?:@(.+))?")
NO_LOGS = ("videos/*", "images/*", "*.mp4", "*.png", "*.jpg", "*.jpeg", "*.gif")


def logs_folder(src: str | Path) -> Path:
    """Return the folder or file of logs; what an address of the Hub names is downloaded.

    The Hub's own library keeps it in its cache, by commit, and downloads nothing twice.

    Args:
        src: A path, or hf://USER/DATASET, with @REVISION behind it for another branch, tag or
            commit than main.

    Raises:
        RemoteError: It cannot be reached.
    """
    match = ADDRESS.fullmatch(Path(src).as_posix())
    if match is None:
        return Path(src)
    from huggingface_hub import snapshot_download

    repository, revision = match.groups()
    with network_errors(f"hf://{repository}"):
        folder = snapshot_download(
            repository,
            repo_type="dataset",
            revision=revision,
            endpoint=os.environ.get("HF_ENDPOINT"),
            ignore_patterns=list(NO_LOGS),
        )
    return Path(folder)
