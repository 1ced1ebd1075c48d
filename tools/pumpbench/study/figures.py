"""The figures of the study as PNG: box plots of each strategy's tuning, all contrasts, and comparisons over time.

Colours are of the Okabe-Ito palette, told apart by the colour-blind, and lines differ in style as well.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np
import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MultipleLocator

from can_bus.lockstep import STEP_MINUTES
from pumpbench.files import write_file
from pumpbench.study import paper, selection, statistics

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

HOURS: Final = 48
"""Length of the comparisons over time, from the start of the run."""

STYLES: Final = {
    "nma": ("#0072b2", "-", "no meal announcement (NMA)"),
    "s1": ("#d55e00", (0, (5, 1.5)), "strategy 1: bolus on detection"),
    "s2": ("#009e73", (0, (1.5, 1)), "strategy 2: ratio, basal only"),
}
RATIO_STYLES: Final = ((10, "#0072b2", "-"), (6, "#d55e00", (0, (5, 1.5))))
BOX, CHOSEN, INK, MUTED, LIMIT = "#cfdce8", "#e69f00", "#22262b", "#6b7280", "#b3402e"
NAMES: Final = {
    "tbr_54": "below 54 mg/dL",
    "tbr_70": "below 70 mg/dL",
    "tir_70_180": "70–180 mg/dL",
    "tar_180": "above 180 mg/dL",
    "tar_250": "above 250 mg/dL",
    "lbgi": "LBGI",
    "hbgi": "HBGI",
    "insulin_u_per_day": "insulin",
    "pramlintide_ug_per_day": "pramlintide",
}
UNITS: Final = {
    **dict.fromkeys(("tbr_54", "tbr_70", "tir_70_180", "tar_180", "tar_250"), "% of time"),
    **dict.fromkeys(("lbgi", "hbgi"), "index"),
    "insulin_u_per_day": "U/day",
    "pramlintide_ug_per_day": "µg/day",
}
TUNING_PANELS: Final = ("tir_70_180", "tar_180", "tbr_70", "pramlintide_ug_per_day")


@dataclass(frozen=True)
class Curves:
    """Samples of one run every 5 min from midnight of its first day on: mg/dL, pmol/L, pmol/L; NaN: no reading."""

    cgm: Array
    plasma_insulin: Array
    plasma_pramlintide: Array


CurveSet: TypeAlias = Mapping[tuple[str, str, int], Curves]
"""By patient, mode and seed."""

Meal: TypeAlias = tuple[float, float]
"""Minutes from the start of the run, grams of carbohydrate."""


def write_figures(
    folder: Path,
    runs: pd.DataFrame,
    curves: CurveSet | None = None,
    six: CurveSet | None = None,
    meals: Sequence[Meal] = (),
    ten: CurveSet | None = None,
) -> dict[str, Path]:
    """All figures there are data for, by name.

    They are contrasts, tuning_s1 to tuning_s4, strategies_over_time and ratio_6_and_10. `curves` and `meals` are those
    of the validation, whose ratio is the chosen one; `six` and `ten` the curves of strategies 2 and 4 with 6 and with
    10 ug/U. Of several seeds the first is drawn, since an
    average over seeds would hide how a run looks.
    """
    figures = {"contrasts": contrasts_figure(statistics.compare(statistics.contrasts(statistics.validation(runs))))}
    tuning = runs[runs["part"] == "tuning"]
    for strategy in paper.STRATEGIES:
        part = selection.dose_runs(tuning, strategy)
        if len(part):
            figures[f"tuning_{strategy}"] = tuning_figure(part, strategy)
    if curves and any(mode in STYLES for _, mode, _ in curves):
        figures["strategies_over_time"] = strategies_figure(curves, meals)
    if ten and six and {mode for _, mode, _ in six} & {mode for _, mode, _ in ten} & {"s2", "s4"}:
        figures["ratio_6_and_10"] = ratio_figure(ten, six, meals)
    for name, figure in figures.items():
        write_file(folder / f"{name}.png", png(figure))
    return {name: folder / f"{name}.png" for name in figures}


def png(figure: Figure) -> bytes:
    """The figure at 150 dots per inch."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=150)
    return buffer.getvalue()


def _figure(width: float, height: float, rows: int, columns: int = 1, **options: Any) -> tuple[Figure, Any]:
    figure = Figure(figsize=(width, height), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False, **options)
    for axis in axes.flat:
        axis.grid(axis="y", color="#e5e7eb", lw=0.8)
        axis.set_axisbelow(True)
        for side in ("top", "right"):
            axis.spines[side].set_visible(False)
        axis.tick_params(colors=INK, labelsize=9)
    return figure, axes


# ------------------------------------------------------------------------------------------------------------ contrasts


def contrasts_figure(compared: pd.DataFrame) -> Figure:
    """All contrasts of Table 3 with their 95 % intervals, ours above the paper's, a panel per metric."""
    figure, axes = _figure(11.5, 6.2, 1, len(paper.CONTRAST_METRICS), sharey=True)
    for axis, metric in zip(axes.flat, paper.CONTRAST_METRICS, strict=True):
        part = compared[compared["metric"] == metric].reset_index(drop=True)
        rows = np.arange(len(part))
        axis.axvline(0, color=MUTED, lw=1.0)
        for prefix, offset, (colour, marker, text) in (
            ("", -0.17, ("#0072b2", "o", "this study")),
            ("paper_", 0.17, ("#d55e00", "s", "paper")),
        ):
            middle = part[f"{prefix}difference"]
            axis.hlines(rows + offset, part[f"{prefix}low"], part[f"{prefix}high"], color=colour, lw=1.6)
            axis.plot(middle, rows + offset, marker, color=colour, ms=5, label=text)
        axis.grid(axis="y", visible=False)
        axis.grid(axis="x", color="#e5e7eb", lw=0.8)
        for edge in (3.5, 7.5):
            axis.axhline(edge, color="#d1d5db", lw=0.8)
        axis.set_title(NAMES[metric], fontsize=9.5, color=INK)
        axis.set_xlabel(UNITS[metric], fontsize=9, color=INK)
    first = axes.flat[0]
    first.set_yticks(rows, [f"S{row.strategy[1]} − {row.comparator.upper()}" for row in part.itertuples()])
    first.set_ylim(len(part) - 0.4, -0.6)
    figure.legend(*first.get_legend_handles_labels(), loc="outside upper center", ncols=2, frameon=False, fontsize=9)
    return figure


# --------------------------------------------------------------------------------------------------------------- tuning


def tuning_figure(runs: pd.DataFrame, strategy: str) -> Figure:
    """Boxes over patients per dose: time in range, above, below, and pramlintide per day (figures 1 to 4 of the paper).

    Line: median, box: quartiles, whiskers: to the furthest within 1.5 box lengths, points: beyond. Of several seeds the
    patient's average. The chosen dose is filled in another colour, and the paper's is marked.
    """
    column, name, unit = paper.DOSES[strategy]
    doses = runs.groupby("label")[column].first().sort_values()
    chosen = selection.select(runs).label
    figure, axes = _figure(7.2, 6.0, 2, 2, sharex=True)
    for axis, metric in zip(axes.flat, TUNING_PANELS, strict=True):
        table = statistics.per_patient(runs.assign(mode=runs["label"]), metric)
        boxes = axis.boxplot(
            [table[label].dropna().to_numpy() for label in doses.index],
            widths=0.62,
            patch_artist=True,
            medianprops={"color": INK, "lw": 1.8},
            flierprops={"marker": "o", "ms": 3.5, "mfc": INK, "mec": "none"},
            whiskerprops={"color": INK},
            capprops={"color": INK},
            boxprops={"edgecolor": INK},
        )
        for box, label in zip(boxes["boxes"], doses.index, strict=True):
            box.set_facecolor(CHOSEN if label == chosen else BOX)
        axis.set_ylabel(f"{NAMES[metric]}\n[{UNITS[metric]}]", fontsize=9.5, color=INK)
        if metric != "tir_70_180":
            axis.set_ylim(bottom=min(0.0, axis.get_ylim()[0]))
        published = np.flatnonzero(np.isclose(doses, paper.chosen_dose(strategy)))
        for position in published:
            axis.plot(position + 1, 0.985, "v", transform=axis.get_xaxis_transform(), color=LIMIT, ms=6, clip_on=False)
    for axis in axes[-1]:
        axis.set_xticks(range(1, len(doses) + 1), [f"{dose:g}" for dose in doses])
        axis.set_xlabel(f"{name} [{unit}]", fontsize=9.5, color=INK)
    patients = runs["patient"].nunique()
    figure.suptitle(
        f"Tuning of strategy {strategy[1]}, {patients} patient{'s' * (patients != 1)}", fontsize=11.5, color=INK
    )
    handles = [
        Patch(facecolor=CHOSEN, edgecolor=INK, label="chosen here"),
        Line2D([], [], marker="v", ls="", color=LIMIT, label="chosen in the paper"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=2, frameon=False, fontsize=9)
    return figure


# ------------------------------------------------------------------------------------------------------------ over time


def strategies_figure(curves: CurveSet, meals: Sequence[Meal] = (), hours: float = HOURS) -> Figure:
    """CGM with meals, plasma pramlintide and plasma insulin of NMA, strategies 1 and 2: medians and quartile bands."""
    modes = [mode for mode in STYLES if any(mode == known for _, known, _ in curves)]
    hours = _length(curves, hours)
    panels = {
        "cgm": "CGM [mg/dL]",
        "plasma_pramlintide": "plasma pramlintide\n[pmol/L]",
        "plasma_insulin": "plasma insulin\n[pmol/L]",
    }
    # runs over a bus do not tell what is in the patient's plasma
    known = [name for name in panels if any(np.isfinite(getattr(run, name)).any() for run in curves.values())]
    heights = [1.5 if name == "cgm" else 1.0 for name in known]
    figure, axes = _figure(9.6, 2.0 * sum(heights) + 0.6, len(known), sharex=True, height_ratios=heights)
    for axis, name in zip(axes.flat, known, strict=True):
        label = panels[name]
        for mode in modes:
            colour, style, text = STYLES[mode]
            _band(axis, _stack(curves, mode, name, hours), colour, style, text)
        axis.set_ylabel(label, fontsize=9.5, color=INK)
        if name != "cgm":
            axis.set_ylim(bottom=0)
    _limits_and_meals(axes[0, 0], meals, hours, (180,))
    _hours_axis(axes[-1, 0], hours)
    figure.legend(
        *axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False, fontsize=9
    )
    return figure


def ratio_figure(ten: CurveSet, six: CurveSet, meals: Sequence[Meal] = (), hours: float = HOURS) -> Figure:
    """CGM of strategies 2 and 4 with 10 ug/U (`ten`) and with 6 ug/U: medians and quartile bands."""
    known = [mode for mode in ("s2", "s4") if any(mode == key[1] for key in ten) and any(mode == key[1] for key in six)]
    hours = _length(ten, hours)
    figure, axes = _figure(9.6, 2.9 * len(known) + 0.9, len(known), sharex=True)
    for axis, mode in zip(axes.flat, known, strict=True):
        for (ratio, colour, style), curves in zip(RATIO_STYLES, (ten, six), strict=True):
            _band(axis, _stack(curves, mode, "cgm", hours), colour, style, f"{ratio} µg/U")
        axis.set_ylabel(f"strategy {mode[1]}\nCGM [mg/dL]", fontsize=9.5, color=INK)
        _limits_and_meals(axis, meals, hours, (70, 180))
    _hours_axis(axes[-1, 0], hours)
    figure.legend(
        *axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=2, frameon=False, fontsize=9
    )
    return figure


def _length(curves: CurveSet, hours: float) -> float:
    """The hours asked for, or those of the longest run, in whole hours."""
    return min(hours, round(max(len(run.cgm) for run in curves.values()) * STEP_MINUTES / 60))


def _stack(curves: CurveSet, mode: str, name: str, hours: float) -> Array:
    """Patients x samples of the first seed of a mode, as long as the shortest run."""
    seed = min(key[2] for key in curves if key[1] == mode)
    rows = [np.asarray(getattr(run, name)) for key, run in sorted(curves.items()) if key[1:] == (mode, seed)]
    length = min([int(hours * 60 / STEP_MINUTES) + 1, *(len(row) for row in rows)])
    return np.array([row[:length] for row in rows], dtype=float)


def _band(axis: Any, rows: Array, colour: str, style: Any, label: str) -> None:
    hours = np.arange(rows.shape[1]) * STEP_MINUTES / 60
    low, middle, high = bands = np.full((3, rows.shape[1]), np.nan)
    known = ~np.isnan(rows).all(axis=0)  # at some instants no patient has a reading
    bands[:, known] = np.nanpercentile(rows[:, known], [25, 50, 75], axis=0)
    if len(rows) > 1:
        axis.fill_between(hours, low, high, color=colour, alpha=0.18, lw=0)
    axis.plot(hours, middle, color=colour, ls=style, lw=2.0, label=label)


def _limits_and_meals(axis: Any, meals: Sequence[Meal], hours: float, limits: Sequence[float]) -> None:
    for limit in limits:
        axis.axhline(limit, color=LIMIT, lw=1.0, ls=(0, (4, 3)))
    low, high = axis.get_ylim()
    low, high = min(low, min(limits) - 10), max(high, max(limits) + 10)
    shown = [(minutes / 60, grams) for minutes, grams in meals if minutes <= 60 * hours]
    if not shown:
        axis.set_ylim(low, high)
        return
    # circles on a line of their own above the curves, their area by the carbohydrate
    top = high + 0.16 * (high - low)
    axis.set_ylim(low, top)
    row = high + 0.07 * (high - low)
    times, grams = np.array(shown).T
    axis.scatter(times, np.full(len(times), row), s=2.2 * grams, color="#9ca3af", edgecolor=INK, lw=0.6, zorder=3)
    before, raised = -np.inf, False
    for time, amount in shown:
        raised = time - before < 0.045 * hours and not raised
        axis.annotate(
            f"{amount:.0f} g",
            (time, row),
            xytext=(0, 10 if not raised else -17),
            textcoords="offset points",
            ha="center",
            fontsize=7.5,
            color=INK,
        )
        before = time


def _hours_axis(axis: Any, hours: float) -> None:
    axis.set_xlim(0, hours)
    axis.xaxis.set_major_locator(MultipleLocator(6 if hours <= 72 else 24))
    axis.set_xlabel("time from midnight of day 1 [h]", fontsize=9.5, color=INK)
