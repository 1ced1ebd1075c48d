"""The virtual patients: from a row of a CSV file to parameters, steady state and basal insulin."""

import csv
import difflib
import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from . import parameters as par
from .operating_point import NoSteadyStateError, operating_point

Array = npt.NDArray[np.float64]

_DATA = Path(__file__).parent / "data"
_COHORT = _DATA / "adults.csv"
_PRAMLINTIDE = _DATA / "pramlintide.csv"

#: Type 1 diabetes shows 0.65 of the plasma concentration of healthy subjects (Kolterman 1996, label).
TYPE_1 = "+type1"
TYPE_1_BIOAVAILABILITY = 0.65

#: columns of a patient file that are parameters; `d` is the name that simglucose gives to the paper's c
_PATIENT_COLUMNS = {
    ("d" if record.name == "c" else record.name): index
    for index, record in enumerate(par.PARAMETERS)
    if record.source.startswith("simglucose")
}
_PRAMLINTIDE_COLUMNS = ("a_s", "kq1", "kq12", "kq2", "ke", "VP", "ka", "n", "d", "e")


class PatientError(ValueError):
    """A patient, a pramlintide set or a patient file that cannot be used."""


@dataclass(frozen=True)
class Patient:
    """A virtual patient at rest."""

    name: str
    params: Array  #: parameter vector, read-only
    x0: Array  #: state vector at the operating point, read-only
    basal_u_per_h: float  #: basal insulin that holds the operating point
    basal_glucose: float  #: mg/dL
    carb_ratio_g_per_u: float  #: grams of carbohydrate covered by one unit
    body_weight_kg: float


def cohort() -> tuple[str, ...]:
    """Names of the adults that come with the package."""
    return tuple(_table(_COHORT, "Name"))


def load_patient(name: str, *, basal_glucose: float | None = 120.0, pramlintide: str = "P2") -> Patient:
    """Load a virtual patient.

    Args:
        name: one of `cohort()`, or `path/to/file.csv#name` for a file of your own (docs/physiology.md).
        basal_glucose: glucose of the operating point, mg/dL; None for the patient's own (column Gb).
        pramlintide: name of a parameter set (data/pramlintide.csv), with `+type1` for the bioavailability
            seen in type 1 diabetes.

    Raises:
        PatientError: for an unknown name or an unusable file, naming file, row and column.
    """
    path, row_name = _locate(name)
    rows = _table(path, "Name")
    if row_name not in rows:
        raise PatientError(_unknown("patient", row_name, rows, path))
    line, row = rows[row_name]

    p = np.zeros(len(par.PARAMETERS))
    for column, index in _PATIENT_COLUMNS.items():
        p[index] = _number(path, line, row, column)
    p[[par.INDEX[column] for column in _PRAMLINTIDE_COLUMNS]] = pramlintide_set(pramlintide)

    native = _number(path, line, row, "Gb")
    level = native if basal_glucose is None else float(basal_glucose)
    try:
        x0, basal = operating_point(p, level)
    except NoSteadyStateError as error:
        raise PatientError(f"{path.name}, row {line} ({row_name}): {error}") from error

    p.flags.writeable = False
    x0.flags.writeable = False
    return Patient(
        name=row_name,
        params=p,
        x0=x0,
        basal_u_per_h=basal,
        basal_glucose=level,
        carb_ratio_g_per_u=_number(path, line, row, "carb_ratio"),
        body_weight_kg=float(p[par.BW]),
    )


def pramlintide_sets() -> tuple[str, ...]:
    """Names of the pramlintide parameter sets."""
    return tuple(_table(_PRAMLINTIDE, "set"))


def pramlintide_set(name: str) -> list[float]:
    """The ten pramlintide parameters in array order, a_s ... e.

    `+type1` scales a_s and d alike: the effect on the stomach was fitted to what was seen in patients, so it
    must not weaken because the same doses are taken to give a lower plasma concentration.
    """
    base, type1 = (name.removesuffix(TYPE_1), name.endswith(TYPE_1))
    sets = _table(_PRAMLINTIDE, "set")
    if base not in sets:
        raise PatientError(_unknown("pramlintide set", base, sets, _PRAMLINTIDE))
    line, row = sets[base]
    values = {column: _number(_PRAMLINTIDE, line, row, column) for column in _PRAMLINTIDE_COLUMNS}
    if type1:
        values["a_s"] *= TYPE_1_BIOAVAILABILITY
        values["d"] *= TYPE_1_BIOAVAILABILITY
    return list(values.values())


def _locate(name: str) -> tuple[Path, str]:
    file, mark, row_name = name.rpartition("#")
    if mark and file.lower().endswith(".csv"):
        return Path(file), row_name
    # names of the cohort hold a '#' themselves
    before, mark, after = name.partition(".csv#")
    return (Path(before + ".csv"), after) if mark else (_COHORT, name)


@cache
def _shipped(path: Path, key: str) -> dict[str, tuple[int, dict[str, str]]]:
    return _read(path, key)


def _table(path: Path, key: str) -> dict[str, tuple[int, dict[str, str]]]:
    """Rows of a CSV file by their `key` column, each with its line; files of the package are read once."""
    return _shipped(path, key) if path.parent == _DATA else _read(path, key)


def _read(path: Path, key: str) -> dict[str, tuple[int, dict[str, str]]]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            rows = {row[key]: (reader.line_num, row) for row in reader if row.get(key)}
            columns = reader.fieldnames or ()
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise PatientError(f"cannot read patient file {path}: {error}") from error
    if key not in columns:
        raise PatientError(f"{path}: no column {key!r}")
    return rows


def _number(path: Path, line: int, row: dict[str, str], column: str) -> float:
    text = row.get(column)
    where = f"{path.name}, row {line}, column {column!r}"
    if text is None or not text.strip():
        raise PatientError(f"{where}: missing")
    try:
        value = float(text)
    except ValueError:
        raise PatientError(f"{where}: {text!r} is not a number") from None
    if not math.isfinite(value) or value < 0.0:
        raise PatientError(f"{where}: {text} must be a finite number, zero or greater")
    return value


def _unknown(what: str, name: str, known: dict[str, tuple[int, dict[str, str]]], path: Path) -> str:
    close = difflib.get_close_matches(name, known, n=1)
    hint = f"; did you mean {close[0]!r}?" if close else ""
    return f"unknown {what} {name!r}; {path.name} has {', '.join(known)}{hint}"
