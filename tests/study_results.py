"""Made-up results of a study, drawn from the paper's own means and standard deviations: for tests only."""

from functools import cache

import numpy as np
import pandas as pd
from pumpbench.study import paper

DOSES = {
    "s1": ("lambda_ug", (15, 30, 45, 60, 90, 100, 300)),
    "s2": ("ratio_ug_per_u", (3, 6, 10, 12, 15)),
    "s3": ("phi_ug", (15, 30, 45, 60, 90, 100, 300)),
    "s4": ("ratio_ug_per_u", (3, 6, 10, 12, 15)),
}
SWEPT = ("phi_ug", "lambda_ug", "ratio_ug_per_u", "z1", "z2", "z3")


@cache
def _table(patients: int, seeds: int) -> pd.DataFrame:
    random = np.random.default_rng(20250601)
    said = paper.table2().set_index(["mode", "metric"])
    names = [f"adult#{i + 1:03}" for i in range(patients)]
    difficulty = np.linspace(-1.3, 1.3, patients) if patients > 1 else np.zeros(1)

    def run(mode: str, level: float, worse: float = 0.0) -> dict[str, float]:
        """Metrics of one run: `level` is the patient's difficulty, `worse` takes points of time in range."""

        def drawn(metric: str, sign: float) -> float:
            mean, sd = said.loc[(mode, metric)][["mean", "sd"]]
            return mean + 0.7 * sd * sign * level + 0.07 * sd * random.normal() + 0.02 * random.normal()

        below = max(drawn("tbr_70", 1), 0.0)
        above = max(drawn("tar_180", 1) + worse, 0.0)
        hbgi, lbgi = max(drawn("hbgi", 1), 0.05), max(drawn("lbgi", -0.3), 0.0)
        mean = 118 + 12 * hbgi
        return {
            "tir_70_180": 100 - below - above, "tbr_54": 0.1 * below, "tbr_70": below, "tar_180": above,
            "tar_250": max(drawn("tar_250", 1), 0.0), "lbgi": lbgi, "hbgi": hbgi, "mean_glucose": mean,
            "cv": 18 + 3 * hbgi, "gmi": 3.31 + 0.02392 * mean, "gri": 0.8 * above + 2.4 * below,
            "insulin_u_per_day": drawn("insulin_u_per_day", 0.5),
            "pramlintide_ug_per_day": max(drawn("pramlintide_ug_per_day", 0.5), 0.0) if mode in DOSES else 0.0,
            "limiter_steps": 0.0,
        }  # fmt: skip

    rows = []

    def add(part: str, mode: str, label: str, swept: dict[str, float], worse: float = 0.0, dose: float = 1.0) -> None:
        for seed in range(1, seeds + 1) if part != "tuning" else (1,):
            for name, level in zip(names, difficulty, strict=True):
                metrics = run(mode, level, worse)
                metrics["pramlintide_ug_per_day"] *= dose
                row = {"part": part, "patient": name, "mode": mode, "seed": seed, "days": 14, "label": label}
                rows.append(row | dict.fromkeys(SWEPT, np.nan) | swept | metrics)

    for mode in paper.MODES:
        add("validation", mode, "", {})
    for mode, worse in (("s2", 2.2), ("s4", 1.1)):
        add("dose_ratio", mode, "ratio=6", {"ratio_ug_per_u": 6.0}, worse, 0.6)
    for mode, (column, doses) in DOSES.items():
        best = {"s1": 30, "s2": 10, "s3": 15, "s4": 10}[mode]
        for dose in doses:
            ratio = dose / best
            label = f"{column.split('_')[0]}={dose}"
            add("tuning", mode, label, {column: float(dose)}, 6 * abs(np.log(ratio)) * (ratio < 1) - 0.1, ratio)
    for z2 in (0.5, 1.0):
        add("tuning", "s1", f"z=2,{z2:g},12", {"lambda_ug": 30.0, "z1": 2.0, "z2": z2, "z3": 12.0}, 4 * (z2 - 0.5))
    return pd.DataFrame(rows)


def synthetic_runs(patients: int = 10, seeds: int = 2) -> pd.DataFrame:
    """All three parts of a study with the paper's level and spread."""
    return _table(patients, seeds).copy()
