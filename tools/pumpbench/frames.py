"""All frames of a run as columns: what was on the bus, and in which step, turn and simulated time."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from can_bus import codec
from can_bus.frame import MAX_DATA, Frame

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

_HASHED: Final = np.dtype([("channel", "u1"), ("step", "<u4"), ("can_id", "<u4"), ("length", "u1"), ("data", "V8")])


@dataclass(frozen=True, eq=False)
class Frames:
    """All frames of a run in canonical order: by step; within a step channel 0 in bus order, then channel 1.

    Attributes:
        channel: 0 = the device's bus, 1 = the plant's bus (only with a gateway between).
        can_id: identifier with the flag bits of Linux (EFF, RTR, ERR).
        length: number of data bytes.
        data: (n, 8) bytes, zero beyond `length`.
        step: sampling instant k the frame belongs to.
        time_s: simulated seconds: SimTime of the turn's token plus 0.25 ms for each frame before it.
        turn: -1 for the configuration before step 0, 0 for a step's first turn, then counting up.
    """

    channel: Array
    can_id: Array
    length: Array
    data: Array
    step: Array
    time_s: Array
    turn: Array

    def __len__(self) -> int:
        return len(self.can_id)

    @classmethod
    def none(cls) -> Frames:
        """No frames at all."""
        kinds = ("u1", "u4", "u1", "u1", "i4", "f8", "i2")
        columns = [np.zeros(0, kind) for kind in kinds]
        columns[3] = np.zeros((0, MAX_DATA), "u1")
        return cls(*columns)

    @property
    def word(self) -> Array:
        """The payloads as little-endian 64-bit integers."""
        return np.ascontiguousarray(self.data).view("<u8").reshape(-1)

    def select(self, rows: Array) -> Frames:
        """The frames chosen by a mask or an array of positions, in that order."""
        return Frames(*(getattr(self, field.name)[rows] for field in fields(self)))

    def at_step(self, step: int) -> Frames:
        """The same frames, as if they belonged to another step."""
        return replace(self, step=np.full_like(self.step, step))

    def in_order(self) -> Frames:
        """The same frames in canonical order; those of a step and channel stay as they are."""
        return self.select(np.lexsort((self.channel, self.step)))

    def frame(self, row: int) -> Frame:
        """One frame as the bus carries it."""
        return Frame(int(self.can_id[row]), self.data[row, : self.length[row]].tobytes())

    def frames(self, channel: int = 0) -> list[Frame]:
        """All frames of a channel as the bus carries them, in bus order."""
        rows = np.flatnonzero(self.channel == channel)
        ids, lengths, data = self.can_id[rows].tolist(), self.length[rows].tolist(), self.data[rows].tobytes()
        return [
            Frame(can_id, data[8 * row : 8 * row + length])
            for row, (can_id, length) in enumerate(zip(ids, lengths, strict=True))
        ]

    def sha256(self) -> str:
        """Hash over channel, step, id, length and data (padded with zeros) of all frames, packed as `<BIIB8s`."""
        packed = np.zeros(len(self), _HASHED)
        packed["channel"], packed["step"] = self.channel, self.step
        packed["can_id"], packed["length"] = self.can_id, self.length
        packed["data"] = np.ascontiguousarray(self.data).view("V8").reshape(-1)
        return hashlib.sha256(packed.tobytes()).hexdigest()

    @functools.cached_property
    def intact(self) -> Array:
        """Which frames a receiver may believe: an id of the DBC, its length, and an E2E checksum that fits."""
        return intact(self.can_id, self.length, self.data)


def concatenated(parts: Sequence[Frames]) -> Frames:
    """These frames, one after the other."""
    parts = parts or [Frames.none()]
    return Frames(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Frames)))


def intact(can_id: Array, length: Array, data: Array) -> Array:
    """Which frames have an id and a length of the DBC and, where protected, a fitting checksum (E2E Profile 2)."""
    good = np.zeros(len(can_id), bool)
    table = np.array(codec.crc_table(), "u1")
    for message in codec.messages().values():
        rows = np.flatnonzero((can_id == message.can_id) & (length == message.length))
        if not len(rows):
            continue
        if message.data_ids is None:
            good[rows] = True
            continue
        payload = data[rows]
        crc = np.full(len(rows), 0xFF, "u1")
        for column in range(1, message.length):
            crc = table[crc ^ payload[:, column]]
        data_ids = np.frombuffer(message.data_ids, "u1")
        crc = table[crc ^ data_ids[payload[:, 1] & 0xF]]
        good[rows] = crc ^ 0xFF == payload[:, 0]
    return good


@functools.cache
def device_ids() -> frozenset[int]:
    """Identifiers of the frames that the device sends (CTRL of the DBC)."""
    return frozenset(message.can_id for message in codec.messages().values() if message.sender == "CTRL")
