"""Dexcom G5, calibrated twice a day. Equations in `dissected.py`.

    a = 1.04 + 0.02 t,   b = -8.75
    v: 1.27, -0.42, variance of w 7.64 (mg/dL)^2: 6.8 mg/dL;   no common component

Source: M. Vettoretti, A. Facchinetti, G. Sparacino, C. Cobelli: Type-1 diabetes patient decision simulator for in
silico testing safety and effectiveness of insulin treatments. IEEE Trans Biomed Eng 2018;65(6):1281-1290,
doi:10.1109/TBME.2017.2746340, Tables 1 and 2, read in LoopInsighT1 (MIT). Calibration every 12 h as for the SEVEN Plus
(assumed); it matters: without it a(t) would grow by 0.14 in a week. Not modelled: differences between sensors.
"""

from typing import ClassVar, Literal

from .autoregression import AR2
from .dissected import Calibrated


class DexcomG5(Calibrated):
    """Dexcom G5, the average sensor."""

    name: Literal["dexcom-g5"] = "dexcom-g5"
    lifetime_days: ClassVar[float | None] = 7.0

    a = (1.04, 0.02, 0.0)
    b = (-8.75, 0.0, 0.0)
    own = AR2(1.27, -0.42, 7.64**0.5)
