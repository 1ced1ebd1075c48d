"""Strategy 4: pramlintide as a fixed ratio of infusion and bolus, simplified announcements.

Pons Torres et al. 2025, section "Strategy 4": p_I(k) = delta (u_I(k) + u_b(k)), which is strategy 2's infusion, and
p_B(k) = delta u_B(k).
"""

from ..fixed import Ints
from ..layout import PRAM_RATIO


def dose(insulin_bolus: int, parameters: Ints) -> int:
    """Pramlintide bolus in 0.1 ug, rounded down, for an insulin bolus in 0.01 U that has passed all limits."""
    return parameters[PRAM_RATIO] * insulin_bolus // 1000
