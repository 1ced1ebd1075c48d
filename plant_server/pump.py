"""The pump's electronics: commands in, acknowledgements, status and totals out; its limits are its own.

It trusts no controller: every set-point has a number and an absolute expiry, is answered, and is refused as a whole for
a drug when it is above the pump's limit. Without a valid set-point the pump runs its stored schedule of insulin and no
pramlintide.
"""

import enum
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from can_bus.codec import Transmitter
from can_bus.frame import Frame

from . import mechanism

SEQUENCES = 1023
EXPIRY_AHEAD_MAX = 24
"""Steps: a set-point that claims to hold longer is malformed (DBC, BasalUntilStep)."""

RATE_RESERVED = 8000
"""Raw rates above this are reserved codes."""

MILLIUNITS_PER_LSB = 5
"""InsulinRate is in 0.005 U/h, the schedule and the motor count 0.001 U/h."""


class Op(enum.IntEnum):
    """PUMP_BasalCmd.BasalOp."""

    SET_RATE = 1
    SUSPEND = 2
    RESUME_SCHEDULE = 3


class AckFor(enum.IntEnum):
    """PUMP_Ack.AckFor."""

    INSULIN_RATE = 1
    PRAM_RATE = 8


class AckResult(enum.IntEnum):
    """PUMP_Ack.AckResult."""

    ACCEPTED = 0
    DUPLICATE = 1
    EXPIRED = 2
    OVER_LIMIT = 3
    MALFORMED = 7


class PumpState(enum.IntEnum):
    """PUMP_Status.PumpState."""

    RUNNING = 3
    SUSPENDED = 4


@dataclass(frozen=True)
class PumpSettings:
    """What the pump was set up with, independent of the controller."""

    basal_milliunits_per_h: int  # stored schedule, 0.001 U/h
    max_rate_raw: int = 6000  # 30 U/h, the largest rate of commercial pumps
    max_pramlintide_rate_raw: int = 3000  # 300 ug/h: 10 ug/U at the largest insulin rate
    insulin_reservoir_u: float = 300.0
    pramlintide_reservoir_ug: float = 4000.0
    change_every_steps: int = 3 * 288  # reservoirs and battery are changed every three days
    battery_percent_per_day: float = 8.0


class Pump:
    """A two-chamber pump."""

    def __init__(self, settings: PumpSettings) -> None:
        self.settings = settings
        self.insulin = mechanism.motor()
        self.pramlintide = mechanism.motor()
        self._rate = settings.basal_milliunits_per_h
        self._pramlintide_rate = 0
        self._commanded = False  # a set-point is in force, not the schedule
        self._suspended = False
        self._expires = -1  # last step of the set-point in force
        self._sequence: int | None = None
        self._echo = (0, 0)
        self._insulin_at_change = 0
        self._pramlintide_at_change = 0
        self._changed_at = 0
        self._insulin_out = np.zeros(mechanism.SUBSTEPS)
        self._pramlintide_out = np.zeros(mechanism.SUBSTEPS)

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
        return (
            self._judge_rate(values["InsulinRate"], self.settings.max_rate_raw),
            self._judge_rate(values["PramlintideRate"], self.settings.max_pramlintide_rate_raw),
        )

    @staticmethod
    def _judge_rate(raw: int, limit: int) -> AckResult:
        if raw > RATE_RESERVED:
            return AckResult.MALFORMED
        return AckResult.OVER_LIMIT if raw > limit else AckResult.ACCEPTED

    def _obey(self, values: dict[str, int], step: int, results: tuple[AckResult, AckResult]) -> None:
        if AckResult.ACCEPTED not in results:
            return
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
            return
        # a drug whose rate was refused falls back, the other one goes on
        accepted = [result == AckResult.ACCEPTED for result in results]
        self._rate = values["InsulinRate"] * MILLIUNITS_PER_LSB if accepted[0] else self.settings.basal_milliunits_per_h
        self._pramlintide_rate = values["PramlintideRate"] if accepted[1] else 0

    def _fall_back(self) -> None:
        """The stored schedule of insulin, no pramlintide."""
        self._commanded = False
        self._suspended = False
        self._rate = self.settings.basal_milliunits_per_h
        self._pramlintide_rate = 0

    # ---- delivery

    def deliver(self, step: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Run both motors from instant `step` to the next one.

        Returns:
            Insulin (U) and pramlintide (ug) delivered within each of the ten 30-s steps; the arrays are used again.
        """
        if self._commanded and step > self._expires:
            self._fall_back()
        mechanism.run(self.insulin, self._rate, mechanism.INSULIN_STROKE, mechanism.INSULIN_STROKE_U, self._insulin_out)
        mechanism.run(
            self.pramlintide,
            self._pramlintide_rate,
            mechanism.PRAMLINTIDE_STROKE,
            mechanism.PRAMLINTIDE_STROKE_UG,
            self._pramlintide_out,
        )
        return self._insulin_out, self._pramlintide_out

    # ---- reports

    def report(self, step: int, transmitter: Transmitter) -> list[Frame]:
        """Status, totals and bolus states as they stand at instant `step`."""
        settings = self.settings
        if step - self._changed_at >= settings.change_every_steps:
            self._changed_at = step
            self._insulin_at_change = int(self.insulin[mechanism.DELIVERED])
            self._pramlintide_at_change = int(self.pramlintide[mechanism.DELIVERED])
        insulin = int(self.insulin[mechanism.DELIVERED])
        pramlintide = int(self.pramlintide[mechanism.DELIVERED])
        insulin_left = settings.insulin_reservoir_u - (insulin - self._insulin_at_change) * mechanism.INSULIN_STROKE_U
        pramlintide_left = (
            settings.pramlintide_reservoir_ug
            - (pramlintide - self._pramlintide_at_change) * mechanism.PRAMLINTIDE_STROKE_UG
        )
        battery = 100.0 - (step - self._changed_at) / 288 * settings.battery_percent_per_day
        sequence = {} if self._sequence is None else {"PumpLastBasalSeq": self._sequence}
        frame = transmitter.frame
        return [
            frame(
                "PUMP_Status",
                PumpState=PumpState.SUSPENDED if self._suspended else PumpState.RUNNING,
                InsulinReservoir=max(round(insulin_left * 10), 0),
                PramReservoir=max(round(pramlintide_left), 0),
                PumpBattery=max(round(battery), 0),
                InsulinOcclusion=0,
                PramOcclusion=0,
                TbrActive=int(self._commanded),
                **sequence,
            ),
            frame(
                "PUMP_Delivered",
                PumpBootCount=0,
                InsulinTotal=insulin * round(mechanism.INSULIN_STROKE_U * 1000),
                PramTotal=pramlintide * round(mechanism.PRAMLINTIDE_STROKE_UG * 100),
            ),
            *(
                frame("PUMP_BolusState", BolusStateHormone=hormone, BolusPhase=0, BolusDeliveredRaw=0)
                for hormone in (1, 2)
            ),
        ]
