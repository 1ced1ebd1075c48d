"""Any python-can interface as a link."""

from __future__ import annotations

import os
import queue
import select
import threading
from collections.abc import Iterable, Sequence

import can

from can_bus.frame import Frame, from_message, to_message
from can_bus.link import BaseLink, BusLost

_BATCH = 256
_LOOKS_EVERY = 0.1
"""Seconds a reading thread waits before it looks whether it is to end."""


class _Reader:
    """Receives in a thread, for an interface without a descriptor: one of ours is readable while something waits."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus
        self._queue: queue.SimpleQueue[can.Message | Exception] = queue.SimpleQueue()
        self._ended = threading.Event()
        self.descriptor = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_SEMAPHORE)
        self._thread = threading.Thread(target=self._read, name="python-can reader", daemon=True)
        self._thread.start()

    def _read(self) -> None:
        while not self._ended.is_set():
            try:
                message: can.Message | Exception | None = self._bus.recv(_LOOKS_EVERY)
            except Exception as error:  # told to whoever receives
                message = error
            if message is not None:
                self._queue.put(message)
                os.eventfd_write(self.descriptor, 1)
            if isinstance(message, Exception):
                return

    def recv(self, timeout: float | None) -> can.Message | None:
        """As `can.BusABC.recv`."""
        if not select.select([self.descriptor], [], [], timeout)[0]:
            return None
        os.eventfd_read(self.descriptor)
        message = self._queue.get()
        if isinstance(message, Exception):
            raise message
        return message

    def close(self) -> None:
        """End the thread."""
        self._ended.set()
        self._thread.join()
        os.close(self.descriptor)


def _has_descriptor(bus: can.BusABC) -> bool:
    try:
        return bus.fileno() >= 0
    except NotImplementedError:
        return False


class PythonCanLink(BaseLink):
    """A link made of a python-can bus object. What the interface loses or reorders, this link can't know."""

    def __init__(self, bus: can.BusABC, url: str, *, filters: Iterable[int] | None = None) -> None:
        super().__init__(url, filters)
        self._bus = bus
        self._reader = None if _has_descriptor(bus) else _Reader(bus)
        self._next = bus.recv if self._reader is None else self._reader.recv

    def recv(self, timeout: float | None) -> list[Frame]:
        """Return the frames that wait, waiting for the first; CAN FD frames of others are skipped."""
        return self._receive_wanted(self._receive, timeout)

    def _receive(self, timeout: float | None) -> list[Frame]:
        if self._dead is not None:
            raise self._lose("")
        frames: list[Frame] = []
        try:
            message = self._next(timeout)
            while message is not None:
                if not message.is_fd:
                    frames.append(from_message(message))
                message = self._next(0) if len(frames) < _BATCH else None
        except BusLost:
            raise
        except (can.CanError, OSError) as error:
            raise self._lose(f"receive failed: {error}") from error
        return frames

    def send(self, frames: Sequence[Frame]) -> None:
        """Send the frames one by one."""
        if self._dead is not None:
            raise self._lose("")
        messages = [to_message(frame) for frame in frames]
        try:
            for message in messages:
                self._bus.send(message)
        except (can.CanError, OSError) as error:
            raise self._lose(f"send failed: {error}") from error

    def fileno(self) -> int:
        """The interface's descriptor, or that of a thread that reads it."""
        return self._bus.fileno() if self._reader is None else self._reader.descriptor

    def close(self) -> None:
        """Shut the bus down; a second call does nothing."""
        if self._dead is None:
            self._closed()
        if self._reader is not None:
            self._reader.close()
            self._reader = None
        self._bus.shutdown()
