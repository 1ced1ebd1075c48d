"""Continuous glucose sensors: interstitial glucose plus an error with a memory.

An error model gives the error of every sample of a run in advance, so that all strategies meet the same realisation.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from .streams import stream

Array = npt.NDArray[np.float64]

RANGE = (40.0, 400.0)
"""mg/dL a sensor shows; beyond, it reports BelowRange or AboveRange (usual range of a commercial CGM)."""

STATE_OK, STATE_BELOW_RANGE, STATE_ABOVE_RANGE = 1, 4, 5
"""CGM_Reading.CgmState."""

SAMPLE_MINUTES = 5

AR_1, AR_2 = 1.220, -0.331
"""AR(2) of the Dexcom G6 error (Vettoretti et al. 2019, sensor part), taken per 5-min sample."""

COLOURED_SD = 5.0
"""mg/dL, standard deviation of the coloured error used for the study (identified for this project)."""


class Sample(NamedTuple):
    """What the sensor says."""

    state: int  # CgmState
    glucose: float  # mg/dL


def ideal(count: int, generator: np.random.Generator) -> Array:
    """No error."""
    return np.zeros(count)


def coloured(count: int, generator: np.random.Generator) -> Array:
    """Gaussian AR(2) error of standard deviation `COLOURED_SD`, stationary from the first sample on."""
    variance = (1 - AR_2) / ((1 + AR_2) * ((1 - AR_2) ** 2 - AR_1**2))
    drive = COLOURED_SD / np.sqrt(variance)
    warm_up = 200
    noise = generator.standard_normal(count + warm_up) * drive
    error = np.zeros(count + warm_up)
    for k in range(2, count + warm_up):
        error[k] = AR_1 * error[k - 1] + AR_2 * error[k - 2] + noise[k]
    return error[warm_up:]


XI, LAMBDA, GAMMA, DELTA = -5.471, 15.9574, -0.5444, 1.6898
"""Johnson SU parameters of Breton and Kovatchev 2008, mg/dL."""


def breton(count: int, generator: np.random.Generator) -> Array:
    """Breton and Kovatchev 2008: an AR(1) every 15 min through a Johnson SU distribution, interpolated between."""
    knots = count * SAMPLE_MINUTES // 15 + 2
    e = np.empty(knots)
    e[0] = generator.standard_normal()
    for k in range(1, knots):
        e[k] = 0.7 * (e[k - 1] + generator.standard_normal())
    error = XI + LAMBDA * np.sinh((e - GAMMA) / DELTA)
    return np.interp(np.arange(count) * SAMPLE_MINUTES, np.arange(knots) * 15.0, error)


MODELS: dict[str, Callable[[int, np.random.Generator], Array]] = {
    "ideal": ideal,
    "coloured": coloured,
    "breton": breton,
}


class SensorError(ValueError):
    """There is no such sensor model."""


class Sensor:
    """One sensor on one patient over one run."""

    def __init__(self, model: str, count: int, seed: int, patient: str) -> None:
        """Draw the errors of `count` samples.

        Raises:
            SensorError: the model is none of `MODELS`.
        """
        if model not in MODELS:
            raise SensorError(f"there is no sensor {model!r}; choose one of {', '.join(MODELS)}")
        self._error = MODELS[model](count, stream(seed, patient, "cgm"))

    def sample(self, step: int, interstitial: float) -> Sample:
        """The reading at sampling instant `step` of interstitial glucose in mg/dL."""
        glucose = interstitial + float(self._error[step])
        if glucose < RANGE[0]:
            return Sample(STATE_BELOW_RANGE, RANGE[0])
        if glucose > RANGE[1]:
            return Sample(STATE_ABOVE_RANGE, RANGE[1])
        return Sample(STATE_OK, glucose)
