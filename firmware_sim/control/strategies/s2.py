"""Strategy 2: pramlintide as a fixed ratio of the insulin infusion, no announcements.

Pons Torres et al. 2025, section "Strategy 2": p_I(k) = rho u(k).
"""

from ..fixed import Ints
from ..layout import PRAM_CARRY, PRAM_RATIO


def infusion(insulin_rate: int, state: Ints, parameters: Ints) -> int:
    """Pramlintide rate for an insulin rate that has passed all limits.

    Args:
        insulin_rate: u(k) in 0.005 U/h.
        state, parameters: as in `layout`; what is below one LSB is carried in state.

    Returns:
        p_I in 0.1 ug/h (rounded down), with rho in 0.01 ug/U.
    """
    total = parameters[PRAM_RATIO] * insulin_rate + state[PRAM_CARRY]
    state[PRAM_CARRY] = total % 2000
    return total // 2000
