"""Targets on standard input: a line of JSON each (live.Message), from a program at the other end of a pipe."""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Hashable
from typing import Any

from gaponet.base.errors import UsageError
from gaponet.hw.targets.live import LARGEST, Heard, decode

CHUNK = 1 << 16  # bytes taken at one look: some 40 messages of a humanoid


class PipeWire:
    """A `Wire` that reads lines; it tells nobody anything."""

    def __init__(self, descriptor: int | None = None) -> None:
        """
        Args:
            descriptor: A pipe's; default standard input.

        Raises:
            UsageError: Standard input is a terminal, where any key stops a run.
        """
        if descriptor is None and (sys.stdin is None or sys.stdin.isatty()):
            raise UsageError("targets on stdin come through a pipe: PROGRAM | gaponet run --targets stdin --yes …")
        self.address = "stdin"
        self._descriptor = sys.stdin.fileno() if descriptor is None else descriptor
        self._rest = b""  # of a line that is not over
        self._skipping = self._over = False

    def receive(self) -> list[Heard]:
        """Whole lines since the last look."""
        if self._over or not select.select([self._descriptor], [], [], 0)[0]:
            return []
        data = os.read(self._descriptor, CHUNK)
        if not data:
            self._over = True
            return [Heard("stdin", wrong="the other end closed the pipe")]
        *lines, self._rest = (self._rest + data).split(b"\n")
        if self._skipping and lines:  # the end of a line that was too long
            lines, self._skipping = lines[1:], False
        heard = [decode("stdin", line) for line in lines]
        if len(self._rest) > LARGEST:
            self._rest, self._skipping = b"", True
            heard.append(decode("stdin", bytes(LARGEST + 1)))
        return heard

    def publish(self, to: Hashable, state: dict[str, Any]) -> None:
        """Nobody listens."""

    def close(self, why: str) -> None:
        """Leave standard input alone."""
