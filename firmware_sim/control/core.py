"""One control step, from a CGM sample and the pump's totals to the rates and boluses of both drugs.

The core is pure arithmetic on arrays of integers: no frames, no clock, no exceptions. The same source runs as plain
Python on lists in the firmware process and compiled by numba on int64 arrays in campaigns; a test compares the two bit
by bit. What may be dosed at all (age and plausibility of the sample, state of the pump) is decided outside, by the
supervisor, and arrives here as IN_LIMIT.
"""

from .fixed import Ints, round_divide, round_shift, saturate
from .layout import (
    BOLUS_WAIT,
    GLUCOSE,
    GLUCOSE_1,
    GLUCOSE_2,
    IN_GLUCOSE,
    IN_MODE,
    IN_RESET,
    IOB_1,
    IOB_2,
    MODE_MA,
    MODE_NMA,
    MODE_OFF,
    MODE_OPEN_LOOP,
    MODE_S1,
    MODE_S2,
    MODE_S3,
    MODE_S4,
    MODE_SMA,
    OUT_BOLUS,
    OUT_DEMAND,
    OUT_IOB,
    OUT_LIMITERS,
    OUT_PRAM_BOLUS,
    OUT_PRAM_RATE,
    OUT_RATE,
    OUT_REFUSED,
    PRAM_WAIT,
    SATURATIONS,
    TREND,
)  # fmt: skip
from .limits import RATE_MAX, limit_bolus, limit_pram_bolus, limit_pram_rate, limit_rate, schedule
from .observer import above_schedule, meal_insulin
from .prandial import announced_carbs, bolus, deduction
from .strategies import s1, s2, s3, s4

__all__ = [
    "MODE_MA", "MODE_NMA", "MODE_OFF", "MODE_OPEN_LOOP", "MODE_S1", "MODE_S2", "MODE_S3", "MODE_S4", "MODE_SMA",
    "RATE_MAX", "control_step", "insulin_on_board", "limit_rate",
]  # fmt: skip

IOB_MAX = 4090

IOB_A11 = 980434429
IOB_A21 = 89130403
"""Insulin on board as two equal compartments of 55 min, so that 3 % of a bolus is left after 5 h (project's choice):
exp(-5/55) and 5/55 exp(-5/55), 30 fractional bits."""


def insulin_on_board(state: Ints, parameters: Ints, inputs: Ints) -> int:
    """Advance the insulin on board by what was delivered above the schedule; in 0.01 U, never below zero."""
    counts = state[SATURATIONS : SATURATIONS + 1]
    one = state[IOB_1]
    two = state[IOB_2]
    state[IOB_2] = saturate(round_shift(IOB_A21 * one + IOB_A11 * two, 30), counts)
    state[IOB_1] = saturate(round_shift(IOB_A11 * one, 30) + above_schedule(parameters, inputs, 8), counts)
    state[SATURATIONS] = counts[0]
    return min(max(round_divide(state[IOB_1] + state[IOB_2], 2560), 0), IOB_MAX)


def follow_trend(state: Ints, inputs: Ints) -> None:
    """Shift the last samples, before the observer takes the new one; a missing sample or a new start ends the row."""
    if inputs[IN_GLUCOSE] < 0 or inputs[IN_RESET] == 1:
        state[TREND] = 0
    if inputs[IN_GLUCOSE] >= 0:
        state[GLUCOSE_2] = state[GLUCOSE_1]
        state[GLUCOSE_1] = state[GLUCOSE]
        state[TREND] = min(state[TREND] + 1, 3)


def wait(state: Ints) -> None:
    """One step less to wait for the next bolus."""
    if state[BOLUS_WAIT] > 0:
        state[BOLUS_WAIT] -= 1
    if state[PRAM_WAIT] > 0:
        state[PRAM_WAIT] -= 1


def control_step(state: Ints, parameters: Ints, inputs: Ints, outputs: Ints) -> None:
    """Run one sampling instant.

    Args:
        state, parameters, inputs, outputs: arrays of integers laid out as in `layout` (lists in plain Python, int64
            arrays when compiled); state and outputs are written.
    """
    mode = inputs[IN_MODE]
    outputs[OUT_LIMITERS] = 0
    outputs[OUT_IOB] = insulin_on_board(state, parameters, inputs)
    wait(state)
    follow_trend(state, inputs)
    meal = meal_insulin(state, parameters, inputs)
    taken = deduction(state, parameters, inputs)
    demand = schedule(parameters)
    if mode == MODE_OFF:
        demand = 0
    elif mode != MODE_OPEN_LOOP:
        counts = state[SATURATIONS : SATURATIONS + 1]
        demand = saturate(demand + meal - taken, counts)
        state[SATURATIONS] = counts[0]
    outputs[OUT_DEMAND] = demand
    peak = s1.peak(max(demand, 0), state, parameters)

    dose = 0
    carbs = announced_carbs(parameters, inputs)
    if carbs > 0:
        dose = limit_bolus(bolus(carbs, parameters), state, parameters, inputs, outputs)
    outputs[OUT_BOLUS] = dose
    outputs[OUT_REFUSED] = 1 if carbs > 0 and dose == 0 else 0

    wanted = 0
    if mode == MODE_S1 and peak:
        wanted = s1.dose(state, parameters)
    elif mode == MODE_S3 and dose > 0:
        wanted = s3.dose(parameters)
    elif mode == MODE_S4 and dose > 0:
        wanted = s4.dose(dose, parameters)
    outputs[OUT_PRAM_BOLUS] = limit_pram_bolus(wanted, state, parameters, inputs, outputs)

    outputs[OUT_RATE] = limit_rate(demand, dose, state, parameters, inputs, outputs)
    outputs[OUT_PRAM_RATE] = 0
    if mode in (MODE_S2, MODE_S4):
        infusion = s2.infusion(outputs[OUT_RATE], state, parameters)
        outputs[OUT_PRAM_RATE] = limit_pram_rate(infusion, outputs[OUT_PRAM_BOLUS], inputs, outputs)
