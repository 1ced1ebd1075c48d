"""The model of the paper, metric ~ mode + (1 | patient) by REML, and cluster-robust errors beside it.

With every patient in every mode the fit has a closed form: differences of means, SE = sqrt(2 s2_e / n), where s2_e is
the residual mean square, or, where the patients' variance is estimated as zero, the mean square within modes. Otherwise
statsmodels' MixedLM is fitted. The robust errors are those of ordinary least squares with a dummy per patient, one
cluster per patient, correction n/(n - 1): with every patient in every mode SE = sd(differences)/sqrt(n).
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
import statsmodels.api as sm
from scipy.optimize import minimize_scalar
from statsmodels.regression.mixed_linear_model import MixedLMParams
from statsmodels.tools.sm_exceptions import ConvergenceWarning

Array = np.ndarray[Any, Any]


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
