"""What faults of the pump and effects of the sensor have in common: how the bus tells of them."""

from typing import ClassVar

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

    def report(self, step: int) -> dict[str, int]:
        """Raw values of FAULT_Inject."""
        return {
            "FaultTarget": TARGETS[self.NODE],
            "FaultKind": self.CODE,
            "FaultCanId": codec.message(self.MESSAGE).can_id if self.MESSAGE else 0,
            "FaultCount": 1,
            "FaultParam": step % 65536,
        }
