"""The disturbance observer: which meal would explain the glucose seen, given the insulin delivered?

Pons Torres et al. 2025, section "Main controller", after Sanz et al. 2023:

    d(s) = F(s) G_d(s)^-1 [ y(s) + G_u(s) u(s) ],    u_I(s) = gamma d(s),    y = G - G_b,
    G_i(s) = K_i e^(-15 s) / ((tau_1i s + 1)^2 (tau_2i s + 1)),    F(s) = 1 / (theta s + 1)^3.

e^(+15 s) of G_d^-1 looks into the future, so the filter is realised without it: d is the meal rate filtered by F and
15 min late. G_u is three lags with an exact hold over the sample; F G_d^-1 is three sections (tau s + 1)/(theta s + 1)
by Tustin's rule, divided by K_d. u is what the pump says it delivered above the schedule, clipped or not: that is the
anti-windup.
"""

from . import lags
from .fixed import Ints, round_divide, round_shift, saturate
from .layout import (
    BASAL,
    GLUCOSE,
    IN_DELIVERED,
    IN_GLUCOSE,
    IN_RESET,
    INSULIN_A11,
    INSULIN_A21,
    INSULIN_A22,
    INSULIN_A31,
    INSULIN_A32,
    INSULIN_A33,
    INSULIN_B1,
    INSULIN_B2,
    INSULIN_B3,
    INSULIN_GAIN,
    LAG_1,
    LEAD1_B0,
    LEAD1_B1,
    LEAD2_B0,
    LEAD2_B1,
    LEAD_1,
    LEAD_2,
    LEAD_3,
    LEAD_A1,
    MEAL_GAIN,
    OBSERVER_GAIN,
    PRIMED,
    SATURATIONS,
    TARGET,
    U_1,
    U_2,
    U_3,
    V_1,
)  # fmt: skip

DELIVERED_MAX = 60000
"""mU in one step beyond which a total is not believed: 60 U, more than any limit of either side allows."""


def above_schedule(parameters: Ints, inputs: Ints, bits: int) -> int:
    """Insulin delivered in the last step above the schedule, in mU with `bits` fractional bits; 0 when not known."""
    if inputs[IN_DELIVERED] < 0:
        return 0
    delivered = min(inputs[IN_DELIVERED], DELIVERED_MAX)
    return (delivered << bits) - round_divide(parameters[BASAL] << bits, 12)


def insulin_effect(state: Ints, parameters: Ints, inputs: Ints) -> int:
    """Advance G_u by one sample and give its output, the glucose lowered by insulin above the schedule.

    Returns:
        K_u x_3(k) in 0.1 mg/dL, 10 fractional bits.
    """
    p = parameters
    lagged = lags.advance(
        state, LAG_1, state[U_3],
        p[INSULIN_A11], p[INSULIN_A21], p[INSULIN_A22], p[INSULIN_A31], p[INSULIN_A32], p[INSULIN_A33],
        p[INSULIN_B1], p[INSULIN_B2], p[INSULIN_B3],
    )  # fmt: skip
    state[U_3] = state[U_2]
    state[U_2] = state[U_1]
    state[U_1] = above_schedule(parameters, inputs, 14)
    # K_u in 0.001 mg/dL/(U/min), x_3 in mU per 5 min with 14 bits: / (1000 * 1000 * 5) * 10 and 4 bits less
    counts = state[SATURATIONS : SATURATIONS + 1]
    effect = saturate(round_divide(parameters[INSULIN_GAIN] * lagged, 500000 * 16), counts)
    state[SATURATIONS] = counts[0]
    return effect


def lead(x: int, x_last: int, y_last: int, b0: int, b1: int, a1: int, counts: Ints) -> int:
    """One section (tau s + 1)/(theta s + 1): b0 x(k) + b1 x(k-1) - a1 y(k-1), coefficients with 24 bits."""
    return saturate(round_shift(b0 * x + b1 * x_last - a1 * y_last, 24), counts)


def meal_insulin(state: Ints, parameters: Ints, inputs: Ints) -> int:
    """One step of the observer: the insulin rate that answers the estimated meal.

    Args:
        state, parameters, inputs: integer arrays laid out as in `layout`; state is advanced in place.

    Returns:
        u_I = gamma d in 0.005 U/h, 16 fractional bits; 0 before the first sample.
    """
    effect = insulin_effect(state, parameters, inputs)
    if inputs[IN_GLUCOSE] >= 0:
        state[GLUCOSE] = inputs[IN_GLUCOSE]
        if inputs[IN_RESET] == 1:
            state[PRIMED] = 0
    elif state[PRIMED] == 0:
        return 0
    counts = state[SATURATIONS : SATURATIONS + 1]
    v = saturate(((state[GLUCOSE] - parameters[TARGET]) << 10) + effect, counts)
    if state[PRIMED] == 0:
        # start every section in its steady state, so that the first sample does not look like a meal
        state[PRIMED] = 1
        state[LEAD_1] = v
        state[LEAD_2] = v
        state[LEAD_3] = v
    else:
        p = parameters
        first = lead(v, state[V_1], state[LEAD_1], p[LEAD2_B0], p[LEAD2_B1], p[LEAD_A1], counts)
        second = lead(first, state[LEAD_1], state[LEAD_2], p[LEAD1_B0], p[LEAD1_B1], p[LEAD_A1], counts)
        third = lead(second, state[LEAD_2], state[LEAD_3], p[LEAD1_B0], p[LEAD1_B1], p[LEAD_A1], counts)
        state[LEAD_1] = first
        state[LEAD_2] = second
        state[LEAD_3] = third
    state[V_1] = v
    # gamma 1e-7 U/g, LEAD_3 0.1 mg/dL with 10 bits, K_d 0.001 mg/dL/(g/min), 60 min/h, LSB 0.005 U/h with 16 bits
    rate = saturate(round_divide(parameters[OBSERVER_GAIN] * state[LEAD_3] * 192, 25 * parameters[MEAL_GAIN]), counts)
    state[SATURATIONS] = counts[0]
    return rate
