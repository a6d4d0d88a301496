"""Targets and states over ZeroMQ: a ROUTER here, one DEALER that commands (targets.client). JSON, see live.Message."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Hashable
from typing import Any

import zmq

from gaponet.base.errors import UsageError
from gaponet.hw.targets.live import LARGEST, Heard, decode

ADDRESS = "tcp://127.0.0.1:5555"
QUEUE = 64  # messages taken at one look, and kept per connection between two


class ZeroMQWire:
    """A `Wire` that others connect to."""

    def __init__(self, address: str = ADDRESS) -> None:
        """
        Args:
            address: tcp://HOST:PORT of this machine, or ipc://PATH. 127.0.0.1 is heard from this machine alone; nothing
                is encrypted and nobody has to prove who he is.

        Raises:
            UsageError: It cannot be listened at.
        """
        self.address = address
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.ROUTER)
        for option, value in ((zmq.LINGER, 200), (zmq.MAXMSGSIZE, LARGEST), (zmq.RCVHWM, QUEUE), (zmq.SNDHWM, QUEUE)):
            self._socket.setsockopt(option, value)
        try:
            self._socket.bind(address)
        except zmq.ZMQError as error:
            self._context.destroy(linger=0)
            raise UsageError(f"cannot listen at {address} ({error}); is another run there?") from None
        self._sender: Hashable | None = None

    def receive(self) -> list[Heard]:
        """Messages since the last look; whoever said the first one well formed is told states from then on."""
        heard: list[Heard] = []
        with contextlib.suppress(zmq.Again):
            while len(heard) < QUEUE:
                sender, *parts = self._socket.recv_multipart(zmq.NOBLOCK)
                heard.append(decode(sender, parts[-1] if parts else b""))
        return heard

    def publish(self, to: Hashable, state: dict[str, Any]) -> None:
        """One JSON object to the sender; dropped if he does not read."""
        self._say(to, state)

    def _say(self, to: Hashable, message: dict[str, Any]) -> None:
        self._sender = to
        if to is not None:
            with contextlib.suppress(zmq.ZMQError):  # he is gone
                self._socket.send_multipart([to, json.dumps(message).encode()], zmq.NOBLOCK)  # type: ignore[list-item]

    def close(self, why: str) -> None:
        """Tell the sender why it is over."""
        self._say(self._sender, {"end": why})
        self._context.destroy()
