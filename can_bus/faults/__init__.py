"""Faults of the wire and of the device as values: what, to which message of the DBC, when in simulated time.

A fault is written in YAML or in Python, can be printed and compared, and does the same in every run. It acts between
two buses, in the gateway, never inside a node, so that it works on a real device too.
"""

from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from can_bus import yaml_file

from .base import TARGETS, Fault, FrameFault, Held, Memory, report
from .bus import Babble, BusFault, BusOff, ErrorFrames, ForeignId, SlowTask
from .clocks import ClockDrift, ClockJump, DayChange
from .fields import Time, clock, seconds
from .frames import (
    Delay,
    Drop,
    Duplicate,
    ExtendedId,
    FlipBits,
    FrozenCounter,
    Masquerade,
    Misroute,
    RemoteFrame,
    Reorder,
    Replay,
    SetValue,
    StuckFrame,
    StuckValue,
    WrongLength,
)
from .injector import Injector
from .nodes import Hang, Kill, MemoryState, NodeControl, Restart

__all__ = [
    "TARGETS", "AnyWireFault", "Babble", "BusFault", "BusOff", "ClockDrift", "ClockJump", "DayChange", "Delay", "Drop",
    "Duplicate", "ErrorFrames", "ExtendedId", "Fault", "FaultFile", "FlipBits", "ForeignId", "FrameFault",
    "FrozenCounter", "Hang", "Held", "Injector", "Kill", "Masquerade", "Memory", "MemoryState", "Misroute",
    "NodeControl", "NodeFault", "RemoteFrame", "Reorder", "Replay", "Restart", "SetValue", "SlowTask", "StuckFrame",
    "StuckValue", "Time", "WireFaults", "WrongLength", "clock", "load_faults", "report", "seconds",
]  # fmt: skip

NodeFault = Restart | Kill | Hang

WireFaults = (
    Drop | Delay | Duplicate | Reorder | Replay | FlipBits | SetValue | StuckFrame | StuckValue | FrozenCounter
    | WrongLength | RemoteFrame | ExtendedId | Misroute | Masquerade
    | Babble | ForeignId | ErrorFrames | BusOff
    | ClockJump | ClockDrift | DayChange
    | Restart | Kill | Hang | SlowTask
)  # fmt: skip

AnyWireFault = Annotated[WireFaults, Field(discriminator="kind")]
"""A fault of the wire or of the device in a file."""


class FaultFile(BaseModel):
    """The layout of a gateway's fault file."""

    model_config = ConfigDict(extra="forbid")

    faults: list[AnyWireFault]


def load_faults(path: Path) -> tuple[Fault, ...]:
    """Read a fault file.

    Raises:
        yaml_file.FileError: with file, line and what was expected.
    """
    return tuple(yaml_file.load(path, FaultFile).faults)
