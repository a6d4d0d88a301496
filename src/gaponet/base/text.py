"""Text for people: names that other people chose may hold any character.

Measured numbers carry their uncertainty.
"""

from __future__ import annotations

import math
import re

MAX_PRINTED_ERROR = 1e4  # in the unit of the text; the number then says nothing


def format_uncertainty(value: float, standard_error: float) -> str:
    """Format a number and its standard error, rounded to two digits of the error: 0.0 ± 1.3, 320 ±
    170; 5 ± ?.
    """
    if standard_error > MAX_PRINTED_ERROR:
        return f"{value:.3g} ± ?"
    digits = 3  # behind the decimal point; below zero, tens and hundreds are rounded
    if 0 < standard_error < math.inf:
        digits = 1 - math.floor(math.log10(standard_error))
    shown = max(digits, 0)
    no_minus_zero = round(value, digits) + 0.0
    return f"{no_minus_zero:.{shown}f} ± {round(standard_error, digits):.{shown}f}"


def escape(text: str) -> str:
    """Return the text as one line, with control characters and unpaired surrogates as escapes."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def escape_markdown(text: str) -> str:
    """Return the text so that Markdown shows it literally: no markup, no HTML, no end of a table
    cell.
    """
    return re.sub(r"([\\`*\[\]<>|&$~])", r"\\\1", escape(text))


def remove_credentials(text: str) -> str:
    """Remove user names and keys from addresses: s3://KEY:SECRET@bucket/x becomes s3://bucket/x."""
    # A secret may hold a slash. As a path, an address has one slash after its colon.
    return re.sub(r"(?<=:/)(/?\S*:\S*|/[^\s/@]*)@", "/", text)
