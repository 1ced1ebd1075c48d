"""Linux SocketCAN (vcan, or a real adapter with a kernel driver) as a link."""

from __future__ import annotations

import ctypes
import errno
import os
import select
import socket
import struct
import time
from collections.abc import Iterable, Sequence

import can

from can_bus.frame import CAN_EFF_MASK, RECORD_SIZE, Frame, pack, unpack
from can_bus.link import BaseLink
from can_bus.timeval import SHORT, timeval

_AF_CAN = 29
_CAN_RAW = 1
_SOL_CAN_RAW = 101
_CAN_RAW_FILTER = 1
_SO_RCVBUFFORCE = 33
_SO_TIMESTAMPNS = 35
_SO_RXQ_OVFL = 40
_SO_MEMINFO = 55
_MEMINFO_DROPS = 8
_RECEIVE_BUFFER = 64 << 20
_COUNTER = struct.Struct("@I")
_FLAGS = struct.Struct("@i")
MSG_WAITFORONE = 0x10000
_BATCH = 256
_SEND_LIMIT = 5.0
_SLICE = 1.0


class SocketcanLink(BaseLink):
    """A raw CAN socket on `socketcan:vcan0` or any other SocketCAN interface.

    The kernel throws frames away when a socket's receive queue is full (about 280 frames by default). This link asks
    for a queue of some 80,000 (root) or whatever `net.core.rmem_max` allows, and the kernel's count of what did not
    fit turns into a `BusLost`, at the latest one second after. It cannot see frames that the interface itself lost
    before the socket, on a real wire or in the kernel's backlog: the counters of the protocol do that. And on a machine
    with several CPUs, frames that two nodes send in the same instant may reach two readers in different orders.
    """

    def __init__(
        self, channel: str, *, filters: Iterable[int] | None = None, receive_buffer: int = _RECEIVE_BUFFER
    ) -> None:
        super().__init__(f"socketcan:{channel}", filters)
        wanted = self._wanted
        self._bus = _open(channel)
        self._socket: socket.socket = self._bus.socket
        self._timeout: float | None = None
        self._reading = False
        self._readable = select.poll()
        self._readable.register(self._socket, select.POLLIN)
        self._inbox = FrameBatch(self._socket.fileno())
        self._outboxes = [FrameBatch(self._socket.fileno())]
        self._socket.setblocking(True)
        self._socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 0)
        self._socket.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, receive_buffer)
        except PermissionError:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        if wanted is not None:
            rules = b"".join(struct.pack("=II", i, CAN_EFF_MASK) for i in wanted.identifiers)
            self._socket.setsockopt(_SOL_CAN_RAW, _CAN_RAW_FILTER, rules)

    def recv(self, timeout: float | None) -> list[Frame]:
        """Return all frames that wait, waiting for the first; see `Link.recv`."""
        self._reading = True
        try:
            return self._recv(timeout)
        finally:
            self._reading = False

    def _recv(self, timeout: float | None) -> list[Frame]:
        left = timeout
        end: float | None = None  # the clock is only read when the first look was not enough: a guest pays for it
        while True:
            wait = _SLICE if left is None or left > _SLICE else left
            frames = self._receive(wait)
            if frames:
                if self._wanted is not None:  # the first ones may have come before the kernel's filter was set
                    frames = self._wanted.select(frames)
                if frames:
                    return frames
                wait = 0.0
            else:
                if self._dead is not None:
                    raise self._lose("")
                self._check_drops()
            if left is not None:
                now = time.monotonic()
                end = now + left - wait if end is None else end
                left = end - now
                if left <= 0:
                    return frames

    def _receive(self, timeout: float) -> list[Frame]:
        if self._dead is not None:
            raise self._lose("")
        if timeout < SHORT:
            flags = int(socket.MSG_DONTWAIT)
            if timeout > 0:
                self._readable.poll(timeout * 1000)
        else:
            flags = MSG_WAITFORONE
            if timeout != self._timeout:
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, timeval(timeout))
                self._timeout = timeout
        batch = self._inbox
        try:
            count = batch.receive(flags)
        except BlockingIOError:
            return []
        except OSError as error:
            raise self._lose(f"the interface is gone ({error.strerror})") from error
        if batch.truncated(count - 1):  # there was a drop count to report, and no room for it
            self._check_drops()
        return unpack(batch.bytes(count))

    def _check_drops(self) -> None:
        """Ask for the drop count: a loss with nothing behind it shows in no received frame."""
        counters = self._socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 64)
        if len(counters) > 4 * _MEMINFO_DROPS:
            self._lost_frames(*_COUNTER.unpack_from(counters, 4 * _MEMINFO_DROPS))

    def _lost_frames(self, count: int) -> None:
        if count:
            raise self._lose(f"{count} frames lost: this reader was too slow for the kernel's receive queue")

    def send(self, frames: Sequence[Frame]) -> None:
        """Send the batch; a full transmit queue is waited out for some seconds, then it raises `BusLost`."""
        if self._dead is not None:
            raise self._lose("")
        records = pack(frames)
        try:
            outbox = self._outboxes.pop()  # no lock: it would read the clock, which is dear in a guest
        except IndexError:
            outbox = FrameBatch(self._socket.fileno())
        end: float | None = None
        while records:
            try:
                records = records[outbox.send(records) * RECORD_SIZE :]
            except OSError as error:
                if error.errno != errno.ENOBUFS:
                    raise self._lose(f"cannot send ({error.strerror})") from error
                now = time.monotonic()
                end = end or now + _SEND_LIMIT
                if now > end:
                    reason = f"the transmit queue stayed full for {_SEND_LIMIT:g} s, is the wire open?"
                    raise self._lose(reason) from error
                time.sleep(1e-3)
        self._outboxes.append(outbox)

    def fileno(self) -> int:
        """The raw CAN socket."""
        return self._socket.fileno()

    def close(self) -> None:
        """Leave the bus; a second call does nothing. It waits for a receive in another thread, up to a second."""
        if self._socket.fileno() >= 0:
            self._closed()
            end = time.monotonic() + 2 * _SLICE
            while self._reading and time.monotonic() < end:  # its descriptor must not become another file's
                time.sleep(0.01)
            self._bus.shutdown()


class _IoVector(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _MessageHeader(ctypes.Structure):
    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_length", ctypes.c_uint32),
        ("vectors", ctypes.POINTER(_IoVector)),
        ("vector_count", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_length", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _Message(ctypes.Structure):
    _fields_ = (("header", _MessageHeader), ("length", ctypes.c_uint))


_libc = ctypes.CDLL(None, use_errno=True)


class FrameBatch:
    """Room for many frames, moved by one `recvmmsg` or `sendmmsg` (Python's own calls move one frame each)."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._buffer = ctypes.create_string_buffer(_BATCH * RECORD_SIZE)
        self._view = memoryview(self._buffer).cast("B")
        base = ctypes.addressof(self._buffer)
        self._vectors = (_IoVector * _BATCH)(*[_IoVector(base + i * RECORD_SIZE, RECORD_SIZE) for i in range(_BATCH)])
        self._messages = (_Message * _BATCH)()
        for i, message in enumerate(self._messages):
            message.header.vectors = ctypes.pointer(self._vectors[i])
            message.header.vector_count = 1
        self._headers = memoryview(self._messages).cast("B")
        self._place = ctypes.byref(self._messages)

    def receive(self, flags: int) -> int:
        """Return how many frames were received; OSError as `recv` would raise it."""
        while (count := _libc.recvmmsg(self._descriptor, self._place, _BATCH, flags, None)) < 0:
            _raise_errno()
        return int(count)

    def send(self, records: bytes) -> int:
        """Return how many of the records were sent, at least one; OSError as `send` would raise it."""
        size = min(len(records), len(self._view))
        self._view[:size] = records[:size]
        while (count := _libc.sendmmsg(self._descriptor, self._place, size // RECORD_SIZE, 0)) < 0:
            _raise_errno()
        return int(count)

    def truncated(self, index: int) -> bool:
        """Whether control data of a received frame found no room."""
        (flags,) = _FLAGS.unpack_from(self._headers, index * _MESSAGE_SIZE + _FLAGS_OFFSET)
        return bool(flags & socket.MSG_CTRUNC)

    def bytes(self, count: int) -> bytes:
        """Return the first records."""
        return self._view[: count * RECORD_SIZE].tobytes()


_MESSAGE_SIZE = ctypes.sizeof(_Message)
_FLAGS_OFFSET = _Message.header.offset + _MessageHeader.flags.offset


def _raise_errno() -> None:
    """Raise what the last call left in errno; an interrupted call returns, to be made again."""
    number = ctypes.get_errno()
    if number != errno.EINTR:
        raise OSError(number, os.strerror(number))


def _open(channel: str) -> can.interfaces.socketcan.SocketcanBus:
    from can.interfaces.socketcan import SocketcanBus  # noqa: PLC0415

    try:
        socket.socket(_AF_CAN, socket.SOCK_RAW, _CAN_RAW).close()
    except OSError as error:
        reason = "this kernel has no CAN; see tools/with_vcan" if error.errno == errno.EAFNOSUPPORT else error.strerror
        raise can.CanInitializationError(f"socketcan:{channel}: {reason}") from error
    try:
        if channel not in (name for _, name in socket.if_nameindex()):  # python-can would leave its socket open
            raise OSError(errno.ENODEV, "no such interface")
        return SocketcanBus(channel, local_loopback=True, receive_own_messages=False)
    except OSError as error:
        known = errno.ENODEV, errno.ENXIO
        reason = "there is no such CAN interface (ip link)" if error.errno in known else error.strerror
        raise can.CanInitializationError(f"socketcan:{channel}: {reason}") from error
