"""The hub: a CAN bus made of one small, single-threaded switch and stream sockets.

It promises what a lockstep bench needs: one order of all frames for every receiver, no frame lost, no own frames
unless asked for, a joining node that knows from when on it misses nothing, and a loud end when something dies. It
is no model of the electrical bus: no arbitration by identifier, no bit timing, no error counters.

Run one by hand with `python -m can_bus.hub unix:/tmp/bus tcp:127.0.0.1:29536`.
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import os
import select
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterable, Sequence
from types import TracebackType
from typing import Final, Self

import can

from can_bus import hub_wire
from can_bus.address import BusUrlError, parse_address
from can_bus.frame import MAX_DATA, RECORD_SIZE
from can_bus.hub_listener import Listener
from can_bus.hub_local import LocalLink
from can_bus.hub_wire import Reason

_log = logging.getLogger("can_bus.hub")

DEFAULT_CAP: Final = 262_144
_CHUNK: Final = 16384
_LINGER: Final = 10.0
_IN: Final = select.EPOLLIN
_OUT: Final = select.EPOLLOUT
_EVENTS: Final = 64
_LEN: Final = hub_wire.LEN_OFFSET


class _Client:
    """One connection: greeting (no hello yet), member (on the bus) or leaving (gets its goodbye)."""

    __slots__ = ("deadline", "echo", "fd", "member", "mute", "name", "out", "partial", "recv", "send", "sock", "tcp")

    def __init__(self, sock: socket.socket, name: str, tcp: bool) -> None:
        self.sock = sock
        self.recv = sock.recv
        self.send = sock.send
        self.fd = sock.fileno()
        self.name = name
        self.tcp = tcp
        self.echo = False
        self.member = False
        self.mute = False  # its end is closed: it can't be sent anything, but what it sent may wait to be read
        self.deadline: float | None = None  # set when it is leaving
        self.partial = b""
        self.out = bytearray()


class Hub:
    """A switch for CAN frames that listens on any number of Unix and loopback TCP addresses.

    There are two ways to run it. *Embedded*: a node hosts it, talks through `local_link()`, and every blocking
    receive of that link does the switching; while the host computes nothing is forwarded, and in lockstep nobody
    minds. *Standalone*: `serve_forever()` in a process or thread of its own.

    A hub belongs to the thread that drives it. Only `stop`, `clients` and, while another thread is in
    `serve_forever`, `wait_for_clients` may be used from elsewhere.

    It never holds back a sender, so senders can't deadlock; a reader that falls behind by more than `cap` frames
    is disconnected instead, with an error in the log here and the reason in a `BusLost` there.
    """

    def __init__(self, urls: str | Iterable[str] = (), *, cap: int = DEFAULT_CAP) -> None:
        """Listen on the URLs at once.

        Args:
            urls: `unix:/path`, `tcp:127.0.0.1:port` (port 0 chooses one, see `urls`); none is fine for a
                hub that has only local links.
            cap: how many frames the hub keeps for one slow reader before it disconnects it.
        """
        self._cap = cap
        self._epoll = select.epoll()
        self._listeners: dict[int, Listener] = {}
        self._clients: dict[int, _Client] = {}
        self._members: tuple[_Client, ...] = ()
        self._leaving = 0
        self._locals: tuple[LocalLink, ...] = ()
        self.closed = False
        self._stopping = False
        self._selected = False
        self._server: threading.Thread | None = None
        self._changed = threading.Condition()
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._epoll.register(self._wake, _IN)
        self.urls: list[str] = []
        try:
            for url in [urls] if isinstance(urls, str) else urls:
                listener = Listener(parse_address(url))
                self._listeners[listener.fileno()] = listener
                self._epoll.register(listener, _IN)
                self.urls.append(listener.url)
        except BaseException:
            self.close(linger=0.0)
            raise

    # -- driving it --------------------------------------------------------------------------------------------

    def local_link(self, filters: Iterable[int] | None = None) -> LocalLink:
        """Return a link of the hosting node; its `recv` runs the hub. Several are fine, in one thread."""
        link = LocalLink(self, filters)
        self._locals = (*self._locals, link)
        return link

    def serve_forever(self) -> None:
        """Switch until `stop` is called (from a signal handler or another thread)."""
        with self._changed:
            self._server = threading.current_thread()
        try:
            while not self._stopping:
                self.poll(None)
        finally:
            with self._changed:
                self._server = None
                self._changed.notify_all()

    def start(self) -> Self:
        """Serve in a daemon thread of this process until `stop` or `close`."""
        thread = threading.Thread(target=self.serve_forever, name="can hub", daemon=True)
        with self._changed:
            if self._server is not None:
                raise ValueError("the hub is already being served")
            self._server = thread
        thread.start()
        return self

    def stop(self) -> None:
        """Make `serve_forever` return; safe in signal handlers and other threads. Does not close the hub."""
        self._stopping = True
        self._wake_up()

    def _wake_up(self) -> None:
        with contextlib.suppress(OSError):
            os.eventfd_write(self._wake, 1)

    def poll(self, timeout: float | None) -> bool:
        """Wait up to `timeout` seconds (None: for ever) for something to do, do it; False when there was nothing."""
        if self.closed:
            raise ValueError("the hub is closed")
        if self._leaving:
            timeout = self._expire(timeout)
        batches: list[tuple[_Client, bytes]] = []
        events = self._epoll.poll(timeout, _EVENTS)
        for fd, event in events:
            client = self._clients.get(fd)
            if client is None:
                self._other_event(fd)
                continue
            if event & _OUT:
                self._drain(client)
            if event != _OUT:
                records = self._read(client)
                if records:
                    batches.append((client, records))
        if batches:
            self._switch(batches)
        return bool(events)

    def _other_event(self, fd: int) -> None:
        if fd == self._wake:
            with contextlib.suppress(BlockingIOError):
                os.eventfd_read(self._wake)
        elif fd in self._listeners:
            try:
                client = _Client(*self._listeners[fd].accept())
            except (BlockingIOError, ConnectionError):
                pass  # the client went away before we got to it
            except OSError as error:
                _log.error("%s: cannot accept a client: %s", self._listeners[fd].url, error.strerror)
            else:
                self._clients[client.fd] = client
                self._epoll.register(client.sock, _IN)

    # -- clients -----------------------------------------------------------------------------------------------

    @property
    def clients(self) -> int:
        """How many clients have been welcomed and are still there (local links are not counted)."""
        return len(self._members)

    def wait_for_clients(self, count: int, timeout: float) -> None:
        """Switch until `count` clients are on the bus; TimeoutError names those that came."""
        end = time.monotonic() + timeout
        while len(self._members) < count:
            left = end - time.monotonic()
            if left <= 0:
                came = ", ".join(client.name for client in self._members) or "none"
                where, here = " ".join(self.urls), len(self._members)
                raise TimeoutError(f"{where}: {here} of {count} clients joined within {timeout:g} s ({came})")
            with self._changed:
                if self._server not in (None, threading.current_thread()):
                    if len(self._members) < count:
                        self._changed.wait(left)
                    continue
            self.poll(left)

    def _set_members(self, members: Iterable[_Client]) -> None:
        with self._changed:
            self._members = tuple(members)
            self._changed.notify_all()

    def _read(self, client: _Client) -> bytes:
        """Return the complete records a member sent, b"" when there are none (or it is gone)."""
        try:
            chunk = client.recv(_CHUNK)
        except BlockingIOError:
            return b""
        except OSError:
            chunk = b""
        if not chunk:
            self._forget(client)
            return b""
        if not client.member or client.partial or len(chunk) % RECORD_SIZE:
            if client.deadline is not None:
                return b""
            chunk = client.partial + chunk
            if not client.member:
                client.partial = b""
                chunk = self._greet(client, chunk)
                if not client.member:
                    return b""
            whole = len(chunk) - len(chunk) % RECORD_SIZE
            client.partial = chunk[whole:]
            chunk = chunk[:whole]
            if not chunk:
                return b""
        longest = chunk[_LEN] if len(chunk) == RECORD_SIZE else max(chunk[_LEN::RECORD_SIZE])
        if longest > MAX_DATA:
            _log.error("%s sent a record of length %d: disconnected", client.name, longest)
            self._dismiss(client, Reason.MALFORMED, longest)
            return b""
        return chunk

    def _greet(self, client: _Client, chunk: bytes) -> bytes:
        """Answer a hello and return what came behind it; an incomplete hello waits in `partial`."""
        if chunk[: len(hub_wire.MAGIC)] != hub_wire.MAGIC[: len(chunk)]:
            _log.error("%s did not send a hello of this protocol: disconnected", client.name)
            self._dismiss(client, Reason.NOT_A_CLIENT, 0)
            return b""
        if len(chunk) < hub_wire.HELLO.size:
            client.partial = chunk
            return b""
        _, version, flags, pid = hub_wire.HELLO.unpack_from(chunk)
        if version != hub_wire.VERSION:
            _log.error("%s speaks protocol version %d, not %d: disconnected", client.name, version, hub_wire.VERSION)
            self._dismiss(client, Reason.VERSION, hub_wire.VERSION)
            return b""
        if client.tcp and pid:
            client.name += f" (pid {pid})"
        client.echo = bool(flags & hub_wire.FLAG_ECHO)
        client.member = True
        self._push(client, hub_wire.hello(flags))
        self._set_members((*self._members, client))
        _log.info("%s joined", client.name)
        return chunk[hub_wire.HELLO.size :]

    # -- switching ---------------------------------------------------------------------------------------------

    def _switch(self, batches: list[tuple[_Client, bytes]]) -> None:
        """Forward what was read, in the order it was read, to everybody: this order is the bus's order."""
        if len(batches) == 1:
            sender, records = batches[0]
            for client in self._members:
                if client is not sender or client.echo:
                    self._push(client, records)
            for link in self._locals:
                link.deliver(records)
        else:
            for client in self._members:
                records = b"".join([chunk for sender, chunk in batches if client is not sender or client.echo])
                if records:
                    self._push(client, records)
            if self._locals:
                records = b"".join([chunk for _, chunk in batches])
                for link in self._locals:
                    link.deliver(records)

    def switch_local(self, link: LocalLink, records: bytes) -> None:
        """Put a batch of a local link on the bus."""
        for client in self._members:
            self._push(client, records)
        if len(self._locals) > 1:
            for other in self._locals:
                if other is not link:
                    other.deliver(records)
            if self._selected:
                self._wake_up()

    def _push(self, client: _Client, records: bytes) -> None:
        out = client.out
        if not out:
            if client.mute:
                return
            try:
                sent = client.send(records)
            except BlockingIOError:
                sent = 0
            except OSError:
                client.mute = True
                return
            if sent == len(records):
                return
            out += memoryview(records)[sent:]
            self._epoll.modify(client.fd, _IN | _OUT)
        else:
            out += records
        if len(out) > self._cap * RECORD_SIZE:
            self._overrun(client)

    def _drain(self, client: _Client) -> None:
        """Write what waits for a client, as far as it goes."""
        out = client.out
        try:
            while out:
                with memoryview(out) as view:
                    sent = client.sock.send(view[: 16 * _CHUNK])
                del out[:sent]
        except BlockingIOError:
            return
        except OSError:
            client.mute = True
            out.clear()
        if client.deadline is not None:
            self._farewell(client)
        elif client.fd in self._clients:
            self._epoll.modify(client.fd, _IN)

    # -- the end of a client -----------------------------------------------------------------------------------

    def _overrun(self, client: _Client) -> None:
        frames = len(client.out) // RECORD_SIZE
        _log.error("%s is too slow, %d frames wait for it (cap %d): disconnected", client.name, frames, self._cap)
        self._dismiss(client, Reason.OVERRUN, frames)

    def _dismiss(self, client: _Client, reason: Reason, detail: int, *, deliver: bool = False) -> None:
        """Take a client off the bus, with a goodbye behind all that waits, or behind the record that is half sent."""
        if client.member:
            self._set_members(member for member in self._members if member is not client)
        client.member = False
        client.partial = b""
        if not deliver:
            del client.out[len(client.out) % RECORD_SIZE :]
        client.out += hub_wire.goodbye(reason, detail)
        client.deadline = time.monotonic() + _LINGER
        self._leaving += 1
        if not client.tcp:  # its next send fails at once; on TCP what it sends is read and thrown away
            with contextlib.suppress(OSError):
                client.sock.shutdown(socket.SHUT_RD)
        self._epoll.modify(client.fd, (_IN | _OUT) if client.tcp else _OUT)

    def _farewell(self, client: _Client) -> None:
        """The goodbye is out. A Unix socket keeps it for the reader; TCP must not be closed over unread input."""
        if client.tcp and not client.mute:
            with contextlib.suppress(OSError):
                client.sock.shutdown(socket.SHUT_WR)
            self._epoll.modify(client.fd, _IN)
        else:
            self._forget(client)

    def _expire(self, timeout: float | None) -> float | None:
        """Close leaving TCP clients that neither read their goodbye nor hang up; return the wait until the next."""
        now = time.monotonic()
        for client in [client for client in self._clients.values() if client.deadline is not None]:
            assert client.deadline is not None
            left = client.deadline - now
            if left <= 0 and client.tcp:
                self._forget(client)
            elif client.tcp:
                timeout = left if timeout is None else min(timeout, left)
        return timeout

    def _forget(self, client: _Client) -> None:
        if self._clients.pop(client.fd, None) is None:
            return
        if client.deadline is not None:
            self._leaving -= 1
        self._epoll.unregister(client.fd)
        client.sock.close()
        client.out.clear()
        if client.member:
            client.member = False
            self._set_members(member for member in self._members if member is not client)
            _log.info("%s left", client.name)

    # -- the end of the hub ------------------------------------------------------------------------------------

    def fileno(self) -> int:
        """The descriptor to select on when something else must be watched too; readable means: call `poll(0)`."""
        self._selected = True
        return self._epoll.fileno()

    def detach(self, link: LocalLink) -> None:
        """Forget a local link."""
        self._locals = tuple(other for other in self._locals if other is not link)

    def close(self, linger: float = 5.0) -> None:
        """Switch what was sent, deliver what waits, say goodbye, remove the socket files. Calling it again is fine.

        A reader that does not take its frames within `linger` seconds in all loses them, with an error in the log
        here and a `BusLost` there.
        """
        if self.closed:
            return
        server = self._server
        if server is not None and server is not threading.current_thread():
            self.stop()
            server.join()
        for listener in self._listeners.values():
            self._epoll.unregister(listener)
            listener.close()
        self._listeners.clear()
        end = time.monotonic() + linger
        while time.monotonic() < end and self.poll(0):
            pass
        readers = self._members
        for client in readers:
            self._dismiss(client, Reason.CLOSED, 0, deliver=True)
        self.poll(0)
        while any(client.out for client in readers) and (left := end - time.monotonic()) > 0:
            self.poll(left)
        for client in readers:
            untaken = len(client.out) // RECORD_SIZE - 1  # the goodbye is no frame
            if untaken > 0:
                _log.error("%s did not take %d frames before the end", client.name, untaken)
        for client in list(self._clients.values()):
            self._part(client)
        self.closed = True
        self._stopping = True
        self._epoll.close()
        os.close(self._wake)

    def _part(self, client: _Client) -> None:
        with contextlib.suppress(OSError):
            client.sock.shutdown(socket.SHUT_WR)
            for _ in range(64):  # closing TCP over unread input would reset what is on its way
                if not client.sock.recv(_CHUNK):
                    break
        self._forget(client)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close(linger=0.0 if kind else 5.0)


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve a hub until SIGINT or SIGTERM; the exit status is 2 when an address cannot be used."""
    parser = argparse.ArgumentParser(prog="python -m can_bus.hub", description="A CAN bus on local stream sockets.")
    parser.add_argument("urls", nargs="+", metavar="URL", help="unix:/path or tcp:127.0.0.1:port (0: choose one)")
    parser.add_argument("--cap", type=int, default=DEFAULT_CAP, help="frames kept for a slow reader (%(default)s)")
    options = parser.parse_args(arguments)
    logging.basicConfig(format="hub: %(message)s", level=logging.INFO, stream=sys.stderr)
    try:
        hub = Hub(options.urls, cap=options.cap)
    except (BusUrlError, can.CanError) as error:
        print(f"hub: {error}", file=sys.stderr)
        return 2
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: hub.stop())
    with hub:
        print("serving", *hub.urls, flush=True)
        hub.serve_forever()
    return 0


if __name__ == "__main__":
    sys.exit(main())
