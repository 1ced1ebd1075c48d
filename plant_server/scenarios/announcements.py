"""What the person tells the device, meal by meal: the content of MEAL_Announce.

Which meals are told at all depends on the controller's mode (Pons Torres et al. 2025): with meal announcements every
meal and snack with its estimated grams; with simplified announcements the time of the three main meals, no snacks;
without, nothing.
"""

import enum
import functools
from typing import NamedTuple

import dbc
from can_bus.lockstep import STEP_MINUTES

from ..streams import stream
from .meals import SNACK, Meal, Scenario

CARBS_MAX = 500.0
"""g, MEAL_Announce.CarbsEst."""


class Kind(enum.IntEnum):
    """MEAL_Announce.MealKind."""

    CARBS_ESTIMATED = 1
    SIMPLE_MEAL = 2  # time only
    SNACK = 3
    HYPO_TREATMENT = 4


class Policy(enum.Enum):
    """What is told."""

    NOTHING = "none"
    MAIN_MEALS = "the time of main meals"
    EVERYTHING = "every meal and its carbohydrate"


@functools.cache
def policy_of(mode: int) -> Policy:
    """What is told in a mode, by the ending of its name in the DBC: ...MA, ...SMA, or anything else.

    Args:
        mode: MODE_Cmd.ModeRequest.
    """
    names = dbc.load().get_message_by_name("MODE_Cmd").get_signal_by_name("ModeRequest").choices or {}
    name = str(names.get(mode, ""))
    if name.endswith("SMA"):
        return Policy.MAIN_MEALS
    return Policy.EVERYTHING if name.endswith("MA") and not name.endswith("NMA") else Policy.NOTHING


class Announcement(NamedTuple):
    """One meal as it is told."""

    step: int  # sampling instant at which it is told
    kind: Kind
    carbs_g: float | None  # estimate; None where only the time is told
    meal_step: int  # when the meal starts, truly


def announcements(scenario: Scenario, policy: Policy, seed: int, patient: str) -> tuple[Announcement, ...]:
    """The planned meals as they are told, in order of telling.

    Every source draws from a stream of its own, one number per planned meal, told or not: switching one off, or
    another policy, shifts nothing.

    Args:
        scenario: its meals and the person's habits.
        policy: of the mode, see `policy_of`.
        seed: of the run.
        patient: name of the virtual patient.
    """
    habits = scenario.announcing
    count = len(scenario.meals)
    normal = stream(seed, patient, "announcement estimate").standard_normal(count).tolist()
    forget = stream(seed, patient, "announcement missed").random(count).tolist()
    late, delay = stream(seed, patient, "announcement late").random((count, 2)).T.tolist() if count else ([], [])
    told = []
    for k, meal in enumerate(scenario.meals):
        if forget[k] < habits.missed or not _is_told(meal, policy):
            continue
        minutes = -habits.ahead_minutes
        if habits.late is not None and late[k] < habits.late.probability:
            least, most = habits.late.minutes
            minutes = least + (most - least) * delay[k]
        step = max(meal.step + round(minutes / STEP_MINUTES), 0)
        carbs = min(habits.estimate.grams(meal.carbs_g, normal[k]), CARBS_MAX)
        if policy is Policy.MAIN_MEALS:
            told.append(Announcement(step, Kind.SIMPLE_MEAL, None, meal.step))
        else:
            kind = Kind.SNACK if meal.kind == SNACK else Kind.CARBS_ESTIMATED
            told.append(Announcement(step, kind, carbs, meal.step))
    return tuple(sorted(told, key=lambda announcement: announcement.step))


def rescue_announcement(scenario: Scenario, policy: Policy, meal: Meal) -> Announcement | None:
    """How sugar against a low is told, if it is: at once, and exactly, for it comes in known portions."""
    if scenario.rescue is None or not scenario.rescue.announced or policy is not Policy.EVERYTHING:
        return None
    return Announcement(meal.step, Kind.HYPO_TREATMENT, meal.carbs_g, meal.step)


def _is_told(meal: Meal, policy: Policy) -> bool:
    if policy is Policy.MAIN_MEALS:
        return meal.kind != SNACK
    return policy is Policy.EVERYTHING
