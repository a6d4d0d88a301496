"""A study's result in the terminal and on disk."""

from __future__ import annotations

from pathlib import Path

from gaponet.cli.out import Out
from gaponet.experiments.result import Result
from gaponet.experiments.result_files import write


def show_result(result: Result, out: Path, screen: Out) -> None:
    """Write the result's files and print its tables and sentences."""
    files = write(result, out)
    screen.say("", result.title)
    screen.say(result.virtual)
    for table in (t for t in result.tables if t.shown):
        screen.show("", table)
        if table.caption:
            screen.say(table.caption)
    for sentence in result.sentences:
        screen.say(f"- {sentence}")
    screen.say(f"written: {', '.join(str(f) for f in files)}")
    screen.result({"name": result.name, "virtual": result.virtual, "facts": dict(result.facts),
                   "sentences": list(result.sentences), "files": [str(f) for f in files],
                   "tables": {t.name: t.record() for t in result.tables if t.shown}})  # fmt: skip
