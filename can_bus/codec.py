"""Frames to raw signal values and back, and E2E protection, straight from the DBC.

Raw values are the integers on the wire: a firmware has nothing else, and scaling them is a matter of the test side
(cantools, strict). cantools reads the DBC; the packing itself is done here because a lockstep run spends a third of its
time in it: cantools' own encode and decode take 1.8 and 1.2 us without scaling, these 0.9 and 0.6 us.

What this does *not* do: scale to physical units, know what a value means, or decide what a receiver does with a frame
that fails its check.
"""

import enum
import functools
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

from e2e.crc import calculate_crc8_h2f
from e2e.p02 import e2e_p02_check, e2e_p02_protect

import dbc
from can_bus.frame import CAN_EFF_MASK, CAN_ERR_FLAG, Frame

COUNTER_MODULUS = 16


class Field(NamedTuple):
    """Where a signal lies in the little-endian payload, and which raw values the DBC allows."""

    name: str
    shift: int
    mask: int
    sign: int  # the sign bit's weight within the field, 0 for an unsigned signal
    low: int
    high: int
    reserved: frozenset[int]  # raw codes outside [low, high] that have a name (SNA, Error)


class CodecError(ValueError):
    """A value does not fit its signal, or a message or signal is not in the DBC; the text names both."""


def _field(signal: Any) -> Field:
    if signal.byte_order != "little_endian":
        raise CodecError(f"{signal.name}: big-endian signals are not used in this DBC")
    offset, scale = signal.offset, signal.scale
    bounds = [round((bound - offset) / scale) for bound in (signal.minimum, signal.maximum)]
    return Field(
        name=signal.name,
        shift=signal.start,
        mask=(1 << signal.length) - 1,
        sign=1 << (signal.length - 1) if signal.is_signed else 0,
        low=min(bounds),
        high=max(bounds),
        reserved=frozenset(int(code) for code in (signal.choices or {})),
    )


Packer = Callable[..., int | None]
Unpacker = Callable[[int], dict[str, int]]


def _packer(start: int, fields: list[Field]) -> Packer:
    """A function of these signals' raw values that gives the payload, None if a value is outside its range.

    It is made of one expression over the DBC's numbers, as collections.namedtuple makes its classes: a loop over the
    fields takes three times as long, and a lockstep run spends a third of its time here.
    """
    if not fields:
        return lambda: start
    checks = " and ".join(f"{field.low} <= {field.name} <= {field.high}" for field in fields)
    parts = " | ".join(f"({field.name} & {field.mask}) << {field.shift}" for field in fields)
    names = ", ".join(field.name for field in fields)
    packer: Packer = eval(f"lambda {names}: {start} | {parts} if {checks} else None", {"__builtins__": {}})
    return packer


def _unpacker(fields: list[Field]) -> Unpacker:
    """A function of the payload as an integer that gives the raw values by signal name; made like `_packer`."""
    items = (
        f"{field.name!r}: (word >> {field.shift} & {field.mask} ^ {field.sign}) - {field.sign}"
        if field.sign
        else f"{field.name!r}: word >> {field.shift} & {field.mask}"
        for field in fields
    )
    unpacker: Unpacker = eval(f"lambda word: {{{', '.join(items)}}}", {"__builtins__": {}})
    return unpacker


class MessageCodec:
    """One message of the DBC: pack raw values into bytes and back.

    Attributes:
        name, can_id, length, sender: as in the DBC.
        data_ids: the 16 E2E data ids, or None for a message without protection.
        fields: signal name -> `Field`, CHECKSUM and COUNTER left out of protected messages.
        selector: name of the multiplexer signal, or None.
        pages: its code -> the fields that exist only there.
    """

    def __init__(self, message: Any) -> None:
        self.name: str = message.name
        self.can_id: int = message.frame_id
        self.length: int = message.length
        self.sender: str = message.senders[0]
        attributes = message.dbc.attributes
        ids = attributes["E2EDataIdList"].value if "E2EDataIdList" in attributes else ""
        self.data_ids: bytes | None = bytes.fromhex(ids) if ids else None
        hidden = ("CHECKSUM", "COUNTER") if self.data_ids else ()
        self.fields: dict[str, Field] = {}
        self.selector: str | None = None
        common: list[Field] = []
        pages: dict[int, list[Field]] = {}
        self._page_of: dict[str, int] = {}
        self._page_start: dict[str, int] = {}
        initial = 0
        for signal in message.signals:
            if signal.name in hidden:
                continue
            field = _field(signal)
            self.fields[signal.name] = field
            attribute = signal.dbc.attributes.get("GenSigStartValue")
            start = ((int(attribute.value) if attribute else 0) & field.mask) << field.shift
            if signal.multiplexer_ids:
                pages.setdefault(signal.multiplexer_ids[0], []).append(field)
                self._page_of[field.name] = signal.multiplexer_ids[0]
                self._page_start[field.name] = start
            else:
                common.append(field)
                initial |= start
            if signal.is_multiplexer:
                self.selector = signal.name
        self._initial = initial
        self.pages = {key: tuple(fields) for key, fields in pages.items()}
        self._packers: dict[tuple[str | int | None, ...], Packer] = {}
        self._unpack = _unpacker(common)
        self._unpack_page = {key: _unpacker(common + fields) for key, fields in pages.items()}

    def pack(self, values: Mapping[str, int]) -> int:
        """The payload as an integer, CHECKSUM and COUNTER zero; signals left out keep their start value.

        Raises:
            CodecError: an unknown signal, one of another page than the selector's, or a value neither in the signal's
                range nor one of its named codes.
        """
        key = (*values,) if self.selector is None else (*values, values.get(self.selector))
        packer = self._packers.get(key)
        if packer is None:
            packer = self._packers[key] = _packer(self._start(values), [self._field(name) for name in values])
        word = packer(*values.values())
        return self._pack_with_care(values) if word is None else word

    def _pack_with_care(self, values: Mapping[str, int]) -> int:
        """The same with reserved codes among the values; the place where values out of range are found."""
        word = self._start(values)
        for name, value in values.items():
            _, shift, mask, _, low, high, reserved = self._field(name)
            if not low <= value <= high and value not in reserved:
                raise CodecError(f"{self.name}.{name}: raw value {value} is outside {low}..{high}")
            word |= (value & mask) << shift
        return word

    def _field(self, name: str) -> Field:
        try:
            return self.fields[name]
        except KeyError:
            raise CodecError(f"{self.name} has no signal {name}; it has {', '.join(self.fields)}") from None

    def _start(self, values: Mapping[str, int]) -> int:
        """The start values of all signals but these, with those of the page that is selected."""
        word = self._initial
        if self.selector is not None:
            field = self.fields[self.selector]
            page = values.get(self.selector, word >> field.shift & field.mask)
            for name in values:
                if self._page_of.get(name, page) != page:
                    raise CodecError(f"{self.name}.{name} does not exist when {self.selector} is {page}")
            for field in self.pages.get(page, ()):
                word |= self._page_start[field.name]
        for name in values:
            field = self._field(name)
            word &= ~(field.mask << field.shift)
        return word

    def unpack(self, data: bytes) -> dict[str, int]:
        """Raw values by signal name. No range is checked: a receiver has to distrust every field itself.

        Args:
            data: exactly `length` bytes; check it before (`Receiver` does).
        """
        word = int.from_bytes(data, "little")
        if self.selector is None:
            return self._unpack(word)
        selector = self.fields[self.selector]
        return self._unpack_page.get(word >> selector.shift & selector.mask, self._unpack)(word)


@functools.cache
def messages() -> dict[str, MessageCodec]:
    """All messages of the DBC by name."""
    return {message.name: MessageCodec(message) for message in dbc.load().messages}


@functools.cache
def messages_by_id() -> dict[int, MessageCodec]:
    """All messages of the DBC by CAN id."""
    return {codec.can_id: codec for codec in messages().values()}


def message(name: str) -> MessageCodec:
    """The codec of one message.

    Raises:
        CodecError: the DBC has no such message; the text lists those it has.
    """
    try:
        return messages()[name]
    except KeyError:
        raise CodecError(f"the DBC has no message {name!r}; it has {', '.join(messages())}") from None


def choice(message_name: str, signal_name: str, label: str) -> int:
    """The raw code of a named value, e.g. `choice("CTRL_Status", "CtrlState", "SafeBasal")`.

    Raises:
        CodecError: no such message, signal or label.
    """
    message(message_name)
    try:
        signal = dbc.load().get_message_by_name(message_name).get_signal_by_name(signal_name)
        return next(int(code) for code, text in (signal.choices or {}).items() if str(text) == label)
    except (KeyError, StopIteration):
        raise CodecError(f"{message_name}.{signal_name} has no value named {label!r}") from None


def protect(codec: MessageCodec, word: int, counter: int) -> bytes:
    """Payload bytes with COUNTER and CHECKSUM set (AUTOSAR E2E Profile 2), as they are if unprotected."""
    if codec.data_ids is None:
        return word.to_bytes(codec.length, "little")
    data = bytearray((word | counter << 8).to_bytes(codec.length, "little"))
    e2e_p02_protect(data, codec.data_ids, increment_counter=False)
    return bytes(data)


@functools.cache
def crc_table() -> tuple[int, ...]:
    """CRC of each byte alone by the polynomial of CHECKSUM, 0x2F, for those who work on many frames at once."""
    return tuple(
        calculate_crc8_h2f(bytes([byte ^ 0xFF])) ^ 0xFF for byte in range(256)
    )  # starts from and ends with 0xFF


class Transmitter:
    """Builds the frames of one or several nodes and keeps their E2E counters.

    Counters start at 0 and step by one per frame and message, so that the same calls give the same bytes.

    Attributes:
        counters: message name -> COUNTER of its next frame.
    """

    def __init__(self) -> None:
        self._codecs = messages()
        self.counters = dict.fromkeys(self._codecs, 0)

    def frame(self, name: str, **values: int) -> Frame:
        """The next frame of message `name` with these raw values.

        Raises:
            CodecError: see `MessageCodec.pack`.
        """
        try:
            codec = self._codecs[name]
        except KeyError:
            codec = message(name)
        word = codec.pack(values)  # a refused value does not use up a count
        counter = self.counters[name]
        self.counters[name] = (counter + 1) % COUNTER_MODULUS
        return Frame(codec.can_id, protect(codec, word, counter))


class Check(enum.IntEnum):
    """What E2E Profile 2 says of a received frame (AUTOSAR names), and what comes before it."""

    OK = 0
    OK_SOME_LOST = 1  # 1..MAX_LOST frames are missing before this one, which may be used
    REPEATED = 2  # the counter of the last good frame again
    WRONG_SEQUENCE = 3  # more than MAX_LOST frames are missing: not to be used
    ERROR = 4  # the CRC does not fit: as if never received
    MALFORMED = 5  # a remote or 29-bit frame with a subscribed id, or a wrong length
    UNKNOWN = 6  # an id this receiver does not subscribe to, or an error frame: no node sent it


class Received(NamedTuple):
    """A checked frame: `values` only where the check lets a receiver read it (OK, OK_SOME_LOST)."""

    check: Check
    name: str
    values: dict[str, int]
    lost: int


MAX_LOST = 2
"""Frames that may be missing before one that is still used (requirement E2E-02: a counter step of 2 or 3 is used)."""


class Receiver:
    """Checks and decodes the frames a node subscribes to; counts what it refuses.

    It judges frames one by one: sender, CRC, length, counter. Whether a message as a whole is alive (timeouts,
    windows of good and bad checks) is the business of the node.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self._codecs = {message(name).can_id: message(name) for name in names}
        self._last: dict[int, int] = {}
        self.crc_errors = 0
        self.malformed = 0
        self.sequence_errors = 0
        self._lost = dict.fromkeys(self._codecs, 0)

    @property
    def lost(self) -> int:
        """Frames missing by their counters, of all messages; a gap of 16 looks like none."""
        return sum(self._lost.values())

    def lost_of(self, name: str) -> int:
        """Frames of one message missing by its counter."""
        return self._lost[message(name).can_id]

    def reset(self) -> None:
        """Forget the counters of all messages, as after a boot; what was counted so far stays."""
        self._last.clear()

    def receive(self, frame: Frame) -> Received:
        """Check one frame. Frames that fail change nothing but the counts."""
        can_id, data = frame
        codec = self._codecs.get(can_id)
        if codec is None:
            return self._foreign(can_id)
        if len(data) != codec.length:
            self.malformed += 1
            return Received(Check.MALFORMED, codec.name, {}, 0)
        if codec.data_ids is None:
            return Received(Check.OK, codec.name, codec.unpack(data), 0)
        if not e2e_p02_check(data, codec.data_ids):
            self.crc_errors += 1
            return Received(Check.ERROR, codec.name, {}, 0)
        counter = data[1] & 0xF
        step = (counter - self._last.get(can_id, counter - 1)) % COUNTER_MODULUS
        if step == 0:
            self.sequence_errors += 1
            return Received(Check.REPEATED, codec.name, {}, 0)
        self._last[can_id] = counter
        if step == 1:
            return Received(Check.OK, codec.name, codec.unpack(data), 0)
        self._lost[can_id] += step - 1
        if step - 1 > MAX_LOST:
            self.sequence_errors += 1
            return Received(Check.WRONG_SEQUENCE, codec.name, {}, step - 1)
        return Received(Check.OK_SOME_LOST, codec.name, codec.unpack(data), step - 1)

    def _foreign(self, can_id: int) -> Received:
        codec = self._codecs.get(can_id & CAN_EFF_MASK)
        if codec is None or can_id & CAN_ERR_FLAG:  # the id of an error frame is a class of errors, not an id
            return Received(Check.UNKNOWN, "", {}, 0)
        self.malformed += 1
        return Received(Check.MALFORMED, codec.name, {}, 0)
