"""A bus inside one process: the same frames in the same order, without sockets and without wake-ups."""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
import threading
from collections.abc import Iterable, Sequence
from queue import Empty, SimpleQueue
from typing import Final

from can_bus.frame import CAN_RTR_FLAG, MAX_DATA, TOO_LONG, Frame
from can_bus.link import BaseLink

_log = logging.getLogger("can_bus.inproc")

DEFAULT_CAP: Final = 262_144
_registry: dict[str, InprocHub] = {}
_registry_lock = threading.Lock()


class InprocHub:
    """A bus shared by the links of one process; links may live in different threads, or all in one.

    The bus `inproc:name` exists while somebody has a link to it. It cannot be reached from another process.
    """

    def __init__(self, name: str, cap: int = DEFAULT_CAP) -> None:
        self.name = name
        self.cap = cap
        self.lock = threading.Lock()
        self._links: tuple[InprocLink, ...] = ()

    @property
    def clients(self) -> int:
        """How many links are on the bus."""
        return len(self._links)

    def holds(self, link: InprocLink) -> bool:
        """Whether the link is on the bus."""
        return link in self._links

    def attach(self, link: InprocLink) -> None:
        """Put a link on the bus; from now on it misses nothing."""
        with self.lock:
            self._links = (*self._links, link)

    def detach(self, link: InprocLink) -> None:
        """Take a link off the bus; the last one ends it."""
        with self.lock:
            self._links = tuple(other for other in self._links if other is not link)
            empty = not self._links
        if empty:
            with _registry_lock:
                if _registry.get(self.name) is self and not self._links:
                    del _registry[self.name]

    def switch(self, sender: InprocLink, frames: list[Frame]) -> None:
        """Give a batch to every link but the sender's (and to that one when it asked for its own frames)."""
        with self.lock:
            takers = [link for link in self._links if link is not sender or link.echo]
            late = [link for link in takers if not link.deliver(frames, self.cap)]
        for link in late:
            _log.error("%s is too slow, more than %d frames wait for it: disconnected", link, self.cap)
            self.detach(link)

    def close(self) -> None:
        """End the bus for all its links: their receives raise `BusLost` once they have read what waits."""
        with self.lock:
            links, self._links = self._links, ()
            for link in links:
                link.end("the bus was closed")
        with _registry_lock:
            if _registry.get(self.name) is self:
                del _registry[self.name]


def inproc_hub(name: str) -> InprocHub:
    """Return the bus of this name, made on first use."""
    with _registry_lock:
        hub = _registry.get(name)
        if hub is None:
            hub = _registry[name] = InprocHub(name)
        return hub


class InprocLink(BaseLink):
    """A node's place on an `InprocHub`."""

    _numbers = itertools.count(1)

    def __init__(self, hub: InprocHub, *, filters: Iterable[int] | None = None, echo: bool = False) -> None:
        super().__init__(f"inproc:{hub.name}", filters)
        self.echo = echo
        self._hub = hub
        self._number = next(self._numbers)
        self._queue: SimpleQueue[list[Frame] | str] = SimpleQueue()
        self._rest: list[Frame] = []
        self._delivered = 0
        self._taken = 0
        self._event: int | None = None
        hub.attach(self)

    def deliver(self, frames: list[Frame], cap: int) -> bool:
        """Called by the bus, under its lock: queue a batch; False when the queue is full and the link must go."""
        if self._delivered + len(frames) - self._taken > cap:
            lost = self._delivered + len(frames) - self._taken
            self.end(f"this reader was too slow: its queue was full and {lost} frames were discarded", discard=True)
            return False
        self._delivered += len(frames)
        self._queue.put(frames)
        if self._event is not None:
            os.eventfd_write(self._event, 1)
        return True

    def end(self, reason: str, *, discard: bool = False) -> None:
        """Called by the bus, under its lock: no frames come any more."""
        if discard:
            with contextlib.suppress(Empty):
                while True:
                    self._queue.get_nowait()
            self._lose(reason)
        self._queue.put(reason)
        if self._event is not None:
            os.eventfd_write(self._event, 1)

    def recv(self, timeout: float | None) -> list[Frame]:
        """Return all frames that wait, waiting for the first; see `Link.recv`."""
        if self._wanted is None:  # the common case needs no clock
            return self._take(timeout)
        return self._receive_wanted(self._take, timeout)

    def recv_one(self, timeout: float | None) -> Frame | None:
        """Return one frame, or None on time-out; the others wait for the next call."""
        frames = self.recv(timeout)
        if not frames:
            return None
        self._rest = frames[1:]
        if self._rest and self._event is not None:
            os.eventfd_write(self._event, 1)
        return frames[0]

    def _take(self, timeout: float | None) -> list[Frame]:
        if self._dead is not None:
            raise self._lose("")
        if self._rest:
            frames, self._rest = self._rest, []
            return frames
        if self._event is not None:
            with contextlib.suppress(BlockingIOError):
                os.eventfd_read(self._event)
        queue = self._queue
        try:
            batch = queue.get_nowait() if timeout == 0 else queue.get(True, timeout)
        except Empty:
            return []
        if isinstance(batch, str):
            raise self._lose(batch)
        self._taken += len(batch)
        if queue.empty():
            return batch[:]
        frames = list(batch)
        with contextlib.suppress(Empty):
            while True:
                batch = queue.get_nowait()
                if isinstance(batch, str):
                    queue.put(batch)  # nothing can come behind it: the link is off the bus
                    break
                self._taken += len(batch)
                frames += batch
        return frames

    def send(self, frames: Sequence[Frame]) -> None:
        """Put the batch on the bus; never blocks."""
        if self._dead is not None or not self._hub.holds(self):
            raise self._lose("the bus was closed")
        if frames:
            self._hub.switch(self, _checked(frames))

    def fileno(self) -> int:
        """An event descriptor, made on first use; readable when `recv(0)` has something to say."""
        if self._event is None:
            with self._hub.lock:
                waiting = bool(self._rest) or not self._queue.empty()
                self._event = os.eventfd(int(waiting), os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        return self._event

    def close(self) -> None:
        """Leave the bus; a second call does nothing. A receive that waits in another thread ends."""
        if self._dead is None:
            self._hub.detach(self)
            self._closed()
            self._queue.put("this link was closed")
        event, self._event = self._event, None
        if event is not None:
            os.close(event)

    def __repr__(self) -> str:
        return f"<InprocLink {self._url} #{self._number}>"


def _checked(frames: Sequence[Frame]) -> list[Frame]:
    """Return a copy that other links may keep, with the checks of `pack` and what a trip over a wire would do."""
    batch = []
    for frame in frames:
        can_id, data = frame
        if len(data) > MAX_DATA:
            raise ValueError(TOO_LONG)
        if not 0 <= can_id <= 0xFFFFFFFF:
            raise ValueError("not a classic CAN frame: the id does not fit 32 bits")
        if can_id & CAN_RTR_FLAG or type(data) is not bytes or type(frame) is not Frame:
            batch.append(Frame(can_id, bytes(len(data)) if can_id & CAN_RTR_FLAG else bytes(data)))
        else:
            batch.append(frame)
    return batch
