"""Meals as the user announces them: each MealId acts once, however often repeated (requirements USR-01 to USR-03)."""

from collections.abc import Iterator

from .control.layout import MEAL_CARBS, MEAL_NONE, MEAL_SIMPLE, MEAL_SNACK

HYPO_TREATMENT, CANCEL = 4, 5
"""MEAL_Announce.MealKind of what is no meal to dose for."""

IDS = 255
"""MealId runs from 0 to 254; 255 is SNA."""

CARBS_MAX = 300
"""0.5 g: more than 150 g is refused (project's choice, requirement USR-02)."""

OFFSET_MAX = 60
"""Minutes between announcement and meal."""


class Meals:
    """The announcement of this step, and which was the last one."""

    def __init__(self) -> None:
        self.last: int | None = None  # MealId handled last
        self.refused = False  # an announcement of this step was refused
        self.repeated = 0  # announcements that were older than the last one
        self._waiting: tuple[int, int] | None = None

    def hear(self, values: dict[str, int]) -> None:
        """A MEAL_Announce. One is taken per step; another one is repeated by the user until it is echoed."""
        number, kind = values["MealId"], values["MealKind"]
        if kind == CANCEL and number == self.last:
            self._waiting = None  # a meal of this step; one of an earlier step is dosed
        if number >= IDS or number == self.last or (self._waiting is not None and kind != CANCEL):
            return
        if self.last is not None and (number - self.last) % IDS > IDS // 2:
            self.repeated += 1
            return
        carbs = values["CarbsEst"]
        if kind in (HYPO_TREATMENT, CANCEL):  # a bolus is committed within its step: only what waits can be cancelled
            self._waiting = MEAL_NONE, 0
        elif kind not in (MEAL_CARBS, MEAL_SIMPLE, MEAL_SNACK) or abs(values["MealOffset"]) > OFFSET_MAX:
            self._waiting = MEAL_NONE, 0
            self.refused = True
        elif kind == MEAL_SIMPLE:
            self._waiting = kind, 0
        elif carbs > CARBS_MAX:
            self._waiting = MEAL_NONE, 0
            self.refused = True
        else:
            self._waiting = kind, carbs
        self.last = number

    def take(self) -> tuple[int, int]:
        """Kind and carbohydrate (0.5 g) of this step's meal; none is (0, 0)."""
        meal = (MEAL_NONE, 0) if self._waiting is None else self._waiting
        self._waiting = None
        return meal

    def save(self) -> list[int]:
        """Words for the non-volatile memory."""
        return [-1 if self.last is None else self.last]

    def restore(self, words: Iterator[int]) -> None:
        """Take back what `save` wrote."""
        last = next(words)
        self.last = None if last < 0 else last
