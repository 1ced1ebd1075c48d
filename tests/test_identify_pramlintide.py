"""The identification of pramlintide: data, kinetics, effect, what is not determined, and the page."""

import csv
import importlib.util
import math
import re
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from plant_server import physiology
from plant_server.physiology import parameters as par

ROOT = Path(__file__).resolve().parents[1]


def _load() -> ModuleType:
    path = ROOT / "tools" / "identify_pramlintide.py"
    spec = importlib.util.spec_from_file_location("identify_pramlintide", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


tool = _load()
PK = tool.shipped_pk()


# ---- data


def test_every_datum_says_what_it_is_and_where_it_is_from() -> None:
    lines = [line for line in tool.DATA.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    rows = list(csv.DictReader(lines, strict=True))
    assert len({row["id"] for row in rows}) == len(rows) > 30
    for row in rows:
        assert None not in row and None not in row.values(), row  # as many cells as columns
        assert row["unit"] and row["source"] and row["quantity"], row
        assert row["certainty"] in {"read", "assumed", "recalled"}, row
        assert row["use"] in {"pk", "pd", "compare"} and row["relation"] in {"=", "<=", ">="}, row
        assert math.isfinite(float(row["value"])) and float(row["value"]) > 0.0, row
        assert not row["error"] or 0.0 < float(row["error"]) < float(row["value"]), row


def test_the_studies_disagree_as_the_page_says() -> None:
    samsom, vella = tool.log_ratio("samsom_30", "samsom_0"), tool.log_ratio("vella_30", "vella_0")
    assert math.exp(samsom[0]) == pytest.approx(1.51, abs=0.005)
    assert math.exp(vella[0]) == pytest.approx(2.945, abs=0.005)
    assert (vella[0] - samsom[0]) / math.hypot(samsom[1], vella[1]) > 3.0


# ---- kinetics


def test_the_solved_kinetics_are_those_of_the_patient() -> None:
    patient = physiology.load_patient("adult#001", pramlintide="P2")
    x, none = patient.x0.copy(), np.zeros(1)
    for step in range(480):
        ug = np.array([30.0 if step == 0 else 0.0])
        physiology.advance(x, patient.params, 0.5 * step, none + patient.basal_u_per_h / 120, ug, none)
        after = 0.5 * (step + 1) - 0.25  # the dose arrives within the first half minute
        expected = 30.0 * float(tool.concentration(PK, after))
        assert physiology.plasma_pramlintide(x, patient.params) == pytest.approx(expected, rel=2e-3, abs=0.02)


def test_auc_is_dose_over_clearance_and_tmax_the_top() -> None:
    times = np.arange(0.0, 3000.0, 0.05)
    profile = tool.concentration(PK, times)
    auc, cmax, tmax, _ = tool.pk_responses(PK)
    assert auc == pytest.approx(np.trapezoid(profile, times), rel=1e-4)
    assert cmax == pytest.approx(profile.max(), rel=1e-5)
    assert tmax == pytest.approx(times[profile.argmax()], abs=0.1)


@pytest.mark.parametrize("dose", tool.DOSES)
def test_shipped_kinetics_and_refit_meet_the_label(dose: int) -> None:
    """AUC within 15 %, Cmax within 10 %, Tmax within 2 min, half-life within 10 %, as docs/pramlintide.md says."""
    for pk in (PK, tool.fit_pk(30.0).values):
        auc, cmax, tmax, half = tool.pk_responses(pk)
        assert auc * dose == pytest.approx(tool.value(f"auc_{dose}"), rel=0.15)
        assert cmax * dose == pytest.approx(tool.value(f"cmax_{dose}"), rel=0.10)
        assert tmax == pytest.approx(tool.value(f"tmax_{dose}"), abs=2.0)
        assert half == pytest.approx(tool.value(f"half_{dose}"), rel=0.10)


def test_the_refit_is_the_shipped_kinetics() -> None:
    refit = tool.fit_pk(30.0)
    assert refit.values == pytest.approx(PK, rel=0.05)
    assert np.sum(tool.pk_residuals(PK, 30.0) ** 2) < refit.cost + 0.1
    assert refit.values[3] * refit.values[4] == pytest.approx(0.826, abs=0.002)


def test_the_label_does_not_determine_the_intravenous_half_life() -> None:
    alone = tool.identifiability(tool.jacobian(tool.label_residuals, PK))
    assert alone.undetermined and alone.singular[-1] < 1e-6 < 1.0 < alone.singular[-2]
    direction = dict(zip(tool.PK_NAMES, alone.weakest, strict=True))
    assert direction["ke"] == pytest.approx(-direction["VP"], rel=1e-3)  # the clearance stays
    assert abs(direction["ke"]) > 0.2

    moved = PK * np.exp(0.01 * alone.weakest)  # along it nothing the label knows changes
    assert tool.label_residuals(moved) == pytest.approx(tool.label_residuals(PK), abs=0.02)
    assert moved[3] / PK[3] == pytest.approx(1.0 + 0.01 * direction["ke"], rel=1e-3)

    costs = [tool.fit_pk(half).cost for half in (None, 25.0, 30.0, 37.0)]
    assert costs == pytest.approx([costs[0]] * 4, abs=0.01)
    held = tool.identifiability(tool.jacobian(lambda pk: tool.pk_residuals(pk, 30.0), PK))
    assert not held.undetermined


# ---- effect


@pytest.mark.parametrize(("name", "margin"), [("moderate", 0.5), ("P4", 5.0)])
def test_the_shipped_sets_are_near_the_best_of_their_weighting(name: str, margin: float) -> None:
    best = tool.fit_pd(name)
    shipped = tool.objective(name, tool.shipped_pd(name))
    assert best.cost <= shipped <= best.cost + margin
    assert best.costs == pytest.approx([best.cost] * len(best.costs), abs=0.05)  # from every start


def test_p2_is_no_fit_to_these_data_and_the_page_says_so() -> None:
    for name in tool.WEIGHTINGS:
        assert tool.objective(name, tool.shipped_pd("P2")) > tool.fit_pd(name).cost + 10.0
    page = tool.PAGE.read_text(encoding="utf-8")
    assert "calibrated" in page and "not identified" in page.replace("\n", " ")


def test_what_the_shipped_sets_are_said_to_do() -> None:
    p2, p4 = (tool.emptying(PK, tool.shipped_pd(name)) for name in ("P2", "P4"))
    assert (p2.ratio_30, p2.ratio_60, p2.ra) == pytest.approx((2.80, 4.79, 0.63), abs=0.01)
    assert (p4.ratio_30, p4.ratio_60, p4.ra) == pytest.approx((2.69, 3.79, 0.625), abs=0.01)


def test_n_is_bounded_from_below_only() -> None:
    fit = tool.identifiability(tool.fit_pd("P4").jacobian)
    assert fit.undetermined
    direction = dict(zip(tool.PD_NAMES, fit.weakest, strict=True))
    assert direction["n"] * direction["d"] > 0.3  # they rise together
    assert max(abs(direction["e"]), abs(direction["ka"])) < 0.1
    first, second, correlation = fit.strongest_pair
    assert {tool.PD_NAMES[first], tool.PD_NAMES[second]} == {"n", "d"} and correlation > 0.9

    profile = {n: cost for n, cost, _ in tool.profile_n("P4")}
    least = tool.fit_pd("P4").cost
    assert profile[3.0] > least + 4.0
    assert max(profile[n] for n in (6.0, 12.0, 19.0, 40.0)) < least + 1.0


def test_a_well_determined_jacobian_is_not_flagged() -> None:
    good = tool.identifiability(np.diag([5.0, 4.0, 3.0]))
    assert not good.undetermined and good.errors == pytest.approx([0.2, 0.25, 1 / 3])
    assert tool.identifiability(np.array([[1.0, 1.0], [2.0, 2.0]])).undetermined


def test_intravenous_infusion_reaches_its_steady_state() -> None:
    """Rate over clearance, within 1 % after five hours: no bioavailability, no delay by the skin."""
    patient = physiology.load_patient("adult#001")
    p = patient.params.copy()
    p[par.INDEX["a_s"]], p[par.INDEX["kq1"]], p[par.INDEX["kq12"]] = 1.0, 2.0, 0.0
    x, steps = patient.x0.copy(), 600
    basal = np.full(steps, patient.basal_u_per_h / 120)
    physiology.advance(x, p, 0.0, basal, np.full(steps, 25.0 / 120), np.zeros(steps))
    expected = 25.0 * tool.PMOL_PER_UG / 60.0 / (PK[3] * PK[4])
    assert physiology.plasma_pramlintide(x, p) == pytest.approx(expected, rel=0.01)


# ---- page

_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?")


def test_the_page_is_up_to_date() -> None:
    """Word by word; numbers may differ in their last digit, for other processors round otherwise."""
    written, now = tool.PAGE.read_text(encoding="utf-8"), tool.text()
    hint = "run `python tools/identify_pramlintide.py --write-docs`"
    assert re.sub(r"[-+]?\d+(\.\d+)?", "#", written) == re.sub(r"[-+]?\d+(\.\d+)?", "#", now), hint
    for old, new in zip(_NUMBER.findall(written), _NUMBER.findall(now), strict=True):
        last = 10.0 ** -len(new.partition(".")[2])
        assert abs(float(old) - float(new)) <= 1.01 * last + 0.005 * abs(float(new)), f"{old}, now {new}: {hint}"


def test_the_figures_are_there() -> None:
    page = tool.PAGE.read_text(encoding="utf-8")
    images = re.findall(r"\]\((images/[\w-]+\.png)\)", page)
    assert len(images) == 3
    for image in images:
        assert (ROOT / "docs" / image).read_bytes().startswith(b"\x89PNG")
