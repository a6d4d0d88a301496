"""Errors of places that are reached over a network."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from gaponet.base.errors import GAPONetError

# Modules of the network libraries → base classes of their errors that are neither OSError nor
# ValueError.
LIBRARY_ERRORS = {
    "huggingface_hub.errors": (
        "HTTPError",
        "EntryNotFoundError",
        "CorruptedCacheException",
        "RevisionResolutionError",
        "XetDownloadError",
    ),
}


class RemoteError(GAPONetError):
    """A remote place cannot be reached, or its content differs from its index."""


def _network_error_types() -> tuple[type[Exception], ...]:
    """Return the errors that network libraries raise.

    A library that was not imported cannot have raised one.
    """
    types: list[type[Exception]] = [OSError, ValueError, RuntimeError]  # Xet raises RuntimeError
    for module_name, names in LIBRARY_ERRORS.items():
        module = sys.modules.get(module_name)
        if module is not None:
            types += [getattr(module, name) for name in names if hasattr(module, name)]
    return tuple(types)


@contextmanager
def network_errors(address: str) -> Iterator[None]:
    """Turn errors of the network libraries into a RemoteError with the address and without
    secrets.
    """
    try:
        yield
    except _network_error_types() as error:
        text = re.sub(r"\?\S+", "?…", " ".join(str(error).split()))  # a query may hold a signature
        reason = ""
        if isinstance(error, FileNotFoundError):
            reason = "not found: "
        elif isinstance(error, PermissionError):
            reason = "no permission: "
        raise RemoteError(f"{address}: {reason}{text[:300] or type(error).__name__}") from None
