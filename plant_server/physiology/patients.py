"""The virtual patients: from a row of a CSV file to parameters, steady state and basal insulin."""

import csv
import difflib
import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from . import parameters as par
from . import states as st
from .compiled import Array
from .operating_point import NoSteadyStateError, operating_point

_DATA = Path(__file__).parent / "data"
_COHORT = _DATA / "adults.csv"
_PRAMLINTIDE = _DATA / "pramlintide.csv"

PHYSIOLOGIES = ("S2008", "S2013")

BASAL_GLUCOSE_RANGE = (60.0, 300.0)
"""mg/dL; outside this range a person with diabetes is not at rest, and counter-regulation has no meaning."""

TYPE_1 = "+type1"
TYPE_1_BIOAVAILABILITY = 0.65
"""Type 1 diabetes shows 0.65 of the plasma concentration of healthy subjects (Kolterman 1996, label)."""

# Columns of a patient file. Those of simglucose keep its names, so its file can be used after adding carb_ratio.
_REQUIRED = {
    ("d" if record.name == "c" else record.name): index
    for index, record in enumerate(par.PARAMETERS)
    if record.source == par.COHORT
}
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
"""Parameters of S2013 and their values when a file has no such column."""

_OTHER = ("Name", "physiology", "Gb", "carb_ratio", "u2ss")
_REDUNDANT = (
    *("i", "EGPb", "Ipb", "Ilb", "m5", "CL", "HEb", "Gpb", "Gtb", "Rdb", "PCRb", "dosekempt", "isc1ss", "isc2ss"),
    *("patient_history", "basal_U_per_h", *(f"x0_{i:2d}" for i in range(1, 14))),
    # T1DMS besides: what load_patient sets itself, and the kinetics of injected glucagon
    *("r2", "Gth", "Ith", "SRHb", "SQgluc_k1", "SQgluc_k2", "SQgluc_kc1", "SQgluc_Vgcn", "Vgcn"),
    *("age", "TDI", "CF", *(f"x0_{i}" for i in range(1, 20))),
)
"""Columns of simglucose's file that follow from the others, or that it does not use itself."""

_ALIASES = {"Gnb": "Hb", "CR": "carb_ratio", "names": "Name"}
"""What T1DMS calls columns of ours."""

_AGREEMENT = 0.01
"""How far numbers that say the same may lie apart: files are written with few digits."""

_PRAMLINTIDE_COLUMNS = ("a_s", "kq1", "kq12", "kq2", "ke", "VP", "ka", "n", "d", "e")

_MAY_BE_ZERO = {"Fsnc", "ke1", "Vmx", "m4", "small_meal", "r3", "kcounter", "Hb", "kGSRs", "kGSRd", "n"}
_SHARES = {"b": 0.999, "d": 0.999, "f": 1.0}
"""Shares, and the greatest value each can have."""

FASTEST_RATE = 2.0
"""1/min; a faster process does not fit a Runge-Kutta step of 30 s."""


class Cell(NamedTuple):
    """What a file says, and where."""

    text: str
    where: str


class Row(NamedTuple):
    """A patient of a file, by our name of the column."""

    where: str
    cells: dict[str, Cell]

    def text(self, column: str) -> str:
        """Its text, empty if the file has no such column."""
        return self.cells[column].text if column in self.cells else ""


class Column(NamedTuple):
    """A column as the file spells it; in a transposed file it is a row."""

    spelt: str
    where: str

    @property
    def name(self) -> str:
        """What we call it."""
        return _ALIASES.get(self.spelt, self.spelt)


Rows = dict[str, Row]


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


def patients_of(path: Path) -> tuple[str, ...]:
    """Names of the patients in a file of your own.

    Raises:
        PatientError: the file cannot be used.
    """
    return tuple(_table(path, "Name"))


def load_patient(
    name: str,
    *,
    basal_glucose: float | None = 120.0,
    pramlintide: str = "P4",
    physiology: str | None = None,
) -> Patient:
    """Load a virtual patient.

    Args:
        name: one of `cohort()`, or `path/to/file.csv#name` for a file of your own (docs/physiology.md).
        basal_glucose: glucose of the operating point, mg/dL; None for the patient's own (column Gb).
        pramlintide: name of a parameter set (data/pramlintide.csv; the default is the one from public data alone, the
            paper's study asks for the calibrated `P2`), with `+type1` for the bioavailability
            seen in type 1 diabetes.
        physiology: "S2008" or "S2013"; None for what the file says.

    Raises:
        PatientError: for an unknown name or an unusable file, naming file, row and column.
    """
    path, row_name = _locate(name)
    rows = _table(path, "Name")
    if row_name not in rows:
        raise PatientError(_unknown("patient", row_name, rows, path))
    row = rows[row_name]

    p = np.zeros(len(par.PARAMETERS))
    for column, index in _REQUIRED.items():
        p[index] = _number(row, column)
    p[[par.INDEX[column] for column in _PRAMLINTIDE_COLUMNS]] = pramlintide_set(pramlintide)
    if p[par.K_MIN] > p[par.K_MAX]:
        raise PatientError(f"{row.cells['kmin'].where}: greater than kmax")
    for column, greatest in _SHARES.items():
        if p[_REQUIRED[column]] > greatest:
            raise PatientError(f"{row.cells[column].where}: a share is at most {greatest:g}")

    native = _number(row, "Gb")
    level = native if basal_glucose is None else float(basal_glucose)
    if not BASAL_GLUCOSE_RANGE[0] <= level <= BASAL_GLUCOSE_RANGE[1]:
        low, high = BASAL_GLUCOSE_RANGE
        raise PatientError(f"basal glucose {level:g} mg/dL is outside {low:g}..{high:g}")

    chosen = physiology or row.text("physiology") or _told_by_columns(row)
    if chosen not in PHYSIOLOGIES:
        where = "" if physiology else f"{row.cells['physiology'].where}: "
        raise PatientError(f"{where}unknown physiology {chosen!r}; there are {', '.join(PHYSIOLOGIES)}")
    if chosen == "S2013":
        p[par.S2013] = 1.0
        for column, default in _OPTIONAL.items():
            p[par.INDEX[column]] = _number(row, column, default)
        # Re-basing moves the basal glucose, from which a fall is counted; it does not turn a raised one healthy.
        p[par.GTH] = min(level, native)
        p[par.R2] = math.log(p[par.GTH]) ** p[par.R1]
        _check_risk(row, p, native)
    elif row.text("small_meal"):
        p[par.SMALL_MEAL] = _number(row, "small_meal")
    _check_production(row, p, native)

    try:
        x0, basal = operating_point(p, level)
    except NoSteadyStateError as error:
        raise PatientError(f"{row.where} ({row_name}): {error}") from error
    p[par.ITH] = x0[st.IP] / p[par.VI]

    p.flags.writeable = False
    x0.flags.writeable = False
    return Patient(
        name=row_name,
        params=p,
        x0=x0,
        basal_u_per_h=basal,
        basal_glucose=level,
        carb_ratio_g_per_u=_number(row, "carb_ratio"),
        body_weight_kg=float(p[par.BW]),
        physiology=chosen,
    )


def _told_by_columns(row: Row) -> str:
    """The equations of a file that does not name them: those of 2013 if it has any parameter of theirs."""
    return "S2013" if any(row.text(column) for column in _OPTIONAL if column != "small_meal") else "S2008"


def _check_risk(row: Row, p: Array, native: float) -> None:
    """r2 is not read, but one that belongs to another form of the equation tells that r1 and r3 do too."""
    if row.text("r2"):
        r2, expected = _number(row, "r2"), math.log(native) ** p[par.R1]
        if abs(r2 - expected) > _AGREEMENT * expected:
            raise PatientError(
                f"{row.cells['r2'].where}: {r2:g} is not ln(Gb)^r1 = {expected:.4g}, at which the risk is zero at Gb; "
                "in the form read here r1 is the exponent and r3 the gain"
            )


def _check_production(row: Row, p: Array, native: float) -> None:
    """Basal production follows from the others; where a file gives it too, it tells of a wrong digit."""
    if row.text("EGPb"):
        basal = _number(row, "EGPb")
        kp1 = basal + p[par.KP2] * native * p[par.VG] + p[par.KP3] * p[par.IB]
        if abs(p[par.KP1] - kp1) > _AGREEMENT * kp1:
            raise PatientError(
                f"{row.cells['kp1'].where}: {p[par.KP1]:g} is not EGPb + kp2*Gb*Vg + kp3*Ib = {kp1:.4g}; "
                "one of these is wrong"
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
    values = {column: _number(sets[base], column) for column in _PRAMLINTIDE_COLUMNS}
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
    """Rows of a CSV file by their `key` column; files of the package are read once."""
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
    numbers = [line for line, _ in content]
    for line, cells in zip(numbers, table, strict=True):
        if len(cells) != len(table[0]):
            raise PatientError(f"{path.name}, row {line}: {len(cells)} cells, but {len(table[0])} columns")
    table = [[cell.strip() for cell in cells] for cells in table]
    if key == "Name" and "BW" not in table[0] and any(cells[0] == "BW" for cells in table):
        return _transposed(path, numbers, table)
    return _upright(path, numbers, table, key)


def _upright(path: Path, numbers: list[int], table: list[list[str]], key: str) -> Rows:
    """One row per patient (or set), one column per parameter."""
    columns = [Column(spelt, f"{path.name}, row {numbers[0]}") for spelt in table[0]]
    _check_columns(columns, f"{path.name}, row {numbers[0]}", "column", key)
    rows: Rows = {}
    for line, texts in zip(numbers[1:], table[1:], strict=True):
        where = f"{path.name}, row {line}"
        cells = {
            column.name: Cell(text, f"{where}, column {column.spelt!r}")
            for column, text in zip(columns, texts, strict=True)
        }
        name, place = cells[key]
        if not name:
            raise PatientError(f"{place}: missing")
        if name in rows:
            raise PatientError(f"{place}: {name!r} stands in {rows[name].where.removeprefix(path.name + ', ')} too")
        rows[name] = Row(where, cells)
    return rows


def _transposed(path: Path, numbers: list[int], table: list[list[str]]) -> Rows:
    """One row per parameter, one column per patient; the first row has the patients' names."""
    columns = [Column(cells[0], f"{path.name}, row {line}") for line, cells in zip(numbers[1:], table[1:], strict=True)]
    _check_columns(columns, path.name, "row", None)
    rows: Rows = {}
    for position, name in enumerate(table[0][1:], 1):
        heading = f"{path.name}, row {numbers[0]}, column {position + 1}"
        if not name:
            raise PatientError(f"{heading}: the name of the patient is missing")
        if name in rows:
            raise PatientError(f"{heading}: {name!r} stands there twice")
        cells = {
            column.name: Cell(texts[position], f"{column.where} ({column.spelt!r}), column {name!r}")
            for column, texts in zip(columns, table[1:], strict=True)
        }
        rows[name] = Row(f"{path.name}, column {name!r}", cells)
    return rows


def _check_columns(columns: list[Column], where: str, what: str, key: str | None) -> None:
    """A misspelt column must not pass for one that is left out.

    Args:
        columns: all there are.
        where: where one that is missing would stand.
        what: what the file has them as, "column" or "row".
        key: the one with the names, which says what kind of file it is; None for a transposed patient file.
    """
    names = [column.name for column in columns]
    if key is not None and key not in names:
        raise PatientError(f"{where}: no {what} {key!r}")
    known: Iterable[str]
    if key == "set":
        needed: Iterable[str] = _PRAMLINTIDE_COLUMNS
        known = {*_PRAMLINTIDE_COLUMNS, "set", "source"}
    else:
        needed = (*_REQUIRED, "Gb", "carb_ratio")
        known = {*_REQUIRED, *_OPTIONAL, *_OTHER, *_REDUNDANT, *_ALIASES}
    for column in columns:
        if names.count(column.name) > 1:
            others = {other.spelt for other in columns if other.name == column.name} - {column.spelt}
            same = f", as {others.pop()!r}" if others else ""
            raise PatientError(f"{column.where}: {what} {column.spelt!r} stands there twice{same}")
        if column.spelt not in known:
            raise PatientError(f"{column.where}: unknown {what} {column.spelt!r}{_hint(column.spelt, known)}")
    for name in needed:
        if name not in names:
            alias = next((f" (or {theirs!r})" for theirs, ours in _ALIASES.items() if ours == name), "")
            raise PatientError(f"{where}: no {what} {name!r}{alias}")


def _number(row: Row, column: str, default: float | None = None) -> float:
    text = row.text(column)
    if not text:
        if default is None:
            raise PatientError(f"{row.cells[column].where}: missing")
        return default
    where = row.cells[column].where
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
