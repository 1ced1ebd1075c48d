"""Facchinetti 2014: the Dexcom SEVEN Plus, calibrated twice a day. Equations in `dissected.py`.

    a = 1.1 + 0.0002 t,   b = -14.8 + 0.04 t
    v: 1.013, -0.2135, variance of w 14.45 (mg/dL)^2: 7.1 mg/dL
    c: 1.23, -0.3995, variance of w' 11.3 (mg/dL)^2: 7.7 mg/dL

together 10.4 mg/dL of noise; without noise the sensor is right at 148 mg/dL and 10 mg/dL too low at 50.

Source: A. Facchinetti, S. Del Favero, G. Sparacino, J.R. Castle, W.K. Ward, C. Cobelli: Modeling the glucose sensor
error. IEEE Trans Biomed Eng 2014;61(3):620-629, doi:10.1109/TBME.2013.2284023, Table 1 and eqs. (13), (14), read in
LoopInsighT1 (MIT). Calibration every 12 h: such models hold between two calibrations (Vettoretti et al., Sensors
2019;19(23):5320). Not modelled: differences between sensors.
"""

from typing import ClassVar, Literal

from .autoregression import AR2
from .dissected import Calibrated


class Facchinetti2014(Calibrated):
    """Dexcom SEVEN Plus, the average sensor."""

    name: Literal["facchinetti"] = "facchinetti"
    lifetime_days: ClassVar[float | None] = 7.0

    a = (1.1, 2e-4, 0.0)
    b = (-14.8, 0.04, 0.0)
    own = AR2(1.013, -0.2135, 14.45**0.5)
    common = AR2(1.23, -0.3995, 11.3**0.5)
