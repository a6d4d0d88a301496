"""Stop requests by signal, key or call. A request is latched; the first reason counts."""

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
_STOP_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP")
STOP_SIGNALS = tuple(number for number in signal.Signals if number.name in _STOP_NAMES)


class StopRequest:
    """Latched request to stop; nothing clears it.

    Safe to call from any thread and from signal handlers.
    """

    def __init__(self) -> None:
        self.reason: str | None = None

    def __call__(self, reason: str = "called") -> None:
        """Request a stop, which takes effect in the next period."""
        if self.reason is None:
            self.reason = reason


@contextmanager
def stop_on_signals(stop: StopRequest) -> Iterator[None]:
    """Let STOP_SIGNALS request a stop instead of ending or suspending the process.

    Works in the main thread only.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handle(number: int, _: FrameType | None) -> None:
        stop(signal.Signals(number).name)

    before = {number: signal.signal(number, handle) for number in STOP_SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class StopKeys:
    """Any key on the terminal requests a stop, also Ctrl-C, Ctrl-Z and Ctrl-S.

    So does the end of the terminal.

    It is polled once per period. Without a terminal it does nothing.
    """

    def __init__(self, stop: StopRequest) -> None:
        self.stop = stop
        self._settings_before: list[Any] | None = None
        self._terminal = -1

    def __enter__(self) -> StopKeys:
        if sys.stdin is not None and sys.stdin.isatty():
            import termios

            self._terminal = sys.stdin.fileno()
            self._settings_before = termios.tcgetattr(self._terminal)
            mode = termios.tcgetattr(self._terminal)
            input_flags = termios.IXON | termios.IGNCR
            local_flags = termios.ICANON | termios.ECHO | termios.ISIG | termios.IEXTEN
            mode[0] &= ~input_flags
            mode[3] &= ~local_flags
            mode[6][termios.VMIN] = 1
            mode[6][termios.VTIME] = 0
            # TCSANOW: keys typed before this count, and output that Ctrl-S holds back is not waited
            # for.
            termios.tcsetattr(self._terminal, termios.TCSANOW, mode)
        return self

    def poll(self) -> None:
        """Read pressed keys without waiting."""
        if self._settings_before is None:
            return
        try:
            if select.select([self._terminal], [], [], 0)[0]:
                typed = os.read(self._terminal, 1024)  # all of them: the rest would go to the shell
                self.stop(f"key {chr(typed[0])!r}" if typed else "the terminal is gone")
        except OSError as error:
            self.stop(f"the terminal is gone ({error})")

    def __exit__(self, *_: object) -> None:
        if self._settings_before is not None:
            import termios

            with suppress(termios.error):  # the terminal is gone
                termios.tcsetattr(self._terminal, termios.TCSANOW, self._settings_before)
