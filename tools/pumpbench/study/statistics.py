"""Paired differences between modes, as in Table 3 of Pons Torres et al. 2025, and how far they are from the paper's.

The paper fits metric ~ mode + (1 | patient) with lme4 (REML) and takes differences with normal 95 % intervals. With
every patient in every mode the fit has a closed form: differences of means, SE = sqrt(2 s2_e / n), where s2_e is the
residual mean square, or, where the patients' variance is estimated as zero, the mean square within modes. Otherwise
statsmodels' MixedLM is fitted. Beside it stand cluster-robust errors (ordinary least squares with a dummy per patient,
one cluster per patient, correction n/(n - 1)): with every patient in every mode SE = sd(differences)/sqrt(n).

The tables come as one row per run with columns part, label, patient, mode, seed and the metrics of metrics.json.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import pandas as pd
import statsmodels.api as sm
from scipy import stats
from scipy.optimize import minimize_scalar
from statsmodels.regression.mixed_linear_model import MixedLMParams
from statsmodels.tools.sm_exceptions import ConvergenceWarning

from pumpbench.study import paper

LEVEL: Final = 0.05
"""p below it is significant; intervals cover 1 - LEVEL."""

QUANTILE: Final = float(stats.norm.ppf(1 - LEVEL / 2))
"""Normal, not Student: `marginaleffects` takes infinite degrees of freedom for lme4 models."""

PAIRS: Final = tuple((comparator, strategy) for comparator in paper.COMPARATORS for strategy in paper.STRATEGIES)
RATIOS: Final = (6.0, 10.0)
"""ug/U that the paper compares in its discussion."""

Array = np.ndarray[Any, Any]

KEYS: Final = ("part", "label", "patient", "mode", "seed")


@dataclass(frozen=True)
class Fit:
    """Means per mode and two covariances of them: variances of differences are what they are good for."""

    means: pd.Series
    covariance: pd.DataFrame
    robust: pd.DataFrame
    patients: int
    method: str
    """closed form | MixedLM | least squares (MixedLM with no variance between patients) | none"""

    note: str = ""
    """Why there are no intervals, where there are none."""


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


# --------------------------------------------------------------------------------------------------------------- models


def fit(values: pd.DataFrame, *, closed_form: bool = True) -> Fit:
    """Mixed model and robust errors of a table patients x modes (NaN: not run).

    closed_form=False fits MixedLM even where the closed form applies, to check one by the other.

    Raises:
        ValueError: the model did not converge.
    """
    means = values.mean()
    empty = pd.DataFrame(np.nan, index=values.columns, columns=values.columns)
    patients, modes = values.shape
    none = Fit(means, empty, empty, patients, "none")
    if patients < 2:
        return replace(none, note="one patient: no interval")
    if modes < 2:
        return replace(none, note="one mode: nothing to compare")
    if values.isna().any(axis=None):
        return _unbalanced(values, none)
    table = values.to_numpy(dtype=float)
    residual = table - table.mean(axis=0) - table.mean(axis=1, keepdims=True) + table.mean()
    if _is_nothing(np.sum(residual**2), table):
        return replace(none, note="no variation within patients: no interval")
    robust = values.cov() / patients
    if not closed_form:
        means, covariance, method = _mixed_model(values)
        return Fit(means, covariance, robust, patients, method)
    degrees = (patients - 1) * (modes - 1)
    between = modes * np.sum((table.mean(axis=1) - table.mean()) ** 2)
    variance = np.sum(residual**2) / degrees
    if between / (patients - 1) < variance:
        # REML would make the patients' variance negative; at its bound of zero the modes are independent samples
        variance = (np.sum(residual**2) + between) / (degrees + patients - 1)
    covariance = pd.DataFrame(np.eye(modes) * variance / patients, index=values.columns, columns=values.columns)
    return Fit(means, covariance, robust, patients, "closed form")


def _is_nothing(sum_of_squares: float, table: Array) -> bool:
    """Rounding errors only: no more than a part in 1e12 of the values themselves."""
    scale = max(float(np.nanmax(np.abs(table))), 1e-9)
    return sum_of_squares <= (1e-12 * scale) ** 2 * table.size


def _unbalanced(values: pd.DataFrame, none: Fit) -> Fit:
    counts = values.notna().sum()
    if (counts < 2).any():
        few = " ".join(counts.index[counts < 2])
        return replace(none, note=f"fewer than two patients of {few}: no interval")
    shared = values.notna().astype(int)
    if ((shared.T @ shared).to_numpy() == 0).any():
        return replace(none, note="two modes without a patient in common: no interval")
    long = _long(values)
    design, groups = _design(long, values)
    ordinary = sm.OLS(long["value"], design).fit()
    if _is_nothing(float(np.sum(ordinary.resid**2)), values.to_numpy(dtype=float)):
        return replace(none, note="no variation within patients: no interval")
    clustered = sm.OLS(long["value"], design).fit(
        cov_type="cluster", cov_kwds={"groups": groups, "use_correction": False}
    )
    modes = list(values.columns)
    robust = clustered.cov_params().loc[modes, modes] * len(values) / (len(values) - 1)
    means, covariance, method = _mixed_model(values)
    return Fit(means, covariance, robust, len(values), method)


def _long(values: pd.DataFrame) -> pd.DataFrame:
    rows = [
        (patient, mode, values.loc[patient, mode])
        for patient in values.index
        for mode in values.columns
        if not np.isnan(values.loc[patient, mode])
    ]
    return pd.DataFrame(rows, columns=["patient", "mode", "value"])


def _design(long: pd.DataFrame, values: pd.DataFrame) -> tuple[pd.DataFrame, Array]:
    """A column per mode, one per patient but the first, and the patient's number of each row."""
    columns = {mode: (long["mode"] == mode).astype(float) for mode in values.columns}
    columns |= {f"patient {name}": (long["patient"] == name).astype(float) for name in values.index[1:]}
    return pd.DataFrame(columns), pd.factorize(long["patient"])[0]


def _mixed_model(values: pd.DataFrame) -> tuple[pd.Series, pd.DataFrame, str]:
    """Means and their covariance of value ~ mode + (1 | patient), REML; values in units of their spread to converge."""
    long = _long(values)
    modes = list(values.columns)
    centre, spread = long["value"].mean(), long["value"].std()
    scaled = (long["value"] - centre) / spread
    design = pd.DataFrame({mode: (long["mode"] == mode).astype(float) for mode in modes})
    patients = pd.factorize(long["patient"])[0]
    model = sm.MixedLM(scaled, design, groups=patients)
    # Started from its default, the fit ends far off where the patients' variance is small, sometimes as "converged";
    # so the one parameter that is not linear, its ratio to the residual variance, is looked for over its range first.
    found = minimize_scalar(
        lambda log: _reml(math.exp(log), scaled.to_numpy(), design.to_numpy(), patients), bounds=(-16, 16)
    )
    ratio = math.exp(found.x)
    if ratio < 1e-5:  # REML's estimate is zero, where MixedLM cannot go: independent samples
        result = sm.OLS(scaled, design).fit()
        estimates, method = result.params, "least squares"
    else:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "The MLE may be on the boundary", ConvergenceWarning)
            start = MixedLMParams.from_components(fe_params=np.zeros(len(modes)), cov_re=np.array([[ratio]]))
            result = model.fit(reml=True, start_params=start)
        if not result.converged:
            raise ValueError("mixed model: statsmodels' MixedLM did not converge")
        estimates, method = result.fe_params, "MixedLM"
    covariance = result.cov_params().loc[modes, modes] * spread**2
    return estimates * spread + centre, covariance, method


def _reml(ratio: float, value: Array, design: Array, patients: Array) -> float:
    """-2 log REML likelihood, up to a constant, at a ratio of the patients' variance to the residual one."""
    same = patients[:, None] == patients[None, :]
    covariance = np.eye(len(value)) + ratio * same
    inverse = np.linalg.inv(covariance)
    information = design.T @ inverse @ design
    residual = value - design @ np.linalg.solve(information, design.T @ inverse @ value)
    degrees = len(value) - design.shape[1]
    determinants = np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(information)[1]
    return float(determinants + degrees * math.log(residual @ inverse @ residual))


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


# --------------------------------------------------------------------------------------------------------------- tuning

TIR_MARGIN: Final = 1.0
"""Percent points of mean time in range within which two tunings count as similar; choice, a third of the difference
between groups that clinicians call meaningful."""

TBR_MARGIN: Final = 0.5
"""Percent points of mean time below 70 mg/dL within which two tunings count as similar; choice, an eighth of the
consensus limit of 4 %."""

THRESHOLD_MARGIN: Final = 0.1
"""The same for strategy 1's thresholds, which say when a dose is given, not how much: nearly only the time counts."""


def sweeps_thresholds(tuning: pd.DataFrame) -> pd.Series:
    """Which tuning runs belong to the search for z1, z2, z3 of strategy 1 (those with a z1)."""
    return tuning["z1"].notna() if "z1" in tuning else pd.Series(False, index=tuning.index)


def dose_runs(tuning: pd.DataFrame, strategy: str) -> pd.DataFrame:
    """The tuning runs that sweep the dose or ratio of a strategy.

    Raises:
        ValueError: the dose or ratio is missing in a run.
    """
    part = tuning[(tuning["mode"] == strategy) & ~sweeps_thresholds(tuning)]
    column = paper.DOSES[strategy][0]
    if len(part):
        check_columns(part, [column])
        if part[column].isna().any():
            raise ValueError(
                f"results: tuning of {strategy}: no {column} in {part['label'][part[column].isna()].iloc[0]}"
            )
    return part


@dataclass(frozen=True)
class Selection:
    """The tuning chosen for a strategy, why, and all candidates with their means."""

    label: str
    why: str
    candidates: pd.DataFrame
    """Columns label, tir_70_180, tbr_70, tar_180, pramlintide_ug_per_day (means over patients), similar."""


def select(
    tuning: pd.DataFrame,
    *,
    tir_margin: float = TIR_MARGIN,
    tbr_margin: float = TBR_MARGIN,
    least: str = "pramlintide_ug_per_day",
) -> Selection:
    """The paper's rule on the tuning runs of one strategy, candidates told apart by `label`.

    The paper takes the longest time in range with the lowest time in hypoglycaemia and, of tunings that behave
    similarly in both, the one with the lowest daily pramlintide. Here, with means over patients (seeds averaged first):
    keep what is within tir_margin of the longest time in range, of that keep what is within tbr_margin of the lowest
    time below 70, of that take the lowest daily pramlintide; a tie goes to the longer time in range, then to the label
    in order. Where no pramlintide is given, `least` names another column of what is to be as small as possible.

    Raises:
        ValueError: no runs, more than one strategy, a missing column, or a candidate that lacks a patient.
    """
    metrics = list(dict.fromkeys(["tir_70_180", "tbr_70", "tar_180", "pramlintide_ug_per_day", least]))
    check_columns(tuning, ["label", "mode", "patient", "seed", *metrics])
    modes = sorted(set(tuning["mode"]))
    if len(modes) != 1:
        raise ValueError(f"tuning: runs of one strategy expected, got {' '.join(modes) or 'none'}")
    by_label = tuning.assign(mode=tuning["label"])
    means = pd.DataFrame({metric: _whole(per_patient(by_label, metric)).mean() for metric in metrics})
    table = means.rename_axis("label").reset_index().sort_values([least, "label"])
    table["similar"] = table["tir_70_180"] >= table["tir_70_180"].max() - tir_margin
    table["similar"] &= table["tbr_70"] <= table.loc[table["similar"], "tbr_70"].min() + tbr_margin
    order = table[table["similar"]].sort_values([least, "tir_70_180", "label"], ascending=[True, False, True])
    chosen, best = order.iloc[0], table.loc[table["tir_70_180"].idxmax()]
    what = "pramlintide" if least == "pramlintide_ug_per_day" else least
    why = (
        f"{chosen['label']}: {chosen['tir_70_180']:.2f} % in range and {chosen['tbr_70']:.2f} % below 70 with "
        f"{chosen['pramlintide_ug_per_day']:.1f} µg/day, the least {what} of {len(order)} of {len(table)} tunings "
        f"within {tir_margin:.1f} points of the longest time in range ({best['label']}: {best['tir_70_180']:.2f} %) "
        f"and {tbr_margin:.1f} points of the lowest time below 70 among them"
    )
    return Selection(str(chosen["label"]), why, table.reset_index(drop=True))


def _whole(table: pd.DataFrame) -> pd.DataFrame:
    lacking = table.isna().stack()
    if lacking.any():
        patient, label = lacking[lacking].index[0]
        raise ValueError(f"tuning: no run of {label} for {patient}")
    return table
