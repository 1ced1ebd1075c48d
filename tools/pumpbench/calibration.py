"""The calibration of the reference controller for one patient: physical values to the integers that are flashed.

This is the tool on the clinic's PC, not the pump: it may use floats. The firmware gets raw values of CFG_Param, one per
index, and a CRC over the set.
"""

import functools
from collections.abc import Mapping
from dataclasses import dataclass

from can_bus import codec
from firmware_sim.calibration import SET_CRC_INDEX, parameter_names, set_crc
from plant_server.physiology import Patient
from pumpbench.controller_model import SAMPLE_MINUTES, ControllerModel, lags, model_of

MODES = {"nma": 2, "ma": 3, "sma": 4, "s1": 5, "s2": 6, "s3": 7, "s4": 8}
"""`--strategy` names of the paper's seven modes -> CtrlMode of the DBC."""


class CalibrationError(ValueError):
    """A value does not fit its parameter; the text says which, and what does."""


@dataclass(frozen=True)
class Tuning:
    """What the paper leaves open, common to all patients (chosen for this project; see docs/design.md)."""

    theta: float = 12.0  # min, time constant of the filter F
    gain: float = 0.68  # gamma K_u / K_d: share of an ideal feedback; 1 would be integral action
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


def lead(tau: float, theta: float, minutes: float = SAMPLE_MINUTES) -> tuple[float, float, float]:
    """(tau s + 1)/(theta s + 1) by Tustin's rule: b0, b1, a1 of y(k) = b0 x(k) + b1 x(k-1) - a1 y(k-1)."""
    below = 1 + 2 * theta / minutes
    return (1 + 2 * tau / minutes) / below, (1 - 2 * tau / minutes) / below, (1 - 2 * theta / minutes) / below


def calibrate(patient: Patient, tuning: Tuning | None = None, model: ControllerModel | None = None) -> dict[int, int]:
    """The calibration of one patient as CfgIndex -> raw value, with the CRC of the set at the end.

    Args:
        patient: whose basal rate and target are flashed.
        tuning: what is common to all patients; default: `Tuning()`.
        model: what the controller knows of the patient; default: the one that comes with the package.

    Raises:
        ControllerModelError: the patient has no controller model.
        CalibrationError: a value is outside its parameter's range.
    """
    tuning = tuning or Tuning()
    model = model or model_of(patient)
    physical = {
        "CfgBasal": patient.basal_u_per_h,
        "CfgCarbRatio": model.carb_ratio,
        "CfgGlucoseTarget": patient.basal_glucose,
        "CfgMaxBasal": tuning.max_basal,
        "CfgMaxBolus": tuning.max_bolus,
        "CfgMaxIob": tuning.max_iob,
        "CfgPramRatio": tuning.pram_ratio,
        "CfgPramBolus": tuning.pram_bolus,
        "CfgInsulinTdd": 24 * patient.basal_u_per_h * 2,
        "CfgStaleCgmLimit": 15.0,
        "CfgMealGain": model.K_d,
        "CfgInsulinGain": model.K_u,
        "CfgObserverGain": tuning.gain * model.K_d / model.K_u,
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
        **_coefficients(tuning.theta, model),
    }
    return with_crc(
        {index: _raw(name, physical[name]) for index, name in parameter_names().items() if name in physical}
    )


def with_crc(raws: Mapping[int, int]) -> dict[int, int]:
    """A set of raw values by CfgIndex, with its CRC as the last one (a CRC already there is replaced)."""
    values = {index: raw for index, raw in raws.items() if index != SET_CRC_INDEX}
    return {**values, SET_CRC_INDEX: set_crc(values)}


@functools.lru_cache(maxsize=64)  # two matrix exponentials; a campaign asks for the same few again and again
def _coefficients(theta: float, model: ControllerModel) -> Mapping[str, float]:
    b0, b1, a1 = lead(model.tau_1d, theta)
    c0, c1, _ = lead(model.tau_2d, theta)
    values = {"CfgLead1B0": b0, "CfgLead1B1": b1, "CfgLead2B0": c0, "CfgLead2B1": c1, "CfgLeadA1": a1}
    matrix, inlet = lags((model.tau_1u, model.tau_1u, model.tau_2u))
    for i in range(3):
        values[f"CfgInsulinB{i + 1}"] = float(inlet[i])
        for j in range(i + 1):
            values[f"CfgInsulinA{i + 1}{j + 1}"] = float(matrix[i, j])
    matrix, inlet = lags((theta, theta, theta))
    for i in range(3):
        values[f"CfgFilterB{i + 1}"] = float(inlet[i])
        values[f"CfgFilterA{i + 1}"] = float(matrix[i, 0])
    return values


def _raw(name: str, value: float) -> int:
    import dbc  # noqa: PLC0415

    signal = dbc.load().get_message_by_name("CFG_Param").get_signal_by_name(name)
    raw = round((value - float(signal.offset)) / float(signal.scale))
    field = codec.message("CFG_Param").fields[name]
    if not field.low <= raw <= field.high:
        raise CalibrationError(f"{name}: {value:g} {signal.unit} is outside {signal.minimum:g}..{signal.maximum:g}")
    return raw
