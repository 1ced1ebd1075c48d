"""The client side of a hub: the native, fast link over a Unix or loopback TCP stream."""

from __future__ import annotations

import contextlib
import fcntl
import select
import socket
import termios
import threading
import time
from collections.abc import Callable, Iterable, Sequence

import can

from can_bus import hub_wire
from can_bus.address import Address, parse_address
from can_bus.frame import MAX_DATA, RECORD_SIZE, Frame, pack, unpack
from can_bus.link import BaseLink, BusLost
from can_bus.timeval import SHORT, timeval

_CHUNK = 16384  # larger allocations cost more than the second receive they save
_SEND_LIMIT = 60.0
_CLOSE_LIMIT = 2.0
_RETRY = 0.02
_LEN_OF_LAST = hub_wire.LEN_OFFSET - RECORD_SIZE


class HubLink(BaseLink):
    """A node's connection to a hub at `unix:/path` or `tcp:127.0.0.1:port`.

    Opening returns after the hub's welcome: from then on no frame is missed. An embedded hub gives its welcome
    only while its host is receiving. A link does not reconnect when the hub comes back.
    """

    def __init__(
        self,
        url: str,
        *,
        filters: Iterable[int] | None = None,
        echo: bool = False,
        wait: float = 0.0,
        welcome_timeout: float = 10.0,
    ) -> None:
        """Connect and wait for the welcome.

        Args:
            url: `unix:/path` or `tcp:127.0.0.1:port`.
            filters: standard identifiers wanted, None for all frames.
            echo: whether the own frames come back, in their place in the bus's order.
            wait: seconds to wait for a hub that is not there yet.
            welcome_timeout: seconds to wait for the welcome of a hub that is there.
        """
        super().__init__(url, filters)
        self._partial = b""
        self._timeout: float | None = None
        self._lock = threading.Lock()
        address = parse_address(url)
        self._tcp = address.is_tcp
        self._socket = _connect(address, wait)
        self._hangup: select.poll | None = None
        try:
            self._greet(echo, welcome_timeout)
            self._socket.settimeout(None)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, timeval(_SEND_LIMIT))
            if self._tcp:
                self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._hangup = select.poll()
                self._hangup.register(self._socket, select.POLLRDHUP)
        except BaseException:
            self._socket.close()
            raise
        self._readable = select.poll()
        self._readable.register(self._socket, select.POLLIN)
        self._read: Callable[..., bytes] = self._socket.recv

    def _greet(self, echo: bool, timeout: float) -> None:
        answer = b""
        end = time.monotonic() + timeout
        try:
            self._socket.settimeout(timeout)
            self._socket.sendall(hub_wire.hello(hub_wire.FLAG_ECHO if echo else 0))
            while len(answer) < RECORD_SIZE:
                self._socket.settimeout(max(1e-3, end - time.monotonic()))
                part = self._socket.recv(RECORD_SIZE - len(answer))
                if not part:
                    raise can.CanInitializationError(f"{self._url}: the hub closed the connection before its welcome")
                answer += part
        except TimeoutError as error:
            raise can.CanInitializationError(
                f"{self._url}: no welcome within {timeout:g} s; is the hub's process stopped, or is this no hub?"
            ) from error
        except OSError as error:
            raise can.CanInitializationError(f"{self._url}: {error.strerror}") from error
        refusal = hub_wire.goodbye_text(answer)
        if refusal is not None:
            raise can.CanInitializationError(f"{self._url}: refused, {refusal}")
        magic, version, _, _ = hub_wire.HELLO.unpack(answer)
        if magic != hub_wire.MAGIC or version != hub_wire.VERSION:
            raise can.CanInitializationError(f"{self._url}: what answers there is not a hub of this protocol")

    def recv(self, timeout: float | None) -> list[Frame]:
        """Return all frames that arrived, waiting for the first; see `Link.recv`."""
        if self._wanted is None:  # the common case needs no clock
            return self._receive(timeout, _CHUNK)
        return self._receive_wanted(lambda left: self._receive(left, _CHUNK), timeout)

    def recv_one(self, timeout: float | None) -> Frame | None:
        """Return one frame, or None on time-out; the next one stays in the socket, where `select` sees it."""
        frames = self._receive_wanted(lambda left: self._receive(left, RECORD_SIZE - len(self._partial)), timeout)
        return frames[0] if frames else None

    def _receive(self, timeout: float | None, size: int) -> list[Frame]:
        try:
            if timeout is not None and timeout < SHORT:
                if timeout > 0:
                    self._readable.poll(timeout * 1000)
                chunk = self._read(size, socket.MSG_DONTWAIT)
            else:
                if timeout != self._timeout:
                    self._set_timeout(timeout)
                chunk = self._read(size)
        except BlockingIOError:
            return []
        except can.CanError:
            raise
        except OSError as error:
            raise self._lose(f"the hub is gone ({error.strerror})") from error
        if len(chunk) % RECORD_SIZE or self._partial or not chunk or chunk[_LEN_OF_LAST] > MAX_DATA:
            chunk = self._sort_out(chunk)
            if not chunk:  # so far only a part of a record came
                return self._receive(timeout, RECORD_SIZE - len(self._partial))
        return unpack(chunk)

    def _sort_out(self, chunk: bytes) -> bytes:
        """Return the complete records in what came; the end of the stream or a goodbye in front raises."""
        if not chunk:
            raise self._lose("the hub is gone (it closed the connection without a goodbye)")
        chunk = self._partial + chunk
        whole = len(chunk) - len(chunk) % RECORD_SIZE
        self._partial = chunk[whole:]
        chunk = chunk[:whole]
        if chunk and chunk[_LEN_OF_LAST] > MAX_DATA:
            reason = hub_wire.goodbye_text(chunk[-RECORD_SIZE:]) or "the hub sent a malformed record"
            chunk = chunk[:-RECORD_SIZE]
            lost = self._lose(reason)
            if not chunk:
                raise lost
        return chunk

    def _lose(self, reason: str) -> BusLost:
        self._read = self._refuse
        return super()._lose(reason)

    def _refuse(self, size: int, flags: int = 0) -> bytes:
        raise self._lose("")

    def _set_timeout(self, timeout: float | None) -> None:
        """Let the kernel bound the next receives: one system call less than poll and receive."""
        if self._dead is None:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, timeval(timeout))
            self._timeout = timeout

    def send(self, frames: Sequence[Frame]) -> None:
        """Send the batch in one system call; blocks while the hub's host is busy and the socket is full."""
        if frames:
            self.send_packed(pack(frames))

    def send_packed(self, records: bytes) -> None:
        """Send what `pack` made. The caller vouches for the format: a malformed record ends the connection."""
        if self._dead is not None:
            raise self._lose("")
        try:
            with self._lock:
                if self._hangup is not None and self._hangup.poll(0):  # TCP would swallow the first batch silently
                    raise self._lose(self._last_words() or "the hub is gone")
                self._socket.sendall(records)
        except BlockingIOError as error:
            raise self._lose(f"the hub has not read for {_SEND_LIMIT:g} s") from error
        except can.CanError:
            raise
        except OSError as error:
            raise self._lose(self._last_words() or f"the hub is gone ({error.strerror})") from error

    def _last_words(self) -> str | None:
        """Return the goodbye that may wait behind unread frames; they can't be trusted to be all, so they go."""
        text = self._partial
        with contextlib.suppress(OSError):
            while chunk := self._socket.recv(_CHUNK, socket.MSG_DONTWAIT):
                text = text[len(text) // RECORD_SIZE * RECORD_SIZE - RECORD_SIZE :] + chunk
        whole = len(text) // RECORD_SIZE * RECORD_SIZE
        return hub_wire.goodbye_text(text[whole - RECORD_SIZE : whole]) if whole else None

    def fileno(self) -> int:
        """The socket; it is readable when frames or the end of the bus are waiting."""
        return self._socket.fileno()

    def close(self) -> None:
        """Leave the bus; what was sent before is still switched. A second call does nothing."""
        if self._socket.fileno() < 0:
            return
        self._closed()
        try:
            if self._tcp:
                self._flush()
            self._socket.shutdown(socket.SHUT_RDWR)
        except OSError:
            pass
        self._socket.close()

    def _flush(self) -> None:
        """Wait until the hub's kernel has what we sent: closing TCP with unread input throws unsent output away."""
        self._socket.shutdown(socket.SHUT_WR)
        end = time.monotonic() + _CLOSE_LIMIT
        while time.monotonic() < end:
            unsent = fcntl.ioctl(self._socket, termios.TIOCOUTQ, bytes(4))
            if int.from_bytes(unsent, "little") <= 1:  # the FIN counts as one
                return
            time.sleep(1e-3)


def _connect(address: Address, wait: float) -> socket.socket:
    end = time.monotonic() + wait
    while True:
        connection = socket.socket(address.family, socket.SOCK_STREAM)
        try:
            connection.settimeout(10.0)
            connection.connect(address.target)
            return connection
        except OSError as error:
            connection.close()
            if isinstance(error, FileNotFoundError | ConnectionRefusedError):
                if time.monotonic() < end:
                    time.sleep(_RETRY)
                    continue
                raise can.CanInitializationError(f"{address.url}: no hub is serving there") from error
            raise can.CanInitializationError(f"{address.url}: {error.strerror or error}") from error
