"""What an error model of a glucose sensor is given, and what it answers."""

from collections.abc import Callable
from typing import ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict

from can_bus.lockstep import STEPS_PER_DAY

Array = npt.NDArray[np.float64]

Streams = Callable[[str], np.random.Generator]
"""A generator for every purpose: "" is the model's first, another word is another, independent stream."""


class Wear(NamedTuple):
    """Which sensor is worn at every sampling instant of a run, and for how long."""

    session: npt.NDArray[np.int64]  # number of the sensor, 0, 1, ...
    age: npt.NDArray[np.int64]  # instants since it was inserted

    @property
    def instants(self) -> int:
        """Sampling instants of the run."""
        return len(self.session)

    @property
    def age_days(self) -> Array:
        """Days since the sensor worn at each instant was inserted."""
        return self.age / STEPS_PER_DAY

    @classmethod
    def whole_run(cls, count: int) -> "Wear":
        """One sensor from the first instant to the last."""
        return cls(np.zeros(count, np.int64), np.arange(count))


class Errors(NamedTuple):
    """One realisation: gain * interstitial glucose + offset at every sampling instant, shown by the sensor or not."""

    gain: Array  # 1
    offset: Array  # mg/dL, the noise included
    noise_sd: Array  # mg/dL, standard deviation of the random part


class Model(BaseModel):
    """A model of the error with its parameters; compares, prints and hashes as a value."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    lifetime_days: ClassVar[float | None] = None
    """How long such a sensor is worn; None where the model has no age."""

    def draw(self, wear: Wear, streams: Streams) -> Errors:
        """One realisation; that of a shorter run is the beginning of that of a longer one.

        Args:
            wear: which sensor is worn when.
            streams: a generator for every purpose.
        """
        raise NotImplementedError


def additive(error: Array, sd: float) -> Errors:
    """Errors of a model that only adds."""
    return Errors(np.ones(len(error)), error, np.full(len(error), sd))
