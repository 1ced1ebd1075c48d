"""Where everything lies in the arrays of the control core, and in which format: the numbers of the firmware.

The core works on arrays of signed integers, as a C struct of int32_t would: `parameters` (constant between two
calibrations), `state` (survives from step to step, goes to NVM), `inputs` and `outputs` of one step. The tables below
are the documentation: docs/numbers.md is generated from them.
"""

from typing import NamedTuple


class Word(NamedTuple):
    """One integer of an array: its name, unit of one LSB times 2**-q, and what it is."""

    name: str
    unit: str
    q: int  # fractional bits: the value is raw / 2**q units
    low: int  # raw range
    high: int
    comment: str


INT32 = (-2147483648, 2147483647)

STATE = (
    Word("SATURATIONS", "-", 0, 0, INT32[1], "clamped additions so far"),
    Word("U_1", "mU/step", 14, *INT32, "insulin above schedule delivered in the last step, u(k-1)"),
    Word("U_2", "mU/step", 14, *INT32, "u(k-2)"),
    Word("U_3", "mU/step", 14, *INT32, "u(k-3), what G_u sees (15 min of delay)"),
    Word("LAG_1", "mU/step", 14, *INT32, "G_u, first lag"),
    Word("LAG_2", "mU/step", 14, *INT32, "G_u, second lag"),
    Word("LAG_3", "mU/step", 14, *INT32, "G_u, third lag"),
    Word("V_1", "0.1 mg/dL", 10, *INT32, "input of the first lead section, one step ago"),
    Word("LEAD_1", "0.1 mg/dL", 10, *INT32, "output of the section (tau_2d s + 1)/(theta s + 1)"),
    Word("LEAD_2", "0.1 mg/dL", 10, *INT32, "output of the first section (tau_1d s + 1)/(theta s + 1)"),
    Word("LEAD_3", "0.1 mg/dL", 10, *INT32, "output of the second one; divided by K_d it is the meal estimate d"),
    Word("GLUCOSE", "0.1 mg/dL", 0, 0, 8000, "last glucose the observer used"),
    Word("PRIMED", "-", 0, 0, 1, "the observer has seen a sample since reset"),
    Word("RATE_CARRY", "0.005 U/h", 16, 0, 65535, "part of the insulin rate below one LSB, carried to the next step"),
    Word("PRAM_CARRY", "0.1 ug/h / 2000", 0, 0, 1999, "part of the pramlintide rate below one LSB, carried on"),
    Word("IOB_1", "mU", 8, *INT32, "insulin above schedule on board, first compartment"),
    Word("IOB_2", "mU", 8, *INT32, "insulin above schedule on board, second compartment"),
    Word("RATE", "0.005 U/h", 0, 0, 8000, "insulin rate commanded in the last step"),
    Word("BOLUS_1", "mU/step", 14, *INT32, "part of u(k-1) that was a bolus"),
    Word("BOLUS_2", "mU/step", 14, *INT32, "part of u(k-2)"),
    Word("BOLUS_3", "mU/step", 14, *INT32, "part of u(k-3), what the deduction sees (15 min of delay)"),
    Word("FILTER_1", "mU/step", 14, *INT32, "F of the bolus, first lag"),
    Word("FILTER_2", "mU/step", 14, *INT32, "F of the bolus, second lag"),
    Word("FILTER_3", "mU/step", 14, *INT32, "F of the bolus, third lag: what is taken out of the feedback"),
    Word("DEMAND", "0.005 U/h", 16, 0, INT32[1], "insulin u(k-1) before limits and rounding, never negative"),
    Word("RISING", "-", 0, 0, 1, "u(k-1) was above u(k-2)"),
    Word("GLUCOSE_1", "0.1 mg/dL", 0, 0, 8000, "sample before the last one"),
    Word("GLUCOSE_2", "0.1 mg/dL", 0, 0, 8000, "sample before that"),
    Word("TREND", "-", 0, 0, 3, "samples in a row up to this one, at most 3: trends need all of them"),
    Word("BOLUS_WAIT", "step", 0, 0, 255, "until the next insulin bolus is allowed"),
    Word("PRAM_WAIT", "step", 0, 0, 255, "until the next pramlintide bolus is allowed"),
    Word("PEAK_WAIT", "step", 0, 0, 256, "until strategy 1 looks for the next peak"),
)

PARAMETERS = (
    Word("BASAL", "0.001 U/h", 0, 0, 60000, "scheduled rate u_b"),
    Word("TARGET", "0.1 mg/dL", 0, 0, 8000, "basal glucose G_b"),
    Word("MAX_BASAL", "0.001 U/h", 0, 0, 60000, "largest insulin rate; 0 = never more than the schedule"),
    Word("PRAM_RATIO", "0.01 ug/U", 0, 0, 4000, "pramlintide per insulin"),
    Word("MEAL_GAIN", "0.001 mg/dL/(g/min)", 0, 1, 16777215, "K_d"),
    Word("INSULIN_GAIN", "0.001 mg/dL/(U/min)", 0, 0, 67108863, "K_u"),
    Word("OBSERVER_GAIN", "1e-7 U/g", 0, 0, 16777215, "gamma"),
    Word("LEAD1_B0", "-", 24, -(1 << 29), (1 << 29) - 1, "(tau_1d s + 1)/(theta s + 1), Tustin"),
    Word("LEAD1_B1", "-", 24, -(1 << 29), (1 << 29) - 1, "of the previous input"),
    Word("LEAD2_B0", "-", 24, -(1 << 29), (1 << 29) - 1, "(tau_2d s + 1)/(theta s + 1), Tustin"),
    Word("LEAD2_B1", "-", 24, -(1 << 29), (1 << 29) - 1, "of the previous input"),
    Word("LEAD_A1", "-", 24, -(1 << 29), (1 << 29) - 1, "of the previous output, subtracted; common to all sections"),
    Word("INSULIN_A11", "-", 30, 0, (1 << 30) - 1, "G_u as three lags, exact hold over one sample"),
    Word("INSULIN_A21", "-", 30, 0, (1 << 30) - 1, ""),
    Word("INSULIN_A22", "-", 30, 0, (1 << 30) - 1, ""),
    Word("INSULIN_A31", "-", 30, 0, (1 << 30) - 1, ""),
    Word("INSULIN_A32", "-", 30, 0, (1 << 30) - 1, ""),
    Word("INSULIN_A33", "-", 30, 0, (1 << 30) - 1, ""),
    Word("INSULIN_B1", "-", 30, 0, (1 << 30) - 1, ""),
    Word("INSULIN_B2", "-", 30, 0, (1 << 30) - 1, ""),
    Word("INSULIN_B3", "-", 30, 0, (1 << 30) - 1, ""),
    Word("CARB_RATIO", "0.01 g/U", 0, 1, 20000, "carbohydrate per insulin, CIR"),
    Word("MAX_BOLUS", "0.01 U", 0, 0, 4000, "largest insulin bolus; 0 = none"),
    Word("MAX_IOB", "0.01 U", 0, 0, 4000, "insulin on board that no bolus and no rate above the schedule exceeds"),
    Word("PRAM_BOLUS", "0.1 ug", 0, 0, 4000, "pramlintide bolus, and the largest one; 0 = none"),
    Word("BOLUS_DEDUCTION", "0.001 -", 0, 0, 1023, "share of a bolus taken out of the feedback"),
    Word("MEAL_FACTOR", "0.001 -", 0, 0, 1023, "nu, attenuation of the prandial bolus"),
    Word("ASSUMED_CARBS", "0.5 g", 0, 0, 1000, "carbohydrate of a simple announcement"),
    Word("FILTER_A1", "-", 30, 0, (1 << 30) - 1, "F as three equal lags, exact hold: A[r,r]"),
    Word("FILTER_A2", "-", 30, 0, (1 << 30) - 1, "A[r,r-1]"),
    Word("FILTER_A3", "-", 30, 0, (1 << 30) - 1, "A[r,r-2]"),
    Word("FILTER_B1", "-", 30, 0, (1 << 30) - 1, ""),
    Word("FILTER_B2", "-", 30, 0, (1 << 30) - 1, ""),
    Word("FILTER_B3", "-", 30, 0, (1 << 30) - 1, ""),
    Word("PEAK_RATIO", "0.01 -", 0, 0, 4095, "z_1: insulin above z_1 times the schedule"),
    Word("PEAK_SLOPE", "0.001 mg/dL/min", 0, 0, 4095, "z_2: glucose rises faster than this"),
    Word("PEAK_LOCKOUT", "steps", 0, 0, 255, "z_3: more steps than this since the last pramlintide bolus"),
    Word("BASAL_FACTOR", "0.1 -", 0, 0, 255, "largest insulin rate in schedules; below 1 = the schedule"),
    Word("LOW_SUSPEND", "0.1 mg/dL", 0, 0, 8000, "below: no insulin; predicted below: at most the schedule; 0 = off"),
    Word("BOLUS_LOCKOUT", "steps", 0, 0, 255, "least distance between two boluses of one drug"),
    Word("MAX_RISE", "0.001 U/h", 0, 0, 60000, "most that the insulin rate rises in one step"),
)

INPUTS = (
    Word("IN_GLUCOSE", "0.1 mg/dL", 0, -1, 8000, "usable CGM sample of this step; -1 = none"),
    Word("IN_DELIVERED", "mU", 0, -1, 16777215, "insulin delivered since the last step; -1 = not known, as scheduled"),
    Word("IN_MODE", "-", 0, 0, 15, "CtrlMode of the DBC"),
    Word("IN_LIMIT", "-", 0, 0, 2, "0 the law decides, 1 at most the schedule, 2 suspend"),
    Word("IN_RESET", "-", 0, 0, 1, "1 = the observer starts anew at this sample (first sample, or a long gap)"),
    Word("IN_BOLUS", "mU", 0, 0, 60000, "part of IN_DELIVERED that was a bolus"),
    Word("IN_MEAL", "-", 0, 0, 3, "meal announced: 0 none, 1 grams estimated, 2 time only, 3 snack"),
    Word("IN_CARBS", "0.5 g", 0, 0, 1000, "estimated carbohydrate of it"),
    Word("IN_OPEN", "0.01 U", 0, 0, 4000, "bolus that may have been given and is in no total yet"),
    Word("IN_INSULIN_LEFT", "mU", 0, 0, INT32[1], "what the limit of 24 h leaves"),
    Word("IN_PRAM_LEFT", "0.1 ug", 0, 0, INT32[1], "what the limit of 24 h leaves"),
    Word("IN_PRAM_STOP", "-", 0, 0, 1, "1 = no pramlintide (its line or reservoir is out of order)"),
    Word("IN_BOLUS_STOP", "-", 0, 0, 3, "drugs of which no bolus can be started now: 1 insulin, 2 pramlintide"),
)

OUTPUTS = (
    Word("OUT_RATE", "0.005 U/h", 0, 0, 8000, "insulin rate to command"),
    Word("OUT_PRAM_RATE", "0.1 ug/h", 0, 0, 8000, "pramlintide rate to command"),
    Word("OUT_LIMITERS", "-", 0, 0, 255, "LimiterBits of the DBC"),
    Word("OUT_IOB", "0.01 U", 0, 0, 4090, "insulin above schedule on board, never below zero"),
    Word("OUT_DEMAND", "0.005 U/h", 16, *INT32, "insulin rate the law asks for, before limits and rounding"),
    Word("OUT_BOLUS", "0.01 U", 0, 0, 4000, "insulin bolus to give now"),
    Word("OUT_PRAM_BOLUS", "0.1 ug", 0, 0, 4000, "pramlintide bolus to give now"),
    Word("OUT_REFUSED", "-", 0, 0, 1, "1 = a meal that asks for a bolus gets none"),
)

(
    SATURATIONS, U_1, U_2, U_3, LAG_1, LAG_2, LAG_3, V_1, LEAD_1, LEAD_2, LEAD_3, GLUCOSE, PRIMED, RATE_CARRY,
    PRAM_CARRY, IOB_1, IOB_2, RATE, BOLUS_1, BOLUS_2, BOLUS_3, FILTER_1, FILTER_2, FILTER_3, DEMAND, RISING, GLUCOSE_1,
    GLUCOSE_2, TREND, BOLUS_WAIT, PRAM_WAIT, PEAK_WAIT,
) = range(len(STATE))  # fmt: skip
(
    BASAL, TARGET, MAX_BASAL, PRAM_RATIO, MEAL_GAIN, INSULIN_GAIN, OBSERVER_GAIN, LEAD1_B0, LEAD1_B1, LEAD2_B0,
    LEAD2_B1, LEAD_A1, INSULIN_A11, INSULIN_A21, INSULIN_A22, INSULIN_A31, INSULIN_A32, INSULIN_A33, INSULIN_B1,
    INSULIN_B2, INSULIN_B3, CARB_RATIO, MAX_BOLUS, MAX_IOB, PRAM_BOLUS, BOLUS_DEDUCTION, MEAL_FACTOR, ASSUMED_CARBS,
    FILTER_A1, FILTER_A2, FILTER_A3, FILTER_B1, FILTER_B2, FILTER_B3, PEAK_RATIO, PEAK_SLOPE, PEAK_LOCKOUT,
    BASAL_FACTOR, LOW_SUSPEND, BOLUS_LOCKOUT, MAX_RISE,
) = range(len(PARAMETERS))  # fmt: skip
(
    IN_GLUCOSE, IN_DELIVERED, IN_MODE, IN_LIMIT, IN_RESET, IN_BOLUS, IN_MEAL, IN_CARBS, IN_OPEN, IN_INSULIN_LEFT,
    IN_PRAM_LEFT, IN_PRAM_STOP, IN_BOLUS_STOP,
) = range(len(INPUTS))  # fmt: skip
(
    OUT_RATE, OUT_PRAM_RATE, OUT_LIMITERS, OUT_IOB, OUT_DEMAND, OUT_BOLUS, OUT_PRAM_BOLUS, OUT_REFUSED,
) = range(len(OUTPUTS))  # fmt: skip

LIMIT_NONE, LIMIT_SCHEDULE, LIMIT_SUSPEND = 0, 1, 2
"""Codes of IN_LIMIT."""

STOP_INSULIN, STOP_PRAM = 1, 2
"""Bits of IN_BOLUS_STOP."""

MEAL_NONE, MEAL_CARBS, MEAL_SIMPLE, MEAL_SNACK = range(4)
"""Codes of IN_MEAL, as MealKind of the DBC numbers them."""

LIMITER_MAX_BASAL, LIMITER_MAX_BOLUS, LIMITER_MAX_IOB, LIMITER_LOW_GLUCOSE = 1, 2, 4, 8
LIMITER_STALE_CGM, LIMITER_LOCKOUT, LIMITER_DAY, LIMITER_RISE = 16, 32, 64, 128
"""Bits of OUT_LIMITERS, as LimiterBits of the DBC numbers them."""

MODE_OFF, MODE_OPEN_LOOP, MODE_NMA, MODE_MA, MODE_SMA, MODE_S1, MODE_S2, MODE_S3, MODE_S4 = range(9)
"""Codes of IN_MODE, as CtrlMode of the DBC numbers them."""
