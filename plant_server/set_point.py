"""The pump's side of the set-points: each has a number and an absolute expiry, and is obeyed no longer than that.

Without a valid one the pump runs its stored schedule of insulin and no pramlintide.
"""

import enum

from .bolus import AckResult

SEQUENCES = 1023
"""BasalCmdSeq runs from 0 to 1022; 1023 is SNA."""

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


class SetPoint:
    """The rates in force, and the newest set-point accepted.

    Args:
        schedule: stored rate of insulin, 0.001 U/h.
        max_rate_raw, max_pramlintide_rate_raw: the pump's own limits, in the raw coding of the command.
        coformulation_ug_per_u: of one chamber that holds both drugs; None: two chambers.

    Attributes:
        rate: of insulin, 0.001 U/h.
        pramlintide_rate: 0.1 ug/h.
        commanded: the rates are those of a set-point, not of the schedule.
        suspended: by a command.
        deserted: the last set-point has expired, and no other came.
        sequence: BasalCmdSeq of the newest one accepted, None before the first.
    """

    def __init__(
        self,
        schedule: int,
        max_rate_raw: int,
        max_pramlintide_rate_raw: int,
        coformulation_ug_per_u: float | None = None,
    ) -> None:
        self._schedule = schedule
        self._limits = max_rate_raw, max_pramlintide_rate_raw
        self._ratio = coformulation_ug_per_u
        self.rate = schedule
        self.pramlintide_rate = 0
        self.commanded = False
        self.suspended = False
        self.deserted = False
        self.sequence: int | None = None
        self._expires = -1  # last step of the set-point in force
        self._echo = (0, 0)

    def take(self, values: dict[str, int], step: int) -> tuple[tuple[AckResult, AckResult], tuple[int, int]]:
        """Take a decoded PUMP_BasalCmd in instant `step`.

        Returns:
            AckResult and AckEchoRaw for insulin and pramlintide: the rates as understood, those of the first time for a
            repeated command.
        """
        results = self._judge(values, step)
        if results is None:  # the number of the last command again: answer as then, do nothing
            return (AckResult.DUPLICATE, AckResult.DUPLICATE), self._echo
        self._echo = values["InsulinRate"], values["PramlintideRate"]
        self._obey(values, step, results)
        return results, self._echo

    def _judge(self, values: dict[str, int], step: int) -> tuple[AckResult, AckResult] | None:
        number = values["BasalCmdSeq"]
        operation = values["BasalOp"]
        if number >= SEQUENCES or operation not in (Op.SET_RATE, Op.SUSPEND, Op.RESUME_SCHEDULE):
            return AckResult.MALFORMED, AckResult.MALFORMED
        if number == self.sequence:
            return None
        if self.sequence is not None and not 0 < (number - self.sequence) % SEQUENCES < SEQUENCES // 2:
            return AckResult.EXPIRED, AckResult.EXPIRED
        ahead = (values["BasalUntilStep"] - step) % 128
        if ahead > EXPIRY_AHEAD_MAX:
            late = AckResult.EXPIRED if ahead >= 64 else AckResult.MALFORMED
            return late, late
        if operation != Op.SET_RATE:
            return AckResult.ACCEPTED, AckResult.ACCEPTED
        insulin, pramlintide = (
            self._judge_rate(values[name], limit)
            for name, limit in zip(("InsulinRate", "PramlintideRate"), self._limits, strict=True)
        )
        if pramlintide == AckResult.ACCEPTED and not self._mixture_fits(values):
            pramlintide = AckResult.WRONG_STATE
        return insulin, pramlintide

    @staticmethod
    def _judge_rate(raw: int, limit: int) -> AckResult:
        if raw > RATE_RESERVED:
            return AckResult.MALFORMED
        return AckResult.OVER_LIMIT if raw > limit else AckResult.ACCEPTED

    def _mixture_fits(self, values: dict[str, int]) -> bool:
        """Whether a co-formulation can give this pramlintide rate with this insulin rate (to one LSB)."""
        if self._ratio is None:
            return True
        given = values["InsulinRate"] * MILLIUNITS_PER_LSB * self._ratio / 100
        return abs(given - values["PramlintideRate"]) <= 1

    def _obey(self, values: dict[str, int], step: int, results: tuple[AckResult, AckResult]) -> None:
        if AckResult.ACCEPTED not in results:
            return
        self.deserted = False
        self.sequence = values["BasalCmdSeq"]
        self._expires = step + (values["BasalUntilStep"] - step) % 128
        operation = values["BasalOp"]
        if operation == Op.RESUME_SCHEDULE:
            self.fall_back()
            return
        self.commanded = True
        self.suspended = operation == Op.SUSPEND
        if self.suspended:
            self.rate = self.pramlintide_rate = 0
            return
        # a drug whose rate was refused falls back, the other one goes on
        accepted = [result == AckResult.ACCEPTED for result in results]
        self.rate = values["InsulinRate"] * MILLIUNITS_PER_LSB if accepted[0] else self._schedule
        self.pramlintide_rate = values["PramlintideRate"] if accepted[1] else 0

    def expire(self, step: int) -> None:
        """Nothing is obeyed beyond its expiry."""
        if self.commanded and step > self._expires:
            self.fall_back()
            self.deserted = True

    def fall_back(self) -> None:
        """The stored schedule of insulin, no pramlintide."""
        self.commanded = False
        self.suspended = False
        self.rate = self._schedule
        self.pramlintide_rate = 0
