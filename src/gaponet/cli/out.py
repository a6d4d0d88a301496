"""Output of commands: tables for people, or exactly one JSON object on stdout."""

from __future__ import annotations

import functools
import inspect
import json
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

from rich.console import Console
from rich.table import Table
from rich.text import Text

from gaponet.base.files import json_compatible, lock_folder
from gaponet.base.result_table import ResultTable as ResultTable
from gaponet.base.text import escape

if TYPE_CHECKING:
    from gaponet.robot.finding import Finding

Command = TypeVar("Command", bound=Callable[..., Any])

COLOURS = {"ok": "green", "note": "cyan", "warning": "yellow", "error": "bold red"}
WIDTH = 120  # letters of a line in a file or a pipe
# letters: labels and numbers longer than that are wrapped
LABEL = 30
NUMBER = 22
BORDER = 3  # letters between two cells


class _Console(Console):
    def on_broken_pipe(self) -> None:
        raise


class Out:
    """People read stdout; with json they read stderr, and stdout carries one object."""

    names_next = True  # False within a command that gives the next one itself

    def __init__(self, as_json: bool = False) -> None:
        self.as_json = as_json
        self.console = _Console(stderr=as_json, highlight=False)
        if not self.console.is_terminal:
            self.console.width = max(self.console.width, WIDTH)

    def say(self, text: str, start: str = "", style: str = "bold") -> None:
        """A line for people; `start` stands before the text, in this style.

        Neither is markup, whatever it holds.
        """
        self.console.print(Text.assemble((escape(start), style), escape(text)), soft_wrap=True)

    def next(self, command: str) -> None:
        """The command that a person would give next; nothing within `gaponet start`, which gives
        it itself.
        """
        if self.names_next:
            self.say(f"next: {command}")

    def table(self, title: str, columns: list[str], rows: Iterable[list[str]]) -> None:
        """A table for people, in as many parts as the screen is narrow; rows that are blank in a
        part are left out.

        The first column and long cells are text; the others are right-aligned numbers, which are
        never cut or wrapped.
        """
        cells = _Cells(columns, rows)
        for count, part in enumerate(cells.parts(self.console.width)):
            more = ", continued" if count else ""
            table = Table(
                title=Text(escape(title) + more), title_justify="left", title_style="bold"
            )
            fits = cells.width(part) <= self.console.width
            for i in part:
                is_text = cells.is_text(i)
                table.add_column(
                    Text(cells.heads[i]),
                    overflow="fold",
                    justify="left" if is_text else "right",
                    width=None if fits or is_text else cells.least[i] - BORDER,
                )
            for line in cells.lines_of(part):
                table.add_row(*(Text(line[i]) for i in part))
            self.console.print(table)

    def show(self, title: str, table: ResultTable) -> None:
        """A table of numbers, as `table`."""
        self.table(title, list(table.columns), table.texts())

    def findings(self, findings: Iterable[Finding]) -> None:
        """A line each."""
        for finding in findings:
            self.say(
                f"  {finding.check}: {finding.message}",
                f"{finding.level:>7}",
                COLOURS[finding.level],
            )

    def result(self, value: dict[str, Any]) -> None:
        """The command's result as one JSON object; nothing without --json."""
        if self.as_json:
            json.dump(json_compatible(value), sys.stdout, ensure_ascii=False, allow_nan=False)
            sys.stdout.write("\n")


class _Cells:
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
        """Return True for a column of text."""
        return i == 0 or self.longest[i] > NUMBER

    def parts(self, room: int) -> Iterator[list[int]]:
        """Yield columns that fit beside each other into the room, in letters; each with the
        first."""
        count = len(self.heads)
        if count == 1:
            yield [0]
        start = 1
        while start < count:
            stop = start + 1
            while stop < count and self.least[0] + 1 + sum(self.least[start : stop + 1]) <= room:
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
    """Letters that a column and its border need: cells are wrapped only where they are long, heads
    at any space.
    """
    whole = [cell for cell in cells if len(cell) <= NUMBER]
    words = [word for text in (head, *cells) for word in text.split()]
    return BORDER + max(
        max(map(len, whole), default=1), min(max(map(len, words), default=1), NUMBER)
    )


def holds_folder(out: Path | None, kind: str) -> AbstractContextManager[object]:
    """Hold the folder that a command writes, if it writes one, so that a wrong folder costs no
    work and no motion.
    """
    return nullcontext() if out is None else lock_folder(out, kind)


def writes(kind: str) -> Callable[[Command], Command]:
    """Decorator of a command: it holds its --out from the start (holds_folder)."""

    def decorate(command: Command) -> Command:
        @functools.wraps(command)
        def held(*args: Any, **kwargs: Any) -> Any:
            given = inspect.signature(command).bind(*args, **kwargs)
            given.apply_defaults()
            with holds_folder(given.arguments["out"], kind):
                return command(*args, **kwargs)

        return cast("Command", held)

    return decorate
