"""Faults of the pump as values: what happens to it and when, in simulated time.

They act inside the plant, where a real pump would have them; faults of frames act between two buses (`can_bus.faults`),
those of the sensor are its effects (`plant_server.sensors.effects`). While a fault lasts, the plant says so with
FAULT_Inject in every step, so that a log explains itself. Of two faults of one motor and kind at the same time the
worse one acts.
"""

from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from can_bus.faults import Time
from can_bus.lockstep import STEP_SECONDS

from .chamber import Chamber
from .injected import Injected
from .mechanism import DOUBLE_EVERY, DOUBLE_SINCE, FLUID, MISS_EVERY, MISS_SINCE, SLOWED, STROKES_PER_SUBSTEP
from .pump import Pump

Drug = Literal["insulin", "pramlintide"]

Every = Annotated[int, Field(ge=1, le=1000)]
"""1: every stroke, 2: every second one."""


class PumpFault(Injected):
    """Something that begins at an instant of simulated time; instants between two steps count for the next one."""

    NODE: ClassVar[str] = "PUMP"

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


def _chamber(pump: Pump, drug: Drug) -> Chamber:
    mixed = pump.settings.coformulation_ug_per_u is not None
    return pump.insulin if drug == "insulin" or mixed else pump.pramlintide


class LastingPumpFault(PumpFault):
    """Something that lasts until before `end`, or to the end of the run."""

    end: Time | None = None

    @model_validator(mode="after")
    def _interval(self) -> Self:
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


class Occlusion(LastingPumpFault):
    """The line is blocked: strokes are held back, at 3 U (or 30 ug) the pump notices and stops that motor.

    At `end` what was held back comes out at once, or is lost with the infusion set if `lost`.
    """

    CODE: ClassVar[int] = 18

    kind: Literal["occlusion"] = "occlusion"
    drug: Drug = "insulin"
    lost: bool = False

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


class MissedStrokes(LastingPumpFault):
    """Every nth stroke (`every`) that the motor makes moves nothing, as with a slipping gear: it is made and lost.

    Nothing is missing in the reservoir, and no alarm of the pump is about it.
    """

    CODE: ClassVar[int] = 22

    kind: Literal["missed_strokes"] = "missed_strokes"
    drug: Drug = "insulin"
    every: Every = 2

    def act(self, pump: Pump, step: int) -> None:
        """Slip, counting from the beginning."""
        words = _chamber(pump, self.drug).words
        if step == self.first_step:
            words[MISS_SINCE] = 0
        if self.active(step):
            words[MISS_EVERY] = min(words[MISS_EVERY] or self.every, self.every)


class DoubleStrokes(LastingPumpFault):
    """Every nth stroke (`every`) that the motor makes moves twice the fluid: more is given than anybody asked for.

    The ledger books the extra stroke as commanded, by the motor itself, so that it closes (H6) without a debt that
    every reader of it would have to know of. What gives the fault away is the sum: PUMP_Delivered grows by more than
    rates and boluses asked for. A bolus is still told as what was asked for (PUMP_BolusState): the motor has made its
    strokes, and none of them twice.
    """

    CODE: ClassVar[int] = 23

    kind: Literal["double_strokes"] = "double_strokes"
    drug: Drug = "insulin"
    every: Every = 2

    def act(self, pump: Pump, step: int) -> None:
        """Give too much, counting from the beginning."""
        words = _chamber(pump, self.drug).words
        if step == self.first_step:
            words[DOUBLE_SINCE] = 0
        if self.active(step):
            words[DOUBLE_EVERY] = min(words[DOUBLE_EVERY] or self.every, self.every)


class SlowMotor(LastingPumpFault):
    """The motor makes at most so many strokes per 30 s (a sound one 15); the others are pending and made later."""

    CODE: ClassVar[int] = 24

    kind: Literal["slow_motor"] = "slow_motor"
    drug: Drug = "insulin"
    strokes_per_30s: Annotated[int, Field(ge=1, le=STROKES_PER_SUBSTEP)] = 1

    def act(self, pump: Pump, step: int) -> None:
        """Brake."""
        words = _chamber(pump, self.drug).words
        if self.active(step):
            words[SLOWED] = max(words[SLOWED], STROKES_PER_SUBSTEP - self.strokes_per_30s)


AnyPumpFault = Occlusion | AirBubble | EmptyReservoir | LowBattery | MissedStrokes | DoubleStrokes | SlowMotor
"""The pump's part of the catalogue."""
