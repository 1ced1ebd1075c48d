"""Frames off the bus, put into simulated time.

While a run is on, `Capture` only appends bytes. Afterwards `Capture.finish` reads the lockstep out of the frames
themselves (`pumpbench.turns`) and gives every frame its step, its turn and its time, so that a record depends on
nothing but what was on the wire: not on the transport, and not on when a frame happened to be read. `Follower` does so
while the run is still on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from can_bus import codec
from can_bus.frame import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, CAN_SFF_MASK, MAX_DATA, Frame, pack
from pumpbench.frames import Frames, concatenated, intact
from pumpbench.turns import assign

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

_RECORD: Final = np.dtype([("can_id", "<u4"), ("length", "u1"), ("pad", "V3"), ("data", "u1", (MAX_DATA,))])
_FLAGS: Final = CAN_EFF_FLAG | CAN_ERR_FLAG


class Capture:
    """Collects the frames of a run as they come: bytes in, analysis afterwards.

    Args:
        keep: gets the channel and the packed records of every batch, e.g. to keep them on a disk.
    """

    def __init__(self, keep: Callable[[int, bytes], None] | None = None) -> None:
        self._buffers: dict[int, bytearray] = {}
        self._keep = keep

    def __len__(self) -> int:
        return sum(map(len, self._buffers.values())) // _RECORD.itemsize

    def extend(self, channel: int, frames: Sequence[Frame]) -> None:
        """Append frames in the order the bus showed them.

        Args:
            channel: 0 for the device's bus, 1 for the plant's bus when a gateway lies between.
            frames: what arrived since the last call.

        Raises:
            ValueError: a frame has more than 8 data bytes.
            OSError: `keep` could not; the batch is in memory all the same.
        """
        self.extend_packed(channel, records := pack(frames))
        if self._keep is not None:
            self._keep(channel, records)

    def extend_packed(self, channel: int, records: bytes) -> None:
        """Append frames that are packed already (`can_bus.frame.pack`)."""
        self._buffers.setdefault(channel, bytearray()).extend(records)

    def device_info(self) -> dict[str, int] | None:
        """Raw values of the device's CTRL_Info; None without one.

        It answers the roll call, which is no part of the record but tells which firmware this is.
        """
        message = codec.message("CTRL_Info")
        record = np.frombuffer(bytes(self._buffers.get(0, b"")), _RECORD)
        record = record[(record["can_id"] == message.can_id) & (record["length"] == message.length)]
        good = np.flatnonzero(intact(record["can_id"], record["length"], record["data"]))
        return message.unpack(record["data"][good[0]].tobytes()) if len(good) else None

    def finish(self) -> Frames:
        """Put all frames collected so far into simulated time and canonical order; more may be appended afterwards."""
        return _canonical({channel: np.frombuffer(bytes(raw), _RECORD) for channel, raw in self._buffers.items()})


class NewRun(Exception):
    """The roll was called anew and another run has begun on the bus: what was heard before is no part of it.

    Attributes:
        taken: for each channel, how many frames of the whole record belong to the run before.
    """

    def __init__(self, taken: list[int]) -> None:
        super().__init__("another run has begun on the bus")
        self.taken = taken


class Follower:
    """Puts frames into simulated time while the run is still on, each once its step is over.

    A step is over when the device has closed its last turn, or when the next one has begun. What `Capture.finish` says
    of a frame is said here too, from the frames so far: only a window of them is looked at, back to the last step that
    was over.
    """

    def __init__(self, channels: int) -> None:
        """Args: channels: how many buses are recorded, the device's first."""
        self._raw = [bytearray() for _ in range(channels)]
        self._handed = [0] * channels  # of the frames in the window
        self._before = [0] * channels  # frames that the window has left behind

    def extend(self, channel: int, records: bytes) -> None:
        """Append packed records as the bus showed them, whole ones."""
        self._raw[channel] += records

    def take(self, *, over: bool = False) -> Frames:
        """The frames that were not handed out before and whose step is over on every bus, in canonical order.

        Args:
            over: nothing more will come; all that is left is handed out.

        Raises:
            NewRun: a new run has begun; a new follower has to begin behind the frames it names.
        """
        windows = [_place(np.frombuffer(bytes(raw), _RECORD)) for raw in self._raw]
        for window, handed in zip(windows, self._handed, strict=True):
            if not window.keep[:handed].all():
                raise NewRun([sum(each) for each in zip(self._before, self._handed, strict=True)])
        closed = min(window.closed for window in windows)
        parts = []
        for channel, window in enumerate(windows):
            handed = len(window.step) if over else int(np.searchsorted(window.step, closed, side="right"))
            rows = window.keep.copy()
            rows[: self._handed[channel]] = rows[handed:] = False
            parts.append(window.columns(channel, rows))
            # behind the roll call, or the next window would take it for the start of another run
            context = np.flatnonzero(window.keep & (window.step >= closed))
            start = int(context[0]) if closed >= 0 and len(context) else 0
            del self._raw[channel][: start * _RECORD.itemsize]
            self._handed[channel] = max(handed, self._handed[channel]) - start
            self._before[channel] += start
        return _joined(parts)


class _Window(NamedTuple):
    """Frames of one channel as they came, with what `assign` says of them."""

    can_id: Array
    length: Array
    data: Array
    keep: Array
    step: Array
    turn: Array
    micros: Array
    closed: int

    def columns(self, channel: int, rows: Array) -> tuple[Array, ...]:
        """The columns of `Frames` for the frames that a mask chooses."""
        return (
            np.full(int(rows.sum()), channel, "u1"),
            self.can_id[rows],
            self.length[rows],
            self.data[rows],
            self.step[rows].astype("i4"),
            self.micros[rows] / 1e6,
            self.turn[rows].astype("i2"),
        )


def _place(record: Array) -> _Window:
    can_id, length = record["can_id"].astype("u4"), record["length"].astype("u1")
    # what no CAN bus can carry is written down as the nearest that it can, so that a log says the same
    too_long = (can_id & ~np.uint32(CAN_RTR_FLAG) > CAN_SFF_MASK) & (can_id & _FLAGS == 0)
    can_id[too_long] |= np.uint32(CAN_EFF_FLAG)
    carried = (np.arange(MAX_DATA) < length[:, None]) & (can_id & CAN_RTR_FLAG == 0)[:, None]
    data = record["data"].reshape(-1, MAX_DATA) * carried.astype("u1")
    return _Window(can_id, length, data, *assign(can_id, length, data))


def _canonical(records: dict[int, Array]) -> Frames:
    windows = ((channel, _place(records[channel])) for channel in sorted(records))
    return _joined([window.columns(channel, window.keep) for channel, window in windows])


def _joined(parts: Sequence[tuple[Array, ...]]) -> Frames:
    return concatenated([Frames(*columns) for columns in parts]).in_order()
