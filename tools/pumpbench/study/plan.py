"""What the study simulates, in the order of its choices; those of the controller are frozen before the validation.

1. The law, on the tuning scenario: the gain of every patient and the filter's theta from runs of NMA, the deducted
   share of a bolus from runs of MA. Each is chosen by the paper's rule (`selection.select`): the longest time in range
   with the lowest time below 70 mg/dL, and of similar ones the gentlest, as for pramlintide the smallest dose.
2. The strategies, on the same scenario: strategy 1's thresholds by exhaustive search, then doses and ratios.
3. The validation, on other meals and on seeds that nothing was chosen on.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import pandas as pd

from pumpbench.calibration import MODES, Tuning, tuning_for
from pumpbench.campaign import Job
from pumpbench.controller_model import ControllerModel
from pumpbench.study import paper, selection

TUNING_SEEDS: Final = (1, 2)
VALIDATION_SEEDS: Final = tuple(range(1001, 1011))
"""Seeds of the validation; nothing was ever chosen on them."""

THETAS: Final = (10.0, 11.0, 12.0, 13.0, 15.0)
GAINS: Final = tuple(round(0.48 + 0.04 * i, 2) for i in range(9))
"""gamma K_u/K_d; 1 would be integral action, and above 0.8 the loop is near to it."""
DEDUCTIONS: Final = (0.55, 0.7, 0.85, 1.0)
Z1: Final = (1.0, 1.25, 1.5, 2.0, 2.5, 3.0)
Z2: Final = (0.0, 0.25, 0.5, 1.0, 1.5, 2.0)
Z3: Final = (6, 12, 24, 36, 48)
LAMBDAS: Final = (15.0, 30.0, 60.0, 90.0, 120.0, 200.0, 300.0)
PHIS: Final = LAMBDAS
RATIOS: Final = (3.0, 4.5, 6.0, 8.0, 10.0, 12.0, 15.0)

START_LAMBDA: Final = 30.0
"""ug, with which the thresholds are searched."""

MEALS_A_DAY: Final = 3
"""Of the tuning scenario. The thresholds "act as a meal detection strategy" (section 2.3.1): a setting that gives more
boluses than there are meals is none."""

PRAM_TDD: Final = 1600.0
"""ug in 24 h: the largest limit there is, for the largest doses of the tuning."""


@dataclass(frozen=True)
class Cohort:
    """Who takes part, and what the controller knows of them.

    Attributes:
        patients: names as for `pumpbench run`.
        models: by patient, for patients of one's own; empty: those of the package.
        common: further fields of every job.
    """

    patients: tuple[str, ...]
    models: Mapping[str, ControllerModel] = dataclasses.field(default_factory=dict)
    common: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def job(self, patient: str, mode: str, seed: int, days: int, tuning: Tuning, **fields: Any) -> Job:
        """One run."""
        return Job(
            patient, mode, seed, days, tuning=tuning, model=self.models.get(patient), **{**self.common, **fields}
        )


@dataclass(frozen=True)
class Law:
    """The controller as chosen.

    Attributes:
        theta: min.
        gains: by patient.
        bolus_deduction: share.
        thresholds: z1, z2 (mg/dL/min), z3 (steps).
        doses: by strategy, ug or ug/U.
    """

    theta: float
    gains: Mapping[str, float]
    bolus_deduction: float
    thresholds: tuple[float, float, int] = (2.0, 0.5, 12)
    doses: Mapping[str, float] = dataclasses.field(default_factory=lambda: dict.fromkeys(("s1", "s2", "s3", "s4"), 0.0))

    def tuning(self, patient: str, mode: str, **changes: Any) -> Tuning:
        """The tuning of one patient in one mode."""
        z1, z2, z3 = self.thresholds
        fields: dict[str, Any] = {
            "theta": self.theta,
            "gain": self.gains[patient],
            "bolus_deduction": self.bolus_deduction,
            "peak_ratio": z1,
            "peak_slope": z2,
            "peak_lockout": z3,
        }
        if mode in DOSE_FIELD and self.doses[mode]:
            fields[DOSE_FIELD[mode]] = self.doses[mode]
        return dataclasses.replace(tuning_for(mode), **(fields | changes))


DOSE_FIELD: Final = {"s1": "pram_bolus", "s2": "pram_ratio", "s3": "pram_bolus", "s4": "pram_ratio"}
DOSES: Final = {"s1": LAMBDAS, "s2": RATIOS, "s3": PHIS, "s4": RATIOS}


# ---- 1: the law


def gain_jobs(cohort: Cohort, days: int) -> list[Job]:
    """NMA with every theta and gain."""
    return [
        cohort.job(
            patient, "nma", seed, days, dataclasses.replace(tuning_for("nma"), theta=theta, gain=gain),
            part="law", label=f"theta={theta:g} gain={gain:.2f}", scenario="tuning",
        )
        for patient in cohort.patients for seed in TUNING_SEEDS for theta in THETAS for gain in GAINS
    ]  # fmt: skip


def choose_gains(runs: pd.DataFrame, patients: Iterable[str]) -> tuple[float, dict[str, float], pd.DataFrame]:
    """Theta, and the gain of every patient: for each theta every patient's own gain, then the theta of all.

    Of settings that behave similarly the gentlest is taken: the smallest gain, the slowest filter.

    Args:
        runs: of `gain_jobs`.
        patients: who takes part.

    Returns:
        theta, gain by patient, and the means of every theta with its gains.
    """
    found = runs["label"].str.extract(r"theta=(\S+) gain=(\S+)").astype(float)
    runs = runs.assign(theta=found[0], gain=found[1], speed=-found[0])
    chosen: dict[float, dict[str, float]] = {}
    best = []
    for theta, of_theta in runs.groupby("theta"):
        gains = {}
        for patient in patients:
            own = of_theta[of_theta["patient"] == patient]
            label = selection.select(own, least="gain").label
            gains[patient] = float(label.split("gain=")[1])
            best.append(own[own["label"] == label].assign(label=f"theta={theta:g}"))
        chosen[float(theta)] = gains
    settled = selection.select(pd.concat(best, ignore_index=True), least="speed")
    theta = float(settled.label.removeprefix("theta="))
    return theta, chosen[theta], settled.marked


def deduction_jobs(cohort: Cohort, days: int, theta: float, gains: Mapping[str, float]) -> list[Job]:
    """MA with every share of the bolus taken out of the feedback."""
    return [
        cohort.job(
            patient, "ma", seed, days, Law(theta, gains, share).tuning(patient, "ma"),
            part="law", label=f"deduction={share:g}", scenario="tuning",
        )
        for patient in cohort.patients for seed in TUNING_SEEDS for share in DEDUCTIONS
    ]  # fmt: skip


def choose_deduction(runs: pd.DataFrame) -> tuple[float, pd.DataFrame]:
    """The share of a bolus taken out of the feedback; of similar ones the greatest, which gives the least insulin."""
    share = runs["label"].str.removeprefix("deduction=").astype(float)
    settled = selection.select(runs.assign(kept=1 - share), least="kept")
    return float(settled.label.removeprefix("deduction=")), settled.marked


# ---- 2: the strategies


def threshold_jobs(cohort: Cohort, days: int, law: Law) -> list[Job]:
    """Strategy 1 with every combination of z1, z2 and z3, under the first of the tuning seeds."""
    law = dataclasses.replace(law, doses={**law.doses, "s1": START_LAMBDA})
    return [
        cohort.job(
            patient, "s1", TUNING_SEEDS[0], days,
            dataclasses.replace(law, thresholds=(z1, z2, z3)).tuning(patient, "s1", pram_tdd=PRAM_TDD),
            part="tuning", label=f"z={z1:g},{z2:g},{z3}", scenario="tuning",
            swept=(("lambda_ug", START_LAMBDA), ("z1", z1), ("z2", z2), ("z3", float(z3))),
        )
        for patient in cohort.patients for z1 in Z1 for z2 in Z2 for z3 in Z3
    ]  # fmt: skip


def detectors(runs: pd.DataFrame) -> pd.DataFrame:
    """The threshold runs whose setting detects meals: no more boluses than meals, over the cohort.

    Others are marked as the part "no meal detector", so that no rule takes them.
    """
    boluses = runs.groupby("label")["pramlintide_ug_per_day"].transform("mean") / START_LAMBDA
    return runs.assign(part=runs["part"].where(boluses <= MEALS_A_DAY, "no meal detector"))


def dose_jobs(cohort: Cohort, days: int, law: Law) -> list[Job]:
    """Every strategy with every dose or ratio."""
    return [
        cohort.job(
            patient, mode, seed, days,
            dataclasses.replace(law, doses={**law.doses, mode: dose}).tuning(patient, mode, pram_tdd=PRAM_TDD),
            part="tuning", label=f"{paper.DOSES[mode][0].split('_')[0]}={dose:g}", scenario="tuning",
            swept=((paper.DOSES[mode][0], dose),),
        )
        for patient in cohort.patients for seed in TUNING_SEEDS for mode in DOSES for dose in DOSES[mode]
    ]  # fmt: skip


# ---- 3: validation


def validation_jobs(
    cohort: Cohort,
    days: int,
    law: Law,
    seeds: Sequence[int],
    *,
    part: str = "validation",
    modes: Iterable[str] = MODES,
    series: int = 0,
    changes: Mapping[str, Any] | None = None,
    swept: tuple[tuple[str, float], ...] = (),
    label: str = "",
    **fields: Any,
) -> list[Job]:
    """The validation scenario.

    Args:
        cohort, days, law, seeds: of the runs.
        part, label, swept: for the table.
        modes: of `calibration.MODES`.
        series: of so many seeds, the first, the curves are kept.
        changes: to the tuning of every run.
        **fields: of every job.
    """
    return [
        cohort.job(
            patient, mode, seed, days, law.tuning(patient, mode, **(changes or {})),
            part=part, label=label, swept=swept, series=seed in tuple(seeds)[:series],
            **({"scenario": "validation-14d"} | fields),
        )
        for patient in cohort.patients for seed in seeds for mode in modes
    ]  # fmt: skip


def ratio_jobs(cohort: Cohort, days: int, law: Law, seeds: Sequence[int], ratio: float) -> list[Job]:
    """Strategies 2 and 4 of the validation with another ratio, ug/U; the curves of the first seed are kept."""
    return validation_jobs(
        cohort, days, law, seeds, part="dose_ratio", modes=("s2", "s4"), series=1,
        changes={"pram_ratio": ratio}, swept=(("ratio_ug_per_u", ratio),), label=f"ratio={ratio:g}",
    )  # fmt: skip
