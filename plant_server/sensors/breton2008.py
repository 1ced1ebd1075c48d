"""Breton and Kovatchev 2008: an AR(1) every 15 min through a Johnson SU distribution.

    e(0) = v(0),   e(n) = 0.7 (e(n-1) + v(n)),   v normal with standard deviation 1, one step per 15 min
    error(n) = xi + lambda sinh((e(n) - gamma) / delta)      mg/dL

between two knots of 15 min the error is a straight line. xi = -5.471 mg/dL, lambda = 15.9574 mg/dL, gamma = -0.5444,
delta = 1.6898. The error at the knots has mean 0.7 and standard deviation 11.7 mg/dL (measured sensors: 0.76 and 11).

Source: M. Breton, B. Kovatchev: Analysis, modeling, and simulation of the accuracy of continuous glucose sensors. J
Diabetes Sci Technol 2008;2(5):853-862, PMC2740661 (FreeStyle Navigator); lambda to four decimals as in simglucose
(MIT). Left out: the paper's lag of the sensor (add the effect `lag`), and the moving average that some simulators lay
over the lines.
"""

from typing import Literal

import numpy as np

from can_bus.lockstep import STEP_MINUTES

from .model import Errors, Model, Streams, Wear, additive

PACF = 0.7
KNOT_MINUTES = 15
XI, LAMBDA, GAMMA, DELTA = -5.471, 15.9574, -0.5444, 1.6898

GRID = float(1 << 24)
"""Steps of sinh in 1; far below what a reading shows."""

STATIONARY_SD = 11.73
"""mg/dL at the knots: e has the variance 0.49 / 0.51."""


class Breton2008(Model):
    """Non-white and non-Gaussian noise."""

    name: Literal["breton"] = "breton"

    def draw(self, wear: Wear, streams: Streams) -> Errors:
        """Noise alone."""
        generator = streams("")
        knots = wear.instants * STEP_MINUTES // KNOT_MINUTES + 2
        v = generator.standard_normal(knots).tolist()
        e = [v[0]]
        for drive in v[1:]:
            e.append(PACF * (e[-1] + drive))
        # numpy's sinh differs in the last bits between processors; the grid makes the same bytes of the same seed
        error = XI + LAMBDA * np.round(np.sinh((np.array(e) - GAMMA) / DELTA) * GRID) / GRID
        at = np.arange(wear.instants) * STEP_MINUTES
        return additive(np.interp(at, np.arange(knots) * float(KNOT_MINUTES), error), STATIONARY_SD)
