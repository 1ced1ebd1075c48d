"""Faults of frames as values: what, to which message of the DBC, when in simulated time.

A fault is written in YAML or in Python, can be printed and compared, and does the same in every run. It acts between
two buses, in the gateway, never inside a node, so that it works on a real device too.
"""

import difflib
import re
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PlainSerializer, model_validator

from can_bus import codec, yaml_file
from can_bus.frame import Frame

_TIME = re.compile(r"(?:(?P<days>\d{1,4})\+)?(?P<hours>\d{1,2}):(?P<minutes>[0-5]\d)(?::(?P<seconds>[0-5]\d))?")

FAULT_DROP = 1
"""FAULT_Inject.FaultKind."""

TARGETS = {"CGM": 1, "PUMP": 2, "CTRL": 3, "UI": 4, "PLANT": 5, "TESTER": 5}
"""Sender of the faulty frame -> FAULT_Inject.FaultTarget; 5 is the bus itself."""


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
    """The text that `seconds` reads as this time."""
    return f"{time // 86400}+{time // 3600 % 24:02}:{time // 60 % 60:02}:{time % 60:02}"


def _known_message(name: Any) -> str:
    known = list(codec.messages())
    if isinstance(name, str) and name in known:
        return name
    near = difflib.get_close_matches(name, known, 3) if isinstance(name, str) else []
    hint = f"did you mean {' or '.join(near)}?" if near else f"it has {', '.join(known)}"
    raise ValueError(f"the DBC has no message of this name; {hint}")


Time = Annotated[int, BeforeValidator(seconds), PlainSerializer(clock, when_used="json")]
MessageName = Annotated[str, BeforeValidator(_known_message)]


class Drop(BaseModel):
    """Lose every frame of one message from `start` until before `end`, or the first `count` of them."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Literal["drop"] = "drop"
    message: MessageName
    start: Time = 0
    end: Time | None = None
    count: Annotated[int, Field(ge=1)] | None = None

    @model_validator(mode="after")
    def _interval(self) -> "Drop":
        if self.end is not None and self.end <= self.start:
            raise ValueError("end must be later than start")
        return self

    def covers(self, time: int, already: int) -> bool:
        """Whether the fault acts at this simulated second, having acted `already` times."""
        if time < self.start or (self.end is not None and time >= self.end):
            return False
        return self.count is None or already < self.count


Fault = Drop
"""Any fault of the catalogue."""

CATALOGUE = {"drop": Drop}


class FaultFile(BaseModel):
    """The layout of a fault file."""

    model_config = ConfigDict(extra="forbid")

    faults: list[Fault]


def load_faults(path: Path) -> tuple[Fault, ...]:
    """Read a fault file.

    Raises:
        yaml_file.FileError: with file, line and what was expected.
    """
    return tuple(yaml_file.load(path, FaultFile).faults)


class Injector:
    """Applies faults to frames in passing; remembers how often each has acted."""

    def __init__(self, faults: tuple[Fault, ...]) -> None:
        self._acted = [0] * len(faults)
        self._by_id: dict[int, list[tuple[int, Fault]]] = {}
        for index, fault in enumerate(faults):
            self._by_id.setdefault(codec.message(fault.message).can_id, []).append((index, fault))

    def apply(self, frame: Frame, time: int) -> tuple[list[Frame], list[Frame]]:
        """What becomes of a frame at a simulated second.

        Returns:
            The frames that go on, and the FAULT_Inject frames that tell what was done.
        """
        for index, fault in self._by_id.get(frame.can_id, ()):
            if fault.covers(time, self._acted[index]):
                self._acted[index] += 1
                return [], [self._report(fault, time)]
        return [frame], []

    @staticmethod
    def _report(fault: Fault, time: int) -> Frame:
        message = codec.message(fault.message)
        inject = codec.message("FAULT_Inject")
        word = inject.pack(
            {
                "FaultTarget": TARGETS[message.sender],
                "FaultKind": FAULT_DROP,
                "FaultCanId": message.can_id,
                "FaultCount": 1,
                "FaultParam": time // 300 % 65536,
            }
        )
        return Frame(inject.can_id, codec.protect(inject, word, 0))
