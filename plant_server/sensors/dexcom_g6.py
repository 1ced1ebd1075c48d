"""Dexcom G6, calibrated in the factory. Equations in `dissected.py`, t from insertion.

    a = 1.048 - 0.033 t + 0.002 t^2,   b = -6.398 + 6.179 t - 0.448 t^2
    v: 1.220, -0.331, variance of w 3.641 (mg/dL)^2: 5.1 mg/dL
    c: 1.34, -0.492, variance of w' 5.538 (mg/dL)^2: 6.1 mg/dL

together 8.0 mg/dL of noise.

Source: M. Vettoretti, S. Del Favero, G. Sparacino, A. Facchinetti: Modeling the error of factory-calibrated continuous
glucose monitoring sensors: application to Dexcom G6 sensor data. Conf Proc IEEE Eng Med Biol Soc 2019,
doi:10.1109/EMBC.2019.8856790 (11 subjects with two sensors each), Tables 1 and 2, read in LoopInsighT1 (MIT). The
polynomials hold for the 10 days of a sensor; then a new one is inserted. Not modelled: differences between sensors,
for which see `vettoretti2019.py`.
"""

from typing import ClassVar, Literal

from .autoregression import AR2
from .dissected import Dissected


class DexcomG6(Dissected):
    """Dexcom G6, the average sensor."""

    name: Literal["dexcom-g6"] = "dexcom-g6"
    lifetime_days: ClassVar[float | None] = 10.0

    a = (1.048, -0.033, 0.002)
    b = (-6.398, 6.179, -0.448)
    own = AR2(1.220, -0.331, 3.641**0.5)
    common = AR2(1.34, -0.492, 5.538**0.5)
