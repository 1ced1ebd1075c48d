"""Meals of everyday life, drawn from the families of Camerlingo et al. 2021.

Breakfast at T_B, lunch T_BL later, dinner T_LD after that, with amounts B, L, D; parameters in `data/camerlingo.csv`,
whose header says where they are from. The paper's validation scenario (Pons Torres et al. 2025, supplement, Table 2)
is one such draw, of 14 days, and what the parameters were fitted to.

Assumed, because no source is public: the number of snacks a day is drawn from the counts of that table (6 days of 14
without, 2 with one, 4 with two, 2 with four; Camerlingo et al. classify with an SVM), their times are even between
half an hour after breakfast and three hours after dinner; intervals are at least one hour, amounts within 2 to 200 g.
"""

import csv
import functools
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..streams import stream
from .announcing import Announcing
from .meals import MAIN_MEALS, MINUTES_PER_DAY, SNACK, Scenario, planned
from .misestimation import Kawamura

DATA = Path(__file__).with_name("data") / "camerlingo.csv"

SNACKS_PER_DAY = (6 / 14, 2 / 14, 4 / 14, 0.0, 2 / 14)
"""Probability of 0, 1, .. snacks."""

SNACKS_FROM_H, SNACKS_UNTIL_H = 0.5, 3.0
"""After breakfast, after dinner."""

INTERVAL_LEAST_H = 1.0
AMOUNT_RANGE_G = (2.0, 200.0)


class Distribution(NamedTuple):
    """A distribution in the parametrisation of scipy.stats."""

    family: str
    shape: float
    loc: float
    scale: float

    def quantile(self, share: float) -> float:
        """The value that a `share` of all draws stays below."""
        return self.loc + self.scale * _STANDARD[self.family](max(share, 2.0**-54), self.shape)


def _gamma(share: float, shape: float) -> float:
    from scipy.special import gammaincinv  # noqa: PLC0415  only this scenario needs it, and a run is to start quickly

    return float(gammaincinv(shape, share))


def _lognormal(share: float, shape: float) -> float:
    from scipy.special import ndtri  # noqa: PLC0415

    return float(np.exp(shape * ndtri(share)))


_STANDARD: dict[str, Callable[[float, float], float]] = {
    "gamma": _gamma,
    "lognorm": _lognormal,
    "fisk": lambda share, shape: (share / (1 - share)) ** (1 / shape),
    "genextreme": lambda share, shape: (1 - (-np.log(share)) ** shape) / shape,
}


@functools.cache
def distributions() -> dict[str, Distribution]:
    """By quantity: B, L, D, S in g, T_B, T_BL, T_LD in h."""
    lines = [line for line in DATA.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    return {
        row["quantity"]: Distribution(row["family"], float(row["shape"]), float(row["loc"]), float(row["scale"]))
        for row in csv.DictReader(lines)
    }


def camerlingo(seed: int, patient: str, days: int) -> Scenario:
    """A draw of any length; that of fewer days is the beginning of that of more."""

    def quantiles(quantity: str, columns: int = 1) -> list[list[float]]:
        shares = stream(seed, patient, f"camerlingo {quantity}").random((days, columns)).tolist()
        return [[distributions()[quantity].quantile(share) for share in row] for row in shares]

    def grams(amount: float) -> float:
        return min(max(amount, AMOUNT_RANGE_G[0]), AMOUNT_RANGE_G[1])

    most = len(SNACKS_PER_DAY) - 1
    amounts = [quantiles(quantity) for quantity in ("B", "L", "D")]
    snacks = quantiles("S", most)
    breakfast, to_lunch, to_dinner = quantiles("T_B"), quantiles("T_BL"), quantiles("T_LD")
    counts = np.searchsorted(
        np.cumsum(SNACKS_PER_DAY), stream(seed, patient, "camerlingo snacks").random(days), "right"
    )
    when = stream(seed, patient, "camerlingo T_S").random((days, most)).tolist()

    meals = []
    for day in range(days):
        hours = [breakfast[day][0]]
        for interval in (to_lunch[day][0], to_dinner[day][0]):
            hours.append(hours[-1] + max(interval, INTERVAL_LEAST_H))
        for kind, hour, amount in zip(MAIN_MEALS, hours, amounts, strict=True):
            meals.append((day * MINUTES_PER_DAY + 60 * hour, kind, grams(amount[day][0])))
        begin, end = hours[0] + SNACKS_FROM_H, hours[-1] + SNACKS_UNTIL_H
        for k in range(min(counts[day], most)):
            hour = begin + (end - begin) * when[day][k]
            meals.append((day * MINUTES_PER_DAY + 60 * hour, SNACK, grams(snacks[day][k])))
    return Scenario("camerlingo", days, planned(meals, days), Announcing(estimate=Kawamura()))
