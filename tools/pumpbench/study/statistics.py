"""Paired differences between modes, as in Table 3 of Pons Torres et al. 2025, and how far they are from the paper's.

The paper fits metric ~ mode + (1 | patient) with lme4 (REML) and takes differences with normal 95 % intervals; see
`mixed_model`.

The tables come as one row per run with columns part, label, patient, mode, seed and the metrics of metrics.json.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np
import pandas as pd
from scipy import stats

from pumpbench.study import paper
from pumpbench.study.mixed_model import Fit, fit

LEVEL: Final = 0.05
"""p below it is significant; intervals cover 1 - LEVEL."""

QUANTILE: Final = float(stats.norm.ppf(1 - LEVEL / 2))
"""Normal, not Student: `marginaleffects` takes infinite degrees of freedom for lme4 models."""

PAIRS: Final = tuple((comparator, strategy) for comparator in paper.COMPARATORS for strategy in paper.STRATEGIES)
RATIOS: Final = (6.0, 10.0)
"""ug/U that the paper compares in its discussion."""

KEYS: Final = ("part", "label", "patient", "mode", "seed")


# ---------------------------------------------------------------------------------------------------------------- input


def validation(runs: pd.DataFrame) -> pd.DataFrame:
    """The runs of the validation part with the chosen parameters.

    Raises:
        ValueError: a column is missing, a run is there twice, there are no such runs, or two patients of a mode have
            different seeds.
    """
    check_columns(runs, KEYS)
    chosen = runs[(runs["part"] == "validation") & (runs["label"].fillna("") == "")]
    if chosen.empty:
        raise ValueError("results: no run of part validation with an empty label")
    _check_seeds(chosen)
    return chosen


def check_columns(runs: pd.DataFrame, columns: Iterable[str]) -> None:
    """Raises ValueError naming the columns that are missing."""
    missing = [column for column in columns if column not in runs]
    if missing:
        raise ValueError(f"results: no column {', '.join(missing)}")


def per_patient(runs: pd.DataFrame, metric: str) -> pd.DataFrame:
    """Patients x modes: the metric averaged over seeds; NaN where a patient has no run of a mode.

    Averaging comes first so that n stays the number of patients, however many seeds there are.

    Raises:
        ValueError: the metric is no column, is missing in a run, or a run is there twice or without its seeds.
    """
    check_columns(runs, ("patient", "mode", "seed", metric))
    _check_seeds(runs)
    missing = runs[~np.isfinite(runs[metric].astype(float))]
    if len(missing):
        row = missing.iloc[0]
        raise ValueError(f"results: {row['patient']}, {row['mode']}, seed {row['seed']}: no {metric}")
    table = runs.pivot_table(index="patient", columns="mode", values=metric, aggfunc="mean")
    return table.reindex(columns=[mode for mode in paper.MODES if mode in table] + _others(table))


def _others(table: pd.DataFrame) -> list[str]:
    return sorted(mode for mode in table if mode not in paper.MODES)


def _check_seeds(runs: pd.DataFrame) -> None:
    keys = [key for key in KEYS if key in runs]
    twice = runs[runs.duplicated(keys)]
    if len(twice):
        row = twice.iloc[0]
        raise ValueError(f"results: {row['patient']}, {row['mode']}, seed {row['seed']} is there twice")
    wanted = sorted(set(runs["seed"]))
    for (patient, mode), seeds in runs.groupby(["patient", "mode"])["seed"]:
        if sorted(set(seeds)) != wanted:
            lacking = " ".join(str(seed) for seed in wanted if seed not in set(seeds))
            raise ValueError(f"results: {patient}, {mode}: no run of seed {lacking}, which others have")


# ------------------------------------------------------------------------------------------------------------ contrasts


def cells(runs: pd.DataFrame, metrics: Sequence[str] = paper.TABLE2_METRICS) -> pd.DataFrame:
    """Mean and standard deviation over patients (n - 1; NaN for one patient) per mode and metric, as in Table 2."""
    rows = []
    for metric in metrics:
        table = per_patient(runs, metric)
        for mode in table:
            column = table[mode].dropna()
            rows.append((mode, metric, float(column.mean()), float(column.std()), len(column)))
    return pd.DataFrame(rows, columns=["mode", "metric", "mean", "sd", "patients"])


def contrasts(
    runs: pd.DataFrame,
    metrics: Sequence[str] = paper.CONTRAST_METRICS,
    pairs: Sequence[tuple[str, str]] = PAIRS,
    *,
    closed_form: bool = True,
) -> pd.DataFrame:
    """Differences strategy - comparator per pair and metric, one row each, whatever could be run.

    Columns: comparator, strategy, metric, difference, low, high, p (mixed model), robust_low, robust_high, robust_p,
    patients, note. NaN where there is nothing to say, and `note` tells why.
    """
    rows = []
    for metric in metrics:
        fitted = fit(per_patient(runs, metric), closed_form=closed_form)
        rows += [(order, _contrast(fitted, metric, *pair)) for order, pair in enumerate(pairs)]
    return pd.DataFrame([row for _, row in sorted(rows, key=lambda item: item[0])])


def _contrast(fitted: Fit, metric: str, comparator: str, strategy: str) -> dict[str, Any]:
    row: dict[str, Any] = {"comparator": comparator, "strategy": strategy, "metric": metric}
    absent = [mode for mode in (strategy, comparator) if mode not in fitted.means]
    if absent:
        names = ("difference", "low", "high", "p", "robust_low", "robust_high", "robust_p")
        return row | dict.fromkeys(names, np.nan) | {"patients": 0, "note": f"no runs of {' and '.join(absent)}"}
    difference = float(fitted.means[strategy] - fitted.means[comparator])
    row["difference"] = difference
    note = fitted.note
    for prefix, covariance in (("", fitted.covariance), ("robust_", fitted.robust)):
        variance = float(
            covariance.loc[strategy, strategy]
            + covariance.loc[comparator, comparator]
            - 2 * covariance.loc[strategy, comparator]
        )
        scale = float(covariance.loc[strategy, strategy] + covariance.loc[comparator, comparator])
        if variance <= 1e-14 * scale:
            variance = np.nan
            note = note or "the same difference in every patient: no robust interval"
        error = np.sqrt(variance)
        row |= {
            f"{prefix}low": difference - QUANTILE * error,
            f"{prefix}high": difference + QUANTILE * error,
            f"{prefix}p": float(2 * stats.norm.sf(abs(difference) / error)),
        }
    return row | {"patients": fitted.patients, "note": note}


def fast_path_error(runs: pd.DataFrame) -> float:
    """Largest deviation between the closed form and statsmodels' MixedLM, in standard errors of the contrast.

    Over differences and half-widths of all contrasts; NaN where no interval can be had at all.
    """
    ours, fitted = contrasts(runs), contrasts(runs, closed_form=False)
    width = (ours["high"] - ours["low"]) / 2
    return float(
        np.fmax(
            (ours["difference"] - fitted["difference"]).abs() / width * QUANTILE,
            (width - (fitted["high"] - fitted["low"]) / 2).abs() / width * QUANTILE,
        ).max()
    )


# ---------------------------------------------------------------------------------------------------------------- paper


def compare(table: pd.DataFrame) -> pd.DataFrame:
    """The contrasts beside the paper's, with what agrees.

    agrees_sign: same sign; a paper's difference printed as 0.00 has no sign and agrees with one that is not
    significant. agrees_significance: p < 0.05 in both or in neither. agrees: both of these. inside_interval: our
    difference within the paper's 95 % interval. same_conclusion: significant in both with the same sign, or in neither
    (the sign of a difference that neither study can tell from zero is chance). robust_agrees: as agrees, with the
    robust p. What could not be computed agrees with nothing.
    """
    published = paper.table3().rename(
        columns={name: f"paper_{name}" for name in ("difference", "low", "high", "significant", "source")}
    )
    out = table.merge(published, how="left", on=["comparator", "strategy", "metric"], validate="one_to_one")
    theirs = out["paper_significant"].fillna(False).astype(bool)
    same_sign = np.sign(out["difference"]) == np.sign(out["paper_difference"])
    for prefix in ("", "robust_"):
        known, ours = out[f"{prefix}p"].notna(), out[f"{prefix}p"] < LEVEL
        sign = (same_sign | ((out["paper_difference"] == 0) & ~ours)) & out["difference"].notna()
        significance = known & (ours == theirs)
        if not prefix:
            out["agrees_sign"], out["agrees_significance"] = sign, significance
            out["same_conclusion"] = significance & (~ours | same_sign)
        out[f"{prefix}agrees"] = sign & significance
    out["inside_interval"] = out["difference"].between(out["paper_low"], out["paper_high"])
    return out.drop(columns="paper_source")


def compare_cells(table: pd.DataFrame) -> pd.DataFrame:
    """The cells of Table 2 beside the paper's: low and high are the normal 95 % interval of our mean over patients.

    agrees: the paper's mean, printed with one decimal, lies within that interval. Levels depend on the cohort, which is
    not the paper's; the contrasts are the test.
    """
    out = table.merge(paper.table2(), on=["mode", "metric"], suffixes=("", "_paper"), validate="one_to_one")
    out = out.rename(columns={"mean_paper": "paper_mean", "sd_paper": "paper_sd"}).drop(columns="source")
    half = QUANTILE * out["sd"] / np.sqrt(out["patients"])
    out["low"], out["high"] = out["mean"] - half, out["mean"] + half
    out["agrees"] = out["paper_mean"].between(out["low"] - 0.05, out["high"] + 0.05)
    return out


def rms_distance(table: pd.DataFrame, metric: str = "tir_70_180") -> float:
    """Root mean square, over the modes that were run, of our mean minus that of Table 2 (percent points)."""
    both = table[table["metric"] == metric].merge(paper.table2(), on=["mode", "metric"], suffixes=("", "_paper"))
    return float(np.sqrt(np.mean((both["mean"] - both["mean_paper"]) ** 2)))


def summary(compared: pd.DataFrame, table: pd.DataFrame) -> dict[str, float]:
    """Counts over the contrasts of Table 3 (12 of time in range, 60 in all) and the distance of the seven means."""
    tir = compared["metric"] == "tir_70_180"
    return {
        "tir_inside": int((compared["inside_interval"] & tir).sum()),
        "tir_agree": int((compared["agrees"] & tir).sum()),
        "tir_contrasts": int(tir.sum()),
        "inside": int(compared["inside_interval"].sum()),
        "agree": int(compared["agrees"].sum()),
        "same_conclusion": int(compared["same_conclusion"].sum()),
        "robust_agree": int(compared["robust_agrees"].sum()),
        "contrasts": len(compared),
        "judged": int(compared["p"].notna().sum()),
        "tir_rms": rms_distance(table),
    }


def by_seed(runs: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The comparison done for each seed by itself: all contrasts with a column `seed`, and one summary row per seed."""
    tables, rows = [], []
    for seed, part in runs.groupby("seed"):
        compared = compare(contrasts(part))
        tables.append(compared.assign(seed=seed))
        rows.append({"seed": seed} | summary(compared, cells(part)))
    return pd.concat(tables, ignore_index=True), pd.DataFrame(rows)


def text_contrasts(runs: pd.DataFrame) -> pd.DataFrame:
    """What the paper says in its text only: MA against SMA and NMA, 10 against 6 ug/U, doses at 6 ug/U.

    `runs` holds all parts. The 6 ug/U are the runs of part dose_ratio; the 10 ug/U those of that part if it has them,
    otherwise the validation runs, whose ratio is the chosen one, both with the seeds they share. A ratio contrast is
    a model of its own with two modes.
    """
    alone = validation(runs)
    ratios = {mode: _ratio_runs(runs, alone, mode) for mode in ("s2", "s4")}
    rows = []
    for said in paper.text_numbers().itertuples():
        if said.kind == "chosen":
            continue
        row = {"first": said.first, "second": said.second, "metric": said.metric}
        row |= {"paper_value": said.value, "paper_low": said.low, "paper_high": said.high, "paper_sd": said.sd}
        mode = said.first.split()[0]
        pool = ratios.get(mode, alone)
        if said.kind == "mean" and said.first in set(pool["mode"]):
            column = per_patient(pool, said.metric)[said.first]
            row |= {"value": float(column.mean()), "sd": float(column.std()), "note": ""}
        elif said.kind == "mean":
            row |= {"value": np.nan, "note": f"no runs of {said.first}"}
        elif len(pool):
            told = contrasts(pool, [said.metric], [(said.second, said.first)]).iloc[0]
            row |= {"value": told["difference"], "low": told["low"], "high": told["high"], "p": told["p"]}
            row["note"] = told["note"]
        else:
            row |= {"value": np.nan, "note": f"no runs of {said.first} and {said.second}"}
        rows.append(row)
    columns = ["first", "second", "metric", "value", "low", "high", "p", "sd"]
    columns += ["paper_value", "paper_low", "paper_high", "paper_sd", "inside_interval", "note"]
    table = pd.DataFrame(rows).reindex(columns=columns)
    table["inside_interval"] = table["value"].between(table["paper_low"], table["paper_high"])
    return table


def _ratio_runs(runs: pd.DataFrame, alone: pd.DataFrame, mode: str) -> pd.DataFrame:
    """Runs of one strategy with the two ratios, named "s2 ratio=6" and "s2 ratio=10" as modes."""
    low, high = RATIOS
    part = runs[(runs["part"] == "dose_ratio") & (runs["mode"] == mode)]
    if len(part):
        check_columns(part, ["ratio_ug_per_u"])
        six, ten = part[part["ratio_ug_per_u"] == low], part[part["ratio_ug_per_u"] == high]
    else:
        six = ten = part
    if ten.empty and len(six):
        ten = alone[alone["mode"] == mode]
    if len(six) and len(ten):  # the comparison may have been run with fewer seeds than the validation
        shared = set(six["seed"]) & set(ten["seed"])
        six, ten = six[six["seed"].isin(shared)], ten[ten["seed"].isin(shared)]
    named = [table.assign(mode=f"{mode} ratio={ratio:g}") for table, ratio in ((six, low), (ten, high)) if len(table)]
    return pd.concat(named, ignore_index=True) if named else part
