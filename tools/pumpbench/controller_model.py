"""The models the controller works with, one per patient, and how they are identified from a virtual patient.

Meals and insulin act on subcutaneous glucose through G(s) = K e^(-15 s) / ((tau_1 s + 1)^2 (tau_2 s + 1)), the
structure of Pons Torres et al. 2025, section "Main controller". The paper keeps its values to itself. Here they are
fitted to two experiments on the patient at rest: 50 g of carbohydrate eaten in 15 min, and 1 U of insulin given in
5 min, each followed for ten hours. As in the paper the time constants are common to a cohort and only the gains belong
to a patient.
"""

import csv
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from plant_server import physiology
from plant_server.mechanism import SUBSTEPS
from plant_server.physiology import Patient
from pumpbench.files import write_file

SAMPLE_MINUTES = 5.0
DELAY_SAMPLES = 3
SAMPLES = 120
"""Ten hours."""

MEAL_G, MEAL_SAMPLES = 50.0, 3
PULSE_U, PULSE_SAMPLES = 1.0, 1

TAU_BOUNDS = (2.0, 600.0)
"""min; below the plant cannot be told from a delay, above not from an integrator within ten hours."""

CARB_RATIO_FACTOR = 1.47
"""Carbohydrate ratio as a multiple of K_u/K_d (project's choice): with K_u/K_d itself, or the ratios that simglucose's
adults come with, a meal's bolus alone already lowers glucose below target in these models."""

SHIPPED = Path(__file__).with_name("data") / "controller_adults.csv"

Floats = npt.NDArray[np.float64]


class ControllerModelError(ValueError):
    """A file of controller models cannot be used, or has none of this patient; the text names file, row and column."""


class ControllerModel(NamedTuple):
    """What the controller knows of one patient."""

    patient: str
    K_d: float  # mg/dL per g/min
    K_u: float  # mg/dL per U/min, a fall
    tau_1d: float  # min
    tau_2d: float
    tau_1u: float
    tau_2u: float
    carb_ratio: float  # g/U


COLUMNS = ControllerModel._fields


# ---- the file


@functools.cache
def shipped_models() -> dict[str, ControllerModel]:
    """Those of the ten adults that come with the package, by name."""
    return read_models(SHIPPED)


def model_of(patient: Patient, file: Path | None = None, asked: str | None = None) -> ControllerModel:
    """The model the controller works with for one patient.

    Args:
        patient: as loaded.
        file: of models, or None for those of the package.
        asked: how the patient was asked for, if not by name: one of a file of its own is none of the package's,
            whatever its name.

    Raises:
        ControllerModelError: there is none.
    """
    models = shipped_models() if file is None else read_models(file)
    asked = asked or patient.name
    if file is None and asked not in models:
        raise ControllerModelError(
            f"{asked}: the package has controller models of {', '.join(models)} only; make one with "
            f"`pumpbench identify-controller {asked} --out models.csv`, and give it with --controller models.csv"
        )
    if patient.name not in models:
        raise ControllerModelError(f"{file}: no model of patient {patient.name!r}; it has {', '.join(models)}")
    return models[patient.name]


def read_models(path: Path) -> dict[str, ControllerModel]:
    """Read a CSV file with the columns of `ControllerModel`; lines that start with # are comments.

    Raises:
        ControllerModelError: what is wrong, and where.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ControllerModelError(f"{path}: cannot be read: {error}") from None
    numbered = [(number, line) for number, line in enumerate(lines, 1) if line.strip() and not line.startswith("#")]
    if not numbered:
        raise ControllerModelError(f"{path}: the file is empty, expected the columns {','.join(COLUMNS)}")
    header = [cell.strip() for cell in numbered[0][1].split(",")]
    if set(header) != set(COLUMNS) or len(header) != len(COLUMNS):
        raise ControllerModelError(f"{path}, line {numbered[0][0]}: columns {header}, expected {','.join(COLUMNS)}")
    models: dict[str, ControllerModel] = {}
    for (number, _), cells in zip(numbered[1:], csv.reader(line for _, line in numbered[1:]), strict=True):
        where = f"{path}, line {number}"
        if len(cells) != len(COLUMNS):
            raise ControllerModelError(f"{where}: {len(cells)} cells, expected {len(COLUMNS)}")
        row = dict(zip(header, cells, strict=True))
        name = row.pop("patient").strip()
        if name in models:
            raise ControllerModelError(f"{where}: patient {name!r} is there twice")
        models[name] = ControllerModel(name, **{column: _positive(cell, where, column) for column, cell in row.items()})
    return models


def _positive(text: str, where: str, column: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 < value < float("inf"):
        raise ControllerModelError(f"{where}, {column}: {text.strip()!r}, expected a number above 0")
    return value


def write_models(path: Path, models: Sequence[ControllerModel]) -> None:
    """Write the file that `read_models` reads; it is there as a whole or not at all."""
    lines = [
        "# Controller models identified by pumpbench from the patients' responses at rest to 50 g eaten in 15 min and",
        "# to 1 U in 5 min. K_d: mg/dL per (g/min); K_u: mg/dL per (U/min); tau: min, common to all; carb_ratio: g/U.",
        ",".join(COLUMNS),
        *(",".join([model.patient, *(f"{value:.6g}" for value in model[1:])]) for model in models),
    ]
    write_file(path, ("\n".join(lines) + "\n").encode())


# ---- identification


def lags(taus: tuple[float, float, float], minutes: float = SAMPLE_MINUTES) -> tuple[Floats, Floats]:
    """Three first-order lags in cascade with an exact hold of the input over one sample.

    Args:
        taus: time constants in min, in order from the input.
        minutes: length of the sample.

    Returns:
        A (3x3, lower triangular) and B (3) of x(k+1) = A x(k) + B u(k); the output is x[2].
    """
    from scipy.linalg import expm  # noqa: PLC0415

    system = np.zeros((4, 4))
    for i, tau in enumerate(taus):
        system[i, i] = -1 / tau
        system[i, i - 1 if i else 3] = 1 / tau
    discrete = expm(system * minutes)
    return discrete[:3, :3], discrete[:3, 3]


def identify(patients: Sequence[Patient]) -> list[ControllerModel]:
    """Identify the models of a cohort: common time constants, and the gains of each patient.

    The time constants minimise the squared errors of all patients, each response divided by its range so that a
    sensitive patient counts no more than another.

    Args:
        patients: at least one; their pramlintide does not matter, for none is given.

    Raises:
        ControllerModelError: a patient does not respond as one with diabetes does.
    """
    meals = [_response(patient, carbs_g=MEAL_G) for patient in patients]
    pulses = [-_response(patient, insulin_u=PULSE_U) for patient in patients]
    for patient, rise, fall in zip(patients, meals, pulses, strict=True):
        if rise.max() <= 1.0 or fall.max() <= 1.0:
            raise ControllerModelError(
                f"patient {patient.name!r}: {MEAL_G:g} g raise glucose by {rise.max():.2f} mg/dL, {PULSE_U:g} U lower "
                f"it by {fall.max():.2f}; expected both above 1 mg/dL"
            )
    (tau_1d, tau_2d), meal_gains = _fit(meals, _pulse(MEAL_G, MEAL_SAMPLES), ((100, 5), (5, 150), (150, 2.5)))
    (tau_1u, tau_2u), insulin_gains = _fit(pulses, _pulse(PULSE_U, PULSE_SAMPLES), ((80, 300), (200, 50), (50, 50)))
    return [
        ControllerModel(patient.name, K_d, K_u, tau_1d, tau_2d, tau_1u, tau_2u, CARB_RATIO_FACTOR * K_u / K_d)
        for patient, K_d, K_u in zip(patients, meal_gains, insulin_gains, strict=True)
    ]


def _pulse(amount: float, samples: int) -> Floats:
    """An amount spread over the first samples, per minute."""
    pulse = np.zeros(SAMPLES)
    pulse[:samples] = amount / (samples * SAMPLE_MINUTES)
    return pulse


def _response(patient: Patient, *, carbs_g: float = 0.0, insulin_u: float = 0.0) -> Floats:
    """Subcutaneous glucose above its resting value after a meal or a pulse of insulin, mg/dL, SAMPLES + 1 values."""
    x = patient.x0.copy()
    carbs = np.zeros(SAMPLES * SUBSTEPS)
    carbs[: MEAL_SAMPLES * SUBSTEPS] = carbs_g * 1000 / (MEAL_SAMPLES * SUBSTEPS)
    insulin = np.full(SAMPLES * SUBSTEPS, patient.basal_u_per_h / 60 * physiology.STEP_MIN)
    insulin[: PULSE_SAMPLES * SUBSTEPS] += insulin_u / (PULSE_SAMPLES * SUBSTEPS)
    if carbs_g > 0.0:
        physiology.begin_meal(x, patient.params, carbs_g * 1000)
    glucose = [physiology.interstitial(x, patient.params)]
    for sample in range(SAMPLES):
        piece = slice(sample * SUBSTEPS, (sample + 1) * SUBSTEPS)
        minutes = sample * SAMPLE_MINUTES
        physiology.advance(x, patient.params, minutes, insulin[piece], np.zeros(SUBSTEPS), carbs[piece])
        glucose.append(physiology.interstitial(x, patient.params))
    return np.array(glucose) - glucose[0]


def _unit_response(tau_1: float, tau_2: float, u: Floats) -> Floats:
    """Response of G(s) with K = 1 to an input held over each sample."""
    matrix, inlet = lags((tau_1, tau_1, tau_2))
    delayed = np.concatenate([np.zeros(DELAY_SAMPLES), u])[:SAMPLES]
    x = np.zeros(3)
    output = [0.0]
    for value in delayed:
        x = matrix @ x + inlet * value
        output.append(x[2])
    return np.array(output)


def _fit(
    responses: Sequence[Floats], u: Floats, starts: Sequence[tuple[float, float]]
) -> tuple[tuple[float, float], list[float]]:
    """Common (tau_1, tau_2), the best of several starting points, and the gain of every response."""
    scaled = [response / np.ptp(response) for response in responses]

    def errors(log_taus: Floats) -> Floats:
        tau_1, tau_2 = np.exp(log_taus)
        unit = _unit_response(tau_1, tau_2, u)
        return np.concatenate([response - unit * (unit @ response) / (unit @ unit) for response in scaled])

    bounds = (np.log([TAU_BOUNDS[0]] * 2), np.log([TAU_BOUNDS[1]] * 2))
    from scipy.optimize import least_squares  # noqa: PLC0415  a third of the time a run takes to start

    fits = [least_squares(errors, np.log(start), bounds=bounds) for start in starts]
    tau_1, tau_2 = np.exp(min(fits, key=lambda fit: float(fit.cost)).x)
    unit = _unit_response(tau_1, tau_2, u)
    return (float(tau_1), float(tau_2)), [float(unit @ response / (unit @ unit)) for response in responses]
