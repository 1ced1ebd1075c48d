"""The numbers of Pons Torres et al. 2025, as printed.

Table 2 (means and standard deviations), Table 3 (paired differences with 95 % intervals) and what else its text states,
from the CSV files in `pumpbench/data`, each row with its source.
"""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Final

import pandas as pd

DATA: Final = Path(__file__).parent.parent / "data"

STRATEGIES: Final = ("s1", "s2", "s3", "s4")
COMPARATORS: Final = ("ma", "sma", "nma")
MODES: Final = STRATEGIES + COMPARATORS
"""In the order of Table 2."""

CONTRAST_METRICS: Final = ("tir_70_180", "tar_180", "tar_250", "lbgi", "hbgi")
"""The metrics of Table 3; times below 54 and 70 mg/dL are left out there because they are zero for most patients."""

TABLE2_METRICS: Final = (
    "tbr_54",
    "tbr_70",
    "tir_70_180",
    "tar_180",
    "tar_250",
    "lbgi",
    "hbgi",
    "insulin_u_per_day",
    "pramlintide_ug_per_day",
)

DOSES: Final = {
    "s1": ("lambda_ug", "bolus λ", "µg"),
    "s2": ("ratio_ug_per_u", "ratio ρ", "µg/U"),
    "s3": ("phi_ug", "bolus φ", "µg"),
    "s4": ("ratio_ug_per_u", "ratio δ", "µg/U"),
}
"""Per strategy: the column of the results that is swept in its tuning, its name in the paper, its unit."""

ROUNDING: Final = 0.05 + 0.05 + 0.005
"""Most by which a difference of Table 3 can differ from that of two means of Table 2 through rounding alone."""


def table2(path: Path = DATA / "paper_table2.csv") -> pd.DataFrame:
    """Table 2: one row per mode and metric with `mean` and `sd` over the patients.

    Raises:
        ValueError: not every mode and metric is there exactly once, or a cell is no number.
    """
    table = _read(path, ("mean", "sd"))
    _check_keys(table, path, ("mode", "metric"), product(MODES, TABLE2_METRICS))
    return table


def table3(path: Path = DATA / "paper_table3.csv") -> pd.DataFrame:
    """Table 3: one row per comparator, strategy and metric with `difference` (strategy - comparator), `low`, `high`.

    `significant` is true where the paper prints an asterisk (p < 0.05).

    Raises:
        ValueError: not every one of the 60 contrasts is there exactly once, or a cell is no number.
    """
    table = _read(path, ("difference", "low", "high"))
    _check_keys(table, path, ("comparator", "strategy", "metric"), product(COMPARATORS, STRATEGIES, CONTRAST_METRICS))
    if not table["significant"].isin(["yes", "no"]).all():
        raise ValueError(f"{path}: significant is yes or no")
    table["significant"] = table["significant"] == "yes"
    return table


def text_numbers(path: Path = DATA / "paper_text.csv") -> pd.DataFrame:
    """Contrasts, means and chosen doses in the paper's text only; `low`, `high`, `sd` NaN where not given."""
    return _read(path, ("value",))


def chosen_dose(strategy: str) -> float:
    """The dose (ug) or ratio (ug/U) that the paper chose for a strategy."""
    table = text_numbers()
    return float(table.loc[(table["kind"] == "chosen") & (table["first"] == strategy), "value"].iloc[0])


def inconsistencies() -> pd.DataFrame:
    """Contrasts of Table 3 that are not the difference of the two means of Table 2, beyond what rounding explains.

    Columns comparator, strategy, metric, difference (Table 3), of_means (Table 2), excess (points beyond rounding).
    """
    means = table2().set_index(["mode", "metric"])["mean"]
    table = table3()[["comparator", "strategy", "metric", "difference"]].copy()
    table["of_means"] = [
        means[row.strategy, row.metric] - means[row.comparator, row.metric] for row in table.itertuples()
    ]
    table["excess"] = (table["difference"] - table["of_means"]).abs() - ROUNDING
    return table[table["excess"] > 1e-9].reset_index(drop=True)


def _read(path: Path, numbers: tuple[str, ...]) -> pd.DataFrame:
    table = pd.read_csv(path, comment="#", keep_default_na=False, na_values=[""])
    for column in (*numbers, "source"):
        if column not in table:
            raise ValueError(f"{path}: no column {column}")
        if table[column].isna().any():
            raise ValueError(f"{path}: empty cell in column {column}")
    for column in numbers:
        if not pd.api.types.is_numeric_dtype(table[column]):
            raise ValueError(f"{path}: column {column} is to hold numbers")
        table[column] = table[column].astype(float)
    return table


def _check_keys(table: pd.DataFrame, path: Path, columns: tuple[str, ...], expected: product[tuple[str, ...]]) -> None:
    wanted = set(expected)
    found = list(table[list(columns)].itertuples(index=False, name=None))
    if len(found) != len(wanted) or set(found) != wanted:
        wrong = sorted({key for key in found if key not in wanted or found.count(key) > 1} | (wanted - set(found)))
        raise ValueError(f"{path}: every {', '.join(columns)} once, {len(wanted)} rows; not so: {' '.join(wrong[0])}")
