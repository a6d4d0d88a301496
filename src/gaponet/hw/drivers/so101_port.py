"""The serial port of an SO-101: opened once, kept from other programs, and lent to the watchdog."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING

from gaponet.base.installation import install_command
from gaponet.hw.control.driver import DriverError
from gaponet.hw.drivers.feetech import ServoBus
from gaponet.hw.drivers.serial_port import other_programs

try:
    import fcntl
    import termios
except ImportError:  # Windows, where only one program can open a port
    PORT_ERRORS: tuple[type[Exception], ...] = (OSError,)
    EXCLUSIVE = 0
    SHARED = 0
else:
    # Pyserial's own errors are OSErrors; a removed port also raises the other.
    PORT_ERRORS = (
        OSError,
        termios.error,
    )
    EXCLUSIVE = termios.TIOCEXCL
    SHARED = termios.TIOCNXCL

if TYPE_CHECKING:
    from serial import Serial

BAUD = 1_000_000
PORT_TIMEOUT_S = 0.002
WRITE_TIMEOUT_S = 1.0


class SO101Port:
    """A serial port and the servo bus behind it.

    Attributes:
        name: Of the port, e.g. /dev/ttyACM0.
        timeout: Longest silence of the bus while replies are awaited, s.
    """

    def __init__(self, name: str, timeout: float) -> None:
        self.name = name
        self.timeout = timeout
        self._serial: Serial | None = None  # None: closed
        self._bus: ServoBus | None = None  # of the port that was opened last
        self._is_lent = False  # open for others until it is taken back

    @property
    def is_open(self) -> bool:
        """True between `open` and `close`."""
        return self._serial is not None

    @property
    def bus(self) -> ServoBus:
        """The bus of the open port.

        Raises:
            DriverError: The port is closed, as it is after its cable fell out.
        """
        if self._serial is None or self._bus is None:
            raise DriverError(f"{self.name}: the port is closed; is the cable in?")
        return self._bus

    def open(self) -> ServoBus:
        """Return the bus of the port, which is opened if it is closed.

        Raises:
            DriverError: The port cannot be opened, or pyserial is not installed.
        """
        if self._serial is not None and self._bus is not None:
            return self._bus
        try:
            import serial
        except ImportError:
            raise DriverError(
                f"pyserial is not installed; run: {install_command('so101')}"
            ) from None
        try:
            self._serial = serial.Serial(
                self.name,
                BAUD,
                timeout=PORT_TIMEOUT_S,
                write_timeout=max(WRITE_TIMEOUT_S, self.timeout),
            )
        except (serial.SerialException, ValueError, OSError) as error:
            hint = (
                "is the arm plugged in, may you use the port, does another program command the arm?"
            )
            raise DriverError(f"{self.name}: {error}; {hint}") from None
        self._bus = ServoBus(self._serial, self.timeout)
        return self._bus

    def claim(self) -> None:
        """Keep other programs from opening the port, and refuse if one has it open already.

        Raises:
            DriverError: With the programs.
        """
        self.keep_others_out()
        self._is_lent = False
        others = other_programs(self.name)
        if others:
            raise DriverError(
                f"{self.name}: {', '.join(others)} has the port open and can command the arm; end "
                "it first"
            )

    def keep_others_out(self) -> None:
        """Let no other program open the port. Who has it open, as our watchdog, keeps it."""
        self._set_sharing(EXCLUSIVE)

    def lend(self) -> None:
        """Let other programs open the port until `take_back`."""
        self._set_sharing(SHARED)
        self._is_lent = True

    def take_back(self) -> None:
        """Claim the port again if it was lent."""
        if self._is_lent:
            self.claim()

    @contextlib.contextmanager
    def errors(self) -> Iterator[None]:
        """Turn errors of the port into DriverErrors and close it.

        The next `open` opens it again.
        """
        try:
            yield
        except PORT_ERRORS as error:
            self.close()
            raise DriverError(f"{self.name}: {error}; is the cable in?") from None

    def close(self) -> None:
        """Close the port; others may open it."""
        if self._serial is not None:
            self._set_sharing(SHARED)
            with contextlib.suppress(*PORT_ERRORS):
                self._serial.close()
        self._serial = None

    def _set_sharing(self, mode: int) -> None:
        """Let other programs open the port (SHARED), or not (EXCLUSIVE)."""
        # A port without a descriptor, or removed.
        with contextlib.suppress(*PORT_ERRORS, AttributeError, ValueError):
            if mode:
                fcntl.ioctl(self._serial.fileno(), mode)  # type: ignore[union-attr]
