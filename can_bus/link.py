"""The link: how a node of this bench talks on a bus, whatever the bus is made of.

A link moves *batches* of frames, because a lockstep step is a batch: one system call, one wake-up, and not one
per frame. Everything here blocks plainly in the calling thread; there is no Notifier and no event loop.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from types import TracebackType
from typing import Protocol, Self

import can

from can_bus.frame import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, CAN_SFF_MASK, Frame


class BusLost(can.CanOperationError):
    """The bus is gone for this link, or frames were lost on it: nothing received later can be trusted.

    It is raised by every later call too. A link never recovers; open a new one.
    """


class Link(Protocol):
    """What every transport offers to a node.

    All links deliver every frame of the other nodes, in the same order for everybody, without the link's own
    frames. A link does not time-stamp, does not arbitrate by identifier, and one link must not be read by two
    threads at once (sending from another thread is allowed).
    """

    @property
    def url(self) -> str:
        """The URL this link was opened with."""

    @property
    def carries_errors(self) -> bool:
        """Whether error frames can be sent on it."""

    def recv(self, timeout: float | None) -> list[Frame]:
        """Wait until at least one frame is there and return all that arrived, oldest first.

        `timeout` in seconds, `None` waits for ever, `0` only looks. An empty list means time-out and
        nothing else: a lost bus or a lost frame raises `BusLost`.
        """

    def send(self, frames: Sequence[Frame]) -> None:
        """Send the frames as one batch, in order. Returning does not mean that anybody has read them."""

    def close(self) -> None:
        """Leave the bus. What was sent before is still delivered. Calling it again does nothing."""

    def fileno(self) -> int:
        """A descriptor that is readable when `recv(0)` has something to say, for `select`."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class Wanted:
    """A receive filter by standard identifiers, the same on every transport.

    Data and remote frames with a wanted identifier pass, also where the same number has come as a 29-bit identifier (a
    device must see that somebody sends such), and error frames always do.
    """

    __slots__ = ("_ids", "identifiers")

    def __init__(self, identifiers: Iterable[int]) -> None:
        self.identifiers = sorted(set(identifiers))
        if self.identifiers and not 0 <= self.identifiers[0] <= self.identifiers[-1] <= CAN_SFF_MASK:
            raise ValueError("filters are standard identifiers, 0 to 0x7FF")
        dresses = (0, CAN_RTR_FLAG, CAN_EFF_FLAG, CAN_EFF_FLAG | CAN_RTR_FLAG)
        self._ids = frozenset(can_id | dress for can_id in self.identifiers for dress in dresses)

    def select(self, frames: list[Frame]) -> list[Frame]:
        """Return the frames that pass, in order."""
        ids = self._ids
        return [frame for frame in frames if frame[0] in ids or frame[0] & CAN_ERR_FLAG]


class BaseLink:
    """What the links have in common: the URL, the filter, the reason of the end, the context manager."""

    carries_errors = True

    def __init__(self, url: str, filters: Iterable[int] | None) -> None:
        self._url = url
        self._wanted = None if filters is None else Wanted(filters)
        self._dead: BusLost | None = None

    @property
    def url(self) -> str:
        """The URL this link was opened with."""
        return self._url

    def close(self) -> None:
        """Leave the bus; a second call does nothing."""
        raise NotImplementedError

    def _receive_wanted(self, receive: Callable[[float | None], list[Frame]], timeout: float | None) -> list[Frame]:
        """What `receive` gives and the filter lets pass, asked until there is something or the time is over."""
        end = None if timeout is None else time.monotonic() + timeout
        while True:
            frames = receive(timeout)
            if self._wanted is not None:
                frames = self._wanted.select(frames)
            if frames:
                return frames
            if end is not None:
                timeout = end - time.monotonic()
                if timeout <= 0:
                    return frames

    def _lose(self, reason: str) -> BusLost:
        """Remember why this link ended (the first reason stays) and return the error to raise."""
        if self._dead is None:
            self._dead = BusLost(f"{self._url}: {reason}")
        return BusLost(str(self._dead))

    def _closed(self) -> BusLost:
        return self._lose("this link was closed")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self._url}>"
