"""The patient between the pump and the sensor: what is eaten, how the body varies, where its state is."""

from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt

from can_bus.lockstep import STEP_MINUTES

from . import mechanism, physiology
from .physiology import Patient, Variability
from .scenario import EATING_MINUTES, RESCUE, RESCUE_EATING_MINUTES, Meal, Rescuer
from .user import Plan


class Body:
    """The patient over one run.

    Args:
        patient: at rest.
        plans: what is eaten, in order of time; the last one has all meals.
        steps: of the run.
        seed, variability: see `physiology.Variability`.

    Attributes:
        rescued: sugar eaten at this instant.
    """

    def __init__(
        self, patient: Patient, plans: Sequence[Plan], steps: int, seed: int, variability: Iterable[str]
    ) -> None:
        self._nominal = patient.params
        self._x = patient.x0.copy()
        self._variability = Variability(seed, patient.name, variability)
        self._p = self._variability.apply(self._nominal)
        scenario = plans[-1].scenario
        self._meals = scenario.meals_by_step()
        self._rules = {plan.step: plan.scenario.rescue for plan in plans}
        self._rescuer: Rescuer | None = None
        self._carbs = np.zeros((steps, mechanism.SUBSTEPS))  # mg eaten in every 30-s step of the run
        for meal in scenario.meals:
            self._eat(meal, EATING_MINUTES)
        self._meal_index = 0
        self.rescued: Meal | None = None

    def _eat(self, meal: Meal, minutes: int) -> None:
        """Put a meal on the table; it is eaten evenly over `minutes`."""
        substeps = int(minutes / physiology.STEP_MIN)
        start = meal.step * mechanism.SUBSTEPS
        self._carbs.reshape(-1)[start : start + substeps] += meal.carbs_g * 1000 / substeps

    def feel(self, step: int) -> None:
        """Eat sugar at this instant if glucose has been low for long enough."""
        rule = self._rules.get(step)
        if step in self._rules and rule != (self._rescuer and self._rescuer.rule):
            self._rescuer = None if rule is None else Rescuer(rule)
        carbs = self._rescuer.carbs(step, self.glucose) if self._rescuer else 0.0
        self.rescued = None
        if carbs:
            meal = self.rescued = Meal(step, RESCUE, carbs)
            self._meals.setdefault(step, []).append(meal)
            self._eat(meal, RESCUE_EATING_MINUTES)

    def carbs_starting(self, step: int) -> float:
        """Carbohydrate (g) of the meals that start at this instant."""
        return sum(meal.carbs_g for meal in self._meals.get(step, ()))

    def advance(self, step: int, insulin: npt.NDArray[np.float64], pramlintide: npt.NDArray[np.float64]) -> None:
        """Integrate from instant `step` to the next one."""
        for meal in self._meals.get(step, ()):
            if meal.kind != RESCUE:  # sugar shifts no planned meal's random numbers
                self._p = self._variability.apply(self._nominal, self._variability.meal(self._meal_index), out=self._p)
                self._meal_index += 1
            physiology.begin_meal(self._x, self._p, meal.carbs_g * 1000)
        physiology.advance(self._x, self._p, float(step * STEP_MINUTES), insulin, pramlintide, self._carbs[step])

    @property
    def glucose(self) -> float:
        """mg/dL."""
        return physiology.glucose(self._x, self._p)

    @property
    def interstitial(self) -> float:
        """mg/dL."""
        return physiology.interstitial(self._x, self._p)

    @property
    def plasma_insulin(self) -> float:
        """pmol/L."""
        return physiology.plasma_insulin(self._x, self._p)

    @property
    def plasma_pramlintide(self) -> float:
        """pmol/L."""
        return physiology.plasma_pramlintide(self._x, self._p)

    @property
    def eta(self) -> float:
        """Attenuation of gastric emptying, 0 to 1."""
        return physiology.eta(self._x, self._p)

    @property
    def q_sto(self) -> float:
        """Carbohydrate in the stomach, mg."""
        return physiology.q_sto(self._x, self._p)

    @property
    def rate_of_appearance(self) -> float:
        """mg/kg/min."""
        return physiology.rate_of_appearance(self._x, self._p)
