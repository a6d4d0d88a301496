"""What we print: other people's words (names of motions, joints and files may hold anything), and measured numbers."""

from __future__ import annotations

import math
import re


def measured(value: float, error: float) -> str:
    """A number with its standard error, as many digits as two of the error's: 0.0 ± 1.3, 320 ± 170."""
    digits = 1 - math.floor(math.log10(error)) if 0 < error < math.inf else 3
    return f"{round(value, digits):.{max(digits, 0)}f} ± {round(error, digits):.{max(digits, 0)}f}"


def plain(text: str) -> str:
    """The text as one line that changes nothing where it is shown: controls and halves of pairs as escapes."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def markdown(text: str) -> str:
    """The same letters in Markdown: no markup, no HTML, no end of a table's cell."""
    return re.sub(r"([\\`*\[\]<>|&$~])", r"\\\1", plain(text))


def without_credentials(text: str) -> str:
    """The text without user names and keys in addresses: s3://KEY:SECRET@bucket/x becomes s3://bucket/x."""
    # A secret may hold a slash. As a path, an address has one slash after its colon.
    return re.sub(r"(?<=:/)(/?\S*:\S*|/[^\s/@]*)@", "/", text)
