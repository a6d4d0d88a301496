"""Asking a robot to stop: a signal, a key, a call. A request is latched; the first one is the reason."""

from __future__ import annotations

import select
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

SIGNALS = tuple(s for s in signal.Signals if s.name in ("SIGINT", "SIGTERM", "SIGHUP"))  # Windows has no SIGHUP


class StopRequest:
    """Latched: nothing clears it. Safe to call from any thread and from signal handlers."""

    def __init__(self) -> None:
        self.reason: str | None = None

    def __call__(self, reason: str = "called") -> None:
        """Ask; effective in the period that follows."""
        if self.reason is None:
            self.reason = reason


@contextmanager
def on_signal(stop: StopRequest) -> Iterator[None]:
    """SIGINT, SIGTERM and SIGHUP ask to stop instead of ending the process; only the main thread can do this."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handle(number: int, _: FrameType | None) -> None:
        stop(signal.Signals(number).name)

    before = {number: signal.signal(number, handle) for number in SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class Keys:
    """Any key on the terminal asks to stop; polled once a period. Without a terminal it does nothing."""

    def __init__(self, stop: StopRequest) -> None:
        self.stop = stop
        self._before: list[object] | None = None

    def __enter__(self) -> Keys:
        if sys.stdin is not None and sys.stdin.isatty():
            import termios
            import tty

            self._before = termios.tcgetattr(sys.stdin)
            tty.setcbreak(sys.stdin)
        return self

    def poll(self) -> None:
        """Look, without waiting."""
        try:
            if self._before is not None and select.select([sys.stdin], [], [], 0)[0]:
                self.stop(f"key {sys.stdin.read(1)!r}")
        except OSError as error:
            self.stop(f"the terminal is gone ({error})")

    def __exit__(self, *_: object) -> None:
        if self._before is not None:
            import termios

            with suppress(termios.error):  # the terminal is gone
                termios.tcsetattr(sys.stdin, termios.TCSADRAIN, self._before)  # type: ignore[arg-type]
