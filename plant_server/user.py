"""The user between the meals and the device: tells of each meal until the device has heard it."""

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from can_bus.codec import Transmitter
from can_bus.frame import Frame
from can_bus.lockstep import STEP_MINUTES

from .scenario import Announcement, Meal, Scenario, announcements, policy_of, rescue_announcement
from .scenarios.announcing import OFFSET_MAX

IDS = 255
"""MealId runs from 0 to 254; 255 is SNA."""

PATIENCE = 12
"""Steps after which the user gives up on a device that does not echo a meal."""


class Plan(NamedTuple):
    """What holds from a sampling instant on, until the next plan does."""

    step: int
    mode: int  # CtrlMode
    scenario: Scenario  # the whole one; its meals before `step` are those of the plan before


class User:
    """Announces the meals of a run, one at a time, each repeated in every step until it is echoed.

    Args:
        plans: in order of time, the first from instant 0 on; the mode decides what is told at all.
        seed: of the run.
        patient: name of the virtual patient.
    """

    def __init__(self, plans: Sequence[Plan], seed: int, patient: str) -> None:
        self._plans = deque(plans)
        self._take_up(self._plans.popleft())
        self._planned = deque(_announcements(plans, seed, patient))
        self._waiting: deque[Announcement] = deque()  # due, the first one is being told
        self._number = 0  # MealId of the first one
        self._since: int | None = None

    def _take_up(self, plan: Plan) -> None:
        self._scenario = plan.scenario
        self._policy = policy_of(plan.mode)

    def hear(self, last_meal: int) -> None:
        """The device has echoed a MealId."""
        if self._since is not None and last_meal == self._number:
            self._next()

    def _next(self) -> None:
        self._waiting.popleft()
        self._number = (self._number + 1) % IDS
        self._since = None

    def announce(self, step: int, rescued: Meal | None, transmitter: Transmitter) -> list[Frame]:
        """What is told in instant `step`; `rescued` is sugar that was eaten just now."""
        while self._plans and self._plans[0].step <= step:
            self._take_up(self._plans.popleft())
        while self._planned and self._planned[0].step <= step:
            self._waiting.append(self._planned.popleft())
        sugar = None if rescued is None else rescue_announcement(self._scenario, self._policy, rescued)
        if sugar is not None:
            self._waiting.append(sugar)
        if self._since is not None and step - self._since >= PATIENCE:
            self._next()
        if not self._waiting:
            return []
        meal = self._waiting[0]
        if self._since is None:
            self._since = step
        offset = min(max((meal.meal_step - step) * STEP_MINUTES, -OFFSET_MAX), OFFSET_MAX)
        carbs = {} if meal.carbs_g is None else {"CarbsEst": round(meal.carbs_g * 2)}
        return [transmitter.frame("MEAL_Announce", MealKind=meal.kind, MealId=self._number, MealOffset=offset, **carbs)]


def _announcements(plans: Sequence[Plan], seed: int, patient: str) -> list[Announcement]:
    """What each plan tells while it holds; a meal to come that should have been told of before is told of at once."""
    told: list[Announcement] = []
    for plan, following in zip(plans, [*plans[1:], None], strict=True):
        known = {each.meal_step for each in told}
        for each in announcements(plan.scenario, policy_of(plan.mode), seed, patient):
            overdue = each.step < plan.step <= each.meal_step and each.meal_step not in known
            step = plan.step if overdue else each.step
            if plan.step <= step and (following is None or step < following.step):
                told.append(each._replace(step=step))
    return sorted(told, key=lambda each: each.step)
