"""Where a hub listens: `unix:/path` or `tcp:127.0.0.1:port`, and nothing that leaves this machine."""

from __future__ import annotations

import socket
from dataclasses import dataclass
from pathlib import Path

_LOOPBACK = {"127.0.0.1": socket.AF_INET, "::1": socket.AF_INET6, "localhost": socket.AF_INET}
_MAX_UNIX_PATH = 107


class BusUrlError(ValueError):
    """A bus URL that cannot be used; the message is one line with the URL and what was expected."""


@dataclass(frozen=True)
class Address:
    """A hub's address as the socket functions want it."""

    url: str
    family: socket.AddressFamily
    target: str | tuple[str, int]

    @property
    def is_tcp(self) -> bool:
        """Whether the stream is TCP on the loopback."""
        return self.family is not socket.AF_UNIX

    @property
    def path(self) -> Path:
        """The path of a Unix socket."""
        assert isinstance(self.target, str)
        return Path(self.target)


def parse_address(url: str) -> Address:
    """Return the address of a hub.

    Raises BusUrlError for anything but `unix:` with a path that fits a socket address, or `tcp:` on the
    loopback: the stream has neither a password nor encryption, so it must not leave the machine.
    """
    scheme, colon, rest = url.partition(":")
    if scheme == "unix" and colon:
        if not rest or "\0" in rest:
            raise BusUrlError(f"{url!r}: expected unix:/path of a socket")
        if len(rest.encode()) > _MAX_UNIX_PATH:
            raise BusUrlError(
                f"{url!r}: the path of a Unix socket has at most {_MAX_UNIX_PATH} bytes, this one has"
                f" {len(rest.encode())}; choose a shorter one, for instance under /tmp"
            )
        return Address(url, socket.AF_UNIX, rest)
    if scheme == "tcp" and colon:
        host, colon, number = rest.rpartition(":")
        name = host[1:-1] if host.startswith("[") and host.endswith("]") else host
        if not colon or not number.isascii() or not number.isdigit() or int(number) > 65535:
            raise BusUrlError(f"{url!r}: expected tcp:127.0.0.1:port with a port from 0 to 65535")
        family = _LOOPBACK.get(name)
        if family is None:
            raise BusUrlError(
                f"{url!r}: a hub has no password, so it is only reachable on this machine: expected"
                " tcp:127.0.0.1:port or tcp:[::1]:port (use an ssh tunnel from elsewhere)"
            )
        return Address(url, family, ("127.0.0.1" if name == "localhost" else name, int(number)))
    raise BusUrlError(f"{url!r}: expected unix:/path or tcp:127.0.0.1:port")
