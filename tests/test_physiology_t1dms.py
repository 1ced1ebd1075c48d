"""Patient files in the layout of T1DMS: both directions, its names, its .mat by the recipe. All values are invented."""

import csv
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from plant_server.physiology import PatientError, load_patient, patients
from plant_server.physiology import parameters as par

PAGE = Path(__file__).parent.parent / "docs" / "physiology.md"
ADULTS = Path(patients.__file__).parent / "data" / "adults.csv"
S2013 = {
    **{"kcounter": 0.013, "kXGn": 0.09, "k01g": 0.17, "Gnb": 71.0, "alfaG": 0.41, "kGSRs": 0.23, "kGSRd": 0.12},
    **{"r1": 0.83, "r3": 1.31, "SQgluc_k1": 0.03, "SQgluc_k2": 0.02, "SQgluc_kc1": 0.1, "SQgluc_Vgcn": 14.0},
}


def subject(number: int) -> dict[str, float]:
    """An invented patient: one of ours, some numbers moved."""
    text = [line for line in ADULTS.read_text().splitlines() if not line.startswith("#")]
    row = list(csv.DictReader(text))[number]
    ours = ("Name", "physiology", "small_meal", "u2ss")
    values = {column: float(cell) for column, cell in row.items() if column not in ours}
    values["BW"] *= 1.07
    values["kabs"] *= 0.93
    values["EGPb"] = values["kp1"] - values["kp2"] * values["Gb"] * values["Vg"] - values["kp3"] * values["Ib"]
    values |= S2013 | {"Gth": values["Gb"], "Ith": values["Ib"], "r2": math.log(values["Gb"]) ** S2013["r1"]}
    values["CR"] = values.pop("carb_ratio")
    return values


def table() -> list[list[str]]:
    """Upright: names, then two invented patients."""
    subjects = [subject(1), subject(4)]
    header = ["names", *subjects[0]]
    return [header, *([f"s#{i}", *map(repr, values.values())] for i, values in enumerate(subjects, 1))]


def write(path: Path, rows: list[list[str]]) -> Path:
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    return path


def turned(rows: list[list[str]]) -> list[list[str]]:
    return [["parameter", *(row[0] for row in rows[1:])], *map(list, list(zip(*rows, strict=True))[1:])]


def test_upright_and_transposed_are_the_same_patient(tmp_path: Path) -> None:
    upright, transposed = write(tmp_path / "up.csv", table()), write(tmp_path / "over.csv", turned(table()))
    for name, values in (("s#1", subject(1)), ("s#2", subject(4))):
        first, second = (load_patient(f"{path}#{name}", basal_glucose=None) for path in (upright, transposed))
        assert first.params.tobytes() == second.params.tobytes()
        assert first.x0.tobytes() == second.x0.tobytes()
        assert (first.name, first.physiology, first.carb_ratio_g_per_u) == (name, "S2013", values["CR"])
        assert first.basal_glucose == values["Gb"]
        theirs = {"d": "c", "Gnb": "Hb"}
        unread = {"Gb", "EGPb", "CR", "Ith", "r2"}
        for column in values.keys() - unread:
            if not column.startswith("SQgluc"):
                assert first.params[par.INDEX[theirs.get(column, column)]] == values[column], column
        assert first.params[par.R2] == pytest.approx(values["r2"])


def test_a_file_without_s2013_is_s2008_and_either_can_be_chosen(tmp_path: Path) -> None:
    rows = turned(table())
    path = write(tmp_path / "both.csv", rows)
    assert load_patient(f"{path}#s#1", physiology="S2008").params[par.S2013] == 0.0
    old = write(tmp_path / "old.csv", [row for row in rows if row[0] not in S2013.keys() | {"r2", "Gth", "Ith"}])
    assert load_patient(f"{old}#s#1").physiology == "S2008"
    assert load_patient(f"{old}#s#1", physiology="S2013").params[par.HB] == 60.0
    named = write(tmp_path / "named.csv", [*rows, ["physiology", "S2008", ""]])
    assert [load_patient(f"{named}#s#{i}").physiology for i in (1, 2)] == ["S2008", "S2013"]


def at(rows: list[list[str]], name: str) -> int:
    return next(i for i, row in enumerate(rows) if row[0] == name)


def cell(name: str, text: str, column: int = 1):
    def change(rows: list[list[str]]) -> None:
        rows[at(rows, name)][column] = text

    return change


def line_of(name: str) -> str:
    return f"row {at(turned(table()), name) + 1} ({name!r}), column 's#1'"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (cell("kabs", "fast"), [line_of("kabs"), "'fast' is not a number"]),
        (cell("kabs", ""), [line_of("kabs"), "missing"]),
        (cell("Gnb", "-3"), [line_of("Gnb"), "-3 must be"]),
        (cell("BW", "0"), [line_of("BW"), "greater than zero"]),
        (cell("kmin", "1"), [line_of("kmin"), "greater than kmax"]),
        (cell("f", "1.2"), [line_of("f"), "at most 1"]),
        (cell("CR", "x"), [line_of("CR"), "not a number"]),
        (cell("r2", "0.81"), [line_of("r2"), "0.81 is not ln(Gb)^r1", "r1 is the exponent"]),
        (cell("r1", "1.44"), [line_of("r2"), "is not ln(Gb)^r1"]),
        (cell("kp2", "0.5"), [line_of("kp1"), "EGPb + kp2*Gb*Vg + kp3*Ib"]),
        (cell("EGPb", "9"), [line_of("kp1"), "EGPb"]),
        (cell("kabs", "kabz", 0), ["unknown row 'kabz'", "did you mean 'kabs'"]),
        (cell("EGPb", "EGPq", 0), ["row 34", "unknown row 'EGPq'"]),
        (cell("Ith", "Hb", 0), ["'Gnb' stands there twice, as 'Hb'"]),
        (cell("Ith", "Gth", 0), ["'Gth' stands there twice"]),
        (lambda rows: rows.pop(at(rows, "ksc")), ["mine.csv: no row 'ksc'"]),
        (lambda rows: rows.pop(at(rows, "CR")), ["no row 'carb_ratio' (or 'CR')"]),
        (lambda rows: rows[3].pop(), ["row 4", "2 cells, but 3 columns"]),
        (cell("parameter", "s#1", 2), ["row 1, column 3", "'s#1' stands there twice"]),
        (cell("parameter", " ", 2), ["row 1, column 3", "name of the patient is missing"]),
    ],
)
def test_a_wrong_cell_of_a_transposed_file_is_named(tmp_path: Path, change, words: list[str]) -> None:
    rows = turned(table())
    change(rows)
    with pytest.raises(PatientError) as error:
        load_patient(f"{write(tmp_path / 'mine.csv', rows)}#s#1", basal_glucose=None)
    for word in ["mine.csv", *words]:
        assert word in str(error.value)
    assert "\n" not in str(error.value)


def test_a_wrong_cell_of_an_upright_file_is_named_as_the_file_spells_it(tmp_path: Path) -> None:
    rows = table()
    rows[2][rows[0].index("Gnb")] = "many"
    path = write(tmp_path / "mine.csv", rows)
    load_patient(f"{path}#s#1")
    with pytest.raises(PatientError, match=r"mine\.csv, row 3, column 'Gnb': 'many' is not a number"):
        load_patient(f"{path}#s#2")
    with pytest.raises(PatientError, match=r"unknown patient 's#3', did you mean .*; mine\.csv has s#1, s#2"):
        load_patient(f"{path}#s#3")


def test_the_recipe_for_mat_files(tmp_path: Path) -> None:
    script = PAGE.read_text(encoding="utf-8").split("```python\n# mat_to_csv.py", 1)[1].split("```", 1)[0]
    (tmp_path / "mat_to_csv.py").write_text("# " + script)
    values = {column: value for column, value in subject(1).items() if column != "CR"}
    savemat(tmp_path / "one.mat", {"subject": values | {"names": "x", "x0": np.arange(13.0)}, "version": 3.0})
    done = subprocess.run(
        [sys.executable, "mat_to_csv.py", "patients.csv", "one.mat"],
        cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    path = tmp_path / "patients.csv"
    with pytest.raises(PatientError, match="no row 'carb_ratio'"):
        load_patient(f"{path}#my-one")
    path.write_text(path.read_text() + f"carb_ratio,{subject(1)['CR']!r}\n")
    expected = load_patient(f"{write(tmp_path / 'up.csv', table())}#s#1")
    assert load_patient(f"{path}#my-one").params.tobytes() == expected.params.tobytes()


def test_the_page_names_every_column_that_is_read() -> None:
    section = PAGE.read_text(encoding="utf-8").split("### The layout of T1DMS", 1)[1].split("## State vector", 1)[0]
    spelt = {ours: theirs for theirs, ours in patients._ALIASES.items()}
    for column in (*patients._REQUIRED, *patients._OPTIONAL, "Gb", "carb_ratio", "r2", "Gth", "Ith"):
        if column != "small_meal":
            assert f"`{spelt.get(column, column)}`" in section, column
