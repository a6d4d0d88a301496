"""Output of commands: tables for people, or exactly one JSON object on stdout."""

from __future__ import annotations

import functools
import inspect
import json
import sys
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

from rich.console import Console
from rich.table import Table
from rich.text import Text

from gaponet.base.files import json_compatible, lock_folder
from gaponet.base.result_table import ResultTable as ResultTable
from gaponet.base.text import escape
from gaponet.base.wide_table import BORDER, TableCells

if TYPE_CHECKING:
    from gaponet.robot.finding import Finding

Command = TypeVar("Command", bound=Callable[..., Any])

COLOURS = {"ok": "green", "note": "cyan", "warning": "yellow", "error": "bold red"}
WIDTH = 120  # letters of a line in a file or a pipe


class _Console(Console):
    def on_broken_pipe(self) -> None:
        raise


class Out:
    """Output of a command.

    People read stdout. With json they read stderr, and stdout carries one object.
    """

    # False while `gaponet start` runs commands one after the other: none of them names the next.
    names_next = True

    def __init__(self, as_json: bool = False) -> None:
        self.as_json = as_json
        self.console = _Console(stderr=as_json, highlight=False)
        if not self.console.is_terminal:
            self.console.width = max(self.console.width, WIDTH)

    def say(self, text: str, start: str = "", style: str = "bold") -> None:
        """Print a line for people; neither text is markup, whatever it holds.

        Args:
            text: What follows `start`, without a space between them: ": 3 joints", " of 7 files".
            start: Highlighted words at the beginning of the line, such as the robot's name.
            style: How they are highlighted.
        """
        self.console.print(Text.assemble((escape(start), style), escape(text)), soft_wrap=True)

    def next(self, command: str) -> None:
        """Print the command that a person would give next; nothing within `gaponet start`, which
        gives it itself.
        """
        if self.names_next:
            self.say(f"next: {command}")

    def table(self, title: str, columns: list[str], rows: Iterable[list[str]]) -> None:
        """Print a table for people; on a narrow screen in parts, each without the rows that are
        blank in it.

        The first column and long cells are text; the others are right-aligned numbers, which are
        never cut or wrapped.
        """
        cells = TableCells(columns, rows)
        heading = escape(title)
        for part in cells.parts(self.console.width):
            table = Table(title=Text(heading), title_justify="left", title_style="bold")
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
            heading = f"{escape(title)}, continued"

    def show(self, title: str, table: ResultTable) -> None:
        """Print a table of numbers, as `table` does."""
        self.table(title, list(table.columns), table.texts())

    def findings(self, findings: Iterable[Finding]) -> None:
        """Print a line for each finding."""
        for finding in findings:
            self.say(
                f"  {finding.check}: {finding.message}",
                f"{finding.level:>7}",
                COLOURS[finding.level],
            )

    def result(self, value: dict[str, Any]) -> None:
        """Print the command's result as one JSON object; nothing without --json."""
        if self.as_json:
            json.dump(json_compatible(value), sys.stdout, ensure_ascii=False, allow_nan=False)
            sys.stdout.write("\n")


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
