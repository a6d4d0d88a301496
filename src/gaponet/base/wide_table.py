"""Tables that are wider than the screen: which columns stand beside each other."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from gaponet.base.text import escape

MAX_WHOLE_CELL = 22  # letters: a longer cell is text, and is wrapped
BORDER = 3  # letters between two cells


class TableCells:
    """Heads and cells of a table, and how wide its columns are.

    Attributes:
        heads: Headings of the columns.
        lines: Cells of each row.
        longest: Letters of the longest cell of each column.
        least: Letters that each column and its border need.
    """

    def __init__(self, columns: list[str], rows: Iterable[list[str]]) -> None:
        self.heads = [escape(column) for column in columns]
        self.lines = [[escape(cell) for cell in row] for row in rows]
        self.longest: list[int] = []
        self.least: list[int] = []
        for i, head in enumerate(self.heads):
            cells = [line[i] for line in self.lines]
            self.longest.append(max(map(len, cells), default=0))
            self.least.append(_least_width(head, cells))

    def is_text(self, i: int) -> bool:
        """Return True for a column of text: the first one, and one with a long cell."""
        return i == 0 or self.longest[i] > MAX_WHOLE_CELL

    def parts(self, room: int) -> Iterator[list[int]]:
        """Yield the numbers of columns that fit beside each other, part by part; the first column
        stands in every part.

        Args:
            room: Width of the screen, letters.
        """
        count = len(self.heads)
        if count == 1:
            yield [0]
        border_and_first = 1 + self.least[0]
        start = 1
        while start < count:
            stop = start + 1  # one column at least
            while stop < count and border_and_first + sum(self.least[start : stop + 1]) <= room:
                stop += 1
            yield [0, *range(start, stop)]
            start = stop

    def width(self, part: list[int]) -> int:
        """Return the letters that columns need if nothing is wrapped."""
        return 1 + sum(BORDER + max(len(self.heads[i]), self.longest[i]) for i in part)

    def lines_of(self, part: list[int]) -> Iterator[list[str]]:
        """Yield the rows that are not blank in these columns, beside the first."""
        others = part[1:]
        for line in self.lines:
            if not others or any(line[i] for i in others):
                yield line


def _least_width(head: str, cells: list[str]) -> int:
    """Return the letters that a column and its border need: cells are wrapped only where they are
    long, heads at any space.
    """
    whole = [cell for cell in cells if len(cell) <= MAX_WHOLE_CELL]
    longest_whole = max(map(len, whole), default=1)
    words = " ".join([head, *cells]).split()
    longest_word = max(map(len, words), default=1)
    return BORDER + max(longest_whole, min(longest_word, MAX_WHOLE_CELL))
