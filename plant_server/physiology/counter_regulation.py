"""Counter-regulation of the S2013 simulator: glucagon, and the risk that boosts insulin action (Dalla Man 2014).

Glucagon is given by nobody here, so its subcutaneous compartments are left out.
"""

import math

from . import parameters as par
from . import states as st
from .compiled import Array, compiled

RISK_IS_GREATEST_AT = 60.0
"""mg/dL; the risk grows no further below this glucose."""


@compiled
def risk(g: float, p: Array) -> float:
    """How far glucose has fallen below its basal level: 0 above Gth, 10·[ln(G)^r1 - ln(Gth)^r1]² below it."""
    if g >= p[par.GTH]:
        return 0.0
    distance = math.log(max(g, RISK_IS_GREATEST_AT)) ** p[par.R1] - p[par.R2]
    value: float = 10.0 * distance * distance
    return value


@compiled
def insulin_action_gain(x: Array, p: Array) -> float:
    """1 + r3·risk, the factor on insulin action in Uid."""
    gain: float = 1.0 + p[par.R3] * risk(x[st.GP] / p[par.VG], p)
    return gain


@compiled
def glucagon_production(x: Array, p: Array) -> float:
    """kcounter·XH, the glucose production that glucagon adds, mg/kg/min."""
    production: float = p[par.KCOUNTER] * x[st.XH]
    return production


@compiled
def counter_regulation_derivatives(x: Array, p: Array, dx: Array) -> None:
    """Write H', XH', SRHs'. Needs Gp' in `dx`: glucagon also answers the speed of a fall."""
    g = x[st.GP] / p[par.VG]
    insulin = x[st.IP] / p[par.VI]
    basal_secretion = p[par.K01G] * p[par.HB]

    static = p[par.KGSRS] * (p[par.GTH] - g) / (1.0 + max(0.0, insulin - p[par.ITH])) + basal_secretion
    dynamic = p[par.KGSRD] * max(0.0, -dx[st.GP] / p[par.VG])

    dx[st.SRHS] = p[par.ALFA_G] * (max(0.0, static) - x[st.SRHS])
    dx[st.H] = max(0.0, x[st.SRHS]) + dynamic - p[par.K01G] * x[st.H]
    dx[st.XH] = p[par.KXGN] * (max(0.0, x[st.H] - p[par.HB]) - x[st.XH])
