"""Asking a robot to stop: a signal, a key, a call. A request is latched; the first one is the reason."""

from __future__ import annotations

import os
import select
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

# By name: Windows has only the first two.
SIGNALS = tuple(s for s in signal.Signals if s.name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP"))


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
    """SIGNALS ask to stop instead of ending or suspending the process; only the main thread can do this."""
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
    """Any key on the terminal asks to stop, Ctrl-C, Ctrl-Z and Ctrl-S too; so does the end of the terminal.

    Polled once a period. Without a terminal it does nothing.
    """

    def __init__(self, stop: StopRequest) -> None:
        self.stop = stop
        self._before: list[Any] | None = None
        self._terminal = -1

    def __enter__(self) -> Keys:
        if sys.stdin is not None and sys.stdin.isatty():
            import termios

            self._terminal = sys.stdin.fileno()
            self._before = termios.tcgetattr(self._terminal)
            mode = termios.tcgetattr(self._terminal)
            mode[0] &= ~(termios.IXON | termios.IGNCR)  # input flags
            mode[3] &= ~(termios.ICANON | termios.ECHO | termios.ISIG | termios.IEXTEN)  # local flags
            mode[6][termios.VMIN], mode[6][termios.VTIME] = 1, 0
            # Now: what was typed before this counts, and output that Ctrl-S holds back is not waited for.
            termios.tcsetattr(self._terminal, termios.TCSANOW, mode)
        return self

    def poll(self) -> None:
        """Look, without waiting."""
        if self._before is None:
            return
        try:
            if select.select([self._terminal], [], [], 0)[0]:
                typed = os.read(self._terminal, 1024)  # all: what is left would go to the shell
                self.stop(f"key {chr(typed[0])!r}" if typed else "the terminal is gone")
        except OSError as error:
            self.stop(f"the terminal is gone ({error})")

    def __exit__(self, *_: object) -> None:
        if self._before is not None:
            import termios

            with suppress(termios.error):  # the terminal is gone
                termios.tcsetattr(self._terminal, termios.TCSANOW, self._before)
