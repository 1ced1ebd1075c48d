"""The pump's electronics: commands in, acknowledgements, status and totals out; its limits are its own.

It trusts no controller: every set-point has a number and an absolute expiry, is answered, and is refused as a whole for
a drug when it is above the pump's limit. Without a valid set-point the pump runs its stored schedule of insulin and no
pramlintide.
"""

import enum
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from can_bus.batch import Layout
from can_bus.codec import Transmitter
from can_bus.frame import Frame

from .bolus import AckResult, DrugBolus
from .bolus import Op as BolusOp
from .chamber import INSULIN, PRAMLINTIDE, Chamber, ChamberSettings, Occlusion
from .mechanism import SUBSTEPS

SEQUENCES = 1023
EXPIRY_AHEAD_MAX = 24
"""Steps: a set-point that claims to hold longer is malformed (DBC, BasalUntilStep)."""

RATE_RESERVED = 8000
"""Raw rates above this are reserved codes."""

BOOT_COUNTS = 15
"""PumpBootCount runs from 0 to 14; 15 is SNA."""

HEARTBEAT_BOOTS = 32
"""HB_PUMP.BootPump runs from 0 to 31."""

NMT_BOOT_UP, NMT_OPERATIONAL = 0, 5
"""HB_PUMP.NmtPump and HB_CGM.NmtCgm, as CANopen numbers them."""

MILLIUNITS_PER_LSB = 5
"""InsulinRate is in 0.005 U/h, the schedule and the motor count 0.001 U/h."""


class Op(enum.IntEnum):
    """PUMP_BasalCmd.BasalOp."""

    SET_RATE = 1
    SUSPEND = 2
    RESUME_SCHEDULE = 3


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


class Alarm(enum.IntEnum):
    """PUMP_Alarm.PumpAlarmCode."""

    OCCLUSION = 5
    RESERVOIR_LOW = 6
    RESERVOIR_EMPTY = 7
    BATTERY_LOW = 8
    BATTERY_EMPTY = 9
    CTRL_LOST = 21


HIGH, MEDIUM = 3, 2
PRIORITY = {
    Alarm.OCCLUSION: HIGH,
    Alarm.RESERVOIR_LOW: MEDIUM,
    Alarm.RESERVOIR_EMPTY: HIGH,
    Alarm.BATTERY_LOW: MEDIUM,
    Alarm.BATTERY_EMPTY: HIGH,
    Alarm.CTRL_LOST: HIGH,
}
"""PUMP_Alarm.PumpAlarmPriority of each code (requirement ALM-02)."""

INACTIVE, PENDING, CONFIRMED = 0, 1, 2
"""PUMP_Alarm.PumpAlarmState."""

AUX_INSULIN, AUX_PRAMLINTIDE, AUX_PUMP = 1, 2, 0
"""PUMP_Alarm.PumpAlarmAux: which drug it is about."""

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
    change_every_steps: int = 3 * 288  # reservoirs and battery are changed every three days; 0 = never
    battery_percent_per_day: float = 8.0


class Pump:
    """A pump with two chambers, or with one that holds both drugs."""

    def __init__(self, settings: PumpSettings) -> None:
        self.settings = settings
        self.insulin = Chamber(settings.insulin)
        self.pramlintide = Chamber(settings.pramlintide)
        self.battery = 100.0
        self._rate = settings.basal_milliunits_per_h
        self._pramlintide_rate = 0
        self._commanded = False  # a set-point is in force, not the schedule
        self._suspended = False
        self._deserted = False  # the last set-point has expired, and no other came
        self._priming = False
        self._expires = -1  # last step of the set-point in force
        self._sequence: int | None = None
        self._echo = (0, 0)
        self._alarms: dict[tuple[Alarm, int], list[int]] = {}  # (code, drug) -> [instance, state, told]
        self._next_instance = 0
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
        insulin, pramlintide = values["InsulinRate"], values["PramlintideRate"]
        results = self._judge(values, step)
        if results is None:  # the number of the last command again: answer as then, do nothing
            insulin, pramlintide = self._echo
            results = AckResult.DUPLICATE, AckResult.DUPLICATE
        else:
            self._echo = insulin, pramlintide
            self._obey(values, step, results)
        number = values["BasalCmdSeq"]
        limits = self.settings.max_rate_raw, self.settings.max_pramlintide_rate_raw
        return [
            transmitter.frame(
                "PUMP_Ack", AckFor=what, AckResult=result, AckId=number, AckEchoRaw=echo, AckLimitRaw=limit
            )
            for what, result, echo, limit in (
                (AckFor.INSULIN_RATE, results[0], insulin, limits[0]),
                (AckFor.PRAM_RATE, results[1], pramlintide, limits[1]),
            )
        ]

    def bolus(self, values: dict[str, int], step: int, transmitter: Transmitter) -> list[Frame]:
        """Take a decoded PUMP_BolusCmd in instant `step`; return its acknowledgement."""
        self._expire(step)
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
        return self.powered and not self._suspended and not self.boluses[hormone].chamber.stopped

    def reset(self) -> None:
        """The electronics start anew: totals from zero, boluses ended, the schedule.

        The numbers of the last set-point and the newest boluses are kept, so that nothing can be given once more.
        """
        self.boots += 1
        self._booted = True
        self._base = self.insulin.delivered, self.pramlintide.delivered
        for bolus in self.boluses.values():
            bolus.abort()
        self._fall_back()

    def _judge(self, values: dict[str, int], step: int) -> tuple[AckResult, AckResult] | None:
        number = values["BasalCmdSeq"]
        operation = values["BasalOp"]
        if number >= SEQUENCES or operation not in (Op.SET_RATE, Op.SUSPEND, Op.RESUME_SCHEDULE):
            return AckResult.MALFORMED, AckResult.MALFORMED
        if number == self._sequence:
            return None
        if self._sequence is not None and not 0 < (number - self._sequence) % SEQUENCES < SEQUENCES // 2:
            return AckResult.EXPIRED, AckResult.EXPIRED
        ahead = (values["BasalUntilStep"] - step) % 128
        if ahead > EXPIRY_AHEAD_MAX:
            late = AckResult.EXPIRED if ahead >= 64 else AckResult.MALFORMED
            return late, late
        if operation != Op.SET_RATE:
            return AckResult.ACCEPTED, AckResult.ACCEPTED
        insulin = self._judge_rate(values["InsulinRate"], self.settings.max_rate_raw)
        pramlintide = self._judge_rate(values["PramlintideRate"], self.settings.max_pramlintide_rate_raw)
        if pramlintide == AckResult.ACCEPTED and not self._mixture_fits(values):
            pramlintide = AckResult.WRONG_STATE
        return insulin, pramlintide

    def _mixture_fits(self, values: dict[str, int]) -> bool:
        """Whether a co-formulation can give this pramlintide rate with this insulin rate (to one LSB)."""
        ratio = self.settings.coformulation_ug_per_u
        if ratio is None:
            return True
        given = values["InsulinRate"] * MILLIUNITS_PER_LSB * ratio / 100
        return abs(given - values["PramlintideRate"]) <= 1

    @staticmethod
    def _judge_rate(raw: int, limit: int) -> AckResult:
        if raw > RATE_RESERVED:
            return AckResult.MALFORMED
        return AckResult.OVER_LIMIT if raw > limit else AckResult.ACCEPTED

    def _obey(self, values: dict[str, int], step: int, results: tuple[AckResult, AckResult]) -> None:
        if AckResult.ACCEPTED not in results:
            return
        self._deserted = False
        self._sequence = values["BasalCmdSeq"]
        self._expires = step + (values["BasalUntilStep"] - step) % 128
        operation = values["BasalOp"]
        if operation == Op.RESUME_SCHEDULE:
            self._fall_back()
            return
        self._commanded = True
        self._suspended = operation == Op.SUSPEND
        if self._suspended:
            self._rate = self._pramlintide_rate = 0
            for bolus in self.boluses.values():
                bolus.abort()
            return
        # a drug whose rate was refused falls back, the other one goes on
        accepted = [result == AckResult.ACCEPTED for result in results]
        self._rate = values["InsulinRate"] * MILLIUNITS_PER_LSB if accepted[0] else self.settings.basal_milliunits_per_h
        self._pramlintide_rate = values["PramlintideRate"] if accepted[1] else 0

    def _expire(self, step: int) -> None:
        """Nothing is obeyed beyond its expiry."""
        if self._commanded and step > self._expires:
            self._fall_back()
            self._deserted = True

    def _fall_back(self) -> None:
        """The stored schedule of insulin, no pramlintide."""
        self._commanded = False
        self._suspended = False
        self._rate = self.settings.basal_milliunits_per_h
        self._pramlintide_rate = 0

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
        self._expire(step)
        rate, pramlintide_rate = (self._rate, self._pramlintide_rate) if self.powered else (0, 0)
        halted = self._suspended or not self.powered
        if halted:
            for bolus in self.boluses.values():
                bolus.abort()
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
        self.battery = max(self.battery - settings.battery_percent_per_day / 288, 0.0)
        self._priming = settings.change_every_steps > 0 and step % settings.change_every_steps == 0
        if self._priming:
            self.battery = 100.0
            self.insulin.change()
            self.pramlintide.change()

    # ---- reports

    def report(self, transmitter: Transmitter) -> list[Frame]:
        """Alarms, status, totals and bolus states as they stand."""
        values = iter(self.values())
        frames = self.report_alarms(transmitter)
        for name, signals, constants in REPORT:
            frames.append(transmitter.frame(name, **constants, **{signal: next(values) for signal in signals}))
        return frames

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
            SEQUENCES if self._sequence is None else self._sequence,
            min(round(insulin.remaining * 10), 4000),
            min(round(pram_left), 4093),
            round(self.battery),
            insulin.occlusion,
            pram_occlusion,
            int(self._commanded),
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
        return PumpState.SUSPENDED if self._suspended else PumpState.RUNNING

    # ---- alarms

    def _causes(self) -> set[tuple[Alarm, int]]:
        causes = set()
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
        if self._deserted:
            causes.add((Alarm.CTRL_LOST, AUX_PUMP))
        if not self.powered:
            causes.add((Alarm.BATTERY_EMPTY, AUX_PUMP))
        elif self.battery <= BATTERY_LOW_PERCENT:
            causes.add((Alarm.BATTERY_LOW, AUX_PUMP))
        return causes

    def report_alarms(self, transmitter: Transmitter) -> list[Frame]:
        """One frame per change of state, repeated until confirmed."""
        causes = self._causes()
        for cause in sorted(causes - self._alarms.keys()):
            self._alarms[cause] = [self._next_instance, PENDING, False]
            self._next_instance = (self._next_instance + 1) % 65535
        frames = []
        for (code, drug), alarm in sorted(self._alarms.items(), key=lambda item: (-PRIORITY[item[0][0]], item[1][0])):
            if (code, drug) not in causes:
                alarm[1:] = [INACTIVE, False]
            instance, state, told = alarm
            if told and state != PENDING:
                continue
            alarm[2] = True
            frames.append(
                transmitter.frame(
                    "PUMP_Alarm",
                    PumpAlarmState=state,
                    PumpAlarmPriority=PRIORITY[code],
                    PumpAlarmCode=code,
                    PumpAlarmInstance=instance,
                    PumpAlarmAux=drug,
                )
            )
        self._alarms = {cause: alarm for cause, alarm in self._alarms.items() if cause in causes}
        return frames

    def pending_alarms(self) -> list[int]:
        """Instances that the user has been told of and has not confirmed."""
        return [instance for instance, state, told in self._alarms.values() if state == PENDING and told]

    def acknowledge(self, instance: int) -> None:
        """The user confirms an alarm; its cause stays."""
        for alarm in self._alarms.values():
            if alarm[0] == instance and alarm[1] == PENDING:
                alarm[1:] = [CONFIRMED, False]
