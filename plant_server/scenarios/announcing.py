"""How the person tells the device of meals: estimates, forgotten meals, meals told late or ahead of time."""

from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from .misestimation import AnyEstimate, Exact

OFFSET_MAX = 60
"""Minutes between a meal and its announcement that MEAL_Announce.MealOffset can tell."""


def _interval(value: tuple[float, float]) -> tuple[float, float]:
    if not 0 <= value[0] <= value[1] <= OFFSET_MAX:
        raise ValueError(f"a delay is [least, most] within 0 to {OFFSET_MAX} min")
    return value


Probability = Annotated[float, Field(ge=0, le=1)]


class Late(BaseModel):
    """With `probability` a meal is told late, by a delay spread evenly over `minutes`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    probability: Probability
    minutes: Annotated[tuple[float, float], AfterValidator(_interval)] = (10.0, 40.0)


class Announcing(BaseModel):
    """Habits of the person.

    Attributes:
        estimate: of the carbohydrate; `exact` turns misestimation off.
        missed: probability that a meal is never told.
        late: see `Late`.
        ahead_minutes: every meal that is not late is told so long before it starts.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    estimate: AnyEstimate = Exact()
    missed: Probability = 0.0
    late: Late | None = None
    ahead_minutes: Annotated[float, Field(ge=0, le=OFFSET_MAX)] = 0.0
