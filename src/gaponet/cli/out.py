"""What a command prints: tables for people, or exactly one JSON object on stdout."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from typing import Any

from rich.console import Console
from rich.table import Table

from gaponet.data.json_file import finite


class Out:
    """People read stdout; with json they read stderr, and stdout carries one object."""

    def __init__(self, as_json: bool = False) -> None:
        self.as_json = as_json
        self.console = Console(stderr=as_json, highlight=False)

    def say(self, text: str) -> None:
        """A line for people."""
        self.console.print(text, soft_wrap=True)

    def table(self, title: str, columns: list[str], rows: Iterable[list[str]]) -> None:
        """A table for people; the first column is text, the others are right-aligned."""
        table = Table(title=title, title_justify="left", title_style="bold")
        for i, column in enumerate(columns):
            table.add_column(column, justify="left" if i == 0 else "right", no_wrap=i == 0)
        for row in rows:
            table.add_row(*row)
        self.console.print(table)

    def result(self, value: dict[str, Any]) -> None:
        """The command's result as one JSON object; nothing without --json."""
        if self.as_json:
            json.dump(finite(value), sys.stdout, ensure_ascii=False, allow_nan=False)
            sys.stdout.write("\n")
