"""Datasets, runs and robots to and from the Hugging Face Hub, and public recordings."""

from pathlib import Path

from gaponet.base.progress import Progress, no_progress
from gaponet.share.public_recordings import PublicFiles
from gaponet.share.push_pull import TransferResult as TransferResult
from gaponet.share.push_pull import pull as pull
from gaponet.share.push_pull import push as push


def public_recordings(progress: Progress = no_progress) -> tuple[Path, str]:
    """Return the folder of the public recordings of a real arm, and whose they are.

    Raises:
        UsageError, RemoteError: They are neither in GAPONET_DATA nor to be had from the network.
    """
    public = PublicFiles.read()
    return public.provide(progress), public.origin
