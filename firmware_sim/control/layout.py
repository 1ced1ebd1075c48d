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
)

INPUTS = (
    Word("IN_GLUCOSE", "0.1 mg/dL", 0, -1, 8000, "usable CGM sample of this step; -1 = none"),
    Word("IN_DELIVERED", "mU", 0, -1, 16777215, "insulin delivered since the last step; -1 = not known, as scheduled"),
    Word("IN_MODE", "-", 0, 0, 15, "CtrlMode of the DBC"),
    Word("IN_LIMIT", "-", 0, 0, 2, "0 the law decides, 1 at most the schedule, 2 suspend"),
    Word("IN_RESET", "-", 0, 0, 1, "1 = the observer starts anew at this sample (first sample, or a long gap)"),
)

OUTPUTS = (
    Word("OUT_RATE", "0.005 U/h", 0, 0, 8000, "insulin rate to command"),
    Word("OUT_PRAM_RATE", "0.1 ug/h", 0, 0, 8000, "pramlintide rate to command"),
    Word("OUT_LIMITERS", "-", 0, 0, 255, "LimiterBits of the DBC"),
    Word("OUT_IOB", "0.01 U", 0, 0, 4090, "insulin above schedule on board, never below zero"),
    Word("OUT_DEMAND", "0.005 U/h", 16, *INT32, "insulin rate the law asks for, before limits and rounding"),
)

(
    SATURATIONS, U_1, U_2, U_3, LAG_1, LAG_2, LAG_3, V_1, LEAD_1, LEAD_2, LEAD_3, GLUCOSE, PRIMED, RATE_CARRY,
    PRAM_CARRY, IOB_1, IOB_2, RATE,
) = range(len(STATE))  # fmt: skip
(
    BASAL, TARGET, MAX_BASAL, PRAM_RATIO, MEAL_GAIN, INSULIN_GAIN, OBSERVER_GAIN, LEAD1_B0, LEAD1_B1, LEAD2_B0,
    LEAD2_B1, LEAD_A1, INSULIN_A11, INSULIN_A21, INSULIN_A22, INSULIN_A31, INSULIN_A32, INSULIN_A33, INSULIN_B1,
    INSULIN_B2, INSULIN_B3,
) = range(len(PARAMETERS))  # fmt: skip
IN_GLUCOSE, IN_DELIVERED, IN_MODE, IN_LIMIT, IN_RESET = range(len(INPUTS))
OUT_RATE, OUT_PRAM_RATE, OUT_LIMITERS, OUT_IOB, OUT_DEMAND = range(len(OUTPUTS))

LIMIT_NONE, LIMIT_SCHEDULE, LIMIT_SUSPEND = 0, 1, 2
"""Codes of IN_LIMIT."""

LIMITER_MAX_BASAL, LIMITER_LOW_GLUCOSE, LIMITER_STALE_CGM = 1, 8, 16
"""Bits of OUT_LIMITERS, as LimiterBits of the DBC numbers them."""
