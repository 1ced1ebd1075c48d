"""How people estimate the carbohydrate of a meal; one class per model.

A model turns the true amount (g) and one standard normal number per meal into the estimate (g).
"""

from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field


class Estimate(BaseModel):
    """A model of the estimate; compares, prints and hashes as a value."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    def grams(self, carbs_g: float, z: float) -> float:
        """The estimate of `carbs_g` grams for the normal number `z`."""
        raise NotImplementedError


class Exact(Estimate):
    """No error: the switch to turn misestimation off."""

    model: Literal["exact"] = "exact"

    def grams(self, carbs_g: float, z: float) -> float:
        """The truth."""
        return carbs_g


class Kawamura(Estimate):
    """Small meals are over-, large ones underestimated, "after Kawamura 2015".

        estimate = true * max(0.2, mu(true) + sd z),    mu: 1.15 at 10 g, 1.0 at 60 g, 0.85 at 100 g and beyond

    Kawamura et al. (Clin Pediatr Endocrinol 2015;24(4):153-165, PMC4628950), whom Pons Torres et al. 2025 follow,
    report the direction and the turning point ("foods with higher than 6 Carbs", 60 g) and no formula that we could
    read: shape and numbers are **assumed** here.
    """

    model: Literal["kawamura"] = "kawamura"
    sd: Annotated[float, Field(ge=0, le=2)] = 0.2

    def grams(self, carbs_g: float, z: float) -> float:
        """Mean error by size, spread by `sd`."""
        mu = float(np.interp(carbs_g, (10.0, 60.0, 100.0), (1.15, 1.0, 0.85)))
        return carbs_g * max(0.2, mu + self.sd * z)


class Gaussian(Estimate):
    """A normal error in percent of the meal, whatever its size; not below zero.

    The form used before in the T1D patient decision simulator (Roversi et al., Diabetes Technol Ther 2020,
    doi:10.1089/dia.2019.0502). Adults' first estimates of test meals had a median error of -28 % with quartiles of -50
    and 0 % (doi:10.1055/a-1493-2324).
    """

    model: Literal["gaussian"] = "gaussian"
    mean_percent: Annotated[float, Field(ge=-100, le=100)] = 0.0
    sd_percent: Annotated[float, Field(ge=0, le=200)] = 20.0

    def grams(self, carbs_g: float, z: float) -> float:
        """Mean and spread in percent."""
        return carbs_g * max(0.0, 1 + (self.mean_percent + self.sd_percent * z) / 100)


AnyEstimate = Annotated[
    Exact | Kawamura | Gaussian,
    Field(discriminator="model"),
    BeforeValidator(lambda value: {"model": value} if isinstance(value, str) else value),
]
"""A model in a file: its name, or a mapping of its name and parameters."""
