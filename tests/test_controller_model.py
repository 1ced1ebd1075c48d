"""Controller models: identified from responses, written and read back, and refused when they make no sense."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pumpbench import controller_model
from pumpbench.controller_model import (
    COLUMNS,
    ControllerModelError,
    identify,
    read_models,
    shipped_models,
    write_models,
)
from scipy import signal

from plant_server.physiology import cohort, load_patient, parameters


def test_the_ten_adults_are_what_their_responses_give() -> None:
    models = identify([load_patient(name) for name in cohort()])
    shipped = shipped_models()
    assert [model.patient for model in models] == list(shipped) == list(cohort())
    for model in models:
        # the shipped time constants are rounded to minutes, which moves the gains a little
        np.testing.assert_allclose(model[1:], shipped[model.patient][1:], rtol=0.003)


def test_a_patient_that_is_a_model_is_identified_exactly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Responses computed from transfer functions by another way: K, tau_1 and tau_2 come back."""
    truth = {"meal": (700.0, 90.0, 12.0), "insulin": (5000.0, 60.0, 200.0)}

    def response(_patient: object, *, carbs_g: float = 0.0, insulin_u: float = 0.0) -> np.ndarray:
        gain, tau_1, tau_2 = truth["meal" if carbs_g else "insulin"]
        poles = np.polymul(np.polymul([tau_1, 1], [tau_1, 1]), [tau_2, 1])
        minutes = np.arange(0, 601, 5.0)
        pulse = np.zeros(120)
        pulse[: 3 if carbs_g else 1] = carbs_g / 15 if carbs_g else insulin_u / 5
        delayed = np.concatenate([np.zeros(3), pulse, [0.0]])[:121]
        numerator, denominator, _ = signal.cont2discrete(([gain], poles), 5.0, method="zoh")
        output = signal.lfilter(numerator.ravel(), denominator, delayed)
        assert output.size == minutes.size
        return output if carbs_g else -output

    monkeypatch.setattr(controller_model, "_response", response)
    (model,) = identify([load_patient("adult#001")])
    expected = (*truth["meal"], *truth["insulin"])
    found = (model.K_d, model.tau_1d, model.tau_2d, model.K_u, model.tau_1u, model.tau_2u)
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    assert model.carb_ratio == pytest.approx(1.47 * 5000 / 700, rel=1e-4)


def test_a_patient_that_does_not_respond_is_named() -> None:
    patient = load_patient("adult#001")
    params = patient.params.copy()
    params[parameters.INDEX["f"]] = 0.0
    with pytest.raises(ControllerModelError, match=r"adult#001.*50 g raise glucose by 0\.00"):
        identify([replace(patient, params=params)])


def test_a_file_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "new" / "models.csv"
    models = list(shipped_models().values())
    write_models(path, models)
    again = read_models(path)
    assert list(again) == [model.patient for model in models]
    for model in models:
        np.testing.assert_allclose(again[model.patient][1:], model[1:], rtol=1e-5)
    assert [child.name for child in path.parent.iterdir()] == ["models.csv"]


HEADER = ",".join(COLUMNS)
ROW = "x,700,5000,159,2,79,323,10"


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("", "the file is empty"),
        ("# only a comment\n", "the file is empty"),
        ("patient,K_d\nx,1\n", r"line 1: columns .*expected patient,K_d,K_u"),
        (f"{HEADER}\nx,700,5000,159,2,79,323\n", "line 2: 7 cells, expected 8"),
        (f"# c\n{HEADER}\n{ROW}\n{ROW}\n", "line 4: patient 'x' is there twice"),
        (f"{HEADER}\n{ROW.replace('5000', '-1')}\n", "line 2, K_u: '-1', expected a number above 0"),
        (f"{HEADER}\n{ROW.replace('5000', 'much')}\n", "line 2, K_u: 'much'"),
        (f"{HEADER}\n{ROW.replace('5000', 'nan')}\n", "line 2, K_u: 'nan'"),
        (f"{HEADER}\n{ROW.replace('5000', 'inf')}\n", "line 2, K_u: 'inf'"),
    ],
)
def test_a_file_that_makes_no_sense_is_refused(tmp_path: Path, text: str, where: str) -> None:
    path = tmp_path / "models.csv"
    path.write_text(text)
    with pytest.raises(ControllerModelError, match=where):
        read_models(path)


def test_a_file_that_is_not_there_or_no_text_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ControllerModelError, match="cannot be read"):
        read_models(tmp_path / "none.csv")
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ControllerModelError, match="cannot be read"):
        read_models(tmp_path / "binary.csv")
