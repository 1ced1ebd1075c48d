"""The link of the process that hosts a hub: no socket, and whoever receives on it does the hub's work."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from can_bus.frame import Frame, pack, unpack
from can_bus.link import BaseLink

if TYPE_CHECKING:
    from can_bus.hub import Hub


class LocalLink(BaseLink):
    """The link of the process that hosts a hub; `recv` and `recv` alone makes the hub switch."""

    def __init__(self, hub: Hub, filters: Iterable[int] | None) -> None:
        super().__init__(hub.urls[0] if hub.urls else "hub", filters)
        self._hub = hub
        self._pending: list[Frame] = []

    def deliver(self, records: bytes) -> None:
        """Called by the hub: these records are for this link."""
        frames = unpack(records)
        if self._wanted is not None:
            frames = self._wanted.select(frames)
        self._pending = self._pending + frames if self._pending else frames

    def recv(self, timeout: float | None) -> list[Frame]:
        """Run the hub until frames for this node arrived; see `Link.recv`."""
        hub = self._hub
        if hub.closed or self._dead is not None:
            raise self._lose("the hub was closed")
        if not self._pending:
            if timeout is None:
                while not self._pending:
                    hub.poll(None)
            else:
                end = time.monotonic() + timeout
                hub.poll(timeout)
                while not self._pending and (left := end - time.monotonic()) > 0:
                    hub.poll(left)
        frames = self._pending
        self._pending = []
        return frames

    def send(self, frames: Sequence[Frame]) -> None:
        """Put the batch on the bus; never blocks."""
        if frames:
            self.send_packed(pack(frames))

    def send_packed(self, records: bytes) -> None:
        """Put on the bus what `pack` made."""
        if self._hub.closed or self._dead is not None:
            raise self._lose("the hub was closed")
        self._hub.switch_local(self, records)

    def fileno(self) -> int:
        """The hub's descriptor: it is readable when `recv(0)` should be called, which may return nothing."""
        return self._hub.fileno()

    def close(self) -> None:
        """Leave the bus; the hub stays."""
        if self._dead is None:
            self._closed()
            self._hub.detach(self)
