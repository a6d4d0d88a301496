"""What the page says of a command: how it ended, what it printed, and its pictures.

Texts of commands and of files come from strangers: Markdown and HTML hold them only escaped.
"""

from __future__ import annotations

import base64
import html
import re
from pathlib import Path

from gaponet.base.errors import UsageError
from gaponet.base.text import escape_markdown
from gaponet.base.wide_table import TableCells
from gaponet.report.view.inside import read_inside
from gaponet.report.view.jobs import PROGRESS_LINE, Job
from gaponet.report.view.run_job import BY_ITSELF, CANCELLED, WITH_SERVER

# How commands print what they find: the level, two spaces, the name of the check, a sentence.
FINDING_LINE = re.compile(r" *(error|warning)  \S")
PANEL_LETTERS = 80  # of a table beside each other, in the panel of a window 1280 px wide
UNCHANGED = "what was there before is unchanged."


def ending(job: Job) -> str:
    """Return how a command ended, in Markdown."""
    command = f"**gaponet {escape_markdown(job.words[0])}**"
    if job.result is not None:
        return f"{command} has ended."
    return f"{command} gave no result: {escape_markdown(_reason(job))}"


def _reason(job: Job) -> str:
    """Return why a command gave no result."""
    ended = job.ending
    how = "" if ended is None else ended["how"]
    if how == CANCELLED:
        return f"it was cancelled; {UNCHANGED}"
    if how == WITH_SERVER:
        return f"it ended with the server of the page; {UNCHANGED}"
    said = [line for line in job.lines if line.strip() and not PROGRESS_LINE.match(line)]
    if said:
        return said[-1]
    if ended is not None and how == BY_ITSELF:
        return f"it ended with exit code {ended['code']} and said nothing."
    return f"it was killed, or the computer went off; {UNCHANGED}"


def report(job: Job) -> str:
    """Return what a command printed, in Markdown, and the command."""
    shown = list[str]()
    table = _Table()
    for line in job.lines:
        if table.take(line):
            continue
        shown += table.markdown()
        table = _Table()
        if not table.take(line):
            shown += _paragraph(line)
    shown += table.markdown()
    repeat = f"To repeat it in the folder of this page: {escape_markdown(job.command)}"
    return "\n".join([*shown, "", repeat])


def _paragraph(line: str) -> list[str]:
    """Return a line that a command printed as lines of Markdown."""
    text = escape_markdown(line.strip())
    if not text or line.startswith("     ok ") or PROGRESS_LINE.match(line):
        return []
    if FINDING_LINE.match(line):
        return ["", f"**{text}**"]
    return ["", text]


class _Table:
    """A table that a command drew with lines.

    Attributes:
        heads: Headings of its columns.
        rows: Its cells.
    """

    def __init__(self) -> None:
        self.heads: list[str] = []
        self.rows: list[list[str]] = []

    def take(self, line: str) -> bool:
        """Take a line of a table. Return False for any other line, and for the next table."""
        if line.startswith("┏"):
            return not self.heads
        if line.startswith("┃"):
            self._add_heads(_cells(line, "┃"))
            return True
        if not self.heads:
            return False
        if line.startswith("│"):
            cells = _cells(line, "│", at_most=len(self.heads))
            missing = len(self.heads) - len(cells)
            self.rows.append(cells + [""] * missing)
        return line.startswith(("│", "┡", "└"))

    def _add_heads(self, cells: list[str]) -> None:
        """Add a line of headings; a long heading stands in several lines."""
        if not self.heads:
            self.heads = cells
            return
        both = zip(self.heads, cells, strict=False)
        self.heads = [f"{above} {below}".strip() for above, below in both]

    def markdown(self) -> list[str]:
        """Return the table as lines of Markdown, in as many parts as the panel is narrow."""
        lines = list[str]()
        if not self.heads:
            return lines
        table = TableCells(self.heads, self.rows)
        for part in table.parts(PANEL_LETTERS):
            lines += ["", _markdown_row([table.heads[i] for i in part])]
            lines.append(f"| --- |{' ---: |' * (len(part) - 1)}")
            for row in table.lines_of(part):
                lines.append(_markdown_row([row[i] for i in part]))
        return lines


def _cells(line: str, border: str, at_most: int | None = None) -> list[str]:
    """Return the cells between the borders. A cell may hold a border too, if it is the last."""
    inside = line.strip().strip(border)
    if at_most is None:
        cells = inside.split(border)
    else:
        cells = inside.split(border, at_most - 1)
    return [cell.strip() for cell in cells]


def _markdown_row(cells: list[str]) -> str:
    escaped = [escape_markdown(cell) for cell in cells]
    return f"| {' | '.join(escaped)} |"


def picture(folder: Path, name: str) -> str:
    """Return a picture of the page's folder as HTML with a link that saves it, or why it is not
    shown.
    """
    try:
        data = base64.b64encode(read_inside(folder, name)).decode()
    except UsageError as error:
        return f"<p>Not shown: {html.escape(str(error))}</p>"
    kind = Path(name).suffix[1:]
    address = f"data:image/{kind.replace('svg', 'svg+xml')};base64,{data}"
    saved = html.escape(Path(name).name)
    text = f'<a download="{saved}" href="{address}">save {kind.upper()}</a> '
    if kind == "svg":
        text = f'<img alt="{saved}" style="width:100%;background:white" src="{address}">{text}'
    return text
