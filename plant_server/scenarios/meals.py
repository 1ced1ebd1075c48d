"""Meals in order of time."""

from typing import NamedTuple

from can_bus.lockstep import STEP_MINUTES, STEPS_PER_DAY

from .announcing import Announcing
from .rescue import Rescue

MINUTES_PER_DAY = 1440

MAIN_MEALS = ("Breakfast", "Lunch", "Dinner")
SNACK = "Snack"
RESCUE = "Rescue"
"""Sugar against a low: in no plan, eaten when it is needed."""


class Meal(NamedTuple):
    """A meal: the sampling instant it starts at, its kind, carbohydrate in g."""

    step: int
    kind: str
    carbs_g: float


class Scenario(NamedTuple):
    """Meals in order of time, over `days` days, and how the person deals with them."""

    name: str
    days: int
    meals: tuple[Meal, ...]
    announcing: Announcing = Announcing()
    rescue: Rescue | None = None

    def meals_by_step(self) -> dict[int, list[Meal]]:
        """The meals that start at each sampling instant."""
        table: dict[int, list[Meal]] = {}
        for meal in self.meals:
            table.setdefault(meal.step, []).append(meal)
        return table


def planned(meals: list[tuple[float, str, float]], days: int) -> tuple[Meal, ...]:
    """Meals given as (minutes since the start, kind, g), at the nearest sampling instant, within `days` days."""
    rounded = (Meal(round(minute / STEP_MINUTES), kind, carbs) for minute, kind, carbs in meals)
    return tuple(
        sorted((meal for meal in rounded if 0 <= meal.step < days * STEPS_PER_DAY), key=lambda meal: meal.step)
    )
