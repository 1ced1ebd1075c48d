"""Linux SocketCAN (vcan, or a real adapter with a kernel driver) as a link."""

from __future__ import annotations

import errno
import socket
import struct
import time
from collections.abc import Iterable, Sequence

import can

from can_bus.frame import CAN_EFF_FLAG, CAN_SFF_MASK, RECORD_SIZE, Frame, pack, unpack
from can_bus.hub_link import timeval
from can_bus.link import BaseLink

_SOL_CAN_RAW = 101
_CAN_RAW_FILTER = 1
_SO_RCVBUFFORCE = 33
_SO_TIMESTAMPNS = 35
_SO_RXQ_OVFL = 40
_SO_MEMINFO = 55
_MEMINFO_DROPS = 8
_RECEIVE_BUFFER = 64 << 20
_COUNTER = struct.Struct("@I")
_ANCILLARY = socket.CMSG_SPACE(_COUNTER.size)
_BATCH = 4096
_SEND_LIMIT = 5.0
_SLICE = 1.0


class SocketcanLink(BaseLink):
    """A raw CAN socket on ``socketcan:vcan0`` or any other SocketCAN interface.

    The kernel throws frames away when a socket's receive queue is full (about 280 frames by default). This link asks
    for a queue of some 80,000 (root) or whatever ``net.core.rmem_max`` allows, and the kernel's count of what did not
    fit turns into a ``BusLost``, at the latest one second after. It cannot see frames that the interface itself lost
    before the socket, on a real wire or in the kernel's backlog: the counters of the protocol do that.
    """

    def __init__(
        self, channel: str, *, filters: Iterable[int] | None = None, receive_buffer: int = _RECEIVE_BUFFER
    ) -> None:
        super().__init__(f"socketcan:{channel}", filters)
        wanted = self._wanted
        self._bus = _open(channel)
        self._socket: socket.socket = self._bus.socket
        self._timeout: float | None = None
        self._socket.setblocking(True)
        self._socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 0)
        self._socket.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, receive_buffer)
        except PermissionError:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        if wanted is not None:
            rules = b"".join(struct.pack("=II", i, CAN_SFF_MASK | CAN_EFF_FLAG) for i in wanted.identifiers)
            self._socket.setsockopt(_SOL_CAN_RAW, _CAN_RAW_FILTER, rules)

    def recv(self, timeout: float | None) -> list[Frame]:
        """Return all frames that wait, waiting for the first; see ``Link.recv``."""
        end = None if timeout is None else time.monotonic() + timeout
        while True:
            frames = self._receive(timeout if timeout is not None and timeout < _SLICE else _SLICE)
            if self._wanted is not None:  # the first ones may have come before the kernel's filter was set
                frames = self._wanted.select(frames)
            if frames:
                return frames
            self._check_drops()
            if end is not None:
                timeout = end - time.monotonic()
                if timeout <= 0:
                    return frames

    def _receive(self, timeout: float) -> list[Frame]:
        if self._dead is not None:
            raise self._lose("")
        receive = self._socket.recvmsg
        records: list[bytes] = []
        flags = 0
        if timeout <= 0:
            flags = socket.MSG_DONTWAIT
        elif timeout != self._timeout:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, timeval(timeout))
            self._timeout = timeout
        try:
            while len(records) < _BATCH:
                record, ancillary, _, _ = receive(RECORD_SIZE, _ANCILLARY, flags)
                if ancillary:
                    self._count(ancillary)
                records.append(record)
                flags = socket.MSG_DONTWAIT
        except BlockingIOError:
            pass
        except OSError as error:
            raise self._lose(f"the interface is gone ({error.strerror})") from error
        return unpack(b"".join(records))

    def _count(self, ancillary: list[tuple[int, int, bytes]]) -> None:
        for level, kind, value in ancillary:
            if level == socket.SOL_SOCKET and kind == _SO_RXQ_OVFL:
                self._lost_frames(*_COUNTER.unpack(value))

    def _check_drops(self) -> None:
        """Ask for the drop count: a loss with nothing behind it shows in no received frame."""
        counters = self._socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 64)
        if len(counters) > 4 * _MEMINFO_DROPS:
            self._lost_frames(*_COUNTER.unpack_from(counters, 4 * _MEMINFO_DROPS))

    def _lost_frames(self, count: int) -> None:
        if count:
            raise self._lose(f"{count} frames lost: this reader was too slow for the kernel's receive queue")

    def send(self, frames: Sequence[Frame]) -> None:
        """Send the frames one by one; a full transmit queue is waited out for some seconds, then raises ``BusLost``."""
        if self._dead is not None:
            raise self._lose("")
        records = pack(frames)
        send = self._socket.send
        for start in range(0, len(records), RECORD_SIZE):
            record = records[start : start + RECORD_SIZE]
            try:
                send(record)
            except OSError as error:
                self._send_again(record, error)

    def _send_again(self, record: bytes, error: OSError) -> None:
        end = time.monotonic() + _SEND_LIMIT
        while error.errno == errno.ENOBUFS and time.monotonic() < end:
            time.sleep(1e-3)
            try:
                self._socket.send(record)
                return
            except OSError as again:
                error = again
        if error.errno == errno.ENOBUFS:
            raise self._lose(f"the transmit queue stayed full for {_SEND_LIMIT:g} s, is the wire open?") from error
        raise self._lose(f"cannot send ({error.strerror})") from error

    def fileno(self) -> int:
        """The raw CAN socket."""
        return self._socket.fileno()

    def close(self) -> None:
        """Leave the bus; a second call does nothing."""
        if self._socket.fileno() >= 0:
            self._closed()
            self._bus.shutdown()


def _open(channel: str) -> can.interfaces.socketcan.SocketcanBus:
    from can.interfaces.socketcan import SocketcanBus  # noqa: PLC0415

    try:
        return SocketcanBus(channel, local_loopback=True, receive_own_messages=False)
    except OSError as error:
        reason = {
            errno.EAFNOSUPPORT: "this kernel has no CAN; see tools/with_vcan",
            errno.ENODEV: "there is no such interface (ip link add ... type vcan)",
        }.get(error.errno or 0, error.strerror)
        raise can.CanInitializationError(f"socketcan:{channel}: {reason}") from error
