"""One robot, one source of states: the publisher of a topic is pinned, and a second one is
noticed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from gaponet.base.arrays import Array

if TYPE_CHECKING:
    from gaponet.hw.drivers.dds import Reader


class SoleSource:
    """Messages of one publisher of a topic.

    The publisher of the first message is pinned. Messages of others are dropped. A publisher that
    restarts is another one.

    Attributes:
        topic: Name on the bus.
        identity: The pinned publisher in words; empty before the first message.
        second: Another publisher in words, once one was seen; it stays, although that publisher may
            leave.
    """

    def __init__(self, reader: Reader, topic: str) -> None:
        self.topic = topic
        self.identity = ""
        self.second = ""
        self._reader = reader
        self._pinned: int | None = None  # handle

    def receive(self) -> list[Array]:
        """Return the messages of the pinned publisher since the last call, oldest first, as arrays
        of bytes.

        Raises:
            DriverError: DDS fails.
        """
        messages = []
        seen = set()
        for publisher, data in self._reader.receive_with_publisher():
            if self._pinned is None:
                self._pinned = publisher
                self.identity = self._reader.describe(publisher)
            seen.add(publisher)
            if publisher == self._pinned:
                messages.append(data)
        if self._pinned is not None and not self.second:
            others = (seen | self._reader.publishers()) - {self._pinned}
            if others:
                self.second = self._reader.describe(min(others))
        return messages
