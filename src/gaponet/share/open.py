"""Places by their address; a place's module is imported when one is opened."""

from __future__ import annotations

from gaponet.share.target import Target


def open_target(address: str) -> Target:
    """The place that an address names: USER/NAME of the Hugging Face Hub, or s3://, gs:// or file:// and a folder.

    Raises:
        RemoteError: It is no address.
    """
    if "://" in address:
        from gaponet.share.bucket import Bucket

        return Bucket(address)
    from gaponet.share.hub import Hub

    return Hub(address)
