"""Any python-can interface as a link."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence

import can

from can_bus.frame import Frame, from_message, to_message
from can_bus.link import BaseLink, BusLost

_BATCH = 256


class PythonCanLink(BaseLink):
    """A link made of a python-can bus object. What the interface loses or reorders, this link can't know."""

    def __init__(self, bus: can.BusABC, url: str, *, filters: Iterable[int] | None = None) -> None:
        super().__init__(url, filters)
        self._bus = bus

    def recv(self, timeout: float | None) -> list[Frame]:
        """Return the frames that wait, waiting for the first; CAN FD frames of others are skipped."""
        end = None if timeout is None else time.monotonic() + timeout
        while True:
            frames = self._receive(timeout)
            if frames and self._wanted is not None:
                frames = self._wanted.select(frames)
            if frames:
                return frames
            if end is not None:
                timeout = end - time.monotonic()
                if timeout <= 0:
                    return frames

    def _receive(self, timeout: float | None) -> list[Frame]:
        if self._dead is not None:
            raise self._lose("")
        frames: list[Frame] = []
        try:
            message = self._bus.recv(timeout)
            while message is not None:
                if not message.is_fd:
                    frames.append(from_message(message))
                message = self._bus.recv(0) if len(frames) < _BATCH else None
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
        """The interface's descriptor; NotImplementedError when it has none."""
        return self._bus.fileno()

    def close(self) -> None:
        """Shut the bus down; a second call does nothing."""
        if self._dead is None:
            self._closed()
        self._bus.shutdown()
