"""Strategy 1: a fixed pramlintide bolus at a peak of the insulin infusion, no announcements.

Pons Torres et al. 2025, section "Strategy 1": p_B(k) = lambda if B_1(k) and B_2(k), with
B_1: m_u(k-1) > 0 and m_u(k) < 0; B_2: u(k) > z_1 u_b and m_G(k) > z_2 and more than z_3 steps since the last bolus.
The slopes are those of the law's own fixed-point signal: rounded to the command's resolution it would have no peaks.
"""

from ..fixed import Ints, round_divide
from ..layout import (
    BASAL,
    DEMAND,
    GLUCOSE,
    GLUCOSE_1,
    PEAK_LOCKOUT,
    PEAK_RATIO,
    PEAK_SLOPE,
    PEAK_WAIT,
    PRAM_BOLUS,
    RISING,
    TREND,
)  # fmt: skip


def peak(u: int, state: Ints, parameters: Ints) -> bool:
    """Advance the slopes by one step and tell whether B_1 and B_2 hold.

    Args:
        u: u(k) before limits and rounding, in 0.005 U/h with 16 fractional bits, not negative.
        state, parameters: as in `layout`.
    """
    falling = u < state[DEMAND]
    was_rising = state[RISING] == 1
    state[RISING] = 1 if u > state[DEMAND] else 0
    state[DEMAND] = u
    if state[PEAK_WAIT] > 0:
        state[PEAK_WAIT] -= 1
    # z_1 in 0.01, BASAL in 0.001 U/h: the product over 500 is in 0.005 U/h
    threshold = round_divide((parameters[PEAK_RATIO] * parameters[BASAL]) << 16, 500)
    # a difference of 0.1 mg/dL in 5 min is 20 times 0.001 mg/dL/min; without two samples in a row there is no slope
    steep = state[TREND] >= 2 and (state[GLUCOSE] - state[GLUCOSE_1]) * 20 > parameters[PEAK_SLOPE]
    return was_rising and falling and u > threshold and steep and state[PEAK_WAIT] == 0


def dose(state: Ints, parameters: Ints) -> int:
    """Lambda in 0.1 ug; starts the wait of z_3 steps."""
    state[PEAK_WAIT] = parameters[PEAK_LOCKOUT] + 1
    return parameters[PRAM_BOLUS]
