"""What fault files are written in: simulated times, names of the DBC, values of signals, conditions."""

import difflib
import functools
import re
from collections.abc import Iterable, Mapping
from typing import Annotated, Any

from pydantic import BeforeValidator, PlainSerializer

import dbc
from can_bus import codec
from can_bus.codec import MessageCodec

_TIME = re.compile(r"(?:(?P<days>\d{1,4})\+)?(?P<hours>\d{1,2}):(?P<minutes>[0-5]\d)(?::(?P<seconds>[0-5]\d))?")
_CONDITION = re.compile(r"(\w+)\.(\w+)\s*(==|!=|<=|>=|<|>)\s*(\S+)")


def seconds(text: Any) -> int:
    """Simulated seconds from "hh:mm[:ss]" or "days+hh:mm[:ss]", counted from the start of the run.

    Raises:
        ValueError: the text is no such time.
    """
    match = _TIME.fullmatch(text) if isinstance(text, str) else None
    if match is None or int(match["hours"]) > 23:
        raise ValueError('a time is "hh:mm", "hh:mm:ss" or "days+hh:mm" in quotes, e.g. "02:00" or "1+04:00"')
    days, hours, minutes, rest = (int(match[part] or 0) for part in ("days", "hours", "minutes", "seconds"))
    return days * 86400 + hours * 3600 + minutes * 60 + rest


def clock(time: int) -> str:
    """The text that `seconds` reads as this time; no longer than it has to be."""
    days = f"{time // 86400}+" if time >= 86400 else ""
    rest = f":{time % 60:02}" if time % 60 else ""
    return f"{days}{time // 3600 % 24:02}:{time // 60 % 60:02}{rest}"


def known(name: Any, names: Iterable[str], what: str) -> str:
    """The name, if it is one of these.

    Raises:
        ValueError: it is not; the text has the nearest ones, or all.
    """
    names = list(names)
    if isinstance(name, str) and name in names:
        return name
    near = difflib.get_close_matches(name, names, 3) if isinstance(name, str) else []
    hint = f"did you mean {' or '.join(near)}?" if near else f"it has {', '.join(names)}"
    raise ValueError(f"{what} of this name; {hint}")


def _known_message(name: Any) -> str:
    return known(name, codec.messages(), "the DBC has no message")


def known_signal(message: str, name: Any) -> str:
    """The name, if the message has such a signal; CHECKSUM and COUNTER are no signals here.

    Raises:
        ValueError: it has not.
    """
    return known(name, codec.message(message).fields, f"{message} has no signal")


def raw(message: str, signal: str, value: float | str) -> int:
    """The raw value of a signal from its physical value or from the name of a code.

    Raises:
        ValueError: the signal cannot hold it.
    """
    field = codec.message(message).fields[signal]
    described = dbc.load().get_message_by_name(message).get_signal_by_name(signal)
    if isinstance(value, str):
        codes = {str(label): int(code) for code, label in (described.choices or {}).items()}
        if not codes:
            raise ValueError(f"{message}.{signal} has no named values; give a number")
        return codes[known(value, codes, f"{message}.{signal} has no value")]
    number: int = round((value - described.offset) / described.scale)
    if not field.low <= number <= field.high and number not in field.reserved:
        low, high = (bound * described.scale + described.offset for bound in (field.low, field.high))
        unit = f" {described.unit}" if described.unit not in (None, "-") else ""
        raise ValueError(f"{message}.{signal} holds {low:g} to {high:g}{unit}")
    return number


def raw_steps(message: str, signal: str, difference: float) -> int:
    """A difference of physical values in steps of the raw value."""
    scale: float = dbc.load().get_message_by_name(message).get_signal_by_name(signal).scale
    return round(difference / scale)


class Condition:
    """A signal against a value: true by the newest frame of that message, false before the first."""

    def __init__(self, text: str) -> None:
        match = _CONDITION.fullmatch(text.strip())
        if match is None:
            raise ValueError(
                'a condition is "Message.Signal", one of == != < <= > >=, and a number or the name of a code, '
                'e.g. "CGM_Reading.GlucoseConc < 80" or "CTRL_Status.CtrlState == Auto"'
            )
        message, signal, self._operator, value = match.groups()
        self.message = _known_message(message)
        self._signal = known_signal(self.message, signal)
        try:
            number: float | str = float(value)
        except ValueError:
            number = value
        self._value = raw(self.message, self._signal, number)
        field = codec.message(self.message).fields[self._signal]
        self._no_value = {code for code in field.reserved if not field.low <= code <= field.high}

    def holds(self, newest: Mapping[str, Mapping[str, int]]) -> bool:
        """Whether it is true; `newest` has the raw values of the newest frame of each message."""
        found = newest.get(self.message, {}).get(self._signal)
        if found is None:
            return False
        if self._operator in ("==", "!="):
            return (found == self._value) == (self._operator == "==")
        if found in self._no_value:
            return False  # no reading is neither above nor below
        return {
            "<": found < self._value,
            "<=": found <= self._value,
            ">": found > self._value,
            ">=": found >= self._value,
        }[self._operator]


@functools.cache
def condition(text: str) -> Condition:
    """The condition that a text says.

    Raises:
        ValueError: it says none.
    """
    return Condition(text)


def _checked_condition(text: Any) -> str:
    if not isinstance(text, str):
        raise ValueError('a condition is text, e.g. "CGM_Reading.GlucoseConc < 80"')
    condition(text)
    return text


def with_raw(packed: MessageCodec, data: bytes, values: Mapping[str, int]) -> bytes:
    """The payload with these raw values in place of its own, COUNTER and CHECKSUM as they are."""
    word = int.from_bytes(data, "little")
    for name, number in values.items():
        field = packed.fields[name]
        word = word & ~(field.mask << field.shift) | (number & field.mask) << field.shift
    return word.to_bytes(len(data), "little")


def repaired(packed: MessageCodec, data: bytes, counter: int | None = None) -> bytes:
    """The payload with a CHECKSUM that fits it, and with this COUNTER if one is given."""
    if packed.data_ids is None:
        return data
    counter = data[1] & 0xF if counter is None else counter
    return codec.protect(packed, int.from_bytes(data, "little") & ~0xFFF, counter)


Time = Annotated[int, BeforeValidator(seconds), PlainSerializer(clock, when_used="json")]
MessageName = Annotated[str, BeforeValidator(_known_message)]
ConditionText = Annotated[str, BeforeValidator(_checked_condition)]
