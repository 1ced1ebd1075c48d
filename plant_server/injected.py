"""What faults of the pump and effects of the sensor have in common: how the bus tells of them."""

from typing import ClassVar

from pydantic import BaseModel, ConfigDict

from can_bus import codec
from can_bus.faults import TARGETS, report
from can_bus.frame import Frame
from can_bus.lockstep import STEP_SECONDS


class Injected(BaseModel):
    """Something that is done to the pump or the sensor on purpose."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    CODE: ClassVar[int]
    """FAULT_Inject.FaultKind."""

    NODE: ClassVar[str]
    MESSAGE: ClassVar[str | None] = None
    """Whom it is done to, and which frames show it if they are those of one message."""

    def report(self, step: int) -> Frame:
        """FAULT_Inject of this sampling instant."""
        can_id = codec.message(self.MESSAGE).can_id if self.MESSAGE else 0
        return report(self.CODE, TARGETS[self.NODE], step * STEP_SECONDS, can_id)
