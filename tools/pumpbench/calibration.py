"""The calibration of the reference controller for one patient: physical values to the integers that are flashed.

This is the tool on the clinic's PC, not the pump: it may use floats. The firmware gets raw values of CFG_Param, one per
index, and a CRC over the set.
"""

import csv
import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.linalg import expm

from can_bus import codec
from firmware_sim.calibration import SET_CRC_INDEX, set_crc
from plant_server.physiology import Patient

SAMPLE_MINUTES = 5.0

DATA = Path(__file__).with_name("data") / "controller_adults.csv"

MODES = {"nma": 2, "ma": 3, "sma": 4, "s1": 5, "s2": 6, "s3": 7, "s4": 8}
"""`--strategy` names of the paper's seven modes -> CtrlMode of the DBC."""


class CalibrationError(ValueError):
    """There is no controller model for this patient, or a value does not fit its parameter."""


@dataclass(frozen=True)
class Tuning:
    """What the paper leaves open, common to all patients (chosen for this project; see docs/design.md)."""

    theta: float = 12.0  # min, time constant of the filter F
    gain: float = 0.68  # gamma K_u / K_d: share of an ideal feedback; 1 would be integral action
    tau_1d: float = 159.0  # min
    tau_2d: float = 2.0
    tau_1u: float = 79.0
    tau_2u: float = 323.0
    bolus_deduction: float = 0.85  # share of a prandial bolus taken out of the feedback
    meal_factor: float = 0.8  # nu of the paper
    assumed_carbs: float = 25.0  # g, the paper's simplified meal
    pram_ratio: float = 10.0  # ug/U, the paper's strategies 2 and 4
    pram_bolus: float = 30.0  # ug, the paper's strategy 1
    max_basal: float = 30.0  # U/h; a study must not touch it, metrics.json counts
    max_bolus: float = 30.0  # U
    max_iob: float = 40.0  # U
    peak_ratio: float = 2.0  # z_1 of strategy 1
    peak_slope: float = 0.5  # mg/dL/min, z_2
    peak_lockout: int = 12  # steps, z_3
    # limits that would change the paper's results are loose here; `SAFE` has the tight ones
    basal_factor: float = 25.5  # times the schedule
    low_suspend: float = 0.0  # mg/dL; 0 = off
    bolus_lockout: int = 0  # steps
    max_rise: float = 60.0  # U/h in a step
    pram_tdd: float = 1000.0  # ug in 24 h
    stuck_samples: int = 0  # equal values in a row; 0 = off


def tuning_for(strategy: str, *, noisy: bool = True) -> Tuning:
    """The tuning of one of the paper's modes: doses as in its Table 2.

    Args:
        strategy: name as in `MODES`.
        noisy: whether the sensor has noise, so that equal values in a row mean that it is stuck.
    """
    return Tuning(pram_bolus=15.0 if strategy == "s3" else 30.0, stuck_samples=10 if noisy else 0)


SAFE = Tuning(basal_factor=4.0, low_suspend=70.0, bolus_lockout=3, max_rise=2.0, stuck_samples=10)
"""The limits of docs/design.md as a product would set them; the paper's runs would touch them."""


@functools.cache
def _gains() -> dict[str, tuple[float, float]]:
    lines = (line for line in DATA.read_text(encoding="utf-8").splitlines() if not line.startswith("#"))
    return {row["patient"]: (float(row["K_d"]), float(row["K_u"])) for row in csv.DictReader(lines)}


def lags(taus: tuple[float, float, float], minutes: float = SAMPLE_MINUTES) -> tuple[np.ndarray, np.ndarray]:
    """Three first-order lags in cascade with an exact hold of the input over one sample.

    Args:
        taus: time constants in min, in order from the input.
        minutes: length of the sample.

    Returns:
        A (3x3, lower triangular) and B (3) of x(k+1) = A x(k) + B u(k); the output is x[2].
    """
    system = np.zeros((4, 4))
    for i, tau in enumerate(taus):
        system[i, i] = -1 / tau
        system[i, i - 1 if i else 3] = 1 / tau
    discrete = expm(system * minutes)
    return discrete[:3, :3], discrete[:3, 3]


def lead(tau: float, theta: float, minutes: float = SAMPLE_MINUTES) -> tuple[float, float, float]:
    """(tau s + 1)/(theta s + 1) by Tustin's rule: b0, b1, a1 of y(k) = b0 x(k) + b1 x(k-1) - a1 y(k-1)."""
    below = 1 + 2 * theta / minutes
    return (1 + 2 * tau / minutes) / below, (1 - 2 * tau / minutes) / below, (1 - 2 * theta / minutes) / below


def calibrate(patient: Patient, tuning: Tuning | None = None) -> dict[int, int]:
    """The calibration of one patient as CfgIndex -> raw value, with the CRC of the set at the end.

    Raises:
        CalibrationError: the patient has no controller model, or a value is outside its parameter's range.
    """
    tuning = tuning or Tuning()
    if patient.name not in _gains():
        raise CalibrationError(
            f"no controller model for patient {patient.name!r} in {DATA.name}; it has {', '.join(_gains())}"
        )
    meal_gain, insulin_gain = _gains()[patient.name]
    physical = {
        "CfgBasal": patient.basal_u_per_h,
        "CfgCarbRatio": patient.carb_ratio_g_per_u,
        "CfgGlucoseTarget": patient.basal_glucose,
        "CfgMaxBasal": tuning.max_basal,
        "CfgMaxBolus": tuning.max_bolus,
        "CfgMaxIob": tuning.max_iob,
        "CfgPramRatio": tuning.pram_ratio,
        "CfgPramBolus": tuning.pram_bolus,
        "CfgInsulinTdd": 24 * patient.basal_u_per_h * 2,
        "CfgStaleCgmLimit": 15.0,
        "CfgMealGain": meal_gain,
        "CfgInsulinGain": insulin_gain,
        "CfgObserverGain": tuning.gain * meal_gain / insulin_gain,
        "CfgBolusDeduction": tuning.bolus_deduction,
        "CfgMealFactor": tuning.meal_factor,
        "CfgAssumedCarbs": tuning.assumed_carbs,
        "CfgPeakRatio": tuning.peak_ratio,
        "CfgPeakSlope": tuning.peak_slope,
        "CfgPeakLockout": tuning.peak_lockout,
        "CfgBasalFactor": tuning.basal_factor,
        "CfgLowSuspend": tuning.low_suspend,
        "CfgBolusLockout": tuning.bolus_lockout,
        "CfgMaxRise": tuning.max_rise,
        "CfgPramTdd": tuning.pram_tdd,
        "CfgStuckSamples": tuning.stuck_samples,
        **_coefficients(tuning),
    }
    raws = {index: _raw(name, physical[name]) for index, name in _indices().items() if name in physical}
    raws[SET_CRC_INDEX] = set_crc(raws)
    return raws


def _coefficients(tuning: Tuning) -> dict[str, float]:
    b0, b1, a1 = lead(tuning.tau_1d, tuning.theta)
    c0, c1, _ = lead(tuning.tau_2d, tuning.theta)
    values = {"CfgLead1B0": b0, "CfgLead1B1": b1, "CfgLead2B0": c0, "CfgLead2B1": c1, "CfgLeadA1": a1}
    matrix, inlet = lags((tuning.tau_1u, tuning.tau_1u, tuning.tau_2u))
    for i in range(3):
        values[f"CfgInsulinB{i + 1}"] = float(inlet[i])
        for j in range(i + 1):
            values[f"CfgInsulinA{i + 1}{j + 1}"] = float(matrix[i, j])
    matrix, inlet = lags((tuning.theta, tuning.theta, tuning.theta))
    for i in range(3):
        values[f"CfgFilterB{i + 1}"] = float(inlet[i])
        values[f"CfgFilterA{i + 1}"] = float(matrix[i, 0])
    return values


def _indices() -> dict[int, str]:
    return {index: fields[0].name for index, fields in codec.message("CFG_Param").pages.items()}


def _raw(name: str, value: float) -> int:
    import dbc  # noqa: PLC0415

    signal = dbc.load().get_message_by_name("CFG_Param").get_signal_by_name(name)
    raw = round((value - float(signal.offset)) / float(signal.scale))
    field = codec.message("CFG_Param").fields[name]
    if not field.low <= raw <= field.high:
        raise CalibrationError(f"{name}: {value:g} {signal.unit} is outside {signal.minimum:g}..{signal.maximum:g}")
    return raw
