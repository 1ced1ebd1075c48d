"""Pramlintide under the skin, in plasma, and its slowing η of gastric emptying (Pons Torres 2025)."""

from . import parameters as par
from . import states as st
from .compiled import READS, Array, compiled, entry_point, float64

PMOL_PER_UG = 253.20
"""1 µg in pmol; molar mass 3949.4 g/mol (Symlin prescribing information)."""


@compiled
def hill(p_eff: float, n: float, d: float, e: float) -> float:
    """h(Peff) = n·Peff^e / (d^e + Peff^e)."""
    if p_eff <= 0.0:
        return 0.0
    ratio = d / p_eff
    if e == 3.0:
        power = ratio * ratio * ratio
    elif e == 2.0:
        power = ratio * ratio
    else:
        power = ratio**e
    return n / (power + 1.0)


@compiled
def slowing(p_eff: float, p: Array) -> float:
    """η(Peff) = 1/(1 + h(Peff)), the factor on the rate of gastric emptying."""
    return 1.0 / (1.0 + hill(p_eff, p[par.N], p[par.D50], p[par.E]))


@compiled
def pramlintide_derivatives(x: Array, p: Array, infusion: float, dx: Array) -> None:
    """Write Q1', Q2', P1', Peff' (pmol/min). `infusion` is p(t) in pmol/min."""
    q1 = x[st.Q1]
    q2 = x[st.Q2]
    p1 = x[st.P1]

    dx[st.Q1] = p[par.A_S] * infusion - (p[par.KQ1] + p[par.KQ12]) * q1
    dx[st.Q2] = p[par.KQ12] * q1 - p[par.KQ2] * q2
    dx[st.P1] = p[par.KQ1] * q1 + p[par.KQ2] * q2 - p[par.KE] * p1
    dx[st.P_EFF] = p[par.KA] * (p1 - x[st.P_EFF])


@entry_point(float64, READS, READS)
def plasma_pramlintide(x: Array, p: Array) -> float:
    """P = P1/VP, pmol/L."""
    concentration: float = x[st.P1] / p[par.VP]
    return concentration


@entry_point(float64, READS, READS)
def eta(x: Array, p: Array) -> float:
    """The present factor on the rate of gastric emptying, 0..1."""
    return slowing(x[st.P_EFF], p)
