"""The bus to one H1-2: one source of states, and no other program that commands the robot."""

from __future__ import annotations

from typing import TYPE_CHECKING, NoReturn

from gaponet.base.arrays import Array
from gaponet.hw.control.driver import DriverError

if TYPE_CHECKING:
    from gaponet.hw.drivers.dds import Bus, Reader, Writer

STATES_TOPIC = "rt/lowstate"


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


class UnitreeLink:
    """The bus on which this program alone commands one robot.

    Attributes:
        topic: Of commands, without rt/.
        domain: DDS domain.
        interface: Network interface.
    """

    def __init__(self, topic: str, domain: int, interface: str, sole: bool, silent: bool) -> None:
        """Arguments as of UnitreeDriver."""
        self.topic = topic
        self.domain = domain
        self.interface = interface
        self._sole = sole
        self._silent = silent
        self._bus: Bus | None = None
        self._writer: Writer | None = None
        self._of_others: Reader | None = None  # their commands

    @property
    def is_open(self) -> bool:
        """True between `open` and `close`."""
        return self._bus is not None

    @property
    def can_send(self) -> bool:
        """True if commands reach the bus: it is open, and the link is not silent."""
        return self._writer is not None and not self._silent

    def open(self) -> SoleSource:
        """Join the bus and return the source of the robot's states.

        Raises:
            DriverError: Others publish the commands, or two robots their states.
        """
        from gaponet.hw.drivers import dds

        self._bus = dds.Bus(self.domain, self.interface)
        topic = f"rt/{self.topic}"
        states = SoleSource(self._bus.reader(STATES_TOPIC, dds.LowState), STATES_TOPIC)
        if not self._silent:
            self._writer = self._bus.writer(topic, dds.LowCmd)
            if self._sole:
                self._of_others = self._bus.reader(topic, dds.LowCmd, of_others=True)
        publishers = self._bus.publishers() if self._sole else {}
        others = [] if self._silent else publishers.get(topic, [])
        if others:
            raise DriverError(
                f"others publish {topic} on {self.interface}: {'; '.join(others)}; stop them "
                "first (on the robot: leave debug programs, and for lowcmd release the motion mode)"
            )
        robots = publishers.get(STATES_TOPIC, [])
        if len(robots) > 1:
            self._refuse_second(robots)
        return states

    def require_one_robot(self, states: SoleSource) -> None:
        """Refuse a bus on which a second robot was heard meanwhile."""
        if states.second and self._sole:
            self._refuse_second([states.identity, states.second])

    def _refuse_second(self, robots: list[str]) -> NoReturn:
        """Refuse a bus on which more than one robot publishes its states: all of them would take
        each command.
        """
        raise DriverError(
            f"{len(robots)} robots publish {STATES_TOPIC} on domain {self.domain}, "
            f"{self.interface}: {'; '.join(robots)}. Each of them would move. Leave one on this "
            "domain or network; a program that was killed is remembered for about 10 s"
        )

    def send(self, message: Array) -> None:
        """Publish a command; call it only if `can_send`.

        Raises:
            DriverError: DDS refuses it.
        """
        assert self._writer is not None
        self._writer.send(message)

    def other_commander(self) -> str:
        """Return a program that has sent the robot a command since the last call, in words; empty
        if this one alone commands.

        A program that is only connected does not count: a second gaponet connects, sees this one
        and leaves again.

        Raises:
            DriverError: DDS fails.
        """
        if self._of_others is None:
            return ""
        messages = self._of_others.receive_with_publisher()
        if not messages:
            return ""
        publisher, _ = messages[0]
        return self._of_others.describe(publisher)

    def publishers(self) -> dict[str, list[str]]:
        """Return the other publishers on the bus: topic → programs.

        The robot's topics are always included.
        """
        assert self._bus is not None
        publishers = self._bus.publishers()
        topics = (STATES_TOPIC, "rt/arm_sdk", "rt/lowcmd", *sorted(publishers))
        return {topic: publishers[topic] for topic in topics}

    def close(self) -> None:
        """Leave the bus."""
        self._bus = None
        self._writer = None
        self._of_others = None
