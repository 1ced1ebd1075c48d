"""Figures and report of the study: everything is in, nothing is invented, and less than a full study works too."""

import base64
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from html_page import Page
from matplotlib.image import imread
from pumpbench.study import figures, paper, report, selection, statistics
from study_results import synthetic_runs

MEALS = [(605.0, 64.9), (710.0, 47.7), (730.0, 40.6), (2045.0, 84.4)]


def made_up_curves(
    modes: tuple[str, ...], patients: int = 4, days: float = 3, seeds: tuple[int, ...] = (1,)
) -> figures.CurveSet:
    random = np.random.default_rng(5)
    minutes = np.arange(0, days * 1440 + 1, 5)
    wave = 1 - np.cos(2 * np.pi * minutes / 1440)
    return {
        (f"adult#{i + 1:03}", mode, seed): figures.Curves(
            cgm=110 + 30 * wave + 5 * random.normal() + 3 * random.normal(size=len(minutes)),
            plasma_insulin=60 + 40 * wave + random.normal(),
            plasma_pramlintide=(20 * wave if mode != "nma" else 0 * wave),
        )
        for i in range(patients)
        for mode in modes
        for seed in seeds
    }  # fmt: skip


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory) -> Path:
    runs = synthetic_runs()
    worse = runs[runs["part"] == "validation"].copy()
    worse.loc[worse["mode"].isin(["s2", "s4"]), "tir_70_180"] -= 4
    return report.write_report(
        tmp_path_factory.mktemp("study") / "new",
        report.ResultSet("calibrated", runs, "with an eye on Table 3"),
        others=[report.ResultSet("public data only", worse)],
        curves=made_up_curves(("nma", "s1", "s2", "s4")),
        six=made_up_curves(("s2", "s4")),
        ten=made_up_curves(("s2", "s4")),
        meals=MEALS,
        sensitivity=pd.DataFrame({"parameter": ["n", "<d>"], "S2": [97.1, 96.25]}),
        explanations={"lbgi": "the cohort's <basal>", "nma s4 lbgi": "of its own"},
        settings={"pumpbench": "0.1.0", "theta": "12 min"},
        seconds=321,
    )


def test_the_report_is_one_file_without_requests(full: Path) -> None:
    text = full.read_text(encoding="utf-8")
    page = Page(text)
    assert not re.search(r"https?://|@import|url\(|<script|<link", text)
    assert {link.removeprefix("#") for link in page.links} == set(page.ids)
    images = [str(image["src"]) for image in page.images]
    assert len(images) == 7
    for image in images:
        assert base64.b64decode(image.removeprefix("data:image/png;base64,"), validate=True)[:8] == b"\x89PNG\r\n\x1a\n"
    assert "prefers-color-scheme: dark" in text


def test_every_contrast_stands_beside_the_papers(full: Path) -> None:
    tables = [
        table
        for table in Page(full.read_text(encoding="utf-8")).tables
        if table and table[0][:2] == ["contrast", "this study"]
    ]
    assert [len(table) for table in tables] == [13] * 5
    compared = statistics.compare(statistics.contrasts(statistics.validation(synthetic_runs())))
    for metric, table in zip(paper.CONTRAST_METRICS, tables, strict=True):
        for row, known in zip(table[1:], compared[compared["metric"] == metric].itertuples(), strict=True):
            assert row[0] == f"S{known.strategy[1]} − {known.comparator.upper()}"
            assert float(row[1].split(" [")[0].replace("−", "-")) == pytest.approx(known.difference, abs=0.00501)
            assert row[1].endswith("*") == (known.p < 0.05)
            assert row[4].startswith(f"{known.paper_difference:.2f} [".replace("-", "−"))
            assert row[4].endswith("*") == known.paper_significant
            assert row[5].startswith("✓") == known.agrees
            assert row[6] == ("✓" if known.inside_interval else "✗")


def test_the_counts_on_top_are_those_of_the_table(full: Path) -> None:
    text = full.read_text(encoding="utf-8")
    table = pd.read_csv(full.parent / "table3.csv")
    inside = table.loc[table["metric"] == "tir_70_180", "inside_interval"].sum()
    assert f"<b>{inside} of 12</b>" in text
    assert f"<b>{table['agrees'].sum()} of 60</b>" in text
    assert f"<b>{table['same_conclusion'].sum()} of 60</b>" in text
    assert 0 < table["agrees"].sum() < 60


def test_every_cell_of_table_2_is_there(full: Path) -> None:
    rows = Page(full.read_text(encoding="utf-8")).table("metric", "S1", "S2", "S3", "S4", "MA", "SMA", "NMA")
    assert len(rows) == 9
    for row, metric in zip(rows, paper.TABLE2_METRICS, strict=True):
        said = paper.table2().query(f"metric == '{metric}'").set_index("mode")
        for cell, mode in zip(row[1:], paper.MODES, strict=True):
            assert cell.endswith(f"{said.loc[mode, 'mean']:.1f} ({said.loc[mode, 'sd']:.1f})")


def test_what_differs_is_named_with_its_reason(full: Path) -> None:
    rows = Page(full.read_text(encoding="utf-8")).table("what", "metric", "this study", "paper", "how")
    table = pd.read_csv(full.parent / "table3.csv")
    differing = table[~(table["agrees"] & table["inside_interval"])]
    assert len([row for row in rows if not row[0].startswith("mean")]) == len(differing)
    reasons = {(row[0], row[1]): row[5] for row in rows}
    lbgi = {what: why for (what, metric), why in reasons.items() if metric == "LBGI"}
    assert lbgi["S4 − NMA"] == "of its own"
    assert {why for what, why in lbgi.items() if what != "S4 − NMA"} == {"the cohort's <basal>"}
    assert "no explanation known" in reasons.values()
    assert reasons["S4 − MA", "above 250 mg/dL"] == "The means of the paper’s Table 2 differ by −0.6 here."


def test_sets_stand_side_by_side(full: Path) -> None:
    page = Page(full.read_text(encoding="utf-8"))
    rows = page.table("set", "time in range inside")
    assert [row[0] for row in rows] == ["calibratedwith an eye on Table 3", "public data only", "paper"]
    assert rows[0][1] == "12 of 12"
    assert int(rows[1][1].split()[0]) < 12
    assert rows[2][5:] == ["90.1", "97.6", "94.7", "99.2", "93.3", "90.3", "87.1"]
    assert float(rows[1][6]) == pytest.approx(float(rows[0][6]) - 4, abs=0.11)
    contrasts = page.table("contrast", "calibrated", "public data only", "paper")
    assert len(contrasts) == 12


def test_sensitivity_and_settings_are_shown_as_given(full: Path) -> None:
    page = Page(full.read_text(encoding="utf-8"))
    assert page.table("parameter", "S2") == [["n", "97.10"], ["<d>", "96.25"]]
    text = full.read_text(encoding="utf-8")
    assert "seeds 1, 2; computed in 5 min" in text
    assert [["pumpbench", "0.1.0"], ["theta", "12 min"]] in page.tables


def test_the_same_results_give_the_same_bytes(tmp_path: Path) -> None:
    runs = synthetic_runs()
    few = runs[runs["part"] != "tuning"]
    paths = [
        report.write_report(
            tmp_path / name, report.ResultSet("x", table), curves=made_up_curves(("nma", "s1")), meals=MEALS
        )
        for name, table in (("a", few), ("b", few.sample(frac=1, random_state=3)))
    ]
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_one_patient_one_day_three_modes(tmp_path: Path) -> None:
    runs = synthetic_runs()
    few = runs[
        (runs["part"] == "validation")
        & (runs["patient"] == "adult#001")
        & (runs["seed"] == 1)
        & runs["mode"].isin(["s1", "s2", "nma"])
    ].assign(days=1)
    path = report.write_report(
        tmp_path, report.ResultSet("short", few), curves=made_up_curves(("nma", "s1", "s2"), patients=1, days=1)
    )
    text = path.read_text(encoding="utf-8")
    page = Page(text)
    assert "1 of its 10 patients, 1 of its 14 days" in text
    assert "Not run: S3, S4, MA, SMA." in text
    assert "One patient: no interval: 10 contrasts" in text
    assert "<b>0 of 60</b>contrasts agree with the paper in sign and significance (0 could be judged)" in text
    assert "No tuning runs." in text
    assert page.table("contrast", "this study")[0][1] == "not run"
    differing = page.table("what", "metric", "this study", "paper", "how")
    assert {row[4] for row in differing} == {"one patient"}
    assert len(differing) == 10 + 27


def test_two_patients_have_intervals(tmp_path: Path) -> None:
    runs = synthetic_runs()
    few = runs[(runs["part"] == "validation") & runs["patient"].isin(["adult#001", "adult#002"])].copy()
    few.iloc[3, few.columns.get_loc("limiter_steps")] = 7.0
    text = report.write_report(tmp_path, report.ResultSet("two", few)).read_text(encoding="utf-8")
    assert "2 of its 10 patients, 14 of its 14 days" in text
    assert "could be judged" not in text
    assert "limits acted in 1 of 28 runs (7 steps)" in text
    assert "No curves were given." in text


def test_explanations_of_nothing_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="'s5 hbgi' is no metric"):
        report.write_report(tmp_path, report.ResultSet("x", synthetic_runs()), explanations={"s5 hbgi": "?"})
    assert list(tmp_path.iterdir()) == []


# -------------------------------------------------------------------------------------------------------------- figures


def test_figures_are_what_there_is_data_for(tmp_path: Path) -> None:
    runs = synthetic_runs()
    drawn = figures.write_figures(
        tmp_path, runs[runs["mode"] != "s3"], made_up_curves(("s2",)), made_up_curves(("s4",))
    )
    assert list(drawn) == ["contrasts", "tuning_s1", "tuning_s2", "tuning_s4", "strategies_over_time"]
    for path in drawn.values():
        picture = imread(path)
        assert picture.shape[1] > 1000
        assert (picture[..., :3].min(axis=2) < 0.9).mean() > 0.01


def test_boxes_are_those_of_the_patients_and_the_chosen_dose_is_marked() -> None:
    runs = selection.dose_runs(synthetic_runs().query("part == 'tuning'"), "s2")
    figure = figures.tuning_figure(runs, "s2")
    assert [axis.get_ylabel().split("\n")[0] for axis in figure.axes] == [
        *("70–180 mg/dL", "above 180 mg/dL", "below 70 mg/dL", "pramlintide"),
    ]
    assert [text.get_text() for text in figure.axes[2].get_xticklabels()] == ["3", "6", "10", "12", "15"]
    first = figure.axes[0]
    medians = [
        float(line.get_ydata()[0]) for line in first.lines if line.get_color() == figures.INK and line.get_lw() == 1.8
    ]
    by_hand = runs.groupby("ratio_ug_per_u")["tir_70_180"].median()
    assert medians == pytest.approx(list(by_hand))
    chosen = [
        i
        for i, box in enumerate(first.patches)
        if box.get_facecolor()[:3] == pytest.approx((0.902, 0.624, 0), abs=0.01)
    ]
    assert chosen == [list(by_hand.index).index(float(selection.select(runs).label.removeprefix("ratio=")))]
    marks = [line for line in first.lines if line.get_marker() == "v"]
    assert [mark.get_xdata()[0] for mark in marks] == [3]  # the paper's 10 ug/U


def test_bands_are_quartiles_over_the_patients_of_the_first_seed() -> None:
    curves = made_up_curves(("nma", "s1", "s2"), patients=5, days=1, seeds=(3, 2))
    figure = figures.strategies_figure(curves, MEALS)
    top, middle, bottom = figure.axes
    assert [axis.get_ylabel() for axis in (top, middle, bottom)] == [
        *("CGM [mg/dL]", "plasma pramlintide\n[pmol/L]", "plasma insulin\n[pmol/L]"),
    ]
    rows = np.array([curves[f"adult#{i:03}", "s2", 2].cgm for i in range(1, 6)])
    line = next(line for line in top.lines if line.get_label() == figures.STYLES["s2"][2])
    assert line.get_ydata() == pytest.approx(np.median(rows, axis=0))
    band = top.collections[2].get_paths()[0].vertices
    noon = band[np.isclose(band[:, 0], 12.0)][:, 1]
    assert sorted(noon) == pytest.approx(np.percentile(rows[:, 144], [25, 75]))
    assert bottom.get_xlim() == (0, 24)
    for run in curves.values():
        run.cgm[-1] = np.nan
        run.plasma_insulin[:] = np.nan
    figure = figures.strategies_figure(curves)
    assert [axis.get_ylabel() for axis in figure.axes] == ["CGM [mg/dL]", "plasma pramlintide\n[pmol/L]"]
    last = figure.axes[0].lines[0].get_ydata()
    assert np.isnan(last).tolist() == [False] * 288 + [True]
    assert [text.get_text() for text in top.texts] == ["65 g", "48 g", "41 g"]  # the last meal is on the second day


def test_tuning_runs_without_their_dose_are_refused() -> None:
    runs = synthetic_runs()
    runs.loc[(runs["part"] == "tuning") & (runs["label"] == "phi=30"), "phi_ug"] = np.nan
    with pytest.raises(ValueError, match="tuning of s3: no phi_ug in phi=30"):
        selection.dose_runs(runs[runs["part"] == "tuning"], "s3")
