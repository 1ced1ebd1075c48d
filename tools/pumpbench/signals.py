"""What the frames of a message say: its signals, one by one or as arrays of all frames at once."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

import dbc
from can_bus import codec
from can_bus.frame import Frame
from pumpbench.frames import Frames

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

_NO_VALUE: Final = frozenset({"SNA", "Error"})


@dataclass(frozen=True)
class Signal:
    """A signal of the DBC, ready for arrays.

    Attributes:
        name: as in the DBC.
        unit: "" for none.
        comment: the DBC's comment.
        choices: names of raw codes (also of SNA and Error).
        invalid: raw codes that say "no value".
        is_enumeration: whether its values are names, not a quantity.
        page: value of the multiplexer this signal belongs to, or None.
    """

    name: str
    unit: str
    comment: str
    choices: Mapping[int, str]
    invalid: tuple[int, ...]
    is_enumeration: bool
    page: int | None
    shift: int
    mask: int
    sign: int
    scale: float
    offset: float

    def raw(self, words: Array) -> Array:
        """Raw values as signed 64-bit integers, from payloads as 64-bit words."""
        bits = (words >> np.uint64(self.shift)) & np.uint64(self.mask)
        return (bits.astype("i8") ^ self.sign) - self.sign

    def physical(self, raw: Array) -> Array:
        """Physical values; NaN where the raw code says that there is none."""
        values = raw * self.scale + self.offset
        values = values.astype("f8")
        if self.invalid:
            values[np.isin(raw, self.invalid)] = np.nan
        return values

    def text(self, raw: int) -> str:
        """A raw value in physical units, with the unit and no more digits than the scale has."""
        value = f"{raw * self.scale + self.offset:.10g}"
        return f"{value} {self.unit}" if self.unit else value

    def label(self, code: float) -> str:
        """The name of a value of an enumeration, or the number as text; "" for NaN."""
        return "" if math.isnan(code) else self.choices.get(int(code), f"{code:g}")


@functools.cache
def signals(message: str) -> dict[str, Signal]:
    """The signals of a message by name, without CHECKSUM and COUNTER."""
    table = dbc.load().get_message_by_name(message)
    packed = codec.message(message)
    result = {}
    for signal in table.signals:
        if signal.name not in packed.fields:
            continue
        packing = packed.fields[signal.name]
        choices = {int(code): str(label) for code, label in (signal.choices or {}).items()}
        marked = signal.dbc.attributes.get("SigInvalidRaw")
        invalid = {code for code, label in choices.items() if label in _NO_VALUE}
        if marked is not None and marked.value != -1:
            invalid.add(int(marked.value))
        result[signal.name] = Signal(
            name=signal.name,
            unit="" if signal.unit in (None, "-") else str(signal.unit),
            comment=str(signal.comment or ""),
            choices=choices,
            invalid=tuple(sorted(invalid)),
            is_enumeration=bool(set(choices.values()) - _NO_VALUE),
            page=signal.multiplexer_ids[0] if signal.multiplexer_ids else None,
            shift=packing.shift,
            mask=packing.mask,
            sign=packing.sign,
            scale=signal.scale,
            offset=signal.offset,
        )
    return result


def labels(message: str, signal: str) -> Mapping[int, str]:
    """Names of the raw codes of an enumeration."""
    return signals(message)[signal].choices


class Decoded(NamedTuple):
    """All believable frames of one message.

    Attributes:
        rows: their positions in `Frames`.
        raw: signal -> raw integers.
        valid: signal -> mask of the frames that carry the signal (all, unless it is multiplexed).
    """

    rows: Array
    raw: dict[str, Array]
    valid: dict[str, Array]


def decode(frames: Frames, message: str, channel: int | None = None) -> Decoded:
    """Decode every frame of a message that passes its checks (id, length, checksum).

    Args:
        frames: the record.
        message: name in the DBC.
        channel: only this bus; None for all.
    """
    packed = codec.message(message)
    mask = (frames.can_id == packed.can_id) & frames.intact
    if channel is not None:
        mask &= frames.channel == channel
    rows = np.flatnonzero(mask)
    words = frames.word[rows]
    table = signals(message)
    raw = {name: signal.raw(words) for name, signal in table.items()}
    always = np.ones(len(rows), bool)
    valid = {
        name: always if signal.page is None or packed.selector is None else raw[packed.selector] == signal.page
        for name, signal in table.items()
    }
    return Decoded(rows, raw, valid)


def frame_text(frame: Frame) -> str:
    """A frame in words: its message and signals in physical values, or its id and bytes if it is none of the DBC."""
    message = codec.messages_by_id().get(frame.can_id)
    if message is None or len(frame.data) != message.length:
        what = "error frame" if frame.is_error else "remote frame" if frame.is_remote else "frame"
        return f"{what} 0x{frame.identifier:X}{' (29 bits)' if frame.is_extended else ''} [{frame.data.hex(' ')}]"
    table = signals(message.name)
    words = [f"{name}={_value_text(table[name], raw)}" for name, raw in message.unpack(frame.data).items()]
    return f"{message.name} {' '.join(words)}"


def _value_text(signal: Signal, raw: int) -> str:
    return signal.choices.get(raw) or signal.text(raw).replace(" ", "")
