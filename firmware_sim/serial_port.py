"""The console's port on the host: a pseudo terminal or anything pyserial opens. No part of the firmware itself.

Neither reading nor writing ever waits: what does not fit is dropped, as on a UART that nobody listens to.
"""

import os
import select
import tty
from pathlib import Path

import serial

READ_MAX = 4096


class PortError(OSError):
    """The port cannot be opened; the text names it and what was expected."""


class SerialPort:
    """One open port.

    Args:
        name: `pty` or `pty:/path/of/a/link` for a pseudo terminal of its own, else a device or URL of pyserial
            (`/dev/ttyUSB0`, `socket://127.0.0.1:4000`, `loop://`).

    Attributes:
        name: what to open on the other side, for a pseudo terminal its path.

    Raises:
        PortError: there is no such port, or a socket that is not on this machine's loopback.
    """

    def __init__(self, name: str) -> None:
        self._serial: serial.SerialBase | None = None
        self._link: Path | None = None
        self._descriptors: tuple[int, ...] = ()
        if name == "pty" or name.startswith("pty:"):
            self._open_pty(name.partition(":")[2])
            return
        if name.startswith("socket://") and not name.startswith(("socket://127.0.0.1:", "socket://localhost:")):
            raise PortError(f"{name}: a socket is served on the loopback only, e.g. socket://127.0.0.1:4000")
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
            self._link = Path(link)
            try:
                self._link.symlink_to(self.name)
            except OSError as error:
                self.close()
                raise PortError(f"pty:{link}: {error.strerror}, expected a name that does not exist yet") from None

    def wait(self, seconds: float) -> None:
        """Sleep until there may be something to read, at most so long."""
        if self._descriptors:
            select.select([self._descriptors[0]], [], [], seconds)
        else:
            select.select([], [], [], seconds)

    def read(self) -> bytes:
        """What has arrived, perhaps nothing."""
        if self._serial is not None:
            return bytes(self._serial.read(READ_MAX))
        try:
            return os.read(self._descriptors[0], READ_MAX)
        except BlockingIOError:
            return b""

    def write(self, data: bytes) -> None:
        """Send what fits; the rest is dropped."""
        try:
            if self._serial is not None:
                self._serial.write(data)
            elif data:
                os.write(self._descriptors[0], data)
        except (BlockingIOError, serial.SerialTimeoutException):
            return

    def close(self) -> None:
        """Give the port back."""
        if self._serial is not None:
            self._serial.close()
        for descriptor in self._descriptors:
            os.close(descriptor)
        if self._link is not None and self._link.is_symlink() and str(self._link.readlink()) == self.name:
            self._link.unlink()
