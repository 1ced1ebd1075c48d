"""The steady state at a chosen glucose: consistent compartments and the basal insulin that holds them.

Every derivative is zero. Plasma glucose fixes Gp; the tissue balance and the production balance then are two
equations for tissue glucose Gt and insulin I:

    U = k1·Gp - k2·Gt                                   exchange (Gt' = 0 makes it the tissue uptake)
    kp1 - kp2·Gp - kp3·I - Fsnc - E = U                 Gp' = 0
    (Vm0 + Vmx·(I - Ib))·Gt/(Km0 + Gt) = U              Gt' = 0

Putting the first two into the third leaves a quadratic in Gt.
"""

import math

import numpy as np

from . import parameters as par
from . import states as st
from .compiled import Array
from .insulin import PMOL_PER_U


class NoSteadyStateError(ValueError):
    """There is no amount of insulin that holds the glucose asked for."""


def operating_point(p: Array, basal_glucose: float) -> tuple[Array, float]:
    """Return the state with all derivatives zero at `basal_glucose` (mg/dL) and its basal insulin (U/h).

    Raises:
        NoSteadyStateError: when the balance has no solution with positive insulin and tissue glucose.
    """
    gp = basal_glucose * p[par.VG]
    gt = _tissue_glucose(p, gp)
    excretion = p[par.KE1] * max(0.0, gp - p[par.KE2])
    uptake = p[par.K1] * gp - p[par.K2] * gt
    insulin = (p[par.KP1] - p[par.KP2] * gp - p[par.FSNC] - excretion - uptake) / p[par.KP3]
    if not (gt > 0.0 and insulin > 0.0):
        raise NoSteadyStateError(f"no basal insulin holds {basal_glucose:g} mg/dL")

    x = np.zeros(len(st.STATES))
    x[st.GP] = gp
    x[st.GT] = gt
    x[st.GS] = gp
    x[st.IP] = insulin * p[par.VI]
    x[st.IL] = p[par.M2] * x[st.IP] / (p[par.M1] + p[par.M30])
    x[st.X] = insulin - p[par.IB]
    x[st.I1] = insulin
    x[st.XL] = insulin
    if p[par.S2013] != 0.0:
        # insulin is at Ith; above Gth glucagon secretion rests below its basal rate
        static = p[par.KGSRS] * (p[par.GTH] - basal_glucose) + p[par.K01G] * p[par.HB]
        x[st.SRHS] = max(0.0, static)
        x[st.H] = x[st.SRHS] / p[par.K01G]
    infusion = (p[par.M2] + p[par.M4]) * x[st.IP] - p[par.M1] * x[st.IL]  # pmol/kg/min
    x[st.ISC1] = infusion / (p[par.KA1] + p[par.KD])
    x[st.ISC2] = p[par.KD] * x[st.ISC1] / p[par.KA2]
    return x, float(infusion * p[par.BW] / PMOL_PER_U * 60.0)


def _tissue_glucose(p: Array, gp: float) -> float:
    """The root of a·Gt² + b·Gt + c = 0 that balances production and uptake."""
    excretion = p[par.KE1] * max(0.0, gp - p[par.KE2])
    inflow = p[par.K1] * gp
    # I - Ib = action + slope·Gt
    action = (p[par.KP1] - p[par.KP2] * gp - p[par.FSNC] - excretion - inflow) / p[par.KP3] - p[par.IB]
    slope = p[par.K2] / p[par.KP3]
    a = p[par.VMX] * slope + p[par.K2]
    b = p[par.VM0] + p[par.VMX] * action - inflow + p[par.K2] * p[par.KM0]
    c = -inflow * p[par.KM0]
    # a > 0 > c: exactly one positive root, computed without cancellation
    root = math.sqrt(b * b - 4.0 * a * c)
    return float(-2.0 * c / (b + root)) if b > 0.0 else float((root - b) / (2.0 * a))
