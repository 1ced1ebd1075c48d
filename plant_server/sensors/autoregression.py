"""Coloured noise: an autoregressive process of second order, AR(2)."""

import math
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import AfterValidator

from can_bus.lockstep import STEP_MINUTES

from .model import Array

WARM_UP = 200
"""Steps left out at the beginning, so that the noise is stationary from the first sample on."""


def _one_or_five(minutes: int) -> int:
    if minutes not in (1, 5):
        raise ValueError("an AR step is 1 or 5 min")
    return minutes


ArMinutes = Annotated[int, AfterValidator(_one_or_five)]
"""Minutes per step of an AR process."""


class AR2(NamedTuple):
    """e(k) = c1 e(k-1) + c2 e(k-2) + w(k), w normal with standard deviation `drive`."""

    c1: float
    c2: float
    drive: float  # mg/dL

    @property
    def stable(self) -> bool:
        """Whether the process has a standard deviation."""
        return abs(self.c2) < 1 and abs(self.c1) < 1 - self.c2

    @property
    def sd(self) -> float:
        """Stationary standard deviation of e, mg/dL."""
        return self.drive * self.amplification

    @property
    def amplification(self) -> float:
        """Standard deviation of e over that of w."""
        return math.sqrt((1 - self.c2) / ((1 + self.c2) * ((1 - self.c2) ** 2 - self.c1**2)))

    def draw(self, count: int, generator: np.random.Generator, step_minutes: int = STEP_MINUTES) -> Array:
        """The process at `count` sampling instants, stationary from the first on.

        Args:
            count: instants, 5 min apart.
            generator: of w.
            step_minutes: minutes between k-1 and k.
        """
        every = STEP_MINUTES // step_minutes
        steps = WARM_UP + (count - 1) * every + 1
        error = [0.0, 0.0]
        before, last = 0.0, 0.0
        for w in (generator.standard_normal(steps) * self.drive).tolist()[2:]:
            before, last = last, self.c1 * last + self.c2 * before + w
            error.append(last)
        return np.array(error[WARM_UP::every])
