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
# 29.03.2026 12:00:00,125 and 03/29/2026 12:00:00.125 PM
DAY_OR_MONTH_FIRST = re.compile(
    r"(\d\d?)([./])(\d\d?)\2(\d{4})[T, ]+(\d\d?:\d\d(?::\d\d(?:[.,]\d+)?)?) ?([AaPp][Mm])?"
)
TIME_OF_DAY = re.compile(r"\d\d?:\d\d(:\d\d([.,]\d+)?)?")


def is_date(cell: str) -> bool:
    """Return True for 2026-03-01T12:00:00.125Z, 2026-03-01 12:00:00,125+01:00 and 12:00:00.125."""
    cell = _without_quotes(cell)
    if DATE.match(cell) or TIME_OF_DAY.fullmatch(cell):
        return True
    return DAY_OR_MONTH_FIRST.fullmatch(cell) is not None


def to_seconds(cells: Sequence[str | None], where: str) -> Array:
    """Return dates as seconds since 1970 in UTC, (k,); NaN for an empty cell.

    The seconds of two columns are comparable. Without a zone a date is in UTC; times of day are of
    one day, and after midnight of the next.

    Raises:
        LogError: A cell is no date.
    """
    day_first = _day_comes_first(cells)
    seconds = np.full(len(cells), np.nan)
    days = np.zeros(len(cells))
    for i, cell in enumerate(cells):
        text = _without_quotes(cell)
        if not text:
            continue
        try:
            at = _parse(_iso(text, day_first))
        except ValueError:
            raise LogError(
                f"{where}: the clock's cell '{text[:40]}' in row {i + 1} is no date and time as "
                "2026-03-01T12:00:00.125"
            ) from None
        seconds[i] = at.timestamp()
    stated = np.flatnonzero(np.isfinite(seconds))
    if stated.size and TIME_OF_DAY.fullmatch(_without_quotes(cells[stated[0]])):
        midnight = np.diff(seconds[stated], prepend=seconds[stated[0]]) < -DAY_S / 2
        days[stated] = np.cumsum(midnight)
    return seconds + DAY_S * days


def _day_comes_first(cells: Sequence[str | None]) -> bool:
    """Return True if the day stands before the month: behind it there is a dot, a number above 12,
    or the days of a recording would be months apart.
    """
    first = set()
    second = set()
    for cell in cells:
        match = DAY_OR_MONTH_FIRST.fullmatch(_without_quotes(cell))
        if match is None:
            continue
        number, separator, other, *_ = match.groups()
        if separator == ".":
            return True
        first.add(number)
        second.add(other)
    return any(int(number) > 12 for number in first) or len(first) > len(second)


def _without_quotes(cell: str | None) -> str:
    return (cell or "").strip().strip('"')


def _iso(text: str, day_first: bool) -> str:
    """Return a date in another form as ISO 8601."""
    match = DAY_OR_MONTH_FIRST.fullmatch(text)
    if match is None:
        return text
    month, _, day, year, clock, half = match.groups()
    if day_first:
        day, month = month, day
    hours, _, rest = clock.partition(":")
    hour = int(hours)
    if half:
        hour %= 12
        if half.lower() == "pm":
            hour += 12
    return f"{year}-{int(month):02}-{int(day):02} {hour:02}:{rest}"


def _parse(text: str) -> datetime:
    text = text.replace(",", ".")
    if TIME_OF_DAY.fullmatch(text):
        hours, _, rest = text.partition(":")
        text = f"2000-01-01 {hours:>02}:{rest}"
    text = text.replace(" UTC", "Z")
    text = re.sub(r"\s+(?=[+-]\d\d:?\d\d$)", "", text)  # before a zone
    at = datetime.fromisoformat(text)
    return at if at.tzinfo else at.replace(tzinfo=UTC)
