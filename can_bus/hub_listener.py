"""An address that a hub listens on: a loopback port, or a socket file that is nobody else's and goes with the hub."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import socket
import stat
import struct
from collections.abc import Iterator
from pathlib import Path

import can

from can_bus.address import Address

_WAITING = 128
"""Clients that may have connected and not been accepted yet."""


class Listener:
    """A listening socket.

    Attributes:
        url: where clients find it; port 0 has become the port that was chosen.
    """

    def __init__(self, address: Address) -> None:
        """Listen.

        Raises:
            can.CanInitializationError: the address is another program's, or cannot be used.
        """
        self._address = address
        self._file: tuple[Path, int, int] | None = None  # with device and inode
        self._socket = socket.socket(address.family, socket.SOCK_STREAM)
        try:
            if address.is_tcp:
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                self._socket.bind(address.target)
                self._socket.listen(_WAITING)
                host, port = self._socket.getsockname()[:2]
                self.url = f"tcp:[{host}]:{port}" if ":" in host else f"tcp:{host}:{port}"
            else:
                self._bind_file()
                self.url = address.url
        except OSError as error:
            self._socket.close()
            if error.errno == errno.EADDRINUSE:
                raise can.CanInitializationError(f"{address.url}: the address is in use by another program") from error
            raise can.CanInitializationError(f"{address.url}: cannot listen there: {error.strerror}") from error
        except BaseException:
            self._socket.close()
            raise
        self._socket.setblocking(False)

    def _bind_file(self) -> None:
        """Create the socket file with mode 0600, never open to others even for an instant.

        A socket file nobody serves any more is replaced. The lock on the directory keeps two starting hubs from
        each taking the other's new file for a stale one.
        """
        path, url = self._address.path, self._address.url
        with _directory_lock(path.parent):
            if path.is_symlink() or path.exists():
                if not stat.S_ISSOCK(path.lstat().st_mode):
                    raise can.CanInitializationError(f"{url}: a file that is no socket is in the way")
                if _is_served(path):
                    raise can.CanInitializationError(f"{url}: another hub is serving this path")
                path.unlink()
            os.fchmod(self._socket.fileno(), 0o600)  # on Linux the file inherits the mode of the unbound socket
            self._socket.bind(str(path))
            path.chmod(0o600)
            self._socket.listen(_WAITING)
            status = path.stat()
        self._file = path.absolute(), status.st_dev, status.st_ino

    def accept(self) -> tuple[socket.socket, str, bool]:
        """The next client's socket, which does not block, who it is, and whether it came by TCP.

        Raises:
            OSError: as `socket.accept`; BlockingIOError when nobody waits.
        """
        connection, peer = self._socket.accept()
        connection.setblocking(False)
        if self._address.is_tcp:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            name = f"client at {peer}"
        else:
            pid, _, _ = struct.unpack("3i", connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
            name = f"client (pid {pid})"
        return connection, f"{name} on {self._address.url}", self._address.is_tcp

    def fileno(self) -> int:
        """The socket; it is readable when a client waits."""
        return self._socket.fileno()

    def close(self) -> None:
        """Stop listening, and remove the socket file unless somebody has put another one in its place."""
        self._socket.close()
        if self._file is None:
            return
        path, device, inode = self._file
        with contextlib.suppress(OSError):
            status = path.lstat()
            if (status.st_dev, status.st_ino) == (device, inode):
                path.unlink()


@contextlib.contextmanager
def _directory_lock(directory: Path) -> Iterator[None]:
    try:
        descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError as error:
        raise can.CanInitializationError(f"unix:{directory}: {error.strerror}") from error
    try:
        with contextlib.suppress(OSError):  # some network file systems have no locks
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _is_served(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(str(path))
        except (ConnectionRefusedError, FileNotFoundError):
            return False
        except OSError:  # a full backlog, or somebody else's socket: in any case not ours to remove
            return True
        return True
