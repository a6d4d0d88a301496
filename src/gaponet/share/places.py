"""The place at an address: the Hub, or a bucket."""

from __future__ import annotations

from gaponet.share.target import Target


def open_target(address: str) -> Target:
    """The place at an address: USER/NAME or hf://USER/NAME of the Hub, or s3://, gs:// or file:// and a folder.

    Raises:
        RemoteError: The address is not valid.
    """
    if "://" in address and not address.startswith("hf://"):
        from gaponet.share.bucket import Bucket

        return Bucket(address)
    from gaponet.share.hub import Hub

    return Hub(address)
