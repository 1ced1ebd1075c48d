"""The pump as the firmware sees it: set-points with sequence number and expiry, and the totals it reports."""

import enum

from can_bus.lockstep import Turn

from .control.fixed import round_divide

RATE_EXPIRES_AFTER = 3
"""Steps a set-point may run without a newer one; then the pump falls back to its schedule."""

SEQUENCES = 1023
"""BasalCmdSeq runs from 0 to 1022."""

TOTAL_MODULUS = 16777214
"""Totals at or above this raw value are reserved codes."""

BOOT_COUNT_SNA = 15

NEVER = 1 << 20


class Op(enum.IntEnum):
    """PUMP_BasalCmd.BasalOp."""

    SET_RATE = 1
    SUSPEND = 2
    RESUME_SCHEDULE = 3


class Pump:
    """Commands out, acknowledgements and totals in."""

    def __init__(self) -> None:
        self._sequence = SEQUENCES - 1
        self._confirmed_total: int | None = None  # mU, the newest total
        self._boot_count: int | None = None
        self._estimated = 0  # mU assumed and not yet covered by a total
        self._commanded_rate: int | None = None  # 0.005 U/h in force by our last command; None = schedule
        self._status_step = -NEVER
        self._totals_step = -NEVER
        self.refused = 0  # totals that fell without a reset, acknowledgements that were not Accepted

    def age(self, step: int) -> int:
        """Steps since both the status and the totals were last heard."""
        return step - min(self._status_step, self._totals_step)

    def status(self, step: int) -> None:
        """A PUMP_Status arrived for instant `step`."""
        self._status_step = step

    def delivered(self, totals: dict[str, int] | None, step: int, basal: int) -> int:
        """Insulin delivered since the last step.

        What a missing total leaves open is estimated from the command in force and settled when the next one comes, so
        that the sum over all steps is always what the pump says.

        Args:
            totals: decoded PUMP_Delivered of this step, or None.
            step: k.
            basal: scheduled rate in 0.001 U/h.

        Returns:
            mU; -1 while no total has ever come.
        """
        if totals is not None and self._believable(totals):
            return self._settle(totals["InsulinTotal"], totals["PumpBootCount"], step)
        if self._confirmed_total is None:
            return -1
        milliunits = basal if self._commanded_rate is None else self._commanded_rate * 5
        estimate = round_divide(milliunits, 12)
        self._estimated += estimate
        return estimate

    def _believable(self, totals: dict[str, int]) -> bool:
        """Whether a total can be what it claims; one that is not counts as not received."""
        if totals["InsulinTotal"] >= TOTAL_MODULUS or totals["PumpBootCount"] >= BOOT_COUNT_SNA:
            return False
        last = self._confirmed_total
        if last is not None and totals["InsulinTotal"] < last and totals["PumpBootCount"] == self._boot_count:
            self.refused += 1  # a total never falls without a reset of the pump
            return False
        return True

    def _settle(self, total: int, boot_count: int, step: int) -> int:
        last = self._confirmed_total
        rebooted = boot_count != self._boot_count
        self._totals_step = step
        self._confirmed_total = total
        self._boot_count = boot_count
        if last is None:
            return -1
        delivered = total if rebooted else total - last
        estimated = self._estimated
        # what was assumed too much comes off the next steps; before a reset it may well have been delivered
        self._estimated = 0 if rebooted else max(estimated - delivered, 0)
        return max(delivered - estimated, 0)

    def command(self, turn: Turn, op: Op, step: int, rate: int = 0, pramlintide_rate: int = 0) -> None:
        """Send the set-point of this step, with a new number and an absolute expiry.

        Args:
            turn: where to send it.
            op: SET_RATE uses both rates, SUSPEND stops both drugs, RESUME_SCHEDULE leaves insulin to the pump's own
                schedule and stops pramlintide.
            step: k.
            rate: 0.005 U/h.
            pramlintide_rate: 0.1 ug/h.
        """
        self._sequence = (self._sequence + 1) % SEQUENCES
        rates = {"InsulinRate": rate, "PramlintideRate": pramlintide_rate} if op == Op.SET_RATE else {}
        self._commanded_rate = rate if op == Op.SET_RATE else 0 if op == Op.SUSPEND else None
        turn.send(
            "PUMP_BasalCmd",
            BasalOp=op,
            BasalCmdSeq=self._sequence,
            BasalUntilStep=(step + RATE_EXPIRES_AFTER) % 128,
            **rates,
        )
