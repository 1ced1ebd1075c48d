"""What cuts a dose, whatever the law asks for; every cut sets its bit of LimiterBits (requirements LIM-01 to 09)."""

from .fixed import Ints, round_divide
from .layout import (
    BASAL,
    BASAL_FACTOR,
    BOLUS_LOCKOUT,
    BOLUS_WAIT,
    GLUCOSE,
    GLUCOSE_1,
    GLUCOSE_2,
    IN_BOLUS_STOP,
    IN_GLUCOSE,
    IN_INSULIN_LEFT,
    IN_LIMIT,
    IN_OPEN,
    IN_PRAM_LEFT,
    IN_PRAM_STOP,
    LIMIT_NONE,
    LIMIT_SCHEDULE,
    LIMIT_SUSPEND,
    LIMITER_DAY,
    LIMITER_LOCKOUT,
    LIMITER_LOW_GLUCOSE,
    LIMITER_MAX_BASAL,
    LIMITER_MAX_BOLUS,
    LIMITER_MAX_IOB,
    LIMITER_RISE,
    LIMITER_STALE_CGM,
    LOW_SUSPEND,
    MAX_BASAL,
    MAX_BOLUS,
    MAX_IOB,
    MAX_RISE,
    OUT_IOB,
    OUT_LIMITERS,
    PRAM_BOLUS,
    PRAM_WAIT,
    RATE,
    RATE_CARRY,
    STOP_INSULIN,
    STOP_PRAM,
    TREND,
)  # fmt: skip

RATE_MAX = 8000
"""Largest raw rate of either drug on the wire; the codes above are reserved."""

PRAM_LOWEST_GLUCOSE = 700
"""0.1 mg/dL below which there is no pramlintide bolus (requirement TWO-03)."""


def schedule(parameters: Ints) -> int:
    """The scheduled rate u_b in 0.005 U/h, 16 fractional bits."""
    return round_divide(parameters[BASAL] << 16, 5)


def low(parameters: Ints, inputs: Ints) -> bool:
    """Whether the newest sample, if there is one in this step, is below the limit of suspension."""
    return inputs[IN_GLUCOSE] >= 0 and inputs[IN_GLUCOSE] < parameters[LOW_SUSPEND]


def soon_low(state: Ints, parameters: Ints) -> bool:
    """Whether the line through three samples in a row crosses that limit within 30 min (requirement LIM-05)."""
    if state[TREND] < 3:
        return False
    level = state[GLUCOSE] + state[GLUCOSE_1] + state[GLUCOSE_2]
    # least squares: mean + 7 (G_0 - G_2) / 2, six times that
    return 2 * level + 21 * (state[GLUCOSE] - state[GLUCOSE_2]) < 6 * parameters[LOW_SUSPEND]


def limit_rate(demand: int, bolus: int, state: Ints, parameters: Ints, inputs: Ints, outputs: Ints) -> int:
    """The rate to command for a demand: within the limits, rounded down, the rest carried to the next step.

    Args:
        demand: insulin rate in 0.005 U/h, 16 fractional bits.
        bolus: insulin bolus of the same step in 0.01 U.
        state, parameters, inputs, outputs: as in `layout`; adds to OUT_LIMITERS, advances RATE_CARRY and RATE.

    Returns:
        Rate in 0.005 U/h, between 0 and the smallest limit in force.
    """
    basal = schedule(parameters)
    ceiling = min(max(round_divide(parameters[MAX_BASAL] << 16, 5), basal), RATE_MAX << 16)
    ceiling = min(ceiling, max(round_divide((parameters[BASAL_FACTOR] * parameters[BASAL]) << 16, 50), basal))
    bits = LIMITER_MAX_BASAL if demand > ceiling else 0
    # what may still come on board within a step: 0.01 U in 5 min are 24 times 0.005 U/h
    room = max(parameters[MAX_IOB] - outputs[OUT_IOB] - inputs[IN_OPEN] - bolus, 0) * 24
    if basal + (room << 16) < ceiling:
        ceiling = basal + (room << 16)
        bits |= LIMITER_MAX_IOB if demand > ceiling else 0
    # 1 mU in 5 min is 12/5 of 0.005 U/h; a bolus takes 10 mU per 0.01 U
    left = max(inputs[IN_INSULIN_LEFT] - bolus * 10, 0) * 12 // 5
    if left << 16 < ceiling:
        ceiling = left << 16
        bits |= LIMITER_DAY if demand > ceiling else 0
    rise = (state[RATE] << 16) + round_divide(parameters[MAX_RISE] << 16, 5)
    if rise < ceiling:
        ceiling = rise
        bits |= LIMITER_RISE if demand > ceiling else 0
    if low(parameters, inputs) or inputs[IN_LIMIT] == LIMIT_SUSPEND:
        ceiling = 0
        bits |= LIMITER_LOW_GLUCOSE if demand > 0 else 0
    elif soon_low(state, parameters) and basal < ceiling:
        ceiling = basal
        bits |= LIMITER_LOW_GLUCOSE if demand > ceiling else 0
    if inputs[IN_LIMIT] == LIMIT_SCHEDULE and basal < ceiling:
        ceiling = basal
        bits |= LIMITER_STALE_CGM if demand > ceiling else 0
    if inputs[IN_GLUCOSE] < 0 and state[RATE] << 16 < ceiling:
        # without a new sample the held one looks like the end of a fall: insulin may go down but never up
        ceiling = state[RATE] << 16
        bits |= LIMITER_STALE_CGM if demand > ceiling else 0
    outputs[OUT_LIMITERS] |= bits
    total = min(max(demand, 0), ceiling) + state[RATE_CARRY]
    state[RATE_CARRY] = total & 65535
    state[RATE] = min(total >> 16, ceiling >> 16)
    return state[RATE]


def limit_bolus(wanted: int, state: Ints, parameters: Ints, inputs: Ints, outputs: Ints) -> int:
    """The insulin bolus to give for one that a meal asks for, in 0.01 U; 0 = refused."""
    if inputs[IN_LIMIT] != LIMIT_NONE or inputs[IN_BOLUS_STOP] & STOP_INSULIN:
        return 0
    if low(parameters, inputs) or soon_low(state, parameters):
        outputs[OUT_LIMITERS] |= LIMITER_LOW_GLUCOSE
        return 0
    if state[BOLUS_WAIT] > 0:
        outputs[OUT_LIMITERS] |= LIMITER_LOCKOUT
        return 0
    dose = wanted
    if dose > parameters[MAX_BOLUS]:
        dose = parameters[MAX_BOLUS]
        outputs[OUT_LIMITERS] |= LIMITER_MAX_BOLUS
    room = parameters[MAX_IOB] - outputs[OUT_IOB] - inputs[IN_OPEN]
    if dose > room:
        dose = max(room, 0)
        outputs[OUT_LIMITERS] |= LIMITER_MAX_IOB
    if dose * 10 > inputs[IN_INSULIN_LEFT]:
        dose = inputs[IN_INSULIN_LEFT] // 10
        outputs[OUT_LIMITERS] |= LIMITER_DAY
    if dose > 0:
        state[BOLUS_WAIT] = parameters[BOLUS_LOCKOUT]
    return dose


def limit_pram_bolus(wanted: int, state: Ints, parameters: Ints, inputs: Ints, outputs: Ints) -> int:
    """The pramlintide bolus to give for a wanted one, in 0.1 ug; 0 = none."""
    if inputs[IN_BOLUS_STOP] & STOP_PRAM or inputs[IN_PRAM_STOP] == 1:
        return 0
    if wanted == 0 or inputs[IN_LIMIT] != LIMIT_NONE:
        return 0
    if state[GLUCOSE] < PRAM_LOWEST_GLUCOSE or low(parameters, inputs) or soon_low(state, parameters):
        outputs[OUT_LIMITERS] |= LIMITER_LOW_GLUCOSE
        return 0
    if state[PRAM_WAIT] > 0:
        outputs[OUT_LIMITERS] |= LIMITER_LOCKOUT
        return 0
    dose = wanted
    if dose > parameters[PRAM_BOLUS]:
        dose = parameters[PRAM_BOLUS]
        outputs[OUT_LIMITERS] |= LIMITER_MAX_BOLUS
    if dose > inputs[IN_PRAM_LEFT]:
        dose = inputs[IN_PRAM_LEFT]
        outputs[OUT_LIMITERS] |= LIMITER_DAY
    if dose > 0:
        state[PRAM_WAIT] = parameters[BOLUS_LOCKOUT]
    return dose


def limit_pram_rate(wanted: int, bolus: int, inputs: Ints, outputs: Ints) -> int:
    """The pramlintide rate to command, in 0.1 ug/h, beside a bolus in 0.1 ug."""
    if inputs[IN_LIMIT] == LIMIT_SUSPEND or inputs[IN_PRAM_STOP] == 1:
        return 0
    rate = min(wanted, RATE_MAX)
    left = max(inputs[IN_PRAM_LEFT] - bolus, 0) * 12
    if rate > left:
        rate = left
        outputs[OUT_LIMITERS] |= LIMITER_DAY
    return rate
