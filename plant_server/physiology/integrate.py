"""The whole patient as one system, and its integration: classical Runge-Kutta in fixed steps of 30 s.

Fixed steps because a run must give the same bytes again, whatever the size of the pieces it is advanced in; 30 s
because the error then stays below 0.01 mg/dL (docs/physiology.md).
"""

import math

import numpy as np

from . import parameters as par
from . import states as st
from .compiled import READS, WRITES, Array, compiled, entry_point, float64, void
from .counter_regulation import counter_regulation_derivatives, glucagon_production, insulin_action_gain
from .gastric import gastric_derivatives, small_meal_factor, steepness
from .glucose import glucose_derivatives
from .insulin import PMOL_PER_U, insulin_derivatives
from .pramlintide import PMOL_PER_UG, pramlintide_derivatives, slowing

STEP_MIN = 0.5
"""Length of a Runge-Kutta step, min."""

MINUTES_PER_DAY = 1440.0

VANISHED = 1e-200
"""Masses below this many of their units become zero: they change no digit of anything, but arithmetic on numbers
below 1e-308 is a hundred times slower."""

MOST_INSULIN_U = 100.0
MOST_PRAMLINTIDE_UG = 1e5
MOST_CARBS_MG = 1e6
"""Most that can arrive within one step: far above anything a pump or a mouth can do, far below any overflow."""

SWITCHING_PER_PART = 1.0
MOST_PARTS_FOR_ACCURACY = 8.0
"""Change in the argument of k_empt's tanh that one part of a step may hold, and where refining ends."""

_STATES = len(st.STATES)
_PARAMETERS = len(par.PARAMETERS)


@compiled
def circadian_factor(t_min: float, p: Array) -> float:
    """1 + A·sin(2πt/1440 + φ), on Vmx and kp3 (Pons Torres 2025, variability)."""
    if p[par.CIRCADIAN_AMPLITUDE] == 0.0:
        return 1.0
    angle = 2.0 * math.pi / MINUTES_PER_DAY * t_min + p[par.CIRCADIAN_PHASE]
    factor: float = 1.0 + p[par.CIRCADIAN_AMPLITUDE] * math.sin(angle)
    return factor


@entry_point(void, READS, READS, float64, float64, float64, float64, WRITES)
def derivatives(
    x: Array, p: Array, circadian: float, insulin: float, pramlintide: float, eating: float, dx: Array
) -> None:
    """Write x' to `dx`.

    Args:
        x: state vector.
        p: parameter vector.
        circadian: factor on Vmx and kp3 at this time of day.
        insulin: infusion under the skin, pmol/kg/min.
        pramlintide: infusion under the skin, pmol/min.
        eating: mg/min.
        dx: where to write the derivative.
    """
    pramlintide_derivatives(x, p, pramlintide, dx)
    appearance = gastric_derivatives(x, p, eating, slowing(x[st.P_EFF], p), dx)
    insulin_derivatives(x, p, insulin, dx)
    if p[par.S2013] == 0.0:
        glucose_derivatives(x, p, appearance, circadian, 1.0, 0.0, dx)
        dx[st.H] = 0.0
        dx[st.XH] = 0.0
        dx[st.SRHS] = 0.0
    else:
        gain = insulin_action_gain(x, p)
        glucose_derivatives(x, p, appearance, circadian, gain, glucagon_production(x, p), dx)
        counter_regulation_derivatives(x, p, dx)


@compiled
def parts_of_step(x: Array, p: Array, h: float, eating: float) -> int:
    """How many equal parts a step is integrated in: one, but for three short or absurd occasions.

    For accuracy: while a steep patient bolts a meal, the rate of emptying switches within a step. For stability:
    tissue uptake under an absurd amount of insulin, and the emptying of very small meals.
    """
    action = x[st.X] + h * p[par.P2U] * (x[st.IP] / p[par.VI])  # at the end of the step
    gain = insulin_action_gain(x, p) if p[par.S2013] != 0.0 else 1.0
    uptake = p[par.K2] + (p[par.VM0] + 2.0 * p[par.VMX] * gain * max(0.0, action)) / p[par.KM0]
    emptying = p[par.K_MAX] * small_meal_factor(x[st.D], p[par.SMALL_MEAL])
    parts = 1 + int(h * max(uptake, emptying))
    if eating > 0.0:
        switching = eating * steepness(x[st.D], p[par.B], p[par.C])
        parts = max(parts, 1 + int(min(h * switching / SWITCHING_PER_PART, MOST_PARTS_FOR_ACCURACY - 1.0)))
    return parts


@entry_point(void, WRITES, READS, float64, float64, READS, READS, READS)
def runge_kutta(
    x: Array, p: Array, t_min: float, step_min: float, insulin_u: Array, pramlintide_ug: Array, carbs_mg: Array
) -> None:
    """`advance` with steps of any length (min), for studies of the step itself."""
    if x.size != _STATES or p.size != _PARAMETERS:
        raise ValueError("the state or the parameter vector has a wrong length")
    if pramlintide_ug.size != insulin_u.size or carbs_mg.size != insulin_u.size:
        raise ValueError("insulin, pramlintide and carbohydrate differ in their number of steps")
    for step in range(insulin_u.size):
        if not (
            0.0 <= insulin_u[step] <= MOST_INSULIN_U
            and 0.0 <= pramlintide_ug[step] <= MOST_PRAMLINTIDE_UG
            and 0.0 <= carbs_mg[step] <= MOST_CARBS_MG
        ):
            raise ValueError("an amount is negative, not a number, or beyond 100 U, 100 mg or 1 kg in one step")
    y = x.copy()
    k1 = np.empty_like(x)
    k2 = np.empty_like(x)
    k3 = np.empty_like(x)
    k4 = np.empty_like(x)
    circadian = circadian_factor(t_min, p)
    for step in range(insulin_u.size):
        insulin = insulin_u[step] / step_min * PMOL_PER_U / p[par.BW]
        pramlintide = pramlintide_ug[step] / step_min * PMOL_PER_UG
        eating = carbs_mg[step] / step_min

        parts = parts_of_step(x, p, step_min, eating)
        h = step_min / parts
        for part in range(parts):
            t = t_min + step * step_min + part * h
            circadian_middle = circadian_factor(t + h / 2.0, p)
            circadian_end = circadian_factor(t + h, p)

            derivatives(x, p, circadian, insulin, pramlintide, eating, k1)
            for i in range(st.INTEGRATED):
                y[i] = x[i] + h / 2.0 * k1[i]
            derivatives(y, p, circadian_middle, insulin, pramlintide, eating, k2)
            for i in range(st.INTEGRATED):
                y[i] = x[i] + h / 2.0 * k2[i]
            derivatives(y, p, circadian_middle, insulin, pramlintide, eating, k3)
            for i in range(st.INTEGRATED):
                y[i] = x[i] + h * k3[i]
            derivatives(y, p, circadian_end, insulin, pramlintide, eating, k4)
            for i in range(st.INTEGRATED):
                x[i] += h / 6.0 * (k1[i] + 2.0 * (k2[i] + k3[i]) + k4[i])
            circadian = circadian_end

        for i in range(st.Q_STO1, st.Q_GUT + 1):
            if x[i] < VANISHED:
                x[i] = 0.0
        for i in range(st.ISC1, st.P_EFF + 1):
            if x[i] < VANISHED:
                x[i] = 0.0


@entry_point(void, WRITES, READS, float64, READS, READS, READS)
def advance(x: Array, p: Array, t_min: float, insulin_u: Array, pramlintide_ug: Array, carbs_mg: Array) -> None:
    """Advance the state by one 30-s step per entry of the inputs.

    Args:
        x: state vector, changed in place.
        p: parameter vector.
        t_min: simulated minutes at the start, for the variation over the day.
        insulin_u: insulin delivered within each step, U; spread evenly over it.
        pramlintide_ug: pramlintide delivered within each step, µg.
        carbs_mg: carbohydrate eaten within each step, mg.

    Raises:
        ValueError: for an amount that is negative, not a number or absurd, before anything has changed, and for
            arrays of the wrong length.
    """
    runge_kutta(x, p, t_min, STEP_MIN, insulin_u, pramlintide_ug, carbs_mg)
