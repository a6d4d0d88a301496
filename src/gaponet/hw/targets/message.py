"""Messages of live targets, and the transports that deliver them."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from gaponet.base.errors import UsageError
from gaponet.base.structure import parse_json

MAX_MESSAGE_BYTES = 1 << 14  # a message of 27 joints with long names has 1,500
MAX_MESSAGES = 64  # read per call; decoding more takes too much of a control period


@dataclass(frozen=True)
class MessageFields:
    """Fields of a message in JSON; optional fields may be left out.

    Attributes:
        time: On the sender's own clock, s; increases from message to message.
        target: Joint → rad; the same joints in every message. Empty: the sender only wants to
            receive states.
        end: The motion is over: the robot goes back to where it started.
    """

    time: float
    target: dict[str, float] | None = None
    end: bool = False


class Message(NamedTuple):
    """A received message; time None without a clock; error: why it cannot be read, else empty."""

    sender: Hashable
    time: float | None = None
    target: dict[str, float] | None = None
    end: bool = False
    error: str = ""


def sender_name(sender: Hashable) -> str:
    """Return a sender in words: a DDS handle or the bytes of a ZeroMQ connection as hexadecimal
    digits.
    """
    if isinstance(sender, bytes):
        return sender.hex()
    if isinstance(sender, int):
        return f"{sender:x}"
    return str(sender)


def decode(sender: Hashable, data: bytes) -> Message:
    """Return a message from JSON; it carries its error if the bytes are not one."""
    if len(data) > MAX_MESSAGE_BYTES:
        return Message(sender, error=f"has more than {MAX_MESSAGE_BYTES} bytes")
    try:
        fields = parse_json(MessageFields, data, "it", UsageError)
    except UsageError as error:
        return Message(sender, error=str(error))
    return Message(sender, fields.time, fields.target, fields.end)


class Transport(Protocol):
    """Receives targets and publishes states; no method blocks."""

    address: str

    def receive(self) -> list[Message]:
        """Return the messages since the last call, oldest first, at most MAX_MESSAGES and one."""

    def senders(self) -> set[Hashable]:
        """Return the senders that are connected now.

        Empty where a transport knows them by their messages alone.
        """

    def publish(self, to: Hashable, state: dict[str, Any]) -> None:
        """Send joint_names, commanded, and qpos, qvel, tau in SI units to the sender, or to all
        listeners.
        """

    def close(self, reason: str) -> None:
        """Send the reason why the run ended, and close."""
