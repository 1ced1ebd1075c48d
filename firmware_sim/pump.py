"""The pump as the firmware sees it: set-points with sequence number and expiry, and the totals it reports."""

import enum
from collections.abc import Iterator

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

UNLIKE_STEPS = 2
"""Steps in which the pump may show another set-point than the last one before it is an alarm (requirement CMD-09)."""

ACK_INSULIN_RATE, ACK_PRAM_RATE = 1, 8
"""PUMP_Ack.AckFor of the two answers to a set-point."""

ACK_RATES = (ACK_INSULIN_RATE, ACK_PRAM_RATE)

RATE_LIMIT_AT_BOOT = 8000
"""Raw rate of either drug that the pump is taken to accept until it has said otherwise: the largest of the wire."""

ACCEPTED, DUPLICATE, OVER_LIMIT = 0, 1, 3
"""PUMP_Ack.AckResult."""

STATE_STOPPED, STATE_FAULT = 5, 6
OCCLUDED = 2


class Op(enum.IntEnum):
    """PUMP_BasalCmd.BasalOp."""

    SET_RATE = 1
    SUSPEND = 2
    RESUME_SCHEDULE = 3


def accepted_limit(ack: dict[str, int], limit: int) -> int:
    """The largest raw dose the pump accepts: a refusal lowers it, the answer to what was accepted may raise it."""
    if ack["AckResult"] == OVER_LIMIT:
        return ack["AckLimitRaw"]
    return max(ack["AckLimitRaw"], limit) if ack["AckResult"] in (ACCEPTED, DUPLICATE) else limit


class Pump:
    """Commands out, acknowledgements and totals in."""

    def __init__(self) -> None:
        self._sequence = SEQUENCES - 1
        self._confirmed_total: int | None = None  # mU, the newest total
        self._pram_total: int | None = None  # 0.01 ug, the newest total
        self._unlike = 0  # steps in a row in which the pump showed another set-point than the last one
        self.insulin_blocked = False  # its line or its motor does not deliver
        self.pram_blocked = False
        self._insulin_fell = False  # the newest total was below an older one, without a reset of the pump
        self._pram_fell = False
        self.rate_limit = RATE_LIMIT_AT_BOOT  # raw, what the pump accepts as it last said
        self.pram_rate_limit = RATE_LIMIT_AT_BOOT
        self._boot_count: int | None = None
        self._estimated = 0  # mU assumed and not yet covered by a total
        self._commanded_rate: int | None = None  # 0.005 U/h in force by our last command; None = schedule
        self._status_step = -NEVER
        self._totals_step = -NEVER
        self._bolus_steps: dict[int, int] = {}  # drug -> step of its newest PUMP_BolusState
        self._answers = False  # the pump is one that acknowledges set-points
        self._awaited: set[int] = set()  # AckFor of what the last set-point has not been answered with
        self._rates: tuple[int, int] | None = None  # raw, of the last set-point
        self.set_point = (0, 0, 0)  # the last one: operation, insulin raw, pramlintide raw
        self.set_point_step = -NEVER
        self.refused = 0  # totals that fell without a reset, acknowledgements that were not Accepted
        self.unanswered = 0  # answers to set-points that never came
        self.misunderstood = 0  # set-points that the pump took for others

    def asked(self, basal: int) -> tuple[int, int]:
        """Rates in force by the last set-point: insulin in 0.001 U/h, pramlintide in 0.01 ug/h.

        Args:
            basal: scheduled rate in 0.001 U/h, where the pump was left to its schedule.
        """
        insulin = basal if self._commanded_rate is None else self._commanded_rate * 5
        return insulin, 0 if self._rates is None else self._rates[1] * 10

    def age(self, step: int) -> int:
        """Steps since status, totals and the states of boluses were last heard; of these, those ever heard."""
        return step - min(self._status_step, self._totals_step, *self._bolus_steps.values())

    @property
    def heard(self) -> bool:
        """Whether status and totals have been heard since boot (requirement RST-03)."""
        return self._status_step > -NEVER and self._totals_step > -NEVER

    @property
    def unlike(self) -> bool:
        """Whether the pump does not run the set-point it was sent last."""
        return self._unlike >= UNLIKE_STEPS

    @property
    def pram_unanswered(self) -> bool:
        """Whether the pump, which answers set-points, has not answered the last one for pramlintide (TWO-05)."""
        return self._answers and ACK_PRAM_RATE in self._awaited

    @property
    def fallen(self) -> bool:
        """Whether the newest totals are not believed, because one fell without a reset of the pump."""
        return self._insulin_fell or self._pram_fell

    def status(self, values: dict[str, int], step: int) -> None:
        """A PUMP_Status arrived for instant `step`."""
        shown = values["PumpLastBasalSeq"]
        self._unlike = self._unlike + 1 if shown not in (SEQUENCES, self._sequence) else 0
        self._status_step = step
        stopped = values["PumpState"] in (STATE_STOPPED, STATE_FAULT)
        self.insulin_blocked = stopped or values["InsulinOcclusion"] == OCCLUDED or values["InsulinReservoir"] == 0
        self.pram_blocked = values["PramOcclusion"] == OCCLUDED or values["PramReservoir"] == 0

    def bolus_state(self, drug: int, step: int) -> None:
        """A PUMP_BolusState arrived for instant `step`."""
        self._bolus_steps[drug] = step

    def hear_ack(self, values: dict[str, int]) -> None:
        """A PUMP_Ack of the last set-point; the two drugs are judged apart (requirement TWO-05)."""
        if values["AckId"] != self._sequence:
            return
        accepted = values["AckResult"] in (ACCEPTED, DUPLICATE)
        if values["AckFor"] in ACK_RATES:
            self._answers = True
            self._awaited.discard(values["AckFor"])
            asked = None if self._rates is None else self._rates[ACK_RATES.index(values["AckFor"])]
            self.misunderstood += accepted and asked not in (None, values["AckEchoRaw"])
        if values["AckFor"] == ACK_INSULIN_RATE:
            self.refused += not accepted
            self.rate_limit = accepted_limit(values, self.rate_limit)
        elif values["AckFor"] == ACK_PRAM_RATE:
            self.refused += not accepted
            self.pram_rate_limit = accepted_limit(values, self.pram_rate_limit)

    def pramlintide(self, totals: dict[str, int] | None) -> int:
        """Pramlintide delivered since the last total, in 0.01 ug; to be called before `delivered`."""
        if totals is None or totals["PramTotal"] >= TOTAL_MODULUS or totals["PumpBootCount"] >= BOOT_COUNT_SNA:
            return 0
        last, total = self._pram_total, totals["PramTotal"]
        rebooted = totals["PumpBootCount"] != self._boot_count
        self._pram_fell = last is not None and total < last and not rebooted
        if self._pram_fell:
            return 0  # a total never falls without a reset of the pump
        self._pram_total = total
        if last is None:
            return 0
        return total if rebooted else total - last

    def delivered(self, totals: dict[str, int] | None, step: int, basal: int, bolus: int = 0) -> int:
        """Insulin delivered since the last step.

        What a missing total leaves open is estimated from the command in force and the boluses the pump has told of,
        and settled when the next one comes, so that the sum over all steps is always what the pump says.

        Args:
            totals: decoded PUMP_Delivered of this step, or None.
            step: k.
            basal: scheduled rate in 0.001 U/h.
            bolus: what newly turned out to be delivered of boluses, mU.

        Returns:
            mU; -1 while no total has ever come.
        """
        if totals is not None and self._believable(totals):
            return self._settle(totals["InsulinTotal"], totals["PumpBootCount"], step)
        if self._confirmed_total is None:
            return -1
        milliunits = basal if self._commanded_rate is None else self._commanded_rate * 5
        estimate = round_divide(milliunits, 12) + bolus
        self._estimated += estimate
        return estimate

    def _believable(self, totals: dict[str, int]) -> bool:
        """Whether a total can be what it claims; one that is not counts as not received."""
        if totals["InsulinTotal"] >= TOTAL_MODULUS or totals["PumpBootCount"] >= BOOT_COUNT_SNA:
            return False
        last, rebooted = self._confirmed_total, totals["PumpBootCount"] != self._boot_count
        self._insulin_fell = last is not None and totals["InsulinTotal"] < last and not rebooted
        self.refused += self._insulin_fell  # a total never falls without a reset of the pump
        return not self._insulin_fell

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

    def command(self, turn: Turn, op: Op, step: int, rate: int = 0, pramlintide_rate: int = 0) -> bool:
        """Send the set-point of this step, with a new number and an absolute expiry.

        Args:
            turn: where to send it.
            op: SET_RATE uses both rates, SUSPEND stops both drugs, RESUME_SCHEDULE leaves insulin to the pump's own
                schedule and stops pramlintide.
            step: k.
            rate: 0.005 U/h.
            pramlintide_rate: 0.1 ug/h.

        Returns:
            Whether the pump's own limit has cut a rate.
        """
        asked = rate, pramlintide_rate
        rate = min(rate, self.rate_limit)
        if rate < asked[0]:
            pramlintide_rate = pramlintide_rate * rate // asked[0]  # the ratio of the drugs stays
        pramlintide_rate = min(pramlintide_rate, self.pram_rate_limit)
        self._sequence = (self._sequence + 1) % SEQUENCES
        self.unanswered += len(self._awaited) if self._answers else 0
        self._awaited = set(ACK_RATES)
        self._rates = (rate, pramlintide_rate) if op == Op.SET_RATE else None
        rates = {"InsulinRate": rate, "PramlintideRate": pramlintide_rate} if op == Op.SET_RATE else {}
        self._commanded_rate = rate if op == Op.SET_RATE else 0 if op == Op.SUSPEND else None
        self.set_point = (op, *(self._rates or (0, 0)))
        self.set_point_step = step
        turn.send(
            "PUMP_BasalCmd",
            BasalOp=op,
            BasalCmdSeq=self._sequence,
            BasalUntilStep=(step + RATE_EXPIRES_AFTER) % 128,
            **rates,
        )
        return (rate, pramlintide_rate) != asked

    def save(self) -> list[int]:
        """Words for the non-volatile memory; -1 stands for what is not known."""
        known = (self._confirmed_total, self._pram_total, self._boot_count)
        rate = -1 if self._commanded_rate is None else self._commanded_rate
        return [self._sequence, *(-1 if word is None else word for word in known), self._estimated, rate]

    def restore(self, words: Iterator[int]) -> None:
        """Take back what `save` wrote."""
        self._sequence = next(words)
        total, pram_total, boot_count = next(words), next(words), next(words)
        self._confirmed_total = None if total < 0 else total
        self._pram_total = None if pram_total < 0 else pram_total
        self._boot_count = None if boot_count < 0 else boot_count
        self._estimated = next(words)
        rate = next(words)
        self._commanded_rate = None if rate < 0 else rate
