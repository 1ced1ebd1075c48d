"""Faults of the pump as values: what happens to it and when, in simulated time.

They act inside the plant, where a real pump would have them; faults of frames act between two buses (`can_bus.faults`),
those of the sensor are its effects (`plant_server.sensors.effects`). While a fault lasts, the plant says so with
FAULT_Inject in every step, so that a log explains itself.
"""

from typing import Annotated, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from can_bus.faults import TARGETS, Time
from can_bus.lockstep import STEP_SECONDS

from .chamber import Chamber
from .mechanism import FLUID
from .pump import Pump

Drug = Literal["insulin", "pramlintide"]


class PumpFault(BaseModel):
    """Something that begins at an instant of simulated time; instants between two steps count for the next one."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    CODE: ClassVar[int]  # FAULT_Inject.FaultKind
    start: Time

    @property
    def first_step(self) -> int:
        """The sampling instant it begins at."""
        return -(-self.start // STEP_SECONDS)

    def active(self, step: int) -> bool:
        """Whether it acts from this sampling instant to the next one."""
        return step == self.first_step

    def act(self, pump: Pump, step: int) -> None:
        """Do to the pump what is due at this sampling instant."""
        raise NotImplementedError

    def report(self, step: int) -> dict[str, int]:
        """Raw values of FAULT_Inject."""
        return {
            "FaultTarget": TARGETS["PUMP"],
            "FaultKind": self.CODE,
            "FaultCanId": 0,
            "FaultCount": 1,
            "FaultParam": step % 65536,
        }


def _chamber(pump: Pump, drug: Drug) -> Chamber:
    mixed = pump.settings.coformulation_ug_per_u is not None
    return pump.insulin if drug == "insulin" or mixed else pump.pramlintide


class Occlusion(PumpFault):
    """The line is blocked: strokes are held back, at 3 U (or 30 ug) the pump notices and stops that motor.

    At `end` what was held back comes out at once, or is lost with the infusion set if `lost`.
    """

    CODE: ClassVar[int] = 18
    kind: Literal["occlusion"] = "occlusion"
    drug: Drug = "insulin"
    end: Time | None = None
    lost: bool = False

    @model_validator(mode="after")
    def _interval(self) -> "Occlusion":
        if self.end is not None and self.end <= self.start:
            raise ValueError("end must be later than start")
        return self

    @property
    def last_step(self) -> int | None:
        """The sampling instant it ends at, None if it stays."""
        return None if self.end is None else max(-(-self.end // STEP_SECONDS), self.first_step + 1)

    def active(self, step: int) -> bool:
        """From the first to before the last step."""
        return self.first_step <= step and (self.last_step is None or step < self.last_step)

    def act(self, pump: Pump, step: int) -> None:
        """Block the line, or open it."""
        if step == self.first_step:
            _chamber(pump, self.drug).occlude()
        elif step == self.last_step:
            _chamber(pump, self.drug).release(lost=self.lost)


class AirBubble(PumpFault):
    """The next strokes move air: they are made and lost."""

    CODE: ClassVar[int] = 19
    kind: Literal["air_bubble"] = "air_bubble"
    drug: Drug = "insulin"
    strokes: Annotated[int, Field(ge=1, le=1000)] = 20  # 1 U or 10 ug

    def act(self, pump: Pump, step: int) -> None:
        """Let the air in."""
        if step == self.first_step:
            _chamber(pump, self.drug).insert_air(self.strokes)


class EmptyReservoir(PumpFault):
    """The reservoir is empty until the user changes it."""

    CODE: ClassVar[int] = 20
    kind: Literal["empty_reservoir"] = "empty_reservoir"
    drug: Drug = "insulin"

    def act(self, pump: Pump, step: int) -> None:
        """Take what is left."""
        if step == self.first_step:
            _chamber(pump, self.drug).words[FLUID] = 0


class LowBattery(PumpFault):
    """The battery falls to `percent`; at 0 the pump stops."""

    CODE: ClassVar[int] = 21
    kind: Literal["low_battery"] = "low_battery"
    percent: Annotated[float, Field(ge=0, le=100)] = 15.0

    def act(self, pump: Pump, step: int) -> None:
        """Drain it."""
        if step == self.first_step:
            pump.battery = min(pump.battery, self.percent)


AnyPumpFault = Occlusion | AirBubble | EmptyReservoir | LowBattery
"""The pump's part of the catalogue."""
