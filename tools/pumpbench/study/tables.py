"""The CSV files of the study: Table 2, Table 3, seeds, the text's contrasts and the tuning, beside the paper's numbers.

Text with fixed formats, so that equal results are equal bytes, and each file is there as a whole or not at all.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from pumpbench.files import write_file
from pumpbench.study import paper, selection, statistics

FURTHER: Final = ("mean_glucose", "cv", "gmi", "gri", "limiter_steps")
"""Rows of table2.csv after the paper's, where the results have these columns."""

TABLE3_COLUMNS: Final = [
    *("comparator", "strategy", "metric", "difference", "low", "high", "p"),
    *("paper_difference", "paper_low", "paper_high", "agrees"),
    *("agrees_sign", "agrees_significance", "inside_interval", "same_conclusion", "paper_significant"),
    *("robust_low", "robust_high", "robust_p", "robust_agrees", "patients", "note"),
]


def write_table(path: Path, table: pd.DataFrame) -> None:
    """A table as CSV: numbers with four decimals, p with four digits, true/false, nothing where there is no number."""
    text = pd.DataFrame({str(name): [_cell(str(name), value) for value in table[name]] for name in table})
    write_file(path, text.to_csv(index=False, lineterminator="\n").encode())


def _cell(column: str, value: Any) -> str:
    if isinstance(value, (bool, np.bool_)):
        return "true" if value else "false"
    if isinstance(value, (int, np.integer)):
        return str(value)
    if isinstance(value, (float, np.floating)):
        if np.isnan(value):
            return ""
        if column in ("p", "robust_p"):
            return f"{value:.4g}"
        return f"{round(float(value), 4) + 0.0:.4f}"  # + 0.0: no -0.0000
    return str(value)


def table2(runs: pd.DataFrame) -> pd.DataFrame:
    """Table 2: a row per metric; columns s1_mean, s1_sd, ... nma_sd, then the paper's with the prefix paper_."""
    metrics = [*paper.TABLE2_METRICS, *(name for name in FURTHER if name in runs)]
    ours = statistics.cells(statistics.validation(runs), metrics).set_index(["mode", "metric"])
    theirs = paper.table2().set_index(["mode", "metric"])
    rows = []
    for metric in metrics:
        row: dict[str, Any] = {"metric": metric}
        for prefix, table in (("", ours), ("paper_", theirs)):
            for mode in paper.MODES:
                for what in ("mean", "sd"):
                    known = (mode, metric) in table.index
                    row[f"{prefix}{mode}_{what}"] = float(table.loc[(mode, metric), what]) if known else np.nan
        rows.append(row)
    return pd.DataFrame(rows)


def table3(runs: pd.DataFrame) -> pd.DataFrame:
    """Table 3: a row per contrast, averaged over seeds, beside the paper's; the columns are `TABLE3_COLUMNS`."""
    return statistics.compare(statistics.contrasts(statistics.validation(runs)))[TABLE3_COLUMNS]


def write_tables(folder: Path, runs: pd.DataFrame) -> list[Path]:
    """All CSV files of a result table with the parts that were run; returns their paths.

    table2.csv, table3.csv, table3_by_seed.csv, seeds.csv, text_contrasts.csv, paper_inconsistencies.csv and, if there
    are tuning runs, tuning.csv.

    Raises:
        ValueError: the results cannot be used; says why.
    """
    alone = statistics.validation(runs)
    contrasts, seeds = statistics.by_seed(alone)
    tables = {
        "table2": table2(runs),
        "table3": table3(runs),
        "table3_by_seed": contrasts[["seed", *TABLE3_COLUMNS]],
        "seeds": seeds,
        "text_contrasts": statistics.text_contrasts(runs),
        "paper_inconsistencies": paper.inconsistencies(),
    }
    chosen = selection.selections(runs)
    if chosen:
        tables["tuning"] = pd.concat(
            [
                one.candidates.assign(strategy=strategy, chosen=one.candidates["label"] == one.label)
                for strategy, one in chosen.items()
            ],
            ignore_index=True,
        )
    for name, table in tables.items():
        write_table(folder / f"{name}.csv", table)
    return [folder / f"{name}.csv" for name in tables]
