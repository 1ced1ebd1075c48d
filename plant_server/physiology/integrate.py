# ruff: noqa: PLR0917 - compiled functions take numbers by position
"""The whole patient as one system, and its integration: classical Runge-Kutta, fixed steps of 30 s."""

import math

import numpy as np

from . import parameters as par
from . import states as st
from .compiled import READS, WRITES, Array, compiled, entry_point, float64, void
from .gastric import gastric_derivatives
from .glucose import glucose_derivatives
from .insulin import PMOL_PER_U, insulin_derivatives
from .pramlintide import PMOL_PER_UG, pramlintide_derivatives, slowing

#: length of a Runge-Kutta step, min
STEP_MIN = 0.5
MINUTES_PER_DAY = 1440.0
#: masses below this many of their units are set to zero: they change no digit of anything, but arithmetic on
#: numbers below 1e-308 is a hundred times slower
VANISHED = 1e-200


@compiled
def circadian_factor(t_min: float, p: Array) -> float:
    """1 + A·sin(2πt/1440 + φ), on Vmx and kp3 (Pons Torres 2025, variability of the tuning scenario)."""
    if p[par.CIRCADIAN_AMPLITUDE] == 0.0:
        return 1.0
    angle = 2.0 * math.pi / MINUTES_PER_DAY * t_min + p[par.CIRCADIAN_PHASE]
    factor: float = 1.0 + p[par.CIRCADIAN_AMPLITUDE] * math.sin(angle)
    return factor


@compiled
def derivatives(
    x: Array, p: Array, circadian: float, insulin: float, pramlintide: float, eating: float, dx: Array
) -> None:
    """The right-hand side. `insulin` in pmol/kg/min, `pramlintide` in pmol/min, `eating` in mg/min."""
    pramlintide_derivatives(x, p, pramlintide, dx)
    appearance = gastric_derivatives(x, p, eating, slowing(x[st.P_EFF], p), dx)
    insulin_derivatives(x, p, insulin, dx)
    glucose_derivatives(x, p, appearance, circadian, 1.0, 0.0, dx)
    dx[st.H] = 0.0
    dx[st.XH] = 0.0
    dx[st.SRHS] = 0.0


@entry_point(void, WRITES, READS, float64, READS, READS, READS)
def advance(
    x: Array, p: Array, t_min: float, insulin_u: Array, pramlintide_ug: Array, carbs_mg: Array
) -> None:
    """Advance the state `x` in place by one 30-s step per entry of the inputs.

    Args:
        x: state vector, changed in place.
        p: parameter vector.
        t_min: simulated minutes at the start, for the variation over the day.
        insulin_u: insulin delivered within each step, U; spread evenly over it.
        pramlintide_ug: pramlintide delivered within each step, µg.
        carbs_mg: carbohydrate eaten within each step, mg.
    """
    h = STEP_MIN
    y = x.copy()
    k1 = np.zeros_like(x)
    k2 = np.zeros_like(x)
    k3 = np.zeros_like(x)
    k4 = np.zeros_like(x)
    circadian = circadian_factor(t_min, p)
    for step in range(insulin_u.size):
        insulin = insulin_u[step] / h * PMOL_PER_U / p[par.BW]
        pramlintide = pramlintide_ug[step] / h * PMOL_PER_UG
        eating = carbs_mg[step] / h
        t = t_min + step * h
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
