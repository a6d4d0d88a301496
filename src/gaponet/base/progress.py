"""One progress bar for all commands, on stderr, so that stdout stays for results; in a file or a pipe, a line now and
then."""

from __future__ import annotations

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

from gaponet.base.text import plain

EVERY = 10.0  # s between two lines where there is no terminal
ALMOST = 0.99  # shown at most before the end: what is called 100 % is over


Progress = Callable[[float, float, str], None]  # done, total, what is done now
Running = dict[str, tuple[float, str]]  # name of a part → share done, note
_Show = Callable[[Running, float, float, str], None]  # parts running, done, total, note


def silent(done: float, total: float, note: str = "") -> None:
    """A Progress that nobody looks at."""


def noted(progress: Progress, note: str) -> Callable[[int, int], None]:
    """progress(done, total) of a part that is called so."""
    return lambda done, total: progress(done, total, note)


@contextmanager
def bar(title: str) -> Iterator[Callable[[float, float, str], None]]:
    """Yields update(done, total, note)."""
    with _progress(title) as show:

        def update(done: float, total: float, note: str = "") -> None:
            show({}, done, total, note)

        yield update


@contextmanager
def bars(title: str, total: int) -> Iterator[Callable[[Running, int], None]]:
    """Yields show(running, done): a bar over all, with time left, and one per part that is running."""
    with _progress(title) as show:
        yield lambda running, done: show(
            running, done + sum(share for share, _ in running.values()), total, f"{done} of {total} done"
        )


@contextmanager
def _progress(title: str) -> Iterator[_Show]:
    console = Console(stderr=True, force_jupyter=False)  # in a notebook it is text as well
    if not console.is_terminal:
        with _lines(title, console) as lines:
            yield lines
        return
    columns: tuple[ProgressColumn, ...] = (
        TextColumn("{task.description}", style="bold", markup=False), BarColumn(),
        TextColumn("{task.percentage:3.0f} %"), TimeElapsedColumn(), TextColumn("left"),
        TimeRemainingColumn(), TextColumn("{task.fields[note]}", markup=False),
    )  # fmt: skip
    with Bars(*columns, console=console, speed_estimate_period=600) as progress:
        whole = progress.add_task(title, total=None, note="")
        shown: dict[str, TaskID] = {}

        def show(running: Running, done: float, total: float, note: str = "") -> None:
            for name in shown.keys() - running.keys():
                progress.remove_task(shown.pop(name))
            for name, (share, said) in running.items():
                if name not in shown:
                    shown[name] = progress.add_task(f"  {plain(name)}", total=1.0, note="")
                progress.update(shown[name], completed=share, note=plain(said))
            progress.update(whole, completed=min(done, ALMOST * total), total=total, note=plain(note))

        yield show
        if (task := progress.tasks[0]).percentage >= 100 * ALMOST:
            progress.update(whole, completed=task.total)


@contextmanager
def _lines(title: str, console: Console) -> Iterator[_Show]:
    """The same as lines: the first when there is something to say, then at most one every EVERY seconds; the end."""
    began = time.monotonic()
    last, share, newest = began - EVERY, 0.0, ""

    def show(running: Running, done: float, total: float, note: str = "") -> None:
        nonlocal last, share, newest
        parts = [note, *(f"{name} {100 * part:.0f} % {said}".rstrip() for name, (part, said) in running.items())]
        share, newest = done / total if total else 0.0, "; ".join(part for part in parts if part)
        if time.monotonic() - last >= EVERY and (share < 1 or last >= began):
            last = time.monotonic()
            tell(min(share, ALMOST))

    def tell(share: float) -> None:
        line = f"{title}: {100 * share:.0f} %, {time.monotonic() - began:.0f} s{', ' + newest if newest else ''}"
        console.print(plain(line), markup=False, soft_wrap=True)

    yield show
    if share >= 1:
        tell(1.0)
