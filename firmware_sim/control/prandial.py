"""Prandial boluses of the main controller, and how they stay out of the feedback's way.

Pons Torres et al. 2025, section "Main controller": u_B = nu CHO / CIR at an announced meal. The non-interacting
mechanism (after Brosilow and Joseph 2002) takes the insulin that the bolus stands for out of the observer's answer to
the same meal: u_I = gamma d - x F(s) e^(-15 s) u_B, where x is the share that is taken out.
"""

from . import lags
from .fixed import Ints, round_divide, saturate
from .layout import (
    ASSUMED_CARBS,
    BOLUS_1,
    BOLUS_2,
    BOLUS_3,
    BOLUS_DEDUCTION,
    CARB_RATIO,
    FILTER_1,
    FILTER_A1,
    FILTER_A2,
    FILTER_A3,
    FILTER_B1,
    FILTER_B2,
    FILTER_B3,
    IN_BOLUS,
    IN_CARBS,
    IN_MEAL,
    IN_MODE,
    MEAL_CARBS,
    MEAL_FACTOR,
    MEAL_NONE,
    MEAL_SIMPLE,
    MODE_MA,
    MODE_S3,
    MODE_S4,
    MODE_SMA,
    SATURATIONS,
)  # fmt: skip


def deduction(state: Ints, parameters: Ints, inputs: Ints) -> int:
    """Advance F e^(-15 s) by one sample of the bolus insulin that was delivered.

    Args:
        state, parameters, inputs: integer arrays laid out as in `layout`; state is advanced in place.

    Returns:
        x F e^(-15 s) u_B in 0.005 U/h, 16 fractional bits.
    """
    p = parameters
    filtered = lags.advance(
        state, FILTER_1, state[BOLUS_3],
        p[FILTER_A1], p[FILTER_A2], p[FILTER_A1], p[FILTER_A3], p[FILTER_A2], p[FILTER_A1],
        p[FILTER_B1], p[FILTER_B2], p[FILTER_B3],
    )  # fmt: skip
    state[BOLUS_3] = state[BOLUS_2]
    state[BOLUS_2] = state[BOLUS_1]
    state[BOLUS_1] = inputs[IN_BOLUS] << 14
    # x in 0.001, what was filtered in mU per 5 min with 14 bits; 12 steps in an hour, LSB 5 mU/h with 16 bits
    counts = state[SATURATIONS : SATURATIONS + 1]
    taken = saturate(round_divide(p[BOLUS_DEDUCTION] * filtered * 48, 5000), counts)
    state[SATURATIONS] = counts[0]
    return taken


def announced_carbs(parameters: Ints, inputs: Ints) -> int:
    """Carbohydrate (0.5 g) that the mode doses for the meal announced in this step; 0 = it asks for no bolus.

    With meal announcements (MA, strategy 3) every meal and snack counts with its grams, and one told by its time alone
    with the assumed ones. With simplified announcements (SMA, strategy 4) every meal counts with the assumed grams,
    whatever was estimated, and a snack not at all.
    """
    meal = inputs[IN_MEAL]
    mode = inputs[IN_MODE]
    if meal == MEAL_NONE:
        return 0
    if mode in (MODE_MA, MODE_S3):
        return parameters[ASSUMED_CARBS] if meal == MEAL_SIMPLE else inputs[IN_CARBS]
    if mode in (MODE_SMA, MODE_S4) and meal in (MEAL_CARBS, MEAL_SIMPLE):
        return parameters[ASSUMED_CARBS]
    return 0


def bolus(carbs: int, parameters: Ints) -> int:
    """u_B = nu CHO / CIR in 0.01 U, rounded down.

    Args:
        carbs: in 0.5 g.
        parameters: as in `layout`: nu in 0.001, CIR in 0.01 g/U.
    """
    return parameters[MEAL_FACTOR] * carbs * 5 // parameters[CARB_RATIO]
