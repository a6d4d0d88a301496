"""Other people's words in what we print: names of motions, units, joints and files, which may hold anything."""

from __future__ import annotations

import re


def plain(text: str) -> str:
    """The text as one line that changes nothing where it is shown: controls and halves of pairs as escapes."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def markdown(text: str) -> str:
    """The same letters in Markdown: no markup, no HTML, no end of a table's cell."""
    return re.sub(r"([\\`*\[\]<>|&$~])", r"\\\1", plain(text))
