"""What every fault has, and how one that acts on the frames of a message does it."""

import random
from collections.abc import Mapping
from typing import Annotated, ClassVar, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, model_validator

from can_bus import codec
from can_bus.codec import MessageCodec
from can_bus.frame import Frame
from can_bus.lockstep import STEP_SECONDS

from .fields import Condition, ConditionText, MessageName, Time, condition

TARGETS = {"CGM": 1, "PUMP": 2, "CTRL": 3, "UI": 4, "PLANT": 5, "TESTER": 5}
"""Sender of the faulty frame -> FAULT_Inject.FaultTarget; 5 is the bus itself."""

COUNT_MOST = 8190
"""FAULT_Inject.FaultCount goes no higher."""


class Fault(BaseModel):
    """Something that happens on the wire or to a node from `start` until before `end`, or to the end of the run."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    CODE: ClassVar[int]  # FAULT_Inject.FaultKind

    kind: str
    start: Time = 0
    end: Time | None = None
    place: Annotated[int, Field(ge=0)] | None = None
    """In the list, as its random numbers see it; None: where it stands. A fork takes faults out and leaves the rest."""

    @model_validator(mode="after")
    def _interval(self) -> "Fault":
        if self.end is not None and self.end <= self.start:
            raise ValueError("end must be later than start")
        return self

    @property
    def code(self) -> int:
        """FAULT_Inject.FaultKind of what this one does."""
        return self.CODE

    def open(self, time: int) -> bool:
        """Whether the window is open at this simulated second."""
        return time >= self.start and (self.end is None or time < self.end)


def report(code: int, target: int, time: int, can_id: int = 0, count: int = 1) -> Frame:
    """FAULT_Inject: what was done, to whom, when."""
    inject = codec.message("FAULT_Inject")
    word = inject.pack(
        {
            "FaultTarget": target,
            "FaultKind": code,
            "FaultCanId": can_id,
            "FaultCount": min(count, COUNT_MOST),
            "FaultParam": time // STEP_SECONDS % 65536,
        }
    )
    return Frame(inject.can_id, codec.protect(inject, word, 0))


class Held(NamedTuple):
    """A frame that goes on later; the first of these to be true lets it go."""

    frame: Frame
    time: int | None = None  # with the first frame of the same direction at or after this simulated second
    frames: int | None = None  # behind so many more frames of the same direction
    behind: int | None = None  # behind the next frame with this id


class Memory:
    """What a fault carries from frame to frame."""

    def __init__(self, seed: str) -> None:
        self.random = random.Random(seed)
        self.matched = 0  # frames within the window for which the condition held
        self.acted = 0
        self.frames: list[Frame] = []  # what the fault keeps of the past


class FrameFault(Fault):
    """Acts on frames of one message: on all in its window, or on those that the other keys choose."""

    message: MessageName
    when: ConditionText | None = None
    """Only while this holds, by the frames before it: "CTRL_Status.CtrlState == Auto"."""

    nth: Annotated[int, Field(ge=1)] | None = None
    """Only the nth of them, counted from 1."""

    every: Annotated[int, Field(ge=1)] = 1
    """Only every nth of them."""

    probability: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Each of them with this probability."""

    seed: Annotated[int, Field(ge=0)] = 0
    """Of everything random; two faults of one file draw different numbers all the same."""

    count: Annotated[int, Field(ge=1)] | None = None
    """So many times at most."""

    @property
    def codec(self) -> MessageCodec:
        """Of the message."""
        return codec.message(self.message)

    @property
    def condition(self) -> Condition | None:
        """What `when` says."""
        return None if self.when is None else condition(self.when)

    def chosen(self, time: int, memory: Memory, newest: Mapping[str, Mapping[str, int]]) -> bool:
        """Whether the fault acts on the frame that passes at this simulated second; counts it."""
        if not self.open(time) or (self.count is not None and memory.acted >= self.count):
            return False
        if self.when is not None and not condition(self.when).holds(newest):
            return False
        memory.matched += 1
        if self.nth is not None and memory.matched != self.nth:
            return False
        if memory.matched % self.every:
            return False
        return self.probability >= 1.0 or memory.random.random() < self.probability

    def see(self, frame: Frame, memory: Memory) -> None:
        """A frame of the message as its sender sent it, within the window or not."""

    def act(self, frame: Frame, time: int, memory: Memory) -> list[Frame | Held] | None:
        """What goes on in place of the frame; None if there is nothing the fault could do to it."""
        raise NotImplementedError
