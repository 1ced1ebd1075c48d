"""USB and serial CAN adapters that speak slcan (the LAWICEL text protocol), as a link."""

from __future__ import annotations

import logging
import os
import re
import select
import threading
from collections.abc import Iterable, Sequence
from typing import Any, Final

import can

from can_bus.frame import (
    CAN_EFF_FLAG,
    CAN_EFF_MASK,
    CAN_ERR_FLAG,
    CAN_RTR_FLAG,
    CAN_SFF_MASK,
    MAX_DATA,
    TOO_LONG,
    Frame,
)
from can_bus.link import BaseLink

_log = logging.getLogger("can_bus.slcan")

_CHUNK: Final = 4096
_WRITE_LIMIT: Final = 10.0
_MAX_LINE: Final = 512
_WARNINGS: Final = 20  # of one link: an adapter that babbles must not fill a disk with what is said of it
_CODES: Final = {b"t": 0, b"r": CAN_RTR_FLAG, b"T": CAN_EFF_FLAG, b"R": CAN_EFF_FLAG | CAN_RTR_FLAG}
_STATUS: Final = re.compile(rb"F([0-9A-Fa-f]{2})")
_REPLIES: Final = (b"", b"z", b"Z", b"V", b"v", b"N", b"F", b"d", b"D", b"b", b"B")  # the last four are CAN FD frames


class SlcanLink(BaseLink):
    """A link over slcan: `slcan:/dev/ttyACM0@500000`, a pty, or any pyserial URL such as `socket://host:port`.

    python-can sets the adapter up; the frames are then read and written here in bulk, because python-can reads a
    serial port byte by byte. slcan has no error frames (sending one is a ValueError), no flow control beyond the
    serial port's own, and no word about frames that the adapter lost: the counters of the protocol see those.

    Attributes:
        refusals: commands that the adapter refused (BELL) since something was sent.
        status: what it said of itself when it was asked last (`ask_status`), None before.
    """

    carries_errors = False

    def __init__(self, bus: can.BusABC, url: str, *, filters: Iterable[int] | None = None) -> None:
        """Take over the serial port of an opened python-can slcan bus."""
        super().__init__(url, filters)
        self._bus = bus
        self._port: Any = bus.serialPortOrig  # type: ignore[attr-defined]
        self._rest = b""
        self._in_step = False
        self._sent = False
        self.refusals = 0
        self.status: int | None = None
        self._warnings = 0
        self._lock = threading.Lock()
        self._wake = os.eventfd(0, os.EFD_CLOEXEC)  # ends a receive in another thread when this link is closed
        self._poll: select.poll | None = None
        try:
            descriptor = self._port.fileno()
        except (AttributeError, OSError):  # loop:// and rfc2217:// have none
            pass
        else:
            self._poll = select.poll()
            self._poll.register(descriptor, select.POLLIN)
            self._poll.register(self._wake, select.POLLIN)
        self._port.timeout = 0
        self._port.write_timeout = _WRITE_LIMIT

    def recv(self, timeout: float | None) -> list[Frame]:
        """Return all frames that arrived, waiting for the first; see `Link.recv`."""
        return self._receive_wanted(lambda left: self._parse(self._read(left)), timeout)

    def _read(self, timeout: float | None) -> bytes:
        if self._dead is not None:
            raise self._lose("")
        try:
            if self._poll is None:
                self._port.timeout = timeout
                first = self._port.read(1)
                self._port.timeout = 0
                return bytes(first + self._port.read(_CHUNK))
            ready = self._poll.poll(None if timeout is None else max(0.0, timeout * 1000))
            if self._dead is not None:
                raise self._lose("")
            return bytes(self._port.read(_CHUNK)) if ready else b""
        except can.CanError:
            raise
        except (OSError, TypeError) as error:  # pyserial's errors are OSErrors; TypeError: closed in another thread
            raise self._lose(f"the serial port is gone ({error})") from error

    def _parse(self, text: bytes) -> list[Frame]:
        *lines, self._rest = (self._rest + text).replace(b"\a", b"\a\r").split(b"\r")
        if len(self._rest) > _MAX_LINE:
            raise self._lose("this is no slcan: no line end in 512 characters")
        frames: list[Frame] = []
        for line in lines:
            flags = _CODES.get(line[:1])
            if flags is None:
                self._not_a_frame(line)
                continue
            frame = _frame(line, flags)
            if frame is None:
                if self._in_step:
                    raise self._lose(f"a frame was lost: unreadable line {line!r}")
                continue  # the tail of what an earlier session left in the adapter
            self._in_step = True
            frames.append(frame)
        return frames

    def _not_a_frame(self, line: bytes) -> None:
        if line.endswith(b"\a"):
            if self._sent:  # before, adapters refuse steps of the set-up that they find needless
                self.refusals += 1
                self._warn("the adapter refused a command; a frame may not have been sent")
        elif match := _STATUS.fullmatch(line):
            self.status = int(match[1], 16)
        elif line[:1] not in _REPLIES and self._in_step:
            self._warn(f"ignored what is no slcan: {line!r}")

    def _warn(self, text: str) -> None:
        self._warnings += 1
        if self._warnings <= _WARNINGS:
            _log.warning("%s: %s", self._url, text)
        if self._warnings == _WARNINGS:
            _log.warning("%s: no more of this is told", self._url)

    def send(self, frames: Sequence[Frame]) -> None:
        """Send the batch in one write. ValueError for error frames: slcan has none."""
        if self._dead is not None:
            raise self._lose("")
        self._write(b"".join([_line(frame) for frame in frames]))
        self._sent = True

    def _write(self, text: bytes) -> None:
        try:
            with self._lock:
                self._port.write(text)
        except (OSError, TypeError) as error:
            raise self._lose(f"the serial port is gone ({error})") from error

    def ask_status(self) -> None:
        """Ask the adapter for its status flags; a later receive finds the answer, which not every adapter gives."""
        if self._dead is not None:
            raise self._lose("")
        self._write(b"F\r")

    def fileno(self) -> int:
        """The serial port's descriptor; an OSError for a port that has none."""
        return int(self._port.fileno())

    def close(self) -> None:
        """Close the adapter's channel and the port; a second call does nothing."""
        if self._wake < 0:
            return
        self._closed()
        os.eventfd_write(self._wake, 1)
        stream = getattr(self._port, "_socket", None)
        try:
            self._bus.shutdown()
        except (can.CanError, OSError) as error:  # the adapter was pulled: there is nobody left to close
            _log.debug("%s: %s", self._url, error)
        self._port.close()
        if stream is not None:  # pyserial leaves it open when the other side closed first
            stream.close()
        wake, self._wake = self._wake, -1
        os.close(wake)


def _line(frame: Frame) -> bytes:
    can_id, data = frame
    if can_id & CAN_ERR_FLAG:
        raise ValueError("slcan cannot carry error frames")
    if len(data) > MAX_DATA:
        raise ValueError(TOO_LONG)
    remote = bool(can_id & CAN_RTR_FLAG)
    digits = "" if remote else data.hex().upper()
    if can_id & CAN_EFF_FLAG:
        return b"%c%08X%d%b\r" % (b"R" if remote else b"T", can_id & CAN_EFF_MASK, len(data), digits.encode())
    return b"%c%03X%d%b\r" % (b"r" if remote else b"t", can_id & CAN_SFF_MASK, len(data), digits.encode())


def _frame(line: bytes, flags: int) -> Frame | None:
    """Return the frame in a line without its end, None when it cannot be read; a time stamp behind it is ignored."""
    start = 10 if flags & CAN_EFF_FLAG else 5
    if len(line) < start or not line.isalnum():
        return None
    try:
        can_id = int(line[1 : start - 1], 16)
        size = int(line[start - 1 : start])
        if size > MAX_DATA or can_id > (CAN_EFF_MASK if flags & CAN_EFF_FLAG else CAN_SFF_MASK):
            return None
        if flags & CAN_RTR_FLAG:
            return Frame(can_id | flags, bytes(size))
        data = bytes.fromhex(line[start : start + 2 * size].decode("ascii"))
    except ValueError:
        return None
    return Frame(can_id | flags, data) if len(data) == size else None
