"""The console's port on the host: a pseudo terminal or anything pyserial opens. No part of the firmware itself.

Neither reading nor writing ever waits: what does not fit is dropped and counted, as on a UART that nobody listens to.

pyserial's own `write` is avoided where there is a descriptor: with a time-out of zero it does not return when the
device takes nothing, it tries again without a pause, and the control loop would share its CPU with that.
"""

import os
import select
import tty
from pathlib import Path
from urllib.parse import urlsplit

import serial

READ_MAX = 128
"""Bytes taken at once: as few as keep every answer to them short, for the control loop runs beside it."""

PENDING_MAX = 32768
"""Bytes that wait for the other side: all waiting log lines and a reply."""

NETWORK = ("socket", "rfc2217")
LOOPBACK = ("127.0.0.1", "localhost", "::1")


class PortError(OSError):
    """The port cannot be opened or is gone; the text names it and what was expected."""


class SerialPort:
    """One open port.

    Args:
        name: `pty` or `pty:/path/of/a/link` for a pseudo terminal of its own, else a device or URL of pyserial
            (`/dev/ttyUSB0`, `socket://127.0.0.1:4000`).

    Attributes:
        name: what to open on the other side, for a pseudo terminal its path.
        dropped: bytes that did not fit.

    Raises:
        PortError: there is no such port, or a socket that is not on this machine's loopback.
    """

    def __init__(self, name: str) -> None:
        self._serial: serial.SerialBase | None = None
        self._link: Path | None = None
        self._descriptors: tuple[int, ...] = ()
        self._pending = bytearray()
        self.dropped = 0
        if name == "pty" or name.startswith("pty:"):
            self._open_pty(name.partition(":")[2])
            return
        try:
            url = urlsplit(name)  # not a comparison of prefixes: SOCKET:// and 127.0.0.1:1@elsewhere are URLs too
            away = url.scheme in NETWORK and url.hostname not in LOOPBACK
            itself = url.scheme == "loop"
        except ValueError as error:
            raise PortError(f"{name}: {error}") from None
        if away:
            raise PortError(f"{name}: a socket must be on the loopback, e.g. socket://127.0.0.1:4000")
        if itself:
            raise PortError(f"{name}: leads back to the console itself, expected a port with another side")
        try:
            self._serial = serial.serial_for_url(name, timeout=0, write_timeout=0)
        except (serial.SerialException, ValueError) as error:
            raise PortError(f"{name}: {error}") from None
        self.name = name

    def _open_pty(self, link: str) -> None:
        master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        self._descriptors = master, slave  # the slave stays open: without it a read fails while nobody is attached
        self.name = os.ttyname(slave)
        if link:
            path = Path(link)
            try:
                if self._left_behind(path):
                    path.unlink()
                path.symlink_to(self.name)
            except OSError as error:
                self.close()
                raise PortError(f"pty:{link}: {error.strerror}, expected a name that does not exist yet") from None
            self._link = path

    def _left_behind(self, link: Path) -> bool:
        """Whether a link is that of a firmware that was killed: to no terminal, or to ours by its number."""
        if not link.is_symlink():
            return False
        target = str(link.readlink())
        return target == self.name or (target.startswith("/dev/pts/") and not link.exists())

    def fileno(self) -> int:
        """For `select`; -1: this kind of port has no descriptor."""
        if self._descriptors:
            return self._descriptors[0]
        try:
            return int(self._serial.fileno())  # type: ignore[union-attr]
        except (AttributeError, OSError):  # rfc2217:// and others; io.UnsupportedOperation is an OSError
            return -1

    def wait(self, seconds: float) -> None:
        """Sleep until there may be something to read or what waits can be sent, at most so long."""
        descriptor = self.fileno()
        readable = [] if descriptor < 0 else [descriptor]
        select.select(readable, readable if self._pending else [], [], seconds)

    def read(self) -> bytes:
        """What has arrived, perhaps nothing.

        Raises:
            PortError: the port is gone.
        """
        try:
            if self._serial is not None:
                return bytes(self._serial.read(READ_MAX))
            return os.read(self._descriptors[0], READ_MAX)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise PortError(f"{self.name}: {error}") from None

    def write(self, data: bytes) -> None:
        """Send what fits, the rest later; what then is too much is dropped from the end, by whole lines.

        Raises:
            PortError: the port is gone.
        """
        kept = data
        if len(data) > PENDING_MAX - len(self._pending):
            kept = data[: PENDING_MAX - len(self._pending)]
            kept = kept[: kept.rfind(b"\n") + 1]
            self.dropped += len(data) - len(kept)
        self._pending += kept
        if not self._pending:
            return
        try:
            del self._pending[: self._send(bytes(self._pending))]
        except (BlockingIOError, serial.SerialTimeoutException):
            return
        except OSError as error:
            raise PortError(f"{self.name}: {error}") from None

    def _send(self, data: bytes) -> int:
        """How many bytes the port has taken."""
        descriptor = self.fileno()
        if descriptor >= 0:
            return os.write(descriptor, data)  # non-blocking: pyserial opens devices and sockets so too
        self._serial.write(data)  # type: ignore[union-attr]
        return len(data)

    def close(self) -> None:
        """Give the port back."""
        if self._serial is not None:
            self._serial.close()
        for descriptor in self._descriptors:
            os.close(descriptor)
        if self._link is not None and self._link.is_symlink() and str(self._link.readlink()) == self.name:
            self._link.unlink()
