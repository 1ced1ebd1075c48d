"""The virtual patients: from a row of a CSV file to parameters, steady state and basal insulin."""

import csv
import difflib
import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from . import parameters as par
from . import states as st
from .compiled import Array
from .operating_point import NoSteadyStateError, operating_point

_DATA = Path(__file__).parent / "data"
_COHORT = _DATA / "adults.csv"
_PRAMLINTIDE = _DATA / "pramlintide.csv"

PHYSIOLOGIES = ("S2008", "S2013")

#: mg/dL; outside this range a person with diabetes is not at rest, and counter-regulation has no meaning
BASAL_GLUCOSE_RANGE = (60.0, 300.0)

#: Type 1 diabetes shows 0.65 of the plasma concentration of healthy subjects (Kolterman 1996, label).
TYPE_1 = "+type1"
TYPE_1_BIOAVAILABILITY = 0.65

# Columns of a patient file. Those of simglucose keep its names, so its file can be used after adding carb_ratio.
_REQUIRED = {
    ("d" if record.name == "c" else record.name): index
    for index, record in enumerate(par.PARAMETERS)
    if record.source == par.COHORT
}
#: parameters of S2013 and their values when a file has no such column
_OPTIONAL = {
    "small_meal": 30000.0,
    "r1": 0.81,
    "r3": 1.44,
    "kcounter": 0.01,
    "kXGn": 0.1,
    "k01g": 0.2,
    "Hb": 60.0,
    "alfaG": 0.5,
    "kGSRs": 0.2,
    "kGSRd": 0.1,
}
_OTHER = ("Name", "physiology", "Gb", "carb_ratio", "u2ss")
#: columns of simglucose's file that follow from the others, or that it does not use itself
_REDUNDANT = (
    *("i", "EGPb", "Ipb", "Ilb", "m5", "CL", "HEb", "Gpb", "Gtb", "Rdb", "PCRb", "dosekempt", "isc1ss", "isc2ss"),
    *("patient_history", "basal_U_per_h", "r2", *(f"x0_{i:2d}" for i in range(1, 14))),
)
_PRAMLINTIDE_COLUMNS = ("a_s", "kq1", "kq12", "kq2", "ke", "VP", "ka", "n", "d", "e")

_MAY_BE_ZERO = {"Fsnc", "ke1", "Vmx", "m4", "small_meal", "r3", "kcounter", "Hb", "kGSRs", "kGSRd", "n"}
#: shares, and the greatest value each can have
_SHARES = {"b": 0.999, "d": 0.999, "f": 1.0}
#: 1/min; a faster process does not fit a Runge-Kutta step of 30 s
FASTEST_RATE = 2.0

Rows = dict[str, tuple[int, dict[str, str]]]


class PatientError(ValueError):
    """A patient, a pramlintide set or a patient file that cannot be used."""


@dataclass(frozen=True)
class Patient:
    """A virtual patient at rest."""

    name: str
    params: Array  #: parameter vector, read-only
    x0: Array  #: state vector at the operating point, read-only
    basal_u_per_h: float  #: basal insulin that holds the operating point
    basal_glucose: float  #: glucose of the operating point, mg/dL
    carb_ratio_g_per_u: float  #: grams of carbohydrate covered by one unit
    body_weight_kg: float
    physiology: str  #: "S2008" or "S2013"


def cohort() -> tuple[str, ...]:
    """Names of the adults that come with the package."""
    return tuple(_table(_COHORT, "Name"))


def load_patient(
    name: str,
    *,
    basal_glucose: float | None = 120.0,
    pramlintide: str = "P2",
    physiology: str | None = None,
) -> Patient:
    """Load a virtual patient.

    Args:
        name: one of `cohort()`, or `path/to/file.csv#name` for a file of your own (docs/physiology.md).
        basal_glucose: glucose of the operating point, mg/dL; None for the patient's own (column Gb).
        pramlintide: name of a parameter set (data/pramlintide.csv), with `+type1` for the bioavailability
            seen in type 1 diabetes.
        physiology: "S2008" or "S2013"; None for what the file says.

    Raises:
        PatientError: for an unknown name or an unusable file, naming file, row and column.
    """
    path, row_name = _locate(name)
    rows = _table(path, "Name")
    if row_name not in rows:
        raise PatientError(_unknown("patient", row_name, rows, path))
    line, row = rows[row_name]

    p = np.zeros(len(par.PARAMETERS))
    for column, index in _REQUIRED.items():
        p[index] = _number(path, line, row, column)
    p[[par.INDEX[column] for column in _PRAMLINTIDE_COLUMNS]] = pramlintide_set(pramlintide)
    if p[par.K_MIN] > p[par.K_MAX]:
        raise PatientError(f"{path.name}, row {line}, column 'kmin': greater than kmax")
    for column, greatest in _SHARES.items():
        if p[_REQUIRED[column]] > greatest:
            raise PatientError(f"{path.name}, row {line}, column {column!r}: a share is at most {greatest:g}")

    native = _number(path, line, row, "Gb")
    level = native if basal_glucose is None else float(basal_glucose)
    if not BASAL_GLUCOSE_RANGE[0] <= level <= BASAL_GLUCOSE_RANGE[1]:
        low, high = BASAL_GLUCOSE_RANGE
        raise PatientError(f"basal glucose {level:g} mg/dL is outside {low:g}..{high:g}")

    chosen = physiology or (row.get("physiology") or PHYSIOLOGIES[0]).strip()
    if chosen not in PHYSIOLOGIES:
        where = "" if physiology else f"{path.name}, row {line}, column 'physiology': "
        raise PatientError(f"{where}unknown physiology {chosen!r}; there are {', '.join(PHYSIOLOGIES)}")
    if chosen == "S2013":
        p[par.S2013] = 1.0
        for column, default in _OPTIONAL.items():
            p[par.INDEX[column]] = _number(path, line, row, column, default)
        # Re-basing moves the basal glucose, from which a fall is counted; it does not turn a raised one healthy.
        p[par.GTH] = min(level, native)
        p[par.R2] = math.log(p[par.GTH]) ** p[par.R1]
    elif row.get("small_meal"):
        p[par.SMALL_MEAL] = _number(path, line, row, "small_meal")

    try:
        x0, basal = operating_point(p, level)
    except NoSteadyStateError as error:
        raise PatientError(f"{path.name}, row {line} ({row_name}): {error}") from error
    p[par.ITH] = x0[st.IP] / p[par.VI]

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
        physiology=chosen,
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
    """File and row of a patient; names of the cohort hold a '#' themselves."""
    before, mark, after = name.partition(".csv#")
    if not mark and name.endswith(".csv"):
        raise PatientError(f"{name}: say which patient of the file, as {name}#name")
    return (Path(before + ".csv"), after) if mark else (_COHORT, name)


def _table(path: Path, key: str) -> Rows:
    """Rows of a CSV file by their `key` column, each with its line; files of the package are read once."""
    return _shipped(path, key) if path.parent == _DATA else _read(path, key)


@cache
def _shipped(path: Path, key: str) -> Rows:
    return _read(path, key)


def _read(path: Path, key: str) -> Rows:
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise PatientError(f"cannot read patient file {path}: {error}") from error
    # (line number, text), without comments and empty lines
    content = [(i, text) for i, text in enumerate(lines, 1) if text.strip() and not text.startswith("#")]
    if not content:
        raise PatientError(f"{path}: the file is empty")
    try:
        table = list(csv.reader((text for _, text in content), strict=True))
    except csv.Error as error:
        raise PatientError(f"{path}: not a CSV file: {error}") from error
    if len(table) != len(content):
        raise PatientError(f"{path}: a quoted cell runs over the end of its line")
    header = [column.rstrip() for column in table[0]]
    _check_header(path, content[0][0], header, key)

    rows: Rows = {}
    for (line, _), cells in zip(content[1:], table[1:], strict=True):
        if len(cells) != len(header):
            raise PatientError(f"{path.name}, row {line}: {len(cells)} cells, but {len(header)} columns")
        row = dict(zip(header, cells, strict=True))
        name = row[key].strip()
        if not name:
            raise PatientError(f"{path.name}, row {line}, column {key!r}: missing")
        if name in rows:
            raise PatientError(f"{path.name}, row {line}, column {key!r}: {name!r} stands in row {rows[name][0]} too")
        rows[name] = (line, row)
    return rows


def _check_header(path: Path, line: int, header: list[str], key: str) -> None:
    """A misspelt column must not pass for one that is left out."""
    where = f"{path.name}, row {line}"
    if key not in header:
        raise PatientError(f"{where}: no column {key!r}")
    known: Iterable[str]
    if key == "Name":
        needed: Iterable[str] = (*_REQUIRED, "Gb", "carb_ratio")
        known = {*_REQUIRED, *_OPTIONAL, *_OTHER, *_REDUNDANT}
    else:
        needed, known = _PRAMLINTIDE_COLUMNS, {*_PRAMLINTIDE_COLUMNS, "set", "source"}
    for column in header:
        if header.count(column) > 1:
            raise PatientError(f"{where}: column {column!r} stands there twice")
        if column not in known:
            raise PatientError(f"{where}: unknown column {column!r}{_hint(column, known)}")
    for column in needed:
        if column not in header:
            raise PatientError(f"{where}: no column {column!r}")


def _number(path: Path, line: int, row: dict[str, str], column: str, default: float | None = None) -> float:
    where = f"{path.name}, row {line}, column {column!r}"
    text = row.get(column, "").strip()
    if not text:
        if default is None:
            raise PatientError(f"{where}: missing")
        return default
    try:
        value = float(text)
    except ValueError:
        raise PatientError(f"{where}: {text!r} is not a number") from None
    if not math.isfinite(value) or value < 0.0:
        raise PatientError(f"{where}: {text} must be a finite number, zero or greater")
    if value == 0.0 and column not in _MAY_BE_ZERO:
        raise PatientError(f"{where}: must be greater than zero")
    unit = par.PARAMETERS[par.INDEX[column]].unit if column in par.INDEX else ""
    if unit == "1/min" and value > FASTEST_RATE:
        raise PatientError(f"{where}: {text} per minute is too fast for steps of 30 s (at most {FASTEST_RATE:g})")
    return value


def _unknown(what: str, name: str, rows: Rows, path: Path) -> str:
    return f"unknown {what} {name!r}{_hint(name, rows)}; {path.name} has {', '.join(rows)}"


def _hint(name: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(name, known, n=1)
    return f", did you mean {close[0]!r}?" if close else ""
