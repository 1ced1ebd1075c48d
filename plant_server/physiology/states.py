"""The state vector: one named number per compartment, in array order."""

from typing import NamedTuple


class State(NamedTuple):
    """One entry of the state vector."""

    name: str
    unit: str
    description: str
    source: str


STATES = (
    State("Qsto1", "mg", "solid carbohydrate in the stomach", "Pons Torres 2025, meal model"),
    State("Qsto2", "mg", "ground carbohydrate in the stomach", "Pons Torres 2025, meal model"),
    State("Qgut", "mg", "glucose in the intestine", "Pons Torres 2025, meal model"),
    State("Gp", "mg/kg", "glucose in plasma and fast tissues", "Dalla Man 2007, glucose subsystem"),
    State("Gt", "mg/kg", "glucose in slow tissues", "Dalla Man 2007, glucose subsystem"),
    State("Gs", "mg/kg", "interstitial glucose, times Vg", "simglucose (MIT), state 13"),
    State("Ip", "pmol/kg", "insulin in plasma", "Dalla Man 2007, insulin subsystem"),
    State("Il", "pmol/kg", "insulin in the liver", "Dalla Man 2007, insulin subsystem"),
    State("X", "pmol/L", "insulin action on glucose utilisation, above basal", "Dalla Man 2007"),
    State("I1", "pmol/L", "delayed insulin signal, first stage", "Dalla Man 2007"),
    State("XL", "pmol/L", "delayed insulin signal on glucose production", "Dalla Man 2007, Dalla Man 2014"),
    State("Isc1", "pmol/kg", "non-monomeric insulin under the skin", "Dalla Man 2007"),
    State("Isc2", "pmol/kg", "monomeric insulin under the skin", "Dalla Man 2007"),
    State("Q1", "pmol", "pramlintide under the skin, first compartment", "Pons Torres 2025, PK model"),
    State("Q2", "pmol", "pramlintide under the skin, second compartment", "Pons Torres 2025, PK model"),
    State("P1", "pmol", "pramlintide in plasma", "Pons Torres 2025, PK model"),
    State("Peff", "pmol", "pramlintide at its place of action", "Pons Torres 2025, PD model"),
    State("H", "ng/L", "glucagon in plasma (S2013)", "Dalla Man 2014"),
    State("XH", "ng/L", "delayed glucagon action on glucose production (S2013)", "Dalla Man 2014"),
    State("SRHs", "ng/L/min", "static glucagon secretion (S2013)", "Dalla Man 2014"),
    State("D", "mg", "size of the current meal; set at a meal's start, not integrated", "Dalla Man 2006"),
)

(
    Q_STO1,
    Q_STO2,
    Q_GUT,
    GP,
    GT,
    GS,
    IP,
    IL,
    X,
    I1,
    XL,
    ISC1,
    ISC2,
    Q1,
    Q2,
    P1,
    P_EFF,
    H,
    XH,
    SRHS,
    D,
) = range(len(STATES))

INTEGRATED = D
"""States with an equation of their own: all but the meal size."""
