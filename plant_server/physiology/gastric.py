"""Meal: stomach, intestine, and the glucose that appears in plasma.

Dalla Man 2006 with the pramlintide effect of Pons Torres 2025 (meal model with the factor η). η slows the
emptying of the ground phase only; grinding (Qsto1') keeps its rate, as printed.
"""

import math

from . import parameters as par
from . import states as st
from .compiled import READS, WRITES, Array, compiled, entry_point, float64, void

LEAST_MEAL = 1e-9
"""mg; less is no meal (and α of a meal of 1e-320 mg would be infinite)."""


@compiled
def k_empt(q_sto: float, meal: float, k_max: float, k_min: float, b: float, c: float) -> float:
    """Rate of gastric emptying, 1/min: k_max with a full or empty stomach, slower in between.

    k_empt = k_min + (k_max - k_min)/2 · {tanh[α(Qsto - bD)] - tanh[β(Qsto - cD)] + 2},
    α = 5/(2D(1-b)), β = 5/(2Dc) (Pons Torres 2025, meal model). Written with
    tanh z = 1 - 2/(1 + exp 2z), which costs half as much.
    """
    if meal < LEAST_MEAL:
        return k_max
    alpha = 5.0 / (2.0 * meal * (1.0 - b))
    beta = 5.0 / (2.0 * meal * c)
    slowing = 1.0 / (1.0 + math.exp(2.0 * alpha * (q_sto - b * meal)))
    recovery = 1.0 / (1.0 + math.exp(2.0 * beta * (q_sto - c * meal)))
    return k_min + (k_max - k_min) * (1.0 - slowing + recovery)


@compiled
def steepness(meal: float, b: float, c: float) -> float:
    """The greater of α and β, 1/mg: how fast k_empt switches as the stomach fills."""
    if meal < LEAST_MEAL:
        return 0.0
    return 5.0 / (2.0 * meal * min(1.0 - b, c))


SMALLEST_MEAL = 1000.0
"""mg; the small-meal rule treats a meal below this size as one of this size, else its rate would know no bound."""


@compiled
def small_meal_factor(meal: float, limit: float) -> float:
    """Emptying of meals below `limit` mg is limit/D times faster (T1DMS, undocumented; LoopInsighT1, MIT)."""
    if meal < LEAST_MEAL or meal >= limit:
        return 1.0
    return limit / max(meal, SMALLEST_MEAL)


@compiled
def gastric_derivatives(x: Array, p: Array, eating: float, eta: float, dx: Array) -> float:
    """Write Qsto1', Qsto2', Qgut' (mg/min) and return the rate of appearance Ra (mg/kg/min).

    `eating` is Ug in mg/min.
    """
    q_sto1 = x[st.Q_STO1]
    q_sto2 = x[st.Q_STO2]
    q_gut = x[st.Q_GUT]

    meal = x[st.D]
    k = k_empt(q_sto1 + q_sto2, meal, p[par.K_MAX], p[par.K_MIN], p[par.B], p[par.C])

    grinding = p[par.K_MAX] * q_sto1
    emptying = eta * k * small_meal_factor(meal, p[par.SMALL_MEAL]) * q_sto2
    absorption = p[par.K_ABS] * q_gut

    dx[st.Q_STO1] = eating - grinding
    dx[st.Q_STO2] = grinding - emptying
    dx[st.Q_GUT] = emptying - absorption
    appearance: float = p[par.F] * absorption / p[par.BW]
    return appearance


@entry_point(void, WRITES, READS, float64)
def begin_meal(x: Array, p: Array, carbs_mg: float) -> None:
    """Start a meal of `carbs_mg` (mg): D = what is still in the stomach + the new meal.

    The food itself arrives through `advance`, as it is eaten.
    """
    if not 0.0 <= carbs_mg < math.inf:
        raise ValueError("a meal has zero or more mg of carbohydrate")
    x[st.D] = x[st.Q_STO1] + x[st.Q_STO2] + carbs_mg


@entry_point(float64, READS, READS)
def q_sto(x: Array, p: Array) -> float:
    """Carbohydrate in the stomach, mg."""
    content: float = x[st.Q_STO1] + x[st.Q_STO2]
    return content


@entry_point(float64, READS, READS)
def rate_of_appearance(x: Array, p: Array) -> float:
    """Glucose appearing in plasma from the meal, mg/kg/min: f·kabs·Qgut/BW."""
    appearance: float = p[par.F] * p[par.K_ABS] * x[st.Q_GUT] / p[par.BW]
    return appearance
