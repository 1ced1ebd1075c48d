"""Faults of the time that the device is told: SimTime of SYNC_Step; the number of the step stays right."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from can_bus.frame import Frame
from can_bus.lockstep import Phase

from .base import FrameFault, Held, Memory
from .fields import repaired, with_raw

DAY_SECONDS = 86400


class ClockFault(FrameFault):
    """SimTime is off."""

    message: Literal["SYNC_Step"] = "SYNC_Step"

    def off(self, time: int) -> int:
        """By how many seconds."""
        raise NotImplementedError

    def act(self, frame: Frame, time: int, memory: Memory) -> list[Frame | Held] | None:
        """Tell the wrong time."""
        if len(frame.data) != self.codec.length:
            return None
        values = self.codec.unpack(frame.data)
        off = self.off(time)
        if not off or values["SyncPhase"] not in (Phase.STEP, Phase.CONTINUE):
            return None
        told = min(max(values["SimTime"] + off, 0), self.codec.fields["SimTime"].high)
        return [Frame(frame.can_id, repaired(self.codec, with_raw(self.codec, frame.data, {"SimTime": told})))]


class ClockJump(ClockFault):
    """The clock is `seconds` ahead, or set back if negative."""

    CODE: ClassVar[int] = 30
    kind: Literal["clock_jump"] = "clock_jump"
    seconds: Annotated[int, Field(ge=-10_000_000, le=10_000_000)] = 3600

    def off(self, time: int) -> int:
        """The same all the time."""
        return self.seconds


class ClockDrift(ClockFault):
    """The clock gains `ppm` millionths of the time since `start`, or loses them if negative."""

    CODE: ClassVar[int] = 13
    kind: Literal["clock_drift"] = "clock_drift"
    ppm: Annotated[float, Field(ge=-500_000, le=500_000)] = 10_000.0

    def off(self, time: int) -> int:
        """More and more."""
        return round((time - self.start) * self.ppm / 1e6)


class DayChange(ClockFault):
    """The date is wrong by `days`, the time of day is right."""

    CODE: ClassVar[int] = 30
    kind: Literal["day_change"] = "day_change"
    days: Annotated[int, Field(ge=-100, le=100)] = 1

    def off(self, time: int) -> int:
        """Whole days."""
        return self.days * DAY_SECONDS
