"""Strategy 3: a fixed pramlintide bolus with every announced meal.

Pons Torres et al. 2025, section "Strategy 3": p_B(k) = phi if CHO(k) > 0, no pramlintide infusion.
"""

from ..fixed import Ints
from ..layout import PRAM_BOLUS


def dose(parameters: Ints) -> int:
    """Phi in 0.1 ug."""
    return parameters[PRAM_BOLUS]
