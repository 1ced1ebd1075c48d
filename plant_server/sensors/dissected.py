"""The form that the Padova group gives the error of a sensor: calibration error and two coloured noises.

    shown = a(t) IG + b(t) + v + c          mg/dL, IG: interstitial glucose, mg/dL
    a(t) = a0 + a1 t + a2 t^2               1, t in days
    b(t) = b0 + b1 t + b2 t^2               mg/dL
    v(k) = v1 v(k-1) + v2 v(k-2) + w(k)     the sensor's own noise, w normal
    c(k) = c1 c(k-1) + c2 c(k-2) + w'(k)    the "common component", shared by sensors worn side by side

t runs from the last calibration, or from insertion for a sensor that needs none. The delay of the interstitial fluid
is in the patient, not here.

Not verified in the papers: the unit of t and the step of the two AR processes. t is read as days, as in LoopInsighT1
(MIT). For the AR step, `ar_minutes`, public codes differ: LoopInsighT1 takes one per minute; the authors' own ReplayBG
takes one per 5-min sample (for the model of `vettoretti2019.py`). 5 min, the interval at which these sensors report,
is the default. With 1 min the noise has the same standard deviation and is forgotten five times as fast.
"""

from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from can_bus.lockstep import STEP_MINUTES

from .autoregression import AR2, ArMinutes
from .model import Array, Errors, Model, Streams, Wear

Polynomial = tuple[float, float, float]


def polynomial(coefficients: Polynomial, t: Array) -> Array:
    """Coefficients of t^0, t^1 and t^2."""
    return coefficients[0] + coefficients[1] * t + coefficients[2] * t**2


class Dissected(Model):
    """Calibration error and coloured noise; the devices' numbers are in the classes derived from this one."""

    a: ClassVar[Polynomial]
    b: ClassVar[Polynomial]
    own: ClassVar[AR2]
    common: ClassVar[AR2 | None] = None

    ar_minutes: ArMinutes = 5

    def days(self, wear: Wear) -> Array:
        """The model's t at every sampling instant."""
        return wear.age_days

    def draw(self, wear: Wear, streams: Streams) -> Errors:
        """Calibration error by the clock, noise from two streams."""
        t = self.days(wear)
        offset = polynomial(self.b, t) + self.own.draw(wear.instants, streams(""), self.ar_minutes)
        variance = self.own.sd**2
        if self.common is not None:
            offset += self.common.draw(wear.instants, streams("common"), self.ar_minutes)
            variance += self.common.sd**2
        return Errors(polynomial(self.a, t), offset, np.full(wear.instants, variance**0.5))


class Calibrated(Dissected):
    """A sensor that its user calibrates with a finger stick every `calibration_hours`; t starts anew each time."""

    calibration_hours: Annotated[float, Field(gt=0, le=240)] = 12.0

    def days(self, wear: Wear) -> Array:
        """Days since the last calibration."""
        minutes = (wear.age * float(STEP_MINUTES)) % (self.calibration_hours * 60)
        return minutes / (24 * 60)
