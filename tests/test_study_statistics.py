"""Statistics of the study against independent computations, and against the paper's own numbers."""

import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import statsmodels.formula.api as smf
from hypothesis import given, settings
from hypothesis import strategies as st
from pumpbench.study import mixed_model, paper, selection, statistics, tables
from scipy import stats
from study_results import synthetic_runs

Z = 1.959963984540054


def as_runs(values: np.ndarray, modes: tuple[str, ...] = paper.MODES, metric: str = "tir_70_180") -> pd.DataFrame:
    """One seed of validation runs from an array patients x modes; NaN: no run."""
    rows = [
        {
            "part": "validation",
            "label": "",
            "patient": f"adult#{i + 1:03}",
            "mode": mode,
            "seed": 1,
            metric: values[i, j],
        }
        for i in range(values.shape[0])
        for j, mode in enumerate(modes)
        if not np.isnan(values[i, j])
    ]
    return pd.DataFrame(rows)


def drawn(seed: int, patients: int = 10, modes: int = 7, between: float = 5.0, within: float = 2.0) -> np.ndarray:
    random = np.random.default_rng(seed)
    return (
        90
        + np.arange(modes)
        + between * random.normal(size=(patients, 1))
        + within * random.normal(size=(patients, modes))
    )


def one(values: np.ndarray, **options: bool) -> pd.DataFrame:
    return statistics.contrasts(as_runs(values), ["tir_70_180"], **options)


# ---------------------------------------------------------------------------------------------------------------- paper


def test_the_papers_tables_are_whole() -> None:
    assert len(paper.table2()) == 63
    table = paper.table3()
    assert len(table) == 60
    assert table["significant"].sum() == 42
    assert ((table["low"] <= table["difference"]) & (table["difference"] <= table["high"])).all()


def test_the_papers_times_add_up() -> None:
    wide = paper.table2().pivot(index="mode", columns="metric", values="mean")
    assert (wide[["tbr_70", "tir_70_180", "tar_180"]].sum(axis=1) - 100).abs().max() < 0.1501
    assert (wide["tar_250"] <= wide["tar_180"]).all()


def test_the_papers_asterisks_are_its_intervals() -> None:
    table = paper.table3()
    assert (table["significant"] == ((table["low"] > 0) | (table["high"] < 0))).all()


def test_the_papers_intervals_are_symmetric_and_differences_close_up() -> None:
    table = paper.table3()
    assert ((table["low"] + table["high"]) / 2 - table["difference"]).abs().max() < 0.0101
    # (s - ma) - (s - nma) = nma - ma, whatever the strategy
    for metric in paper.CONTRAST_METRICS:
        wide = table[table["metric"] == metric].pivot(index="comparator", columns="strategy", values="difference")
        for other in ("sma", "nma"):
            assert (wide.loc["ma"] - wide.loc[other]).agg(np.ptp) < 0.0101


def test_table_3_is_not_always_the_difference_of_table_2() -> None:
    found = paper.inconsistencies()
    counts = found["metric"].value_counts().to_dict()
    assert counts == {"tar_180": 8, "tar_250": 9, "tir_70_180": 4}
    worst = found.loc[found["excess"].idxmax()]
    assert (worst["comparator"], worst["strategy"], worst["metric"]) == ("nma", "s4", "tar_180")
    # the times of strategy 4 do not add up to zero: 0.27 points less below 70 than MA, which has none
    table = paper.table3().set_index(["comparator", "strategy", "metric"])["difference"]
    assert table["ma", "s4", "tir_70_180"] + table["ma", "s4", "tar_180"] == pytest.approx(0.27)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("ma,s1,lbgi", "ma,s1,hbgi", "once, 60 rows; not so: ma s1 hbgi"),
        ("ma,s1,lbgi,-0.05", "ma,s1,lbgi,much", "column difference is to hold numbers"),
        ("ma,s1,lbgi,-0.05", "ma,s1,lbgi,", "empty cell in column difference"),
        ("-0.09,-0.01,yes", "-0.09,-0.01,perhaps", "significant is yes or no"),
        ("significant,source", "significant,where", "no column source"),
    ],
)
def test_a_damaged_table_is_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    text = (paper.DATA / "paper_table3.csv").read_text(encoding="utf-8")
    assert old in text
    (tmp_path / "t.csv").write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ValueError, match=message):
        paper.table3(tmp_path / "t.csv")


# --------------------------------------------------------------------------------------------------------------- models


def test_differences_of_an_example_by_hand() -> None:
    # three patients, two modes: differences 1, 2, 3; MS_residual = var(d)/2 = 0.5, SE = sqrt(2 * 0.5 / 3)
    values = np.array([[11.0, 10.0], [22.0, 20.0], [33.0, 30.0]])
    row = statistics.contrasts(as_runs(values, ("s1", "ma")), ["tir_70_180"], [("ma", "s1")]).iloc[0]
    assert row["difference"] == pytest.approx(2.0)
    assert row["high"] - row["difference"] == pytest.approx(Z * math.sqrt(1 / 3))
    assert row["robust_high"] == pytest.approx(row["high"])  # two modes: the model is the paired comparison
    assert row["p"] == pytest.approx(2 * stats.norm.sf(2 * math.sqrt(3)))


def test_balanced_errors_are_those_of_the_residual_mean_square() -> None:
    values = drawn(1)
    residual = values - values.mean(0) - values.mean(1, keepdims=True) + values.mean()
    error = math.sqrt(2 * (residual**2).sum() / (9 * 6) / 10)
    table = one(values)
    for row in table.itertuples():
        a, b = paper.MODES.index(row.strategy), paper.MODES.index(row.comparator)
        difference = values[:, a] - values[:, b]
        assert row.difference == pytest.approx(difference.mean())
        assert row.high - row.difference == pytest.approx(Z * error)
        assert row.robust_high - row.difference == pytest.approx(Z * difference.std(ddof=1) / math.sqrt(10))


def test_published_example_of_a_randomised_block() -> None:
    values = np.array([[9.3, 9.4, 9.2, 9.7], [9.4, 9.3, 9.4, 9.6], [9.6, 9.8, 9.5, 10.0], [10.0, 9.9, 9.7, 10.2]])
    # Montgomery, Design and Analysis of Experiments, hardness testing (four tips on four coupons): SS_error 0.0800,
    # 9 degrees of freedom
    fitted = mixed_model.fit(pd.DataFrame(values, columns=["s1", "s2", "s3", "s4"]))
    assert fitted.covariance.loc["s1", "s1"] * 4 == pytest.approx(0.0800 / 9, abs=1e-6)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10**6), between=st.sampled_from([0.0, 0.5, 2.0, 20.0]))
def test_closed_form_is_the_fitted_model(seed: int, between: float) -> None:
    values = drawn(seed, between=between)
    ours, fitted = one(values), one(values, closed_form=False)
    width = ours["high"] - ours["low"]
    assert (ours["difference"] - fitted["difference"]).abs().max() < 1e-6 * width.max()
    assert (width - (fitted["high"] - fitted["low"])).abs().max() < 2e-3 * width.max()


def test_patients_that_differ_less_than_chance_give_the_boundary_fit() -> None:
    values = drawn(3, between=0.0)
    values -= values.mean(axis=1, keepdims=True)  # no variance between patients at all
    fitted = mixed_model.fit(pd.DataFrame(values, columns=paper.MODES))
    pooled = values.var(axis=0, ddof=1).mean()
    assert fitted.covariance.loc["s1", "s1"] == pytest.approx(pooled / 10)
    model = mixed_model.fit(pd.DataFrame(values, columns=paper.MODES), closed_form=False)
    assert model.method == "least squares"
    assert model.covariance.loc["s1", "s1"] == pytest.approx(pooled / 10)


def test_missing_runs_are_what_formulas_say() -> None:
    values = drawn(4)
    values[2, 1] = values[5, 6] = np.nan
    table = one(values).set_index(["comparator", "strategy"])
    long = as_runs(values)
    model = smf.mixedlm("tir_70_180 ~ C(mode, Treatment('nma'))", long, groups="patient").fit(reml=True)
    for strategy in paper.STRATEGIES:
        name = f"C(mode, Treatment('nma'))[T.{strategy}]"
        row = table.loc["nma", strategy]
        assert row["difference"] == pytest.approx(model.params[name], rel=1e-4)
        assert (row["high"] - row["low"]) / 2 == pytest.approx(Z * model.bse[name], rel=1e-3)
    ordinary = smf.ols("tir_70_180 ~ C(mode, Treatment('nma')) + C(patient)", long)
    groups = {"groups": pd.factorize(long["patient"])[0], "use_correction": False}
    clustered = ordinary.fit(cov_type="cluster", cov_kwds=groups)
    error = clustered.bse["C(mode, Treatment('nma'))[T.s4]"] * math.sqrt(10 / 9)
    row = table.loc["nma", "s4"]
    assert (row["robust_high"] - row["robust_low"]) / 2 == pytest.approx(Z * error)


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    shift=st.floats(-50, 50),
    scale=st.floats(0.1, 10),
    patients=st.integers(2, 12),
    order=st.permutations(range(7)),
)
def test_units_patients_levels_and_order_of_rows_do_not_matter(
    seed: int, shift: float, scale: float, patients: int, order: list[int]
) -> None:
    values = drawn(seed, patients=patients)
    table = one(values)
    levels = np.random.default_rng(seed).normal(size=(patients, 1))
    levels -= levels.mean()
    moved = one(scale * values + shift)
    assert np.allclose(moved["difference"], scale * table["difference"])
    assert np.allclose(moved["low"], scale * table["low"])
    assert np.allclose(moved["p"], table["p"])
    assert np.allclose(one(values + 100 * levels)["robust_low"], table["robust_low"])
    shuffled = as_runs(values).sample(frac=1, random_state=seed % 1000)
    pd.testing.assert_frame_equal(statistics.contrasts(shuffled, ["tir_70_180"]), table)


def test_what_cannot_be_fitted_says_why() -> None:
    values = drawn(5)
    single = one(values[:1])
    assert single["difference"].notna().all()
    assert single["p"].isna().all()
    assert set(single["note"]) == {"one patient: no interval"}
    same = np.tile(values[:, :1], 7)
    assert set(one(same)["note"]) == {"no variation within patients: no interval"}
    assert (one(np.zeros((10, 7)))["difference"] == 0).all()
    lacking = values.copy()
    lacking[:, 2] = np.nan
    table = one(lacking).set_index(["comparator", "strategy"])
    assert table.loc[("ma", "s3"), "note"] == "no runs of s3"
    assert table.loc[("ma", "s1"), "note"] == ""
    rare = values.copy()
    rare[1:, 2] = np.nan
    assert set(one(rare)["note"]) == {"fewer than two patients of s3: no interval"}
    apart = drawn(6)
    apart[:5, 0] = apart[5:, 6] = np.nan
    assert set(one(apart)["note"]) == {"two modes without a patient in common: no interval"}
    one_mode = statistics.contrasts(as_runs(values[:, :1], ("s1",)), ["tir_70_180"])
    assert set(one_mode["note"]) == {f"no runs of {name}" for name in ("ma", "sma", "nma")} | {
        f"no runs of {strategy} and {name}" for strategy in ("s2", "s3", "s4") for name in ("ma", "sma", "nma")
    }


def test_a_constant_difference_has_no_robust_interval() -> None:
    values = drawn(7)
    values[:, 0] = values[:, 4] + 1
    row = one(values).set_index(["comparator", "strategy"]).loc[("ma", "s1")]
    assert row["difference"] == pytest.approx(1)
    assert math.isnan(row["robust_p"])
    assert row["p"] > 0
    assert "no robust interval" in row["note"]


# ---------------------------------------------------------------------------------------------------------------- input


def test_bad_results_are_refused() -> None:
    runs = as_runs(drawn(8))
    with pytest.raises(ValueError, match="no column part, label"):
        statistics.validation(runs.drop(columns=["part", "label"]))
    with pytest.raises(ValueError, match="no run of part validation"):
        statistics.validation(runs.assign(part="tuning"))
    with pytest.raises(ValueError, match="adult#001, s1, seed 1 is there twice"):
        statistics.validation(pd.concat([runs, runs.head(1)]))
    with pytest.raises(ValueError, match="adult#001, s1: no run of seed 2, which others have"):
        statistics.validation(pd.concat([runs, runs.iloc[1:].assign(seed=2)]))
    with pytest.raises(ValueError, match="adult#001, s1, seed 1: no tir_70_180"):
        statistics.per_patient(runs.assign(tir_70_180=[np.nan, *runs["tir_70_180"][1:]]), "tir_70_180")
    with pytest.raises(ValueError, match="no column lbgi"):
        statistics.contrasts(runs, ["lbgi"])


def test_seeds_are_averaged_within_patients() -> None:
    first, second = drawn(9), drawn(10)
    both = pd.concat([as_runs(first), as_runs(second).assign(seed=2)])
    pd.testing.assert_frame_equal(
        statistics.contrasts(both, ["tir_70_180"]), one((first + second) / 2), check_exact=False
    )
    table = statistics.cells(both, ["tir_70_180"]).set_index("mode")
    assert table.loc["s2", "mean"] == pytest.approx(((first + second) / 2)[:, 1].mean())
    assert table.loc["s2", "sd"] == pytest.approx(((first + second) / 2)[:, 1].std(ddof=1))
    assert table.loc["s2", "patients"] == 10


# ------------------------------------------------------------------------------------------------------------ agreement


def published_as_ours() -> pd.DataFrame:
    table = paper.table3()
    error = (table["high"] - table["low"]) / 2 / Z
    table["p"] = np.where(table["significant"], 0.01, 0.5)
    return table.assign(robust_p=table["p"], se=error)[
        ["comparator", "strategy", "metric", "difference", "low", "high", "p", "robust_p"]
    ]


def test_the_paper_agrees_with_itself() -> None:
    compared = statistics.compare(published_as_ours())
    for column in ("agrees", "agrees_sign", "agrees_significance", "inside_interval", "same_conclusion"):
        assert compared[column].all(), column
    assert compared["robust_agrees"].all()


def test_agreement_looks_at_sign_significance_and_interval() -> None:
    table = published_as_ours().set_index(["comparator", "strategy", "metric"]).sort_index()
    flipped, lost, unclear, zero = (
        ("nma", "s1", "tir_70_180"),  # 3.02 *
        ("nma", "s2", "tir_70_180"),  # 10.53 *
        ("sma", "s1", "tir_70_180"),  # -0.10, not significant
        ("ma", "s3", "tar_250"),  # printed as 0.00
    )
    table.loc[flipped, "difference"] *= -1
    table.loc[lost, ["p", "difference"]] = [0.2, 20.0]
    table.loc[unclear, "difference"] = 0.4
    table.loc[zero, "difference"] = -0.1
    compared = statistics.compare(table.reset_index()).set_index(["comparator", "strategy", "metric"])
    wanted = ["agrees_sign", "agrees_significance", "agrees", "inside_interval", "same_conclusion"]
    assert compared.loc[flipped, wanted].tolist() == [False, True, False, False, False]
    assert compared.loc[lost, wanted].tolist() == [True, False, False, False, False]
    assert compared.loc[unclear, wanted].tolist() == [False, True, False, True, True]
    assert compared.loc[zero, wanted].tolist() == [True, True, True, True, True]
    assert compared["agrees"].sum() == 57


def test_nothing_known_agrees_with_nothing() -> None:
    compared = statistics.compare(one(drawn(11)[:1]))
    assert not compared["agrees"].any()
    assert not compared["same_conclusion"].any()


def test_distance_of_the_means() -> None:
    cells = paper.table2()
    assert statistics.rms_distance(cells) == 0
    cells.loc[(cells["metric"] == "tir_70_180") & cells["mode"].isin(["s1", "s2"]), "mean"] += 2
    assert statistics.rms_distance(cells) == pytest.approx(math.sqrt(8 / 7))


def test_a_study_like_the_papers_agrees_with_it() -> None:
    runs = statistics.validation(synthetic_runs())
    compared = statistics.compare(statistics.contrasts(runs))
    counts = statistics.summary(compared, statistics.cells(runs))
    assert counts["contrasts"] == counts["judged"] == 60
    assert counts["tir_inside"] == 12
    assert counts["tir_rms"] < 1.0
    assert statistics.fast_path_error(runs) < 1e-3
    tables_by_seed, seeds = statistics.by_seed(runs)
    assert list(seeds["seed"]) == [1, 2]
    assert len(tables_by_seed) == 120


# ------------------------------------------------------------------------------------------------------ text and tuning


def test_contrasts_of_the_text() -> None:
    runs = synthetic_runs()
    table = statistics.text_contrasts(runs)
    assert list(table["first"]) == ["ma", "ma", "s2 ratio=10", "s4 ratio=10", "s2 ratio=6", "s4 ratio=6"]
    by_hand = (
        statistics.per_patient(statistics.validation(runs), "tir_70_180")["s2"]
        - statistics.per_patient(runs[(runs["part"] == "dose_ratio") & (runs["mode"] == "s2")], "tir_70_180")["s2"]
    )
    row = table.iloc[2]
    assert row["value"] == pytest.approx(by_hand.mean())
    assert row["high"] - row["value"] == pytest.approx(Z * by_hand.std() / math.sqrt(10))
    fewer = runs[(runs["part"] != "dose_ratio") | (runs["seed"] == 2)]
    assert statistics.text_contrasts(fewer).iloc[2]["value"] == pytest.approx(
        statistics.text_contrasts(runs[runs["seed"] == 2]).iloc[2]["value"]
    )
    without = statistics.text_contrasts(runs[runs["part"] == "validation"])
    assert without["note"].tolist() == [
        *("", "", "no runs of s2 ratio=10 and s2 ratio=6", "no runs of s4 ratio=10 and s4 ratio=6"),
        *("no runs of s2 ratio=6", "no runs of s4 ratio=6"),
    ]


def tuning_table(*candidates: tuple[str, float, float, float]) -> pd.DataFrame:
    """Two patients per candidate of strategy 3: label, time in range, time below 70, µg/day."""
    rows = [
        {
            "part": "tuning", "label": label, "patient": patient, "mode": "s3", "seed": 1, "tir_70_180": tir + offset,
            "tbr_70": tbr, "tar_180": 100 - tir - tbr, "pramlintide_ug_per_day": pram,
        }
        for label, tir, tbr, pram in candidates
        for patient, offset in (("adult#001", 1.0), ("adult#002", -1.0))
    ]  # fmt: skip
    return pd.DataFrame(rows)


def test_the_least_pramlintide_of_similar_tunings_is_chosen() -> None:
    # as the paper tells of strategy 3: 15 and 30 ug alike in range, fewest hypoglycaemias with 15
    table = tuning_table(("phi=15", 94.7, 0.1, 62), ("phi=30", 94.9, 0.3, 124), ("phi=300", 80, 12, 1240))
    chosen = selection.select(table)
    assert chosen.label == "phi=15"
    assert "least pramlintide of 2 of 3 tunings" in chosen.why
    assert list(chosen.candidates["similar"]) == [True, True, False]


def test_more_time_in_range_beats_less_pramlintide() -> None:
    assert selection.select(tuning_table(("phi=15", 90, 0, 60), ("phi=30", 92, 0, 120))).label == "phi=30"


def test_hypoglycaemia_rules_out_what_is_longest_in_range() -> None:
    table = tuning_table(("phi=15", 94.2, 3.0, 60), ("phi=30", 94.5, 0.2, 120), ("phi=45", 95.0, 2.0, 180))
    assert selection.select(table).label == "phi=30"


def test_a_tie_goes_to_the_longer_time_in_range() -> None:
    table = tuning_table(("z=1", 94.2, 0, 60), ("z=3", 94.5, 0, 60), ("z=2", 94.5, 0, 60))
    assert selection.select(table).label == "z=2"


@given(st.lists(st.tuples(st.floats(50, 99), st.floats(0, 9), st.floats(1, 400)), min_size=1, max_size=8))
def test_what_is_chosen_is_never_beaten_in_everything(numbers: list[tuple[float, float, float]]) -> None:
    table = tuning_table(*((f"c{i}", *values) for i, values in enumerate(numbers)))
    chosen = selection.select(table)
    row = chosen.candidates.set_index("label").loc[chosen.label]
    assert row["tir_70_180"] >= chosen.candidates["tir_70_180"].max() - selection.TIR_MARGIN - 1e-9
    similar = chosen.candidates[chosen.candidates["similar"]]
    assert row["pramlintide_ug_per_day"] == similar["pramlintide_ug_per_day"].min()
    assert row["tbr_70"] <= similar["tbr_70"].min() + selection.TBR_MARGIN + 1e-9


def test_tuning_that_cannot_be_judged_is_refused() -> None:
    table = tuning_table(("phi=15", 90, 0, 60), ("phi=30", 92, 0, 120))
    with pytest.raises(ValueError, match="no run of phi=30 for adult#002"):
        selection.select(table.iloc[:-1])
    with pytest.raises(ValueError, match="runs of one strategy expected, got s2 s3"):
        selection.select(pd.concat([table, table.assign(mode="s2")]))
    with pytest.raises(ValueError, match="got none"):
        selection.select(table.iloc[:0])


# --------------------------------------------------------------------------------------------------------------- tables


def test_tables_keep_their_contract(tmp_path: Path) -> None:
    runs = synthetic_runs()
    written = tables.write_tables(tmp_path, runs)
    assert {path.name for path in written} == {path.name for path in tmp_path.iterdir()}
    table3 = pd.read_csv(tmp_path / "table3.csv", keep_default_na=False)
    assert list(table3.columns)[:11] == [
        *("comparator", "strategy", "metric", "difference", "low", "high", "p"),
        *("paper_difference", "paper_low", "paper_high", "agrees"),
    ]
    assert len(table3) == 60
    assert set(table3["agrees"]) <= {True, False}
    table2 = pd.read_csv(tmp_path / "table2.csv")
    wanted = [f"{mode}_{what}" for mode in ("s1", "s2", "s3", "s4", "ma", "sma", "nma") for what in ("mean", "sd")]
    assert list(table2.columns)[:15] == ["metric", *wanted]
    row = table2.set_index("metric").loc["tir_70_180"]
    assert row["paper_s4_mean"] == 99.2
    assert row["s4_mean"] == pytest.approx(
        statistics.per_patient(statistics.validation(runs), "tir_70_180")["s4"].mean(), abs=5e-5
    )
    assert (tmp_path / "tuning.csv").read_text(encoding="utf-8").count("true\n") == 5


def test_tables_are_the_same_bytes_whatever_the_order_of_rows(tmp_path: Path) -> None:
    runs = synthetic_runs()
    tables.write_tables(tmp_path / "a", runs)
    tables.write_tables(tmp_path / "b", runs.sample(frac=1, random_state=1))
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes(), path.name


def test_cells_of_a_csv(tmp_path: Path) -> None:
    table = pd.DataFrame({"x": [-0.00001, math.nan, 1e3], "p": [1.23456e-9, 0.5, math.nan], "n": [1, 2, 3]})
    tables.write_table(tmp_path / "new" / "t.csv", table.assign(ok=[True, False, True]))
    text = (tmp_path / "new" / "t.csv").read_text(encoding="utf-8")
    assert text == "x,p,n,ok\n0.0000,1.235e-09,1,true\n,0.5,2,false\n1000.0000,,3,true\n"
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["t.csv"]


def test_two_patients_and_one_strategy_are_enough_for_tables(tmp_path: Path) -> None:
    runs = synthetic_runs()
    few = runs[runs["patient"].isin(["adult#001", "adult#002"]) & runs["mode"].isin(["s2", "nma"])]
    tables.write_tables(tmp_path, few[few["part"] == "validation"])
    table = pd.read_csv(tmp_path / "table3.csv").set_index(["comparator", "strategy", "metric"])
    assert table.loc[("nma", "s2", "tir_70_180"), "low"] < table.loc[("nma", "s2", "tir_70_180"), "high"]
    assert table.loc[("ma", "s1", "tir_70_180"), "note"] == "no runs of s1 and ma"
