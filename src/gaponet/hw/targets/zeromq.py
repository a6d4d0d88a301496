"""Targets and states over ZeroMQ: a ROUTER here, one DEALER that commands (targets.client).

Messages are JSON: message.MessageFields.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Hashable
from typing import Any

import zmq

from gaponet.base.errors import UsageError
from gaponet.hw.targets.message import MAX_MESSAGE_BYTES, MAX_MESSAGES, Message, decode

ADDRESS = "tcp://127.0.0.1:5555"
QUEUE_LENGTH = MAX_MESSAGES  # buffered per connection, too


class ZeroMQTransport:
    """A `Transport` that senders connect to."""

    def __init__(self, address: str = ADDRESS) -> None:
        """
        Args:
            address: tcp://HOST:PORT of this machine, or ipc://PATH. Only this machine reaches
                127.0.0.1. Nothing is encrypted or authenticated.

        Raises:
            UsageError: The address cannot be bound.
        """
        self.address = address
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.ROUTER)
        lengths = ((zmq.RCVHWM, QUEUE_LENGTH), (zmq.SNDHWM, QUEUE_LENGTH))
        for option, value in ((zmq.LINGER, 200), (zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES), *lengths):
            self._socket.setsockopt(option, value)
        try:
            self._socket.bind(address)
        except zmq.ZMQError as error:
            self._context.destroy(linger=0)
            raise UsageError(
                f"cannot listen at {address} ({error}); is another run there?"
            ) from None
        self._sender: Hashable | None = None

    def receive(self) -> list[Message]:
        """Return the messages since the last call."""
        messages: list[Message] = []
        with contextlib.suppress(zmq.Again):
            while len(messages) < QUEUE_LENGTH:
                sender, *parts = self._socket.recv_multipart(zmq.NOBLOCK)
                messages.append(decode(sender, parts[-1] if parts else b""))
        return messages

    def senders(self) -> set[Hashable]:
        """Return nothing: ZeroMQ tells senders by their messages alone."""
        return set()

    def publish(self, to: Hashable, state: dict[str, Any]) -> None:
        """Send a JSON object to the sender; it is dropped if the sender does not read."""
        self._sender = to
        if to is not None:
            message: list[Any] = [to, json.dumps(state).encode()]
            with contextlib.suppress(zmq.ZMQError):  # the sender is gone
                self._socket.send_multipart(message, zmq.NOBLOCK)

    def close(self, reason: str) -> None:
        """Send the sender the reason, and close the socket."""
        self.publish(self._sender, {"end": reason})
        self._context.destroy()
