"""A figure of the benchmark: a median of some runs beside its ceiling, or its peer."""

from statistics import median
from typing import TypedDict


class Figure(TypedDict):
    """One line of the benchmark: a median of `runs` runs beside its ceiling; `ratio` 1 is the ceiling."""

    name: str
    value: float
    unit: str
    ceiling: float
    ratio: float
    runs: int


def figure(name: str, unit: str, ours: list[float], bare: list[float], *, lower: bool = False) -> Figure:
    """Medians of both, and their ratio; `lower`: the smaller value is the better one."""
    value, ceiling = median(ours), median(bare)
    ratio = ceiling / value if lower else value / ceiling
    return Figure(
        name=name,
        value=round(value, 2),
        unit=unit,
        ceiling=round(ceiling, 2),
        ratio=round(ratio, 3),
        runs=len(ours),
    )
