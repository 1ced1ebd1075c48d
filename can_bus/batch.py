"""Many frames in one compiled call, for a sender whose batch looks the same in every step.

`Transmitter.frame` costs 2 to 3 us a frame, and the plant says sixteen frames per step: a third of a lockstep run. The
bytes here are the same (a test holds them against `Transmitter`), only the loop over signals and the CRC are compiled.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
from numba import njit

from can_bus import codec
from can_bus.codec import Transmitter, crc_table
from can_bus.frame import RECORD_SIZE, Frame, unpack

Layout = Sequence[tuple[str, Sequence[str], Mapping[str, int]]]
"""Messages in order: name, the signals whose raw values are given each time, and those that never change."""


@njit(cache=True)  # type: ignore[untyped-decorator]
def _encode(
    raws: npt.NDArray[np.int64],
    fields: npt.NDArray[np.int64],
    frames: npt.NDArray[np.int64],
    data_ids: npt.NDArray[np.uint8],
    table: npt.NDArray[np.uint8],
    counters: npt.NDArray[np.int64],
    out: npt.NDArray[np.uint8],
) -> bool:
    """Fill `out` (one 16-byte record per frame); False if a value is outside its range.

    A row of `fields` is shift, mask, low, high; of `frames`: number of fields, start value, length, slot of the
    counter (-1 for an unprotected message).
    """
    position = 0
    for number in range(frames.shape[0]):
        count, word, length, slot = frames[number]
        for _ in range(count):
            shift, mask, low, high = fields[position]
            value = raws[position]
            if value < low or value > high:
                return False
            word |= (value & mask) << shift
            position += 1
        if slot >= 0:
            word |= counters[slot] << 8
        for byte in range(length):
            out[number, 8 + byte] = word >> (8 * byte) & 0xFF
        if slot >= 0:
            crc = 0xFF
            for byte in range(1, length):
                crc = table[crc ^ out[number, 8 + byte]]
            out[number, 8] = table[crc ^ data_ids[slot, counters[slot]]] ^ 0xFF
            counters[slot] = (counters[slot] + 1) % 16
    return True


class Batch:
    """A fixed sequence of frames of one transmitter."""

    def __init__(self, transmitter: Transmitter, layout: Layout) -> None:
        """Look up the layout.

        Raises:
            CodecError: a message or signal the DBC does not have, or a signal of another page than the selector's.
        """
        self._transmitter = transmitter
        self._layout = [(name, tuple(signals), dict(constants)) for name, signals, constants in layout]
        self._protected = sorted({name for name, _, _ in self._layout if codec.message(name).data_ids})
        fields, frames = [], []
        self._out = np.zeros((len(self._layout), RECORD_SIZE), np.uint8)
        for number, (name, signals, constants) in enumerate(self._layout):
            message = codec.message(name)
            start = message.pack(constants)
            message.pack({**constants, **{signal: message.fields[signal].low for signal in signals}})
            for signal in signals:
                field = message.fields[signal]
                start &= ~(field.mask << field.shift)
                fields.append((field.shift, field.mask, field.low, field.high))
            slot = self._protected.index(name) if name in self._protected else -1
            frames.append((len(signals), start, message.length, slot))
            self._out[number, :4] = np.frombuffer(message.can_id.to_bytes(4, "little"), np.uint8)
            self._out[number, 4] = message.length
        self._fields = np.array(fields, np.int64)
        self._frames = np.array([[_signed(cell) for cell in row] for row in frames], np.int64)
        ids = [codec.message(name).data_ids or b"" for name in self._protected]
        self._data_ids = np.array([list(one) for one in ids], np.uint8)
        self._table = np.array(crc_table(), np.uint8)

    def frames(self, raws: Sequence[int]) -> list[Frame]:
        """The next frames, with these raw values in the order of the layout.

        Raises:
            CodecError: see `codec.MessageCodec.pack`.
        """
        counts = self._transmitter.counters
        counters = np.array([counts[name] for name in self._protected], np.int64)
        values = np.array(raws, np.int64)
        if values.size == len(self._fields) and _encode(
            values, self._fields, self._frames, self._data_ids, self._table, counters, self._out
        ):
            counts.update(zip(self._protected, counters.tolist(), strict=True))
            return unpack(self._out.tobytes())
        return self._one_by_one(raws)

    def _one_by_one(self, raws: Sequence[int]) -> list[Frame]:
        """The same with reserved codes among the values; the place where values out of range are found."""
        rest = iter(raws)
        return [
            self._transmitter.frame(name, **constants, **{signal: next(rest) for signal in signals})
            for name, signals, constants in self._layout
        ]


def _signed(word: int) -> int:
    """The same 64 bits as a signed number."""
    return word - (1 << 64) if word >= 1 << 63 else word
