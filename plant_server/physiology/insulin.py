"""Insulin: under the skin, in plasma and liver, and its delayed actions (Dalla Man 2007; simglucose, MIT)."""

from . import parameters as par
from . import states as st
from .compiled import READS, Array, compiled, entry_point, float64

PMOL_PER_U = 6000.0


@compiled
def insulin_derivatives(x: Array, p: Array, infusion: float, dx: Array) -> None:
    """Write Isc1', Isc2', Ip', Il' (pmol/kg/min) and X', I1', XL' (pmol/L/min).

    `infusion` is in pmol/kg/min.
    """
    isc1 = x[st.ISC1]
    isc2 = x[st.ISC2]
    ip = x[st.IP]
    il = x[st.IL]
    insulin = ip / p[par.VI]

    dx[st.ISC1] = infusion - (p[par.KA1] + p[par.KD]) * isc1
    dx[st.ISC2] = p[par.KD] * isc1 - p[par.KA2] * isc2
    appearance = p[par.KA1] * isc1 + p[par.KA2] * isc2

    dx[st.IP] = appearance + p[par.M1] * il - (p[par.M2] + p[par.M4]) * ip
    dx[st.IL] = p[par.M2] * ip - (p[par.M1] + p[par.M30]) * il

    dx[st.X] = p[par.P2U] * (insulin - p[par.IB] - x[st.X])
    dx[st.I1] = p[par.KI] * (insulin - x[st.I1])
    dx[st.XL] = p[par.KI] * (x[st.I1] - x[st.XL])


@entry_point(float64, READS, READS)
def plasma_insulin(x: Array, p: Array) -> float:
    """I = Ip/Vi, pmol/L."""
    concentration: float = x[st.IP] / p[par.VI]
    return concentration
