"""The virtual patient: glucose, insulin and pramlintide in one body, advanced in steps of 30 s."""

from .gastric import begin_meal, q_sto, rate_of_appearance
from .glucose import glucose, interstitial
from .insulin import plasma_insulin
from .integrate import STEP_MIN, advance
from .parameters import PARAMETERS, Parameter
from .patients import PHYSIOLOGIES, Patient, PatientError, cohort, load_patient, patients_of, pramlintide_sets
from .pramlintide import eta, plasma_pramlintide
from .states import STATES, State
from .variability import NOMINAL, SOURCES, MealFactors, Variability

__all__ = [
    "NOMINAL",
    "PARAMETERS",
    "PHYSIOLOGIES",
    "SOURCES",
    "STATES",
    "STEP_MIN",
    "MealFactors",
    "Parameter",
    "Patient",
    "PatientError",
    "State",
    "Variability",
    "advance",
    "begin_meal",
    "cohort",
    "eta",
    "glucose",
    "interstitial",
    "load_patient",
    "patients_of",
    "plasma_insulin",
    "plasma_pramlintide",
    "pramlintide_sets",
    "q_sto",
    "rate_of_appearance",
]
