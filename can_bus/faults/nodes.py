"""Faults of the device as a node: it loses power, hangs, dies. Whoever runs the device does it (`NodeControl`)."""

from typing import Annotated, ClassVar, Literal, Protocol

from pydantic import Field, model_validator

from .base import Fault

MemoryState = Literal["kept", "torn", "lost"]
"""What becomes of the non-volatile memory: nothing; the record being written is half written; it is blank."""


class NodeControl(Protocol):
    """Whoever runs the device: the rig, or a user's command beside a power supply."""

    def cut(self) -> None:
        """Take the power away, at once (SIGKILL)."""

    def start(self, memory: MemoryState) -> None:
        """Give it power again; it says HB_CTRL BootUp when it is there."""

    def freeze(self) -> None:
        """It does nothing from now on (SIGSTOP)."""

    def thaw(self) -> None:
        """It goes on where it was (SIGCONT)."""


class Restart(Fault):
    """The device loses power at the first token at or after `start`, and has it again at once, or at `end`.

    With `after_frames` it answers that token, and so many frames of its answer get out. While it is off, the bench
    takes the turn in its place.
    """

    CODE: ClassVar[int] = 14
    kind: Literal["restart"] = "restart"
    memory: MemoryState = "kept"
    after_frames: Annotated[int, Field(ge=0, le=64)] | None = None

    @property
    def code(self) -> int:
        """FaultKind: NodeReset, BrownOut with a torn memory, NodeMemoryLost."""
        return {"kept": 14, "torn": 15, "lost": 34}[self.memory]

    @model_validator(mode="after")
    def _one_of_them(self) -> "Restart":
        if self.after_frames is not None and self.end is not None:
            raise ValueError("give either after_frames or end")
        return self


class Kill(Fault):
    """The device dies for good: the bench takes its turn to the end of the run."""

    CODE: ClassVar[int] = 32
    kind: Literal["kill"] = "kill"
    end: None = None


class Hang(Fault):
    """The device hangs: what is sent to it is lost, and the bench takes its turn until it goes on, if ever."""

    CODE: ClassVar[int] = 31
    kind: Literal["hang"] = "hang"
