"""The paper's tuning scenario: three meals a day, 14 days, random around a plan.

Times N(8:00, 13:00, 20:00; 20 min), amounts 35, 50, 85 g with a coefficient of variation of 30 %: Pons Torres et al.
2025, section on tuning. Taken as normal (assumed), and never below a tenth of the plan.
"""

import numpy as np

from ..streams import stream
from .announcing import Announcing
from .meals import MINUTES_PER_DAY, Scenario, planned
from .misestimation import Kawamura

DAYS = 14
PLAN = (("Breakfast", 8 * 60, 35.0), ("Lunch", 13 * 60, 50.0), ("Dinner", 20 * 60, 85.0))
TIME_SD_MIN = 20.0
CARBS_CV = 0.30
LEAST_SHARE = 0.1


def tuning(seed: int, patient: str) -> Scenario:
    """The scenario of one patient under one seed."""
    times = stream(seed, patient, "tuning times").standard_normal((DAYS, len(PLAN)))
    amounts = stream(seed, patient, "tuning amounts").standard_normal((DAYS, len(PLAN)))
    share = np.maximum(1 + CARBS_CV * amounts, LEAST_SHARE)
    meals = [
        (day * MINUTES_PER_DAY + minute + TIME_SD_MIN * float(times[day, k]), kind, carbs * float(share[day, k]))
        for day in range(DAYS)
        for k, (kind, minute, carbs) in enumerate(PLAN)
    ]
    return Scenario("tuning", DAYS, planned(meals, DAYS), Announcing(estimate=Kawamura()))
