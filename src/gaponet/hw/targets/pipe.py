"""Targets on standard input: one line of JSON per message (message.MessageFields), from a program
at the other end.
"""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Hashable
from typing import Any

from gaponet.base.errors import UsageError
from gaponet.hw.targets.message import MAX_MESSAGE_BYTES, MAX_MESSAGES, Message, decode

READ_BYTES = 1 << 16  # per call: some 40 messages of a humanoid


class PipeTransport:
    """A `Transport` that reads lines and sends nothing."""

    def __init__(self, descriptor: int | None = None) -> None:
        """Read a pipe, by default standard input.

        Raises:
            UsageError: Standard input is a terminal, where any key stops a run.
        """
        if descriptor is None and (sys.stdin is None or sys.stdin.isatty()):
            raise UsageError(
                "targets on stdin come through a pipe: PROGRAM | gaponet run --targets stdin "
                "--yes …"
            )
        self.address = "stdin"
        self._descriptor = sys.stdin.fileno() if descriptor is None else descriptor
        self._partial_line = b""
        self._skipping = False  # the rest of a line that was too long
        self._closed = False

    def receive(self) -> list[Message]:
        """Return the messages of the newest whole lines since the last call.

        Older lines of a flood are one message with an error.
        """
        if self._closed or not select.select([self._descriptor], [], [], 0)[0]:
            return []
        data = os.read(self._descriptor, READ_BYTES)
        if not data:
            return self._end()
        *lines, self._partial_line = (self._partial_line + data).split(b"\n")
        if self._skipping and lines:  # the end of a line that was too long
            lines = lines[1:]
            self._skipping = False
        newest = lines[-MAX_MESSAGES:]
        messages = [decode("stdin", line) for line in newest]
        unread = len(lines) - len(newest)
        if unread:
            flood = Message("stdin", error=f"came in a flood: {unread} older lines were not read")
            messages.insert(0, flood)
        if len(self._partial_line) > MAX_MESSAGE_BYTES:
            self._partial_line = b""
            self._skipping = True
            messages.append(decode("stdin", bytes(MAX_MESSAGE_BYTES + 1)))
        return messages

    def _end(self) -> list[Message]:
        """Return the last line, which may have no end, and that the pipe was closed."""
        self._closed = True
        messages = [Message("stdin", error="the other end closed the pipe")]
        if self._partial_line.strip() and not self._skipping:
            messages.insert(0, decode("stdin", self._partial_line))
        return messages

    def senders(self) -> set[Hashable]:
        """Return the one sender that a pipe has."""
        return {"stdin"}

    def publish(self, to: Hashable, state: dict[str, Any]) -> None:
        """Do nothing: a pipe has no way back."""

    def close(self, reason: str) -> None:
        """Leave standard input open."""
