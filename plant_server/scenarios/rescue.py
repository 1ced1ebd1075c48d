"""Sugar against a low: the person eats when plasma glucose has been low for some samples, and then waits.

Pons Torres et al. 2025 simulate none; it is off unless a scenario asks for it. The defaults follow the "rule of 15" of
diabetes education (15 g, then wait), with a wait of 30 min because the simulated sugar takes that long (assumed).
"""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from can_bus.lockstep import STEP_MINUTES, STEPS_PER_DAY

RESCUE_EATING_MINUTES = 5
"""Sugar is eaten faster than a meal."""


class Rescue(BaseModel):
    """The rule.

    Attributes:
        below: mg/dL of plasma glucose that is felt as low.
        samples: in a row, until something is eaten.
        carbs: g eaten.
        lockout_minutes: until anything more is eaten.
        announced: told to the device as HypoTreatment, in the modes that announce every meal.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    below: Annotated[float, Field(ge=20, le=100)] = 60.0
    samples: Annotated[int, Field(ge=1, le=STEPS_PER_DAY)] = 3
    carbs: Annotated[float, Field(gt=0, le=100)] = 15.0
    lockout_minutes: Annotated[float, Field(ge=0, le=1440)] = 30.0
    announced: bool = False


class Rescuer:
    """The person, watching for a low."""

    def __init__(self, rule: Rescue) -> None:
        self.rule = rule
        self._low = 0
        self._eaten: int | None = None

    def carbs(self, step: int, glucose: float) -> float:
        """Grams eaten at sampling instant `step`, at a plasma glucose in mg/dL; to be asked once per instant."""
        self._low = self._low + 1 if glucose < self.rule.below else 0
        waited = self._eaten is None or (step - self._eaten) * STEP_MINUTES >= self.rule.lockout_minutes
        if self._low < self.rule.samples or not waited:
            return 0.0
        self._eaten = step
        return self.rule.carbs
