"""Faults of the frames of one message: lost, late, doubled, damaged, forged."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field, model_validator

from can_bus import codec
from can_bus.frame import CAN_EFF_FLAG, CAN_RTR_FLAG, MAX_DATA, Frame
from can_bus.lockstep import STEP_SECONDS, STEPS_PER_DAY

from .base import FrameFault, Held, Memory
from .fields import MessageName, known_signal, raw, raw_steps, repaired, with_raw

FRAME_MS = 0.25
"""Simulated time a frame takes on the wire, as in a recording."""

Value = float | str


def _not_the_turn(message: str) -> None:
    if message in ("SYNC_Step", "SYNC_Done"):
        raise ValueError(f"{message} passes the turn on: held back, it would stop the run; drop it to see that")


class Drop(FrameFault):
    """The frame is lost."""

    CODE: ClassVar[int] = 1
    kind: Literal["drop"] = "drop"

    def act(self, frame: Frame, time: int, memory: Memory) -> list[Frame | Held]:
        """Lose it."""
        return []


class Delay(FrameFault):
    """The frame comes `steps` sampling instants later, ahead of what is sent then; or `ms` later.

    A step is a turn of the lockstep, so milliseconds can only move a frame behind those that follow at once (a frame
    takes 0.25 ms), at most behind the one that passes the turn on: then it counts for the next turn.
    """

    CODE: ClassVar[int] = 2
    kind: Literal["delay"] = "delay"
    steps: Annotated[int, Field(ge=1, le=STEPS_PER_DAY)] | None = None
    ms: Annotated[float, Field(gt=0, le=1000)] | None = None

    @model_validator(mode="after")
    def _one_of_them(self) -> "Delay":
        if (self.steps is None) == (self.ms is None):
            raise ValueError("give either steps or ms")
        _not_the_turn(self.message)
        return self

    def act(self, frame: Frame, time: int, memory: Memory) -> list[Frame | Held]:
        """Hold it."""
        if self.steps is not None:
            return [Held(frame, time=(time // STEP_SECONDS + self.steps) * STEP_SECONDS)]
        assert self.ms is not None
        barrier = codec.message("SYNC_Done" if self.codec.sender == "CTRL" else "SYNC_Step").can_id
        return [Held(frame, frames=max(round(self.ms / FRAME_MS), 1), behind=barrier)]


class Duplicate(FrameFault):
    """The frame comes again, `times` more."""

    CODE: ClassVar[int] = 3
    kind: Literal["duplicate"] = "duplicate"
    times: Annotated[int, Field(ge=1, le=100)] = 1

    def act(self, frame: Frame, time: int, memory: Memory) -> list[Frame | Held]:
        """Repeat it."""
        return [frame] * (1 + self.times)


class Reorder(FrameFault):
    """The frame comes behind the next one of its message: two samples in the wrong order."""

    CODE: ClassVar[int] = 6
    kind: Literal["reorder"] = "reorder"
    every: Annotated[int, Field(ge=2)] = 2

    @model_validator(mode="after")
    def _passes_no_turn(self) -> "Reorder":
        _not_the_turn(self.message)
        return self

    def act(self, frame: Frame, time: int, memory: Memory) -> list[Frame | Held]:
        """Let the next one overtake."""
        return [Held(frame, behind=frame.can_id)]


class Replay(FrameFault):
    """In place of the frame comes the one sent `back` frames of this message before it, byte by byte."""

    CODE: ClassVar[int] = 7
    kind: Literal["replay"] = "replay"
    back: Annotated[int, Field(ge=1, le=1000)] = 3

    def see(self, frame: Frame, memory: Memory) -> None:
        """Keep as many as may be asked for."""
        memory.frames.append(frame)
        del memory.frames[: -self.back - 1]

    def act(self, frame: Frame, time: int, memory: Memory) -> list[Frame | Held] | None:
        """Send the old one."""
        return [memory.frames[0]] if len(memory.frames) > self.back else None


class FlipBits(FrameFault):
    """Bits of the payload are turned over: those of `bits` (0 is the lowest of byte 0), or `random` ones.

    `repair_crc` makes CHECKSUM fit again, as after damage in the sender's memory.
    """

    CODE: ClassVar[int] = 4
    kind: Literal["flip_bits"] = "flip_bits"
    bits: tuple[Annotated[int, Field(ge=0, le=63)], ...] = ()
    random: Annotated[int, Field(ge=1, le=64)] | None = None
    repair_crc: bool = False

    @model_validator(mode="after")
    def _one_of_them(self) -> "FlipBits":
        size = 8 * self.codec.length
        if bool(self.bits) == (self.random is not None):
            raise ValueError("give either bits or random")
        if max(self.bits, default=0) >= size or (self.random or 0) > size:
            raise ValueError(f"{self.message} has {size} bits")
        return self

    @property
    def code(self) -> int:
        """FaultKind: CorruptRaw or CorruptFixCrc."""
        return 5 if self.repair_crc else 4

    def act(self, frame: Frame, time: int, memory: Memory) -> list[Frame | Held]:
        """Damage it."""
        size = 8 * len(frame.data)
        bits = self.bits if self.random is None else memory.random.sample(range(size), min(self.random, size))
        word = int.from_bytes(frame.data, "little")
        for bit in bits:
            word ^= 1 << bit if bit < size else 0
        data = word.to_bytes(len(frame.data), "little")
        if self.repair_crc and len(data) == self.codec.length:
            data = repaired(self.codec, data)
        return [Frame(frame.can_id, data)]


class SetValue(FrameFault):
    """A signal has another value: `value`, a number or the name of a code, or its own plus `add`.

    `repair_crc` is on: the frame is as good as a true one, and only plausibility can tell.
    """

    CODE: ClassVar[int] = 5
    kind: Literal["set_value"] = "set_value"
    signal: str
    value: Value | None = None
    add: float | None = None
    repair_crc: bool = True

    @model_validator(mode="after")
    def _fits(self) -> "SetValue":
        known_signal(self.message, self.signal)
        if (self.value is None) == (self.add is None):
            raise ValueError("give either value or add")
        if self.value is not None:
            raw(self.message, self.signal, self.value)
        return self

    @property
    def code(self) -> int:
        """FaultKind: CorruptRaw or CorruptFixCrc."""
        return 5 if self.repair_crc else 4

    def act(self, frame: Frame, time: int, memory: Memory) -> list[Frame | Held] | None:
        """Change it, within the signal's range."""
        if len(frame.data) != self.codec.length:
            return None
        now = self.codec.unpack(frame.data).get(self.signal)
        if now is None:
            return None  # not on this page of a multiplexed message
        if self.value is not None:
            number = raw(self.message, self.signal, self.value)
        else:
            assert self.add is not None
            field = self.codec.fields[self.signal]
            number = now + raw_steps(self.message, self.signal, self.add)
            number = min(max(number, field.low), field.high)
        data = with_raw(self.codec, frame.data, {self.signal: number})
        return [Frame(frame.can_id, repaired(self.codec, data) if self.repair_crc else data)]


class StuckFrame(FrameFault):
    """The first frame in the window comes again and again in place of all that follow it."""

    CODE: ClassVar[int] = 8
    kind: Literal["stuck_frame"] = "stuck_frame"

    def act(self, frame: Frame, time: int, memory: Memory) -> list[Frame | Held]:
        """Send the first."""
        if not memory.frames:
            memory.frames.append(frame)
        return [memory.frames[0]]


class StuckValue(FrameFault):
    """A signal keeps the value it has in the first frame of the window; counters and checksums go on."""

    CODE: ClassVar[int] = 28
    kind: Literal["stuck_value"] = "stuck_value"
    signal: str

    @model_validator(mode="after")
    def _fits(self) -> "StuckValue":
        known_signal(self.message, self.signal)
        return self

    def act(self, frame: Frame, time: int, memory: Memory) -> list[Frame | Held] | None:
        """Hold the value."""
        if len(frame.data) != self.codec.length or self.signal not in self.codec.unpack(frame.data):
            return None
        if not memory.frames:
            memory.frames.append(frame)
        held = self.codec.unpack(memory.frames[0].data)[self.signal]
        return [Frame(frame.can_id, repaired(self.codec, with_raw(self.codec, frame.data, {self.signal: held})))]


class FrozenCounter(FrameFault):
    """The sender's COUNTER stands still, the rest is right."""

    CODE: ClassVar[int] = 17
    kind: Literal["frozen_counter"] = "frozen_counter"

    @model_validator(mode="after")
    def _protected(self) -> "FrozenCounter":
        if self.codec.data_ids is None:
            raise ValueError(f"{self.message} has no COUNTER")
        return self

    def act(self, frame: Frame, time: int, memory: Memory) -> list[Frame | Held] | None:
        """Hold the counter."""
        if len(frame.data) != self.codec.length:
            return None
        if not memory.frames:
            memory.frames.append(frame)
        return [Frame(frame.can_id, repaired(self.codec, frame.data, memory.frames[0].data[1] & 0xF))]


class WrongLength(FrameFault):
    """The frame has `length` data bytes: cut off, or filled with zeros."""

    CODE: ClassVar[int] = 11
    kind: Literal["wrong_length"] = "wrong_length"
    length: Annotated[int, Field(ge=0, le=MAX_DATA)]

    @model_validator(mode="after")
    def _wrong(self) -> "WrongLength":
        if self.length == self.codec.length:
            raise ValueError(f"{self.length} bytes is what {self.message} has")
        return self

    def act(self, frame: Frame, time: int, memory: Memory) -> list[Frame | Held]:
        """Cut or fill."""
        return [Frame(frame.can_id, frame.data[: self.length].ljust(self.length, b"\0"))]


class RemoteFrame(FrameFault):
    """A remote transmission request with the frame's id and length comes in its place."""

    CODE: ClassVar[int] = 25
    kind: Literal["remote_frame"] = "remote_frame"

    def act(self, frame: Frame, time: int, memory: Memory) -> list[Frame | Held]:
        """Ask instead of tell."""
        return [Frame(frame.can_id | CAN_RTR_FLAG, bytes(len(frame.data)))]


class ExtendedId(FrameFault):
    """The frame comes with the same number as a 29-bit identifier."""

    CODE: ClassVar[int] = 27
    kind: Literal["extended_id"] = "extended_id"

    def act(self, frame: Frame, time: int, memory: Memory) -> list[Frame | Held]:
        """Widen the id."""
        return [Frame(frame.can_id | CAN_EFF_FLAG, frame.data)]


class Misroute(FrameFault):
    """The payload comes under the id of another message, `onto`, as well as under its own: a gateway's wrong table."""

    CODE: ClassVar[int] = 29
    kind: Literal["misroute"] = "misroute"
    onto: MessageName

    @model_validator(mode="after")
    def _another(self) -> "Misroute":
        if self.onto == self.message:
            raise ValueError(f"onto must be another message than {self.message}")
        return self

    def act(self, frame: Frame, time: int, memory: Memory) -> list[Frame | Held]:
        """Send it twice."""
        return [frame, Frame(codec.message(self.onto).can_id, frame.data)]


class Masquerade(FrameFault):
    """Behind the frame comes a forged one: the next COUNTER, a CHECKSUM that fits, and other `values`.

    The true frame that follows then has a COUNTER that was used already.
    """

    CODE: ClassVar[int] = 16
    kind: Literal["masquerade"] = "masquerade"
    values: dict[str, Value] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _fits(self) -> "Masquerade":
        for name, value in self.values.items():
            raw(self.message, known_signal(self.message, name), value)
        return self

    def act(self, frame: Frame, time: int, memory: Memory) -> list[Frame | Held] | None:
        """Forge."""
        if len(frame.data) != self.codec.length:
            return None
        data = with_raw(
            self.codec, frame.data, {name: raw(self.message, name, value) for name, value in self.values.items()}
        )
        counter = ((data[1] & 0xF) + 1) % codec.COUNTER_MODULUS if self.codec.data_ids else None
        return [frame, Frame(frame.can_id, repaired(self.codec, data, counter))]
