"""Clocks that are written as date and time: ISO 8601, with any zone, and times of day."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import LogError

DAY_S = 86400.0
DATE = re.compile(r"\d{4}-?\d\d-?\d\d[T ]\d\d:?\d\d")
TIME_OF_DAY = re.compile(r"\d\d?:\d\d(:\d\d([.,]\d+)?)?")


def is_date(cell: str) -> bool:
    """Return True for 2026-03-01T12:00:00.125Z, 2026-03-01 12:00:00,125+01:00 and 12:00:00.125."""
    cell = cell.strip().strip('"')
    return bool(DATE.match(cell) or TIME_OF_DAY.fullmatch(cell))


def to_seconds(cells: Sequence[str | None], where: str) -> Array:
    """Return dates as seconds after the first one, (k,); NaN for an empty cell.

    Raises:
        LogError: A cell is no date.
    """
    first: datetime | None = None
    seconds = np.full(len(cells), np.nan)
    days = np.zeros(len(cells))
    for i, cell in enumerate(cells):
        text = (cell or "").strip().strip('"')
        if not text:
            continue
        try:
            at = _parse(text)
        except ValueError:
            raise LogError(
                f"{where}: the clock's cell '{text[:40]}' in row {i + 1} is no date and time as "
                "2026-03-01T12:00:00.125"
            ) from None
        first = first or at
        seconds[i] = (at - first).total_seconds()
    if TIME_OF_DAY.fullmatch((cells[0] or "").strip().strip('"')):
        midnight = np.diff(seconds, prepend=seconds[0]) < -DAY_S / 2
        days = np.cumsum(midnight)
    return seconds + DAY_S * days


def _parse(text: str) -> datetime:
    text = text.replace(",", ".")
    if TIME_OF_DAY.fullmatch(text):
        hours, _, rest = text.partition(":")
        text = f"2000-01-01 {hours:>02}:{rest}"
    fraction = re.search(r"\.(\d{7,})", text)
    if fraction:  # nanoseconds: datetime keeps microseconds
        text = text.replace(fraction[1], fraction[1][:6])
    at = datetime.fromisoformat(re.sub(r"\s+(?=[+-]\d\d:?\d\d$)", "", text.replace(" UTC", "Z")))
    return at if at.tzinfo else at.replace(tzinfo=UTC)
