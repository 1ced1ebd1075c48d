"""Glucose: production, utilisation, excretion, interstitial fluid (Dalla Man 2007; simglucose, MIT)."""

from . import parameters as par
from . import states as st
from .compiled import READS, Array, compiled, entry_point, float64

UPTAKE_FADES_BELOW = 10.0
"""mg/dL. The brain's constant uptake would draw plasma glucose below zero when insulin is extreme; below this
level, which no living patient reaches, it fades linearly to nothing. simglucose freezes negative states."""


@compiled
def insulin_independent_uptake(gp: float, fsnc: float, vg: float) -> float:
    """Uii, mg/kg/min: constant, see `UPTAKE_FADES_BELOW`."""
    return fsnc * min(1.0, gp / (UPTAKE_FADES_BELOW * vg))


@compiled
def glucose_derivatives(
    x: Array,
    p: Array,
    appearance: float,
    circadian: float,
    risk_gain: float,
    glucagon_production: float,
    dx: Array,
) -> None:
    """Write Gp', Gt', Gs' (mg/kg/min).

    `appearance` is Ra, mg/kg/min; `circadian` multiplies Vmx and kp3; `risk_gain` is 1 + r3·risk and
    `glucagon_production` kcounter·XH, mg/kg/min (1 and 0 in S2008).
    """
    gp = x[st.GP]
    gt = x[st.GT]

    production = max(0.0, p[par.KP1] - p[par.KP2] * gp - circadian * p[par.KP3] * x[st.XL] + glucagon_production)
    excretion = p[par.KE1] * max(0.0, gp - p[par.KE2])
    uptake_independent = insulin_independent_uptake(gp, p[par.FSNC], p[par.VG])
    uptake = (p[par.VM0] + circadian * p[par.VMX] * x[st.X] * risk_gain) * gt / (p[par.KM0] + gt)
    exchange = p[par.K1] * gp - p[par.K2] * gt

    dx[st.GP] = production + appearance - uptake_independent - excretion - exchange
    dx[st.GT] = exchange - uptake
    dx[st.GS] = p[par.KSC] * (gp - x[st.GS])


@entry_point(float64, READS, READS)
def glucose(x: Array, p: Array) -> float:
    """Plasma glucose G = Gp/Vg, mg/dL."""
    concentration: float = x[st.GP] / p[par.VG]
    return concentration


@entry_point(float64, READS, READS)
def interstitial(x: Array, p: Array) -> float:
    """Interstitial glucose Gs/Vg, mg/dL: what a sensor sees before its own errors."""
    concentration: float = x[st.GS] / p[par.VG]
    return concentration
