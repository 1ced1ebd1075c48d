"""H8: what the device said of itself before a reset against what it says after it."""

from pumpbench.hazards.boluses import ABORTED, COMMIT, DONE
from pumpbench.hazards.counts import Counter

MEAL_IDS, MEAL_SNA = 255, 255
IOB_KEPT, IOB_SLACK = 0.75, 50.0
"""Share of the insulin on board that is left after a step, and 0.01 U besides: no insulin in use fades faster."""

INSULIN = 1
"""PUMP_BolusCmd.BolusHormone, and PUMP_BolusState.BolusStateHormone."""


class ResetWatch:
    """Mode, meals and insulin on board over every reset."""

    def __init__(self, hazards: Counter) -> None:
        self._hazards = hazards
        self._before: dict[str, int] | None = None  # the newest status
        self._step = -1  # of that status
        self._booted = False
        self._mode_asked = False  # since that status: then another mode is no loss
        self._number: int | None = None  # of the newest insulin bolus
        self._open = 0  # its dose (0.01 U) until the device has heard what became of it, which may be counted twice
        self._open_before = 0  # when that status was said
        self._told: int | None = None  # what the device has heard was delivered of it, since it last started
        self._given = 0  # the same, once it has taken it in
        self._given_step = 0

    def boot(self) -> None:
        """The device has started anew in the middle of a run."""
        self._booted = True
        self._told = None  # heard and forgotten

    def forget(self) -> None:
        """The device has come back with a blank memory: there is nothing it could know."""
        self._booted = False

    def mode(self) -> None:
        """A mode was asked for."""
        self._mode_asked = True

    def command(self, values: dict[str, int]) -> None:
        """A PUMP_BolusCmd."""
        if values["BolusHormone"] == INSULIN and values["BolusOp"] == COMMIT:
            self._number, self._open = values["BolusId"], values["InsulinBolus"]
            self._given, self._told = 0, None

    def bolus(self, values: dict[str, int]) -> None:
        """A PUMP_BolusState."""
        if values["BolusStateHormone"] == INSULIN and values["BolusStateId"] == self._number and self._open:
            self._told = values["BolusDeliveredRaw"] if values["BolusPhase"] in (DONE, ABORTED) else self._told

    def status(self, values: dict[str, int], step: int) -> None:
        """A CTRL_Status of instant `step`."""
        if self._told is not None:
            self._open, self._given, self._given_step, self._told = 0, self._told, step, None
        if self._booted and self._before is not None:
            self._hazards.count("H8", self._lost(self._before, values, step))
        self._before, self._step, self._open_before = values, step, self._open
        self._booted = self._mode_asked = False

    def _lost(self, before: dict[str, int], after: dict[str, int], step: int) -> bool:
        mode = before["CtrlMode"] != after["CtrlMode"] and not self._mode_asked
        meal = before["LastMealId"] != MEAL_SNA and (
            after["LastMealId"] == MEAL_SNA or (after["LastMealId"] - before["LastMealId"]) % MEAL_IDS > MEAL_IDS // 2
        )
        left = (before["InsulinOnBoard"] - self._open_before) * IOB_KEPT ** (step - self._step)
        of_bolus = self._given * IOB_KEPT ** (step - self._given_step)
        iob = max(left, of_bolus) - IOB_SLACK > after["InsulinOnBoard"]
        return mode or meal or iob
