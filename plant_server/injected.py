"""What faults of the pump and effects of the sensor have in common: how the bus and a catalogue tell of them."""

from typing import Any, ClassVar, Self

from pydantic import BaseModel, ConfigDict

from can_bus import codec
from can_bus.faults import TARGETS


class Injected(BaseModel):
    """Something that is done to the pump or the sensor on purpose."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    CODE: ClassVar[int]
    """FAULT_Inject.FaultKind."""

    NODE: ClassVar[str]
    MESSAGE: ClassVar[str | None] = None
    """Whom it is done to, and which frames show it if they are those of one message."""

    HAZARDS: ClassVar[tuple[str, ...]]
    """What it puts to the test, of H1 to H8 in docs/design.md."""

    SEEN_BY: ClassVar[tuple[str, ...]] = ()
    """Alarms of the reference firmware or the pump, and counters of CTRL_Diag, that the examples raise in every run."""

    UNSEEN: ClassVar[str] = ""
    """Why there are none."""

    EXAMPLES: ClassVar[tuple[dict[str, Any], ...]]

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """Typical ones, between 01:00 and 04:00 of a run."""
        return tuple(cls.model_validate(keys) for keys in cls.EXAMPLES)

    def report(self, step: int) -> dict[str, int]:
        """Raw values of FAULT_Inject."""
        return {
            "FaultTarget": TARGETS[self.NODE],
            "FaultKind": self.CODE,
            "FaultCanId": codec.message(self.MESSAGE).can_id if self.MESSAGE else 0,
            "FaultCount": 1,
            "FaultParam": step % 65536,
        }
