"""One control step, from a CGM sample and the pump's totals to the rates of both drugs.

The core is pure arithmetic on arrays of integers: no frames, no clock, no exceptions. The same source runs as plain
Python on lists in the firmware process and compiled by numba on int64 arrays in campaigns; a test compares the two bit
by bit. What may be dosed at all (age and plausibility of the sample, state of the pump) is decided outside, by the
supervisor, and arrives here as IN_LIMIT.
"""

from .fixed import Ints, round_divide, round_shift, saturate
from .layout import (
    BASAL,
    IN_GLUCOSE,
    IN_LIMIT,
    IN_MODE,
    IOB_1,
    IOB_2,
    LIMIT_SCHEDULE,
    LIMIT_SUSPEND,
    LIMITER_LOW_GLUCOSE,
    LIMITER_MAX_BASAL,
    LIMITER_STALE_CGM,
    MAX_BASAL,
    OUT_DEMAND,
    OUT_IOB,
    OUT_LIMITERS,
    OUT_PRAM_RATE,
    OUT_RATE,
    RATE,
    RATE_CARRY,
    SATURATIONS,
)  # fmt: skip
from .observer import above_schedule, meal_insulin
from .strategies import s2

MODE_OFF, MODE_OPEN_LOOP, MODE_NMA, MODE_MA, MODE_SMA, MODE_S1, MODE_S2, MODE_S3, MODE_S4 = range(9)
"""Codes of CtrlMode in the DBC."""

RATE_MAX = 8000
"""Largest raw rate of either drug on the wire; the codes above are reserved."""

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


def limit_rate(demand: int, state: Ints, parameters: Ints, inputs: Ints, outputs: Ints) -> int:
    """The rate to command for a demand: within the limits, rounded down, the rest carried to the next step.

    Args:
        demand: insulin rate in 0.005 U/h, 16 fractional bits.
        state, parameters, inputs, outputs: as in `layout`; sets OUT_LIMITERS, advances RATE_CARRY.

    Returns:
        Rate in 0.005 U/h, between 0 and the smallest limit in force.
    """
    schedule = round_divide(parameters[BASAL] << 16, 5)
    ceiling = min(max(round_divide(parameters[MAX_BASAL] << 16, 5), schedule), RATE_MAX << 16)
    bits = 0
    if demand > ceiling:
        bits |= LIMITER_MAX_BASAL
    if inputs[IN_LIMIT] == LIMIT_SCHEDULE:
        ceiling = min(ceiling, schedule)
        if demand > ceiling:
            bits |= LIMITER_STALE_CGM
    elif inputs[IN_LIMIT] == LIMIT_SUSPEND:
        ceiling = 0
        if demand > 0:
            bits |= LIMITER_LOW_GLUCOSE
    if inputs[IN_GLUCOSE] < 0:
        # without a new sample the held one looks like the end of a fall: insulin may go down but never up
        ceiling = min(ceiling, state[RATE] << 16)
        if demand > ceiling:
            bits |= LIMITER_STALE_CGM
    outputs[OUT_LIMITERS] = bits
    total = min(max(demand, 0), ceiling) + state[RATE_CARRY]
    state[RATE_CARRY] = total & 65535
    state[RATE] = min(total >> 16, ceiling >> 16)
    return state[RATE]


def control_step(state: Ints, parameters: Ints, inputs: Ints, outputs: Ints) -> None:
    """Run one sampling instant.

    Args:
        state, parameters, inputs, outputs: arrays of integers laid out as in `layout` (lists in plain Python, int64
            arrays when compiled); state and outputs are written.
    """
    outputs[OUT_IOB] = insulin_on_board(state, parameters, inputs)
    meal = meal_insulin(state, parameters, inputs)
    mode = inputs[IN_MODE]
    demand = round_divide(parameters[BASAL] << 16, 5)
    if mode == MODE_OFF:
        demand = 0
    elif mode != MODE_OPEN_LOOP:
        counts = state[SATURATIONS : SATURATIONS + 1]
        demand = saturate(demand + meal, counts)
        state[SATURATIONS] = counts[0]
    outputs[OUT_DEMAND] = demand
    outputs[OUT_RATE] = limit_rate(demand, state, parameters, inputs, outputs)
    outputs[OUT_PRAM_RATE] = 0
    if mode == MODE_S2 and inputs[IN_LIMIT] != LIMIT_SUSPEND:
        outputs[OUT_PRAM_RATE] = min(s2.infusion(outputs[OUT_RATE], state, parameters), RATE_MAX)
