"""Vettoretti, Battocchio, Sparacino and Facchinetti 2019: Dexcom G6, every sensor another one.

    shown = (a0 + a1 t + a2 t^2) IG + b0 + v      mg/dL, t in days since insertion
    v(k) = alpha1 v(k-1) + alpha2 v(k-2) + w(k)   w normal with standard deviation sigma, mg/dL

(a0, a1, a2, b0, alpha1, alpha2, sigma) is drawn anew for every sensor from a normal distribution. A draw is refused
when the AR process is not stable (alpha1 + alpha2 above 0.98), sigma is not positive, or v has more than 10 mg/dL:
these rules are the authors' (ReplayBG); the one on sigma is ours.

Source of the equations and the mean: Development of an error model for a factory-calibrated continuous glucose
monitoring sensor with 10-day lifetime. Sensors 2019;19(23):5320, doi:10.3390/s19235320 (79 traces). The mean vector,
rounded to three digits, is the one that the authors' simulator ReplayBG gives with that paper as its source.

**The covariance is ours.** The authors' full matrix is public in ReplayBG, whose licence was not verified, and is not
copied. `DEVIATION` and `CORRELATION` have its order of magnitude and are chosen so that
- the gain of a sensor has a standard deviation of about 0.1 from the first day to the tenth (a1 and a2 pull against
  each other),
- alpha1 and alpha2 pull against each other, so that their sum, which sets the memory of the noise, stays near 0.86,
- the mean absolute relative error over many sensors comes to about 10 %, as in the G6's trial (Shah et al. 2018).
So trust the spread between sensors to its order of magnitude, not to its digits.
"""

from typing import ClassVar, Literal, NamedTuple

import numpy as np

from .autoregression import AR2, ArMinutes
from .dissected import polynomial
from .model import Array, Errors, Model, Streams, Wear

NAMES = ("a0", "a1", "a2", "b0", "alpha1", "alpha2", "sigma")

MEAN = np.array([0.942, 0.00494, -0.000585, 6.38, 1.260, -0.402, 3.25])
DEVIATION = np.array([0.10, 0.02, 0.002, 5.0, 0.13, 0.13, 0.8])
CORRELATION = {("a1", "a2"): -0.95, ("alpha1", "alpha2"): -0.93}

NOISE_SD_MAX = 10.0
"""mg/dL."""

STABILITY_MARGIN = 0.02


class SensorParameters(NamedTuple):
    """One sensor."""

    a0: float
    a1: float
    a2: float
    b0: float
    alpha1: float
    alpha2: float
    sigma: float

    @property
    def noise(self) -> AR2:
        """The process v."""
        return AR2(self.alpha1, self.alpha2, self.sigma)

    @property
    def possible(self) -> bool:
        """Whether there can be such a sensor."""
        if not self.noise.stable or self.alpha1 + self.alpha2 > 1 - STABILITY_MARGIN or self.sigma <= 0:
            return False
        return self.noise.sd <= NOISE_SD_MAX


def covariance() -> Array:
    """Of the seven parameters, in the order of `NAMES`."""
    correlation = np.eye(len(NAMES))
    for (one, other), value in CORRELATION.items():
        i, j = NAMES.index(one), NAMES.index(other)
        correlation[i, j] = correlation[j, i] = value
    return correlation * np.outer(DEVIATION, DEVIATION)


def draw_sensor(generator: np.random.Generator) -> SensorParameters:
    """One sensor out of the box."""
    root = np.linalg.cholesky(covariance())
    while True:
        sensor = SensorParameters(*(MEAN + root @ generator.standard_normal(len(NAMES))).tolist())
        if sensor.possible:
            return sensor


class Vettoretti2019(Model):
    """Dexcom G6, a new draw for every sensor worn."""

    name: Literal["vettoretti"] = "vettoretti"
    lifetime_days: ClassVar[float | None] = 10.0

    ar_minutes: ArMinutes = 5

    def draw(self, wear: Wear, streams: Streams) -> Errors:
        """Parameters and noise of every sensor from streams of its own."""
        errors = Errors(*np.zeros((3, wear.instants)))
        days = wear.age_days
        for session in np.unique(wear.session).tolist():
            worn = wear.session == session
            sensor = draw_sensor(streams(f"sensor {session}"))
            errors.gain[worn] = polynomial((sensor.a0, sensor.a1, sensor.a2), days[worn])
            noise = sensor.noise.draw(int(worn.sum()), streams(f"noise {session}"), self.ar_minutes)
            errors.offset[worn] = sensor.b0 + noise
            errors.noise_sd[worn] = sensor.noise.sd
        return errors
