"""The study end to end, small: from the command to the report, again from its results, and on one core or two."""

import csv
import json
import re
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from conftest import Pumpbench
from pumpbench.study import paper, plan, run
from pumpbench.study.run import variations

SMALL = ("--patient", "adult#002,adult#005", "--days", "1", "--seeds", "1001-1002", "--quick")
TABLES = (
    "table2", "table3", "table3_by_seed", "seeds", "text_contrasts", "paper_inconsistencies", "tuning", "law_theta",
    "law_deduction",
)  # fmt: skip


def study(pumpbench: Pumpbench, out: Path, *options: str) -> str:
    done = pumpbench("study", *SMALL, "--out", out, *options, timeout=240)
    assert done.returncode == 0, done.stderr
    return done.stderr


@pytest.mark.nightly
def test_the_small_study(pumpbench: Pumpbench, runs: Path) -> None:
    study(pumpbench, runs / "one", "--workers", "1")
    for name in TABLES:
        assert len((runs / "one" / f"{name}.csv").read_text().splitlines()) > 1, name
    contrasts = list(csv.DictReader((runs / "one" / "table3.csv").read_text().splitlines()))
    expected = ["comparator", "strategy", "metric", "difference", "low", "high", "p", "paper_difference", "paper_low"]
    assert list(contrasts[0])[:11] == [*expected, "paper_high", "agrees"]  # others' scripts rely on them
    assert len(contrasts) == 60
    law = json.loads((runs / "one" / "controller.json").read_text())
    assert law["theta"] in plan.THETAS and set(law["gains"]) == {"adult#002", "adult#005"}
    report = (runs / "one" / "report.html").read_text()
    assert not re.search(r"(src|href)=\"(?!data:|#)", report), "a report that asks for something else"
    assert report.count("data:image/png;base64,") >= 6
    assert {path.name for path in (runs / "one").glob("*.png")} >= {
        "tuning_s1.png", "tuning_s2.png", "tuning_s3.png", "tuning_s4.png", "strategies_over_time.png",
        "ratio_6_and_10.png", "contrasts.png",
    }  # fmt: skip

    # the same tables from two processes, and from what is there already
    study(pumpbench, runs / "two", "--workers", "2")
    kept = {path: path.stat().st_mtime_ns for path in (runs / "two" / "results").iterdir()}
    study(pumpbench, runs / "two")
    assert {path: path.stat().st_mtime_ns for path in (runs / "two" / "results").iterdir()} == kept
    for name in TABLES:
        assert (runs / "one" / f"{name}.csv").read_bytes() == (runs / "two" / f"{name}.csv").read_bytes(), name


def test_a_patient_without_a_model_is_one_line(pumpbench: Pumpbench, runs: Path) -> None:
    from plant_server.physiology import patients

    own = runs / "own.csv"
    own.write_text(Path(patients.__file__).with_name("data").joinpath("adults.csv").read_text())
    done = pumpbench("study", "--patient", f"{own}#adult#001", "--out", runs / "s")
    assert done.returncode == 2
    assert "identify-controller" in done.stderr and len(done.stderr.strip().splitlines()) == 1


def runs_of(label: str, mode: str = "nma", **columns: float) -> pd.DataFrame:
    base = {"part": "law", "patient": "a", "mode": mode, "seed": 1, "label": label, "tar_180": 5.0}
    return pd.DataFrame([base | {"pramlintide_ug_per_day": 0.0} | columns])


def test_of_similar_laws_the_gentlest_is_chosen() -> None:
    settings = {  # theta, gain -> time in range, time below 70
        (10.0, 0.6): (90.0, 0.2), (10.0, 0.7): (90.9, 0.3), (10.0, 0.8): (89.0, 2.0),
        (12.0, 0.6): (88.0, 0.1), (12.0, 0.7): (90.2, 0.3), (12.0, 0.8): (90.4, 0.4),
        (15.0, 0.6): (85.0, 0.1), (15.0, 0.7): (86.0, 0.2), (15.0, 0.8): (87.0, 0.2),
    }  # fmt: skip
    runs = pd.concat(
        runs_of(f"theta={theta:g} gain={gain:.2f}", tir_70_180=tir, tbr_70=low)
        for (theta, gain), (tir, low) in settings.items()
    )
    theta, gains, candidates = plan.choose_gains(runs.reset_index(drop=True), ["a"])
    assert (theta, gains) == (12.0, {"a": 0.7})  # 10 min is 0.2 points better at 0.6, and the faster filter
    assert candidates.loc[candidates["chosen"], "label"].tolist() == ["theta=12"]


def test_of_similar_deductions_the_greatest_is_chosen() -> None:
    runs = pd.concat(
        runs_of(f"deduction={share:g}", "ma", tir_70_180=tir, tbr_70=low)
        for share, tir, low in ((0.55, 92.0, 3.0), (0.7, 92.5, 1.2), (0.85, 92.0, 1.0), (1.0, 91.0, 0.9))
    )
    assert plan.choose_deduction(runs.reset_index(drop=True))[0] == 0.85


def test_thresholds_that_find_more_meals_than_there_are_detect_none() -> None:
    few = runs_of("z=2,0.5,12", "s1", tir_70_180=90.0, tbr_70=0.0)
    few["pramlintide_ug_per_day"] = 90.0
    many = few.assign(label="z=1,0,6", pramlintide_ug_per_day=90.1)
    marked = plan.detectors(pd.concat([few, many], ignore_index=True).assign(part="tuning"))
    assert marked["part"].tolist() == ["tuning", "no meal detector"]


def test_sensitivities_change_one_thing_each() -> None:
    law = plan.Law(12.0, {"adult#001": 0.6}, 0.85, doses={"s1": 15.0, "s2": 8.0, "s3": 30.0, "s4": 6.0})
    cohort = plan.Cohort(("adult#001",))
    made = set()
    for changed, fields, changes in variations(law).values():
        jobs = plan.validation_jobs(cohort, 1, changed, (1,), changes=changes, **fields)
        made.add(tuple(job.key for job in jobs))
    assert len(made) == len(variations(law))


@pytest.mark.parametrize("seeds", [(1,), (1, 2, 3)])
def test_curves_are_kept_of_the_first_seed(seeds: tuple[int, ...]) -> None:
    cohort = plan.Cohort(("adult#001",))
    jobs = plan.validation_jobs(cohort, 1, plan.Law(12.0, {"adult#001": 0.6}, 0.85), seeds, series=1)
    assert {job.seed for job in jobs if job.series} == {1}


def test_curves_of_a_ratio_are_of_that_ratio_whatever_was_chosen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Found by looking at the figure: the validation's own ratio had been drawn under the name of 10 ug/U."""
    for name, values in {
        "THETAS": (12.0,), "GAINS": (0.6,), "DEDUCTIONS": (0.85,), "Z1": (2.0,), "Z2": (1.0,), "Z3": (12,),
        "DOSES": dict.fromkeys(paper.STRATEGIES, (3.0,)),
    }.items():  # fmt: skip
        monkeypatch.setattr(plan, name, values)
    told: dict[str, Any] = {}
    monkeypatch.setattr(run.report, "write_report", lambda *_, **named: told.update(named))
    cohort = plan.Cohort(("adult#002", "adult#005"))
    run.Study(run.Settings(tmp_path, cohort, 1, (1001,), workers=1, quick=True), print, lambda *_: None).run()
    for mode in ("s2", "s4"):
        chosen, six, ten = (
            sum(float(told[name][patient, mode, 1001].plasma_pramlintide.sum()) for patient in cohort.patients)
            for name in ("curves", "six", "ten")
        )
        assert ten / six == pytest.approx(10 / 6, rel=0.1)
        assert chosen / six == pytest.approx(3 / 6, rel=0.2)  # with less pramlintide there is more insulin
