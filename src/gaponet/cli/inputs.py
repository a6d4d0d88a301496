"""What commands read from their arguments."""

from __future__ import annotations


def names(text: str) -> tuple[str, ...]:
    """ "a, b" → ("a", "b")."""
    return tuple(part.strip() for part in text.split(",") if part.strip())
