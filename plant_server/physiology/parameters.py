"""The parameter vector: every number that the equations use, in array order."""

from typing import NamedTuple


class Parameter(NamedTuple):
    """One entry of the parameter vector."""

    name: str
    unit: str
    description: str
    source: str


_PAPER = "Pons Torres 2025, variability"
COHORT = "simglucose 0.2.11 (MIT), adult cohort"
"""Source of what a patient file must hold."""

_S2013 = "Dalla Man 2014; value LoopInsighT1 (MIT) default"
_T1DMS = "T1DMS, undocumented; LoopInsighT1 (MIT)"
_RISK = "Dalla Man 2014; population value, also in ReplayBG"
_PRAMLINTIDE = "Pons Torres 2025, table of parameters; value in data/pramlintide.csv"

PARAMETERS = (
    Parameter("BW", "kg", "body weight", COHORT),
    # meal
    Parameter("kmax", "1/min", "greatest rate of gastric emptying, and of grinding (kg21)", COHORT),
    Parameter("kmin", "1/min", "least rate of gastric emptying", COHORT),
    Parameter("kabs", "1/min", "rate of intestinal absorption", COHORT),
    Parameter("b", "-", "share of the meal left where emptying has slowed halfway", COHORT),
    Parameter("c", "-", "share of the meal left where emptying is halfway back (`d` in simglucose)", COHORT),
    Parameter("f", "-", "share of absorbed glucose that reaches plasma", COHORT),
    Parameter("small_meal", "mg", "meals below this size empty faster, 30 g in S2013; 0 = rule off", _T1DMS),
    # glucose
    Parameter("Vg", "dL/kg", "distribution volume of glucose", COHORT),
    Parameter("k1", "1/min", "transfer of glucose from plasma to tissue", COHORT),
    Parameter("k2", "1/min", "transfer of glucose from tissue to plasma", COHORT),
    Parameter("kp1", "mg/kg/min", "glucose production extrapolated to zero glucose and insulin", COHORT),
    Parameter("kp2", "1/min", "effect of glucose on its production", COHORT),
    Parameter("kp3", "mg/kg/min per pmol/L", "effect of delayed insulin on glucose production", COHORT),
    Parameter("Fsnc", "mg/kg/min", "insulin-independent utilisation (brain, red cells)", COHORT),
    Parameter("ke1", "1/min", "renal excretion rate", COHORT),
    Parameter("ke2", "mg/kg", "renal threshold", COHORT),
    Parameter("Vm0", "mg/kg/min", "tissue uptake at basal insulin, saturated", COHORT),
    Parameter("Vmx", "mg/kg/min per pmol/L", "gain of insulin action on tissue uptake", COHORT),
    Parameter("Km0", "mg/kg", "Michaelis constant of tissue uptake", COHORT),
    Parameter("ksc", "1/min", "exchange between plasma and interstitial glucose", COHORT),
    # insulin
    Parameter("Vi", "L/kg", "distribution volume of insulin", COHORT),
    Parameter("Ib", "pmol/L", "insulin at which its action X is zero", COHORT),
    Parameter("m1", "1/min", "insulin from liver to plasma", COHORT),
    Parameter("m2", "1/min", "insulin from plasma to liver", COHORT),
    Parameter("m30", "1/min", "insulin cleared by the liver", COHORT),
    Parameter("m4", "1/min", "insulin cleared from plasma", COHORT),
    Parameter("p2u", "1/min", "rate of insulin action on utilisation", COHORT),
    Parameter("ki", "1/min", "rate of the delayed insulin signal", COHORT),
    Parameter("ka1", "1/min", "absorption of non-monomeric insulin", COHORT),
    Parameter("ka2", "1/min", "absorption of monomeric insulin", COHORT),
    Parameter("kd", "1/min", "dissociation of insulin under the skin", COHORT),
    # pramlintide
    Parameter("a_s", "-", "bioavailability of pramlintide", _PRAMLINTIDE),
    Parameter("kq1", "1/min", "pramlintide from first compartment to plasma", _PRAMLINTIDE),
    Parameter("kq12", "1/min", "pramlintide from first to second compartment", _PRAMLINTIDE),
    Parameter("kq2", "1/min", "pramlintide from second compartment to plasma", _PRAMLINTIDE),
    Parameter("ke", "1/min", "elimination of pramlintide", _PRAMLINTIDE),
    Parameter("VP", "L", "distribution volume of pramlintide", _PRAMLINTIDE),
    Parameter("ka", "1/min", "rate of the pramlintide effect", _PRAMLINTIDE),
    Parameter("n", "-", "greatest slowing of gastric emptying, minus one", _PRAMLINTIDE),
    Parameter("d", "pmol", "pramlintide of half the greatest slowing", _PRAMLINTIDE),
    Parameter("e", "-", "Hill exponent", _PRAMLINTIDE),
    # counter-regulation, S2013
    Parameter("S2013", "-", "1 = counter-regulation on, 0 = S2008 equations", "Dalla Man 2014"),
    Parameter("Gth", "mg/dL", "glucose below which counter-regulation starts", "Dalla Man 2014"),
    Parameter("Ith", "pmol/L", "insulin above which glucagon secretion is inhibited", "Dalla Man 2014"),
    Parameter("r1", "-", "exponent of the risk function", _RISK),
    Parameter("r2", "-", "ln(Gth)^r1, so that the risk is zero at Gth", "Dalla Man 2014"),
    Parameter("r3", "-", "gain of the risk on insulin action", _RISK),
    Parameter("kcounter", "mg/kg/min per ng/L", "effect of glucagon on glucose production", _S2013),
    Parameter("kXGn", "1/min", "rate of glucagon action", _S2013),
    Parameter("k01g", "1/min", "clearance of glucagon", _S2013),
    Parameter("Hb", "ng/L", "basal glucagon", _S2013),
    Parameter("alfaG", "1/min", "rate of static glucagon secretion", _S2013),
    Parameter("kGSRs", "ng/L/min per mg/dL", "gain of static glucagon secretion", _S2013),
    Parameter("kGSRd", "ng/L per mg/dL", "gain of dynamic glucagon secretion", _S2013),
    # variability over the day, see variability.py
    Parameter("circadian_amplitude", "-", "relative swing of Vmx and kp3 over the day", _PAPER),
    Parameter("circadian_phase", "rad", "phase of that swing", _PAPER),
)

(
    BW,
    K_MAX,
    K_MIN,
    K_ABS,
    B,
    C,
    F,
    SMALL_MEAL,
    VG,
    K1,
    K2,
    KP1,
    KP2,
    KP3,
    FSNC,
    KE1,
    KE2,
    VM0,
    VMX,
    KM0,
    KSC,
    VI,
    IB,
    M1,
    M2,
    M30,
    M4,
    P2U,
    KI,
    KA1,
    KA2,
    KD,
    A_S,
    KQ1,
    KQ12,
    KQ2,
    KE,
    VP,
    KA,
    N,
    D50,
    E,
    S2013,
    GTH,
    ITH,
    R1,
    R2,
    R3,
    KCOUNTER,
    KXGN,
    K01G,
    HB,
    ALFA_G,
    KGSRS,
    KGSRD,
    CIRCADIAN_AMPLITUDE,
    CIRCADIAN_PHASE,
) = range(len(PARAMETERS))

INDEX = {parameter.name: index for index, parameter in enumerate(PARAMETERS)}
