"""Patients and their files: what loads, and what a file that cannot be used is told."""

import csv
from pathlib import Path

import numpy as np
import pytest

from plant_server import physiology
from plant_server.physiology import PatientError, load_patient, patients
from plant_server.physiology import parameters as par

DATA = Path(patients.__file__).parent / "data"


@pytest.fixture
def write(tmp_path):
    """Write a patient file made from the shipped one by `change`, a function of its rows (lists of cells)."""

    def _write(change, name="mine.csv"):
        text = [line for line in (DATA / "adults.csv").read_text().splitlines() if not line.startswith("#")]
        rows = list(csv.reader(text))[:3]
        change(rows)
        path = tmp_path / name
        with path.open("w", newline="") as file:
            csv.writer(file).writerows(rows)
        return path

    return _write


def set_cell(column, value, row=1):
    def change(rows):
        rows[row][rows[0].index(column)] = value

    return change


def test_cohort():
    assert physiology.cohort() == tuple(f"adult#{i:03d}" for i in range(1, 11))
    for name in physiology.cohort():
        patient = load_patient(name)
        assert (patient.name, patient.basal_glucose, patient.physiology) == (name, 120.0, "S2008")
        assert physiology.glucose(patient.x0, patient.params) == pytest.approx(120.0, rel=1e-14)
        assert physiology.interstitial(patient.x0, patient.params) == pytest.approx(120.0, rel=1e-14)
    ratios = [load_patient(name).carb_ratio_g_per_u for name in physiology.cohort()]
    assert ratios == [12.3, 12.5, 15.8, 22.9, 9.3, 14.6, 32.7, 25.7, 7.4, 8.3]


def test_a_patient_cannot_be_changed_by_accident():
    patient = load_patient("adult#001")
    for array in (patient.params, patient.x0):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0
    with pytest.raises(TypeError):
        physiology.begin_meal(patient.x0, patient.params, 1.0)


def test_pramlintide_sets():
    assert physiology.pramlintide_sets() == ("P2", "P4", "moderate", "conservative", "strong")
    p2 = load_patient("adult#001", pramlintide="P2").params
    assert (load_patient("adult#001").params == load_patient("adult#001", pramlintide="P4").params).all()
    moderate = load_patient("adult#001", pramlintide="moderate").params
    type1 = load_patient("adult#001", pramlintide="moderate+type1").params
    assert [p2[par.INDEX[name]] for name in ("n", "d", "e", "ka")] == [40.0, 1000.0, 3.0, 0.012]
    assert [moderate[par.INDEX[name]] for name in ("n", "d", "e", "ka")] == [3.7, 760.0, 2.0, 0.042]
    assert type1[par.A_S] == pytest.approx(0.65 * moderate[par.A_S])
    assert type1[par.D50] == pytest.approx(0.65 * moderate[par.D50])
    # elimination is what the label fixes: CL = ke·VP, L/min at a_s = 0.35
    assert p2[par.KE] * p2[par.VP] == pytest.approx(0.826, rel=1e-3)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: load_patient("adult#011"), ["'adult#011'", "did you mean", "adult#001", "adult#010"]),
        (lambda: load_patient("adult#001", pramlintide="P3"), ["pramlintide set 'P3'", "P2", "conservative"]),
        (lambda: load_patient("adult#001", physiology="S2017"), ["'S2017'", "S2008", "S2013"]),
        (lambda: load_patient("adult#001", basal_glucose=30), ["30 mg/dL", "60..300"]),
        (lambda: load_patient("adult#001", basal_glucose=float("nan")), ["nan mg/dL"]),
        (lambda: load_patient("adult#005", basal_glucose=290), ["adult#005", "no basal insulin holds 290"]),
        (lambda: load_patient("nowhere.csv#x"), ["nowhere.csv"]),
        (lambda: load_patient("nowhere.csv"), ["nowhere.csv#name"]),
    ],
)
def test_says_what_is_wrong_and_what_exists(call, words):
    with pytest.raises(PatientError) as error:
        call()
    for word in words:
        assert word in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (set_cell("kabs", "fast"), ["row 2", "'kabs'", "'fast' is not a number"]),
        (set_cell("kabs", "-0.1"), ["row 2", "'kabs'", "-0.1"]),
        (set_cell("kabs", "nan"), ["row 2", "'kabs'", "finite"]),
        (set_cell("Vg", "inf"), ["row 2", "'Vg'", "finite"]),
        (set_cell("BW", "0"), ["row 2", "'BW'", "greater than zero"]),
        (set_cell("BW", " "), ["row 2", "'BW'", "missing"]),
        (set_cell("kabs", "3"), ["row 2", "'kabs'", "too fast"]),
        (set_cell("b", "1"), ["row 2", "'b'", "0.999"]),
        (set_cell("f", "1.2"), ["row 2", "'f'", "at most 1"]),
        (set_cell("kmin", "1"), ["row 2", "'kmin'", "kmax"]),
        (set_cell("Gb", "500"), ["500 mg/dL"]),
        (set_cell("physiology", "S1999"), ["row 2", "'physiology'", "'S1999'", "S2013"]),
        (set_cell("carb_ratio", ""), ["row 2", "'carb_ratio'", "missing"]),
        (set_cell("kp1", "0.5"), ["row 2", "me", "no basal insulin"]),
        (set_cell("Vg", "Vgg", row=0), ["row 1", "unknown column 'Vgg'", "did you mean 'Vg'"]),
        (set_cell("Name", "name", row=0), ["row 1", "no column 'Name'"]),
        (set_cell("k1", "k2", row=0), ["row 1", "'k2'", "twice"]),
        (set_cell("Name", "me", row=2), ["row 3", "'Name'", "'me' stands in row 2"]),
        (set_cell("Name", "", row=2), ["row 3", "'Name'", "missing"]),
        (lambda rows: rows[1].pop(), ["row 2", "cells"]),
        (lambda rows: rows[2].append("7"), ["row 3", "cells"]),
        (lambda rows: [row.pop(rows[0].index("ksc")) for row in reversed(rows)], ["row 1", "no column 'ksc'"]),
        (lambda rows: rows.clear(), ["empty"]),
        (set_cell("k1", "1\n2"), ["quoted cell"]),
    ],
)
def test_a_bad_file_is_named_with_row_and_column(write, change, words):
    def renamed(rows):
        rows[1][0] = "me"
        change(rows)

    path = write(renamed)
    with pytest.raises(PatientError) as error:
        load_patient(f"{path}#me", basal_glucose=None)
    assert "mine.csv" in str(error.value) or "mg/dL" in str(error.value)
    for word in words:
        assert word in str(error.value)


def test_not_a_text_file(tmp_path):
    path = tmp_path / "photo.csv"
    path.write_bytes(b"\xff\xd8\xff\x00")
    with pytest.raises(PatientError, match=r"photo\.csv"):
        load_patient(f"{path}#me")


def test_own_file_with_s2013_columns_comments_and_hash_in_the_name(write):
    def change(rows):
        rows[0] += ["kcounter", "r3", "small_meal"]
        rows[1] += ["0.02", "", "0"]
        rows[2] += ["", "1.0", ""]
        rows[1][:2] = ["you#me", "S2013"]
        rows[2][:2] = ["other", "S2013"]
        rows.insert(0, ["# parameters of two volunteers"])

    path = write(change)
    first, second = load_patient(f"{path}#you#me"), load_patient(f"{path}#other", basal_glucose=100)
    assert first.name == "you#me"
    values = ("kcounter", "r3", "r1", "Hb", "small_meal", "Gth")
    assert [first.params[par.INDEX[name]] for name in values] == [0.02, 1.44, 0.81, 60.0, 0.0, 120.0]
    assert [second.params[par.INDEX[name]] for name in values] == [0.01, 1.0, 0.81, 60.0, 30000.0, 100.0]
    # as a re-basing above the patient's own glucose does not make the raised level a healthy one
    assert load_patient(f"{path}#other", basal_glucose=180).params[par.GTH] == 136.45


def test_physiology_can_be_chosen_for_any_patient():
    old, new = load_patient("adult#001"), load_patient("adult#001", physiology="S2013")
    assert (old.params[par.S2013], new.params[par.S2013]) == (0.0, 1.0)
    assert old.basal_u_per_h == new.basal_u_per_h
    shared = [i for i in range(par.S2013) if i != par.SMALL_MEAL]
    assert np.array_equal(old.params[shared], new.params[shared])
    assert (old.params[par.SMALL_MEAL], new.params[par.SMALL_MEAL]) == (0.0, 30e3)


def test_every_column_is_documented():
    """The sidecars give unit and source of every column, in agreement with the parameters' own records."""
    for file, key in (("adults.csv", "Name"), ("pramlintide.csv", "set")):
        text = [line for line in (DATA / file).read_text().splitlines() if not line.startswith("#")]
        header = next(csv.reader(text[:1]))
        with (DATA / file).with_suffix(".columns.csv").open(newline="") as sidecar:
            described = {row["column"]: row for row in csv.DictReader(sidecar)}
        assert set(header) <= set(described)
        assert header[0] == key
        for column, row in described.items():
            assert row["description"]
            assert row["source"]
            name = "c" if (file, column) == ("adults.csv", "d") else column
            if name in par.INDEX:
                assert row["unit"] == par.PARAMETERS[par.INDEX[name]].unit


def test_the_page_lists_every_state_and_parameter():
    page = (Path(__file__).parent.parent / "docs" / "physiology.md").read_text(encoding="utf-8")
    for record in (*physiology.STATES, *physiology.PARAMETERS):
        row = f"| `{record.name}` | {record.unit} | {record.description} | {record.source} |"
        assert row in page
