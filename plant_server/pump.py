"""The pump's electronics: commands in, acknowledgements, status and totals out; its limits are its own.

It trusts no controller: every set-point (`set_point`) and every bolus (`bolus`) is answered, and refused as a whole for
a drug when it is above the pump's limit.
"""

import enum
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from can_bus.batch import Layout
from can_bus.codec import Transmitter
from can_bus.frame import Frame
from can_bus.lockstep import STEPS_PER_DAY

from .bolus import AckResult, DrugBolus
from .bolus import Op as BolusOp
from .chamber import INSULIN, PRAMLINTIDE, Chamber, ChamberSettings, Occlusion
from .mechanism import SUBSTEPS
from .pump_alarms import AUX_INSULIN, AUX_PRAMLINTIDE, AUX_PUMP, Alarm, Alarms, Cause
from .set_point import SEQUENCES, SetPoint

BOOT_COUNTS = 15
"""PumpBootCount runs from 0 to 14; 15 is SNA."""

HEARTBEAT_BOOTS = 32
"""HB_PUMP.BootPump runs from 0 to 31."""

NMT_BOOT_UP, NMT_OPERATIONAL = 0, 5
"""HB_PUMP.NmtPump and HB_CGM.NmtCgm, as CANopen numbers them."""


class AckFor(enum.IntEnum):
    """PUMP_Ack.AckFor."""

    NONE = 0
    INSULIN_RATE = 1
    INSULIN_BOLUS_PROGRAM = 2
    INSULIN_BOLUS_COMMIT = 3
    PRAM_BOLUS_PROGRAM = 4
    PRAM_BOLUS_COMMIT = 5
    CANCEL = 6
    PRAM_RATE = 8


BATTERY_LOW_PERCENT = 20

HORMONE_INSULIN, HORMONE_PRAMLINTIDE = 1, 2
"""PUMP_BolusCmd.BolusHormone."""

BOLUS_DOSE = {HORMONE_INSULIN: "InsulinBolus", HORMONE_PRAMLINTIDE: "PramlintideBolus"}

BOLUS_ACKS: dict[tuple[int, int], AckFor] = {
    (HORMONE_INSULIN, BolusOp.PROGRAM): AckFor.INSULIN_BOLUS_PROGRAM,
    (HORMONE_INSULIN, BolusOp.COMMIT): AckFor.INSULIN_BOLUS_COMMIT,
    (HORMONE_PRAMLINTIDE, BolusOp.PROGRAM): AckFor.PRAM_BOLUS_PROGRAM,
    (HORMONE_PRAMLINTIDE, BolusOp.COMMIT): AckFor.PRAM_BOLUS_COMMIT,
    (HORMONE_INSULIN, BolusOp.CANCEL): AckFor.CANCEL,
    (HORMONE_PRAMLINTIDE, BolusOp.CANCEL): AckFor.CANCEL,
}

BOLUS_STATE = ("BolusPhase", "BolusStateId", "BolusDeliveredRaw", "BolusProgrammedRaw")

REPORT: Layout = (
    (
        "PUMP_Status",
        (
            "PumpState", "PumpLastBasalSeq", "InsulinReservoir", "PramReservoir", "PumpBattery", "InsulinOcclusion",
            "PramOcclusion", "TbrActive",
        ),
        {},
    ),
    ("PUMP_Delivered", ("PumpBootCount", "InsulinTotal", "PramTotal"), {}),
    ("PUMP_BolusState", BOLUS_STATE, {"BolusStateHormone": 1}),
    ("PUMP_BolusState", BOLUS_STATE, {"BolusStateHormone": 2}),
)  # fmt: skip
"""What the pump says in every step; `Pump.values` are the raw values."""


class PumpState(enum.IntEnum):
    """PUMP_Status.PumpState."""

    PRIMING = 1
    RUNNING = 3
    SUSPENDED = 4
    STOPPED = 5


@dataclass(frozen=True)
class PumpSettings:
    """What the pump was set up with, independent of the controller."""

    basal_milliunits_per_h: int  # stored schedule, 0.001 U/h
    max_rate_raw: int = 6000  # 30 U/h, the largest rate of commercial pumps
    max_pramlintide_rate_raw: int = 3000  # 300 ug/h: 10 ug/U at the largest insulin rate
    max_bolus_raw: int = 3000  # 30 U, the largest bolus of commercial pumps
    max_pramlintide_bolus_raw: int = 3000  # 300 ug, the largest dose the paper tunes with; labelled are 120
    insulin: ChamberSettings = INSULIN
    pramlintide: ChamberSettings = PRAMLINTIDE
    coformulation_ug_per_u: float | None = None  # one chamber with both drugs in it; None: two chambers
    change_every_steps: int = 3 * STEPS_PER_DAY  # reservoirs and battery are changed every three days; 0 = never
    battery_percent_per_day: float = 8.0


class Pump:
    """A pump with two chambers, or with one that holds both drugs."""

    def __init__(self, settings: PumpSettings) -> None:
        self.settings = settings
        self.insulin = Chamber(settings.insulin)
        self.pramlintide = Chamber(settings.pramlintide)
        self.set_point = SetPoint(
            settings.basal_milliunits_per_h,
            settings.max_rate_raw,
            settings.max_pramlintide_rate_raw,
            settings.coformulation_ug_per_u,
        )
        self.alarms = Alarms()
        self.battery = 100.0
        self._priming = False
        self._mixed = np.zeros(SUBSTEPS)
        self.boots = 0
        self._booted = False  # the next heartbeat is the first one after a reset
        self._base = (0, 0)  # strokes delivered before the last reset of the electronics
        self.boluses = {
            HORMONE_INSULIN: DrugBolus(self.insulin, settings.max_bolus_raw),
            HORMONE_PRAMLINTIDE: DrugBolus(self.pramlintide, settings.max_pramlintide_bolus_raw),
        }

    # ---- commands

    def command(self, values: dict[str, int], step: int, transmitter: Transmitter) -> list[Frame]:
        """Take a decoded PUMP_BasalCmd in instant `step`; return its two acknowledgements."""
        results, echoes = self.set_point.take(values, step)
        if self.set_point.suspended:
            self._abort_boluses()
        number = values["BasalCmdSeq"]
        limits = self.settings.max_rate_raw, self.settings.max_pramlintide_rate_raw
        return [
            transmitter.frame(
                "PUMP_Ack", AckFor=what, AckResult=result, AckId=number, AckEchoRaw=echo, AckLimitRaw=limit
            )
            for what, result, echo, limit in (
                (AckFor.INSULIN_RATE, results[0], echoes[0], limits[0]),
                (AckFor.PRAM_RATE, results[1], echoes[1], limits[1]),
            )
        ]

    def bolus(self, values: dict[str, int], step: int, transmitter: Transmitter) -> list[Frame]:
        """Take a decoded PUMP_BolusCmd in instant `step`; return its acknowledgement."""
        self.set_point.expire(step)
        hormone, operation, number = values["BolusHormone"], values["BolusOp"], values["BolusId"]
        purpose = BOLUS_ACKS.get((hormone, operation), AckFor.NONE)
        result, echo, limit = AckResult.MALFORMED, 0, 0
        if hormone in BOLUS_DOSE:
            bolus, dose = self.boluses[hormone], values[BOLUS_DOSE[hormone]]
            result, echo = bolus.judge(
                operation, number, dose, values["BolusUntilStep"], step, ready=self._gives_bolus(hormone)
            )
            limit = bolus.limit_raw
        return [
            transmitter.frame(
                "PUMP_Ack", AckFor=purpose, AckResult=result, AckId=number, AckEchoRaw=echo, AckLimitRaw=limit
            )
        ]

    def _gives_bolus(self, hormone: int) -> bool:
        """Whether a bolus of this drug can be given as things stand."""
        mixed = self.settings.coformulation_ug_per_u is not None
        if mixed and hormone == HORMONE_PRAMLINTIDE:
            return False
        return self.powered and not self.set_point.suspended and not self.boluses[hormone].chamber.stopped

    def reset(self) -> None:
        """The electronics start anew: totals from zero, boluses ended, the schedule.

        The numbers of the last set-point and the newest boluses are kept, so that nothing can be given once more.
        """
        self.boots += 1
        self._booted = True
        self._base = self.insulin.delivered, self.pramlintide.delivered
        self._abort_boluses()
        self.set_point.fall_back()

    def _abort_boluses(self) -> None:
        for bolus in self.boluses.values():
            bolus.abort()

    # ---- delivery

    @property
    def powered(self) -> bool:
        """Whether the battery still drives the motors."""
        return self.battery > 0

    def deliver(self, step: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Run both motors from instant `step` to the next one.

        Returns:
            Insulin (U) and pramlintide (ug) that reach the patient within each of the ten 30-s steps; the arrays are
            used again.
        """
        self.set_point.expire(step)
        now = self.set_point
        rate, pramlintide_rate = (now.rate, now.pramlintide_rate) if self.powered else (0, 0)
        halted = now.suspended or not self.powered
        if halted:
            self._abort_boluses()
        insulin = self.insulin.run(rate, halted=halted)
        ratio = self.settings.coformulation_ug_per_u
        if ratio is None:
            pramlintide = self.pramlintide.run(pramlintide_rate, halted=halted)
        else:
            pramlintide = np.multiply(insulin, ratio, out=self._mixed)
        for bolus in self.boluses.values():
            bolus.follow()
        self._age(step + 1)
        return insulin, pramlintide

    def _age(self, step: int) -> None:
        """The battery runs down; the user changes it and the reservoirs in time."""
        settings = self.settings
        self.battery = max(self.battery - settings.battery_percent_per_day / STEPS_PER_DAY, 0.0)
        self._priming = settings.change_every_steps > 0 and step % settings.change_every_steps == 0
        if self._priming:
            self.battery = 100.0
            self.insulin.change()
            self.pramlintide.change()

    # ---- reports

    def values(self) -> tuple[int, ...]:
        """The raw values of `REPORT` as they stand."""
        insulin, pramlintide = self.insulin, self.pramlintide
        ratio = self.settings.coformulation_ug_per_u
        insulin_total = (insulin.delivered - self._base[0]) * insulin.settings.stroke_volume
        if ratio is None:
            pram_left = pramlintide.remaining
            pram_total = (pramlintide.delivered - self._base[1]) * pramlintide.settings.stroke_volume
            pram_occlusion = pramlintide.occlusion
        else:
            pram_left = insulin.remaining * ratio
            pram_total = insulin_total * ratio
            pram_occlusion = insulin.occlusion
        return (
            self._state(),
            SEQUENCES if self.set_point.sequence is None else self.set_point.sequence,
            min(round(insulin.remaining * 10), 4000),
            min(round(pram_left), 4093),
            round(self.battery),
            insulin.occlusion,
            pram_occlusion,
            int(self.set_point.commanded),
            self.boots % BOOT_COUNTS,
            round(insulin_total * 1000),
            round(pram_total * 100),
            *self.boluses[HORMONE_INSULIN].state(),
            *self.boluses[HORMONE_PRAMLINTIDE].state(),
        )

    def heartbeat(self) -> tuple[int, int]:
        """NmtPump and BootPump of the next HB_PUMP."""
        state = NMT_BOOT_UP if self._booted else NMT_OPERATIONAL
        self._booted = False
        return state, self.boots % HEARTBEAT_BOOTS

    def _state(self) -> PumpState:
        if not self.powered or self.insulin.stopped:
            return PumpState.STOPPED
        if self._priming:
            return PumpState.PRIMING
        return PumpState.SUSPENDED if self.set_point.suspended else PumpState.RUNNING

    # ---- alarms

    def _causes(self) -> set[Cause]:
        causes: set[Cause] = set()
        chambers = [(self.insulin, AUX_INSULIN)]
        if self.settings.coformulation_ug_per_u is None:
            chambers.append((self.pramlintide, AUX_PRAMLINTIDE))
        for chamber, drug in chambers:
            if chamber.occlusion == Occlusion.OCCLUDED:
                causes.add((Alarm.OCCLUSION, drug))
            if chamber.empty:
                causes.add((Alarm.RESERVOIR_EMPTY, drug))
            elif chamber.low:
                causes.add((Alarm.RESERVOIR_LOW, drug))
        if self.set_point.deserted:
            causes.add((Alarm.CTRL_LOST, AUX_PUMP))
        if not self.powered:
            causes.add((Alarm.BATTERY_EMPTY, AUX_PUMP))
        elif self.battery <= BATTERY_LOW_PERCENT:
            causes.add((Alarm.BATTERY_LOW, AUX_PUMP))
        return causes

    def report_alarms(self, transmitter: Transmitter) -> list[Frame]:
        """PUMP_Alarm of a step, as things stand."""
        return self.alarms.report(self._causes(), transmitter)
