"""The pump's motor: rates become whole strokes, and every stroke is accounted for.

For each drug, in strokes and at every instant: commanded = delivered + pending + lost. A rate fills an accumulator in
exact integer units; a full accumulator is one commanded stroke. Strokes are made on the 30-s grid of the plant.
"""

import numpy as np
import numpy.typing as npt
from numba import njit

SUBSTEPS = 10
"""30-s steps in one sampling interval."""

INSULIN_STROKE_U = 0.05
PRAMLINTIDE_STROKE_UG = 0.5

INSULIN_STROKE = 6000
"""A stroke of 0.05 U in units of 0.001 U/h for 30 s."""

PRAMLINTIDE_STROKE = 600
"""A stroke of 0.5 ug in units of 0.1 ug/h for 30 s."""

STROKES_PER_SUBSTEP = 15
"""Fastest motor: a stroke every 2 s, 1.5 U/min of insulin (the order of commercial pumps)."""

ACCUMULATED, COMMANDED, PENDING, DELIVERED, LOST = range(5)
"""Words of one drug's motor."""

Words = npt.NDArray[np.int64]


def motor() -> Words:
    """A motor at rest that has delivered nothing."""
    return np.zeros(5, dtype=np.int64)


@njit(cache=True)  # type: ignore[untyped-decorator]
def run(words: Words, rate: int, stroke: int, volume: float, out: npt.NDArray[np.float64]) -> None:
    """Run one motor for a sampling interval.

    Args:
        words: the motor, changed in place.
        rate: in the unit of which `stroke` makes one stroke within 30 s.
        stroke: `INSULIN_STROKE` or `PRAMLINTIDE_STROKE`.
        volume: of one stroke, in U or ug.
        out: gets the amount delivered within each 30-s step.
    """
    for i in range(out.size):
        words[ACCUMULATED] += rate
        strokes = words[ACCUMULATED] // stroke
        words[ACCUMULATED] -= strokes * stroke
        words[COMMANDED] += strokes
        words[PENDING] += strokes
        made = min(words[PENDING], STROKES_PER_SUBSTEP)
        words[PENDING] -= made
        words[DELIVERED] += made
        out[i] = made * volume


def ledger_closes(words: Words) -> bool:
    """Whether every stroke is accounted for."""
    return bool(words[COMMANDED] == words[DELIVERED] + words[PENDING] + words[LOST])
