"""One progress bar for all commands, on stderr, so that stdout stays for results."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn


@contextmanager
def bar(title: str) -> Iterator[Callable[[float, float, str], None]]:
    """Yields update(done, total, note)."""
    columns = (
        TextColumn("[bold]{task.description}"), BarColumn(), TextColumn("{task.percentage:3.0f} %"),
        TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(), TextColumn("{task.fields[note]}"),
    )  # fmt: skip
    with Progress(*columns, console=Console(stderr=True), transient=False) as progress:
        task = progress.add_task(title, total=None, note="")

        def update(done: float, total: float, note: str = "") -> None:
            progress.update(task, completed=done, total=total, note=note)

        yield update


@contextmanager
def bars(title: str, total: int) -> Iterator[Callable[[dict[str, tuple[float, str]], int], None]]:
    """Yields show(running, done): a bar over all, with time left, and one per part that is running (share, note)."""
    columns = (
        TextColumn("[bold]{task.description}"), BarColumn(), TextColumn("{task.percentage:3.0f} %"),
        TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(), TextColumn("{task.fields[note]}"),
    )  # fmt: skip
    with Progress(*columns, console=Console(stderr=True), speed_estimate_period=600) as progress:
        whole = progress.add_task(title, total=total, note="")
        shown: dict[str, TaskID] = {}

        def show(running: dict[str, tuple[float, str]], done: int) -> None:
            for name in shown.keys() - running.keys():
                progress.remove_task(shown.pop(name))
            for name, (share, note) in running.items():
                if name not in shown:
                    shown[name] = progress.add_task(f"  {name}", total=1.0, note="")
                progress.update(shown[name], completed=share, note=note)
            together = done + sum(share for share, _ in running.values())
            progress.update(whole, completed=together, note=f"{done} of {total} done")

        yield show
