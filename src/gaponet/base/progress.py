"""Progress bars on stderr, since stdout is for results; in a file or a pipe, occasional lines."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    ProgressColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as Bars

from gaponet.base.text import escape

LINE_INTERVAL_S = 10.0  # without a terminal
LINE_INTERVAL_VARIABLE = "GAPONET_LINE_INTERVAL_S"  # environment variable that replaces it
MAX_UNFINISHED = 0.99  # largest fraction that is shown before the end

Progress = Callable[[float, float, str], None]  # done, total, note
Running = dict[str, tuple[float, str]]  # name of a parallel task → fraction done, note
_Show = Callable[[Running, float, float, str], None]  # running tasks, done, total, note


def no_progress(done: float, total: float, note: str = "") -> None:
    """Progress that shows nothing."""


def with_note(progress: Progress, note: str) -> Callable[[int, int], None]:
    """Return progress(done, total) with a fixed note."""
    return lambda done, total: progress(done, total, note)


@contextmanager
def progress_bar(title: str) -> Iterator[Callable[[float, float, str], None]]:
    """Show a progress bar on stderr.

    Yields update(done, total, note), to be given as `progress`.
    """
    with _progress(title) as show:

        def update(done: float, total: float, note: str = "") -> None:
            show({}, done, total, note)

        yield update


@contextmanager
def progress_bars(title: str, total: int) -> Iterator[Callable[[Running, int], None]]:
    """Show a bar for the whole and one per running task; yields show(running, done)."""
    with _progress(title) as show:
        yield lambda running, done: show(
            running,
            done + sum(fraction for fraction, _ in running.values()),
            total,
            f"{done} of {total} done",
        )


@contextmanager
def _progress(title: str) -> Iterator[_Show]:
    """Show bars in a terminal, and lines anywhere else."""
    console = Console(stderr=True, force_jupyter=False)  # text in a notebook, too
    if not console.is_terminal:
        with _lines(title, console) as lines:
            yield lines
        return
    columns: tuple[ProgressColumn, ...] = (
        TextColumn("{task.description}", style="bold", markup=False),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %"),
        TextColumn("elapsed"),
        TimeElapsedColumn(),
        TextColumn("· left, about"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}", markup=False),
    )
    with Bars(*columns, console=console, speed_estimate_period=600) as progress:
        whole = progress.add_task(title, total=None, note="")
        shown: dict[str, TaskID] = {}

        def show(running: Running, done: float, total: float, note: str = "") -> None:
            for name in shown.keys() - running.keys():
                progress.remove_task(shown.pop(name))
            for name, (fraction, task_note) in running.items():
                if name not in shown:
                    shown[name] = progress.add_task(f"  {escape(name)}", total=1.0, note="")
                progress.update(shown[name], completed=fraction, note=escape(task_note))
            progress.update(
                whole, completed=min(done, MAX_UNFINISHED * total), total=total, note=escape(note)
            )

        yield show
        task = progress.tasks[0]  # the whole
        if task.percentage >= 100 * MAX_UNFINISHED:
            progress.update(whole, completed=task.total)


@contextmanager
def _lines(title: str, console: Console) -> Iterator[_Show]:
    """Print progress as lines: the first update, one every LINE_INTERVAL_S even if nothing is
    reported, and the end.
    """
    interval = float(os.environ.get(LINE_INTERVAL_VARIABLE, LINE_INTERVAL_S))
    lines = _Lines(title, console, interval)
    done = threading.Event()
    heartbeat = threading.Thread(target=lines.print_until, args=(done,), daemon=True)
    heartbeat.start()
    try:
        yield lines.show
    finally:
        done.set()
        heartbeat.join()
    if lines.fraction >= 1:
        lines.print(1.0)


class _Lines:
    """Progress as lines of text.

    Attributes:
        fraction: What is done, 0 to 1.
    """

    def __init__(self, title: str, console: Console, interval: float) -> None:
        """interval: Seconds between lines."""
        self.fraction = 0.0
        self._title = title
        self._console = console
        self._interval = interval
        self._note = ""
        self._start = time.monotonic()
        self._last_line: float | None = None
        self._lock = threading.Lock()

    def show(self, running: Running, done: float, total: float, note: str = "") -> None:
        """Take news, and print them if the last line is old enough."""
        notes = [note]
        for name, (part, progress_text) in running.items():
            notes.append(f"{name} {100 * part:.0f} % {progress_text}".rstrip())
        self._note = "; ".join(text for text in notes if text)
        self.fraction = done / total if total else 0.0
        is_first = self._last_line is None
        if is_first and self.fraction >= 1:
            return  # `_lines` prints the end, and nothing came before it
        self._print_if_due()

    def print_until(self, done: threading.Event) -> None:
        """Print a line whenever the last one is old enough, until `done` is set."""
        while not done.wait(min(self._interval, 1.0)):
            since_start = time.monotonic() - self._start
            if since_start >= self._interval:
                self._print_if_due()

    def print(self, shown: float) -> None:
        """Print a line with what is done, 0 to 1."""
        seconds = time.monotonic() - self._start
        line = f"{self._title}: {100 * shown:.0f} %, {seconds:.0f} s"
        if self._note:
            line = f"{line}, {self._note}"
        self._console.print(escape(line), markup=False, soft_wrap=True)

    def _print_if_due(self) -> None:
        with self._lock:
            now = time.monotonic()
            if self._last_line is not None and now - self._last_line < self._interval:
                return
            self._last_line = now
        self.print(min(self.fraction, MAX_UNFINISHED))
