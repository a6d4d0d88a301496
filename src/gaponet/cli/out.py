"""Output of commands: tables for people, or exactly one JSON object on stdout."""

from __future__ import annotations

import functools
import inspect
import json
import sys
from collections.abc import Callable, Iterable
from contextlib import nullcontext
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
MAX_COLUMNS = 4  # beside the first, of a part of a wide table
WIDTH = 120  # letters of a line in a file or a pipe
LABEL, NUMBER = 30, 10  # letters: labels longer than that are wrapped; room that a number keeps where it is narrow


class _Console(Console):
    def on_broken_pipe(self) -> None:
        raise


class Out:
    """People read stdout; with json they read stderr, and stdout carries one object."""

    def __init__(self, as_json: bool = False) -> None:
        self.as_json = as_json
        self.console = _Console(stderr=as_json, highlight=False)
        if not self.console.is_terminal:
            self.console.width = max(self.console.width, WIDTH)

    def say(self, text: str, start: str = "", style: str = "bold") -> None:
        """A line for people; `start` stands before the text, in this style. Neither is markup, whatever it holds."""
        self.console.print(Text.assemble((escape(start), style), escape(text)), soft_wrap=True)

    def table(self, title: str, columns: list[str], rows: Iterable[list[str]]) -> None:
        """A table for people; the first column is text, the others are right-aligned numbers, which are never cut."""
        lines = [[escape(cell) for cell in row] for row in rows]
        table = Table(title=Text(escape(title)), title_justify="left", title_style="bold")
        for i, column in enumerate(columns):
            cells = [line[i] for line in lines]
            if i == 0:
                table.add_column(
                    Text(escape(column)), overflow="fold", no_wrap=max(map(len, cells), default=0) <= LABEL
                )
            else:
                words = [len(word) for cell in (escape(column), *cells) for word in cell.split()]
                table.add_column(
                    Text(escape(column)), overflow="fold", justify="right", min_width=min(max(words, default=1), NUMBER)
                )
        for line in lines:
            table.add_row(*map(Text, line))
        self.console.print(table)

    def wide_table(self, title: str, columns: list[str], rows: list[list[str]]) -> None:
        """A table in parts of at most MAX_COLUMNS columns; rows that are blank in a part are left out."""
        for start in range(1, len(columns), MAX_COLUMNS):
            part = slice(start, start + MAX_COLUMNS)
            cells = [[row[0], *row[part]] for row in rows if any(row[part])]
            self.table(title if start == 1 else "Further parameters", [columns[0], *columns[part]], cells)

    def show(self, title: str, table: ResultTable) -> None:
        """A table of numbers, as `table`."""
        self.table(title, list(table.columns), table.texts())

    def findings(self, findings: Iterable[Finding]) -> None:
        """A line each."""
        for finding in findings:
            self.say(f"  {finding.check}: {finding.message}", f"{finding.level:>7}", COLOURS[finding.level])

    def result(self, value: dict[str, Any]) -> None:
        """The command's result as one JSON object; nothing without --json."""
        if self.as_json:
            json.dump(json_compatible(value), sys.stdout, ensure_ascii=False, allow_nan=False)
            sys.stdout.write("\n")


def writes(kind: str) -> Callable[[Command], Command]:
    """Decorator of a command: it holds its --out from the start, so that a wrong folder costs no work and no motion."""

    def decorate(command: Command) -> Command:
        @functools.wraps(command)
        def held(*args: Any, **kwargs: Any) -> Any:
            given = inspect.signature(command).bind(*args, **kwargs)
            given.apply_defaults()
            out = given.arguments["out"]
            with nullcontext() if out is None else lock_folder(out, kind):
                return command(*args, **kwargs)

        return cast("Command", held)

    return decorate
