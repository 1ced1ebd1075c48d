"""The paper's rule on tuning runs: which dose, ratio or setting is chosen of those that were tried."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import pandas as pd

from pumpbench.study import paper
from pumpbench.study.statistics import check_columns, per_patient

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

    @property
    def marked(self) -> pd.DataFrame:
        """The candidates with one more column, `chosen`."""
        return self.candidates.assign(chosen=self.candidates["label"] == self.label)


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


def selections(runs: pd.DataFrame) -> Mapping[str, Selection]:
    """What the paper's rule chooses per strategy and, as "s1 thresholds", for z1, z2, z3 of the tuning runs."""
    tuning = runs[runs["part"] == "tuning"]
    parts = {strategy: dose_runs(tuning, strategy) for strategy in paper.STRATEGIES}
    chosen = {name: select(part) for name, part in parts.items() if len(part)}
    thresholds = tuning[sweeps_thresholds(tuning)]
    if len(thresholds):
        chosen["s1 thresholds"] = select(thresholds, tir_margin=THRESHOLD_MARGIN)
    return chosen
