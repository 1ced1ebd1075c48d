"""What the pump has given of both drugs: in a step, within 24 h, and against what it was asked for."""

from .allowance import insulin_left, pram_left
from .balance import Balance
from .bolus import Boluses, Drug
from .day import Day
from .pump import Pump

UNBALANCED_INSULIN, UNBALANCED_PRAM = 500, 500
"""Ten strokes, in mU and in 0.01 ug (project's choice)."""


class Delivery:
    """The account of both drugs, kept from what pump and boluses tell.

    Attributes:
        insulin: mU since the step before, an estimate without a total; -1 while none has ever come.
        bolus: mU, the part of it that was a bolus.
        pramlintide: 0.01 ug since the last total.
        insulin_day, pram_day: within 24 h, in mU and 0.01 ug.
    """

    def __init__(self, pump: Pump, boluses: Boluses) -> None:
        self._pump = pump
        self._boluses = boluses
        self.insulin, self.bolus, self.pramlintide = -1, 0, 0
        self.insulin_day = Day()
        self.pram_day = Day()
        self._balances = {Drug.INSULIN: Balance(UNBALANCED_INSULIN), Drug.PRAMLINTIDE: Balance(UNBALANCED_PRAM)}
        self._totals_known = False  # in the step before
        self._short_seen = dict.fromkeys(Drug, 0)

    def update(self, totals: dict[str, int] | None, step: int, basal: int, skipped: int) -> None:
        """Account for the time up to instant `step`, once per step, when the pump's other news have been heard.

        Args:
            totals: PUMP_Delivered of this step, or None.
            step: k.
            basal: scheduled rate in 0.001 U/h.
            skipped: steps before this one that never came.
        """
        self.pramlintide = self._pump.pramlintide(totals)
        told = self._boluses.open_step(step)
        self.bolus, pram_bolus = (sum(raw * 10 for drug, raw in told if drug == wanted) for wanted in Drug)
        self.insulin = self._pump.delivered(totals, step, basal, self.bolus)
        known = totals is not None and skipped == 0 and self.insulin >= 0
        self._balance(known, basal, {Drug.INSULIN: self.bolus, Drug.PRAMLINTIDE: pram_bolus})
        self.insulin_day.add(max(self.insulin, 0), step)
        self.pram_day.add(self.pramlintide, step)

    def _balance(self, known: bool, basal: int, boluses: dict[Drug, int]) -> None:
        """Hold what the totals grew by against what was asked for; over a gap nobody knows what that was."""
        given = {Drug.INSULIN: self.insulin, Drug.PRAMLINTIDE: self.pramlintide}
        for (drug, bolus), rate in zip(boluses.items(), self._pump.asked(basal), strict=True):
            # of a bolus that ended too early all that was asked for is held against the pump
            asked = bolus + self._newly_short(drug)
            if known and self._totals_known:
                self._balances[drug].account(rate, asked, given[drug])
            else:
                self._balances[drug].reset()
        self._totals_known = known

    def _newly_short(self, drug: Drug) -> int:
        """In mU or 0.01 ug."""
        short = self._boluses.short[drug]
        new, self._short_seen[drug] = short - self._short_seen[drug], short
        return new * 10

    @property
    def unbalanced(self) -> bool:
        """Whether the pump gave more or less of a drug than it was asked for."""
        return any(balance.off(self._boluses.remaining(drug) * 10) for drug, balance in self._balances.items())

    def insulin_left(self, tdd: int) -> int:
        """What `CfgInsulinTdd` leaves within 24 h, in mU."""
        return insulin_left(tdd, self.insulin_day.total, self._boluses.remaining(Drug.INSULIN))

    def pram_left(self, tdd: int) -> int:
        """What `CfgPramTdd` leaves within 24 h, in 0.1 ug."""
        return pram_left(tdd, self.pram_day.total, self._boluses.remaining(Drug.PRAMLINTIDE))
