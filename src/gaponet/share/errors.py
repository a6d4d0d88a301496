"""Errors of places on the network."""

from __future__ import annotations

from gaponet.base.errors import GAPONetError


class RemoteError(GAPONetError):
    """A place on the network cannot be reached, or does not hold what it says."""
