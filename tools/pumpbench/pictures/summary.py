"""A run as one picture.

From top to bottom: true glucose against CGM, insulin commanded against delivered, pramlintide commanded against
delivered, then lanes for the states of firmware, pump and sensor, for injected faults and for alarms, and the alarms as
text.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from can_bus.lockstep import STEP_SECONDS
from pumpbench.closeups import CloseUp, close_ups
from pumpbench.pictures.axes import DAY, LONG_RUN, binned, legend, time_axis
from pumpbench.pictures.lanes import FAULT, PRIORITY, alarm_bars, as_hex, draw_lanes, lanes_of
from pumpbench.story import GREEN, clock, state_changes, title
from pumpbench.trace import Trace

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

TRUTH, CGM, COMMANDED, DELIVERED, PLASMA = "#30343b", "#2f7fd6", "#1557a8", "#f08a1d", "#7b4fa3"
PRAM: Final = "#0b7a75"
MAX_LINES: Final = 12
"""Alarm lines at the bottom of the picture; the rest is counted."""

MAX_EVENTS: Final = 6
"""Events told above a close-up."""


def write_summary(
    trace: Trace, path: Path, metrics: Mapping[str, Any] | None = None, closeup: CloseUp | None = None
) -> None:
    """Draw a run into a PNG of 1600 x 1000 pixels.

    Args:
        trace: the decoded run.
        path: the picture; overwritten.
        metrics: content of metrics.json; without it the headline is computed from the trace.
        closeup: draw only this part of the run.

    Raises:
        OSError: the file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    name, headline = title(trace.info), ""
    if closeup is not None:
        trace = trace.between(closeup.start_s, closeup.end_s)
        name, headline = f"{closeup.name}   ({name})", _events(trace)
    dry = not any(np.nan_to_num(trace.get(name)).any() for name in ("PramRateCommanded", "PramDelivered"))
    dry = dry and not trace.get("PramBolusCommanded").any()
    lanes = lanes_of(trace)
    lines = _alarm_lines(trace)
    rows = (len(lines) + 2) // 3
    lane_height, text_height = 0.25 * len(lanes) + 0.1, 0.19 * rows + (0.25 if lines else 0.0)
    figure = Figure(figsize=(16, 10), dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    rest = 10 - 1.25 - lane_height - text_height
    shares = [0.55 * rest, 0.40 * rest, 0.05 * rest] if dry else [0.44 * rest, 0.30 * rest, 0.26 * rest]
    axes = figure.subplots(4, 1, sharex=True, height_ratios=[*shares, lane_height]).tolist()
    figure.subplots_adjust(left=0.094, right=0.838, top=0.925, bottom=(0.45 + text_height) / 10, hspace=0.09)
    figure.text(0.094, 0.965, name, fontsize=16, fontweight="bold", va="center")
    figure.text(0.094, 0.94, headline or _headline(trace, metrics), fontsize=11.5, va="center", color="#444444")
    end_s = max(float(trace.time_s[-1]), STEP_SECONDS) if len(trace) else float(STEP_SECONDS)
    start_s = float(trace.time_s[0]) if len(trace) else 0.0
    _glucose(axes[0], trace)
    _drug(axes[1], trace, "Insulin", "U", COMMANDED, end_s - start_s)
    if dry:
        axes[2].set_yticks([])
        axes[2].text(0.5, 0.45, "no pramlintide in this run", transform=axes[2].transAxes, ha="center", va="center")
    else:
        _drug(axes[2], trace, "Pram", "µg", PRAM, end_s - start_s)
    draw_lanes(axes[3], lanes, end_s - start_s)
    for axis in axes[:3]:
        for span in trace.fault_spans():
            axis.axvspan(span.start_s, span.end_s, color=FAULT, alpha=0.10, lw=0, zorder=0)
        axis.grid(axis="x", color="#e3e3e3", lw=0.8)
        axis.set_axisbelow(True)
    if closeup is not None:
        for span in trace.fault_spans():
            axes[0].annotate(
                f" {span.label}",
                (span.start_s, 1),
                xycoords=("data", "axes fraction"),
                xytext=(0, -4),
                textcoords="offset points",
                va="top",
                color=FAULT,
                fontsize=10,
                fontweight="bold",
            )
    time_axis(axes[3], start_s, end_s)
    if lines:
        _write_lines(figure, lines, rows, text_height)
    figure.savefig(path, dpi=100)


def write_close_ups(trace: Trace, folder: Path) -> list[tuple[CloseUp, Path]]:
    """Draw each close-up of a run into a PNG of its own.

    Args:
        trace: the whole run.
        folder: where the pictures go; it exists.

    Raises:
        OSError: a file cannot be written.
    """
    drawn = [(closeup, folder / closeup.file_name(number)) for number, closeup in enumerate(close_ups(trace), 1)]
    for closeup, path in drawn:
        write_summary(trace, path, closeup=closeup)
    return drawn


# ------------------------------------------------------------------------------------------------------------ headline


def _events(trace: Trace) -> str:
    """What was wrong and what the firmware did, in a line: faults and changes of state with their times."""
    events = [(span.start_s, f"{span.label} until {_hhmm(span.end_s)}") for span in trace.fault_spans()]
    changes = [(time_s, f"firmware {state}") for time_s, state in state_changes(trace, "CtrlState", "CTRL_Status")]
    events += [change for change in changes[1:] if not change[1].endswith(" ")]
    shown = [f"{_hhmm(time_s)} {text}" for time_s, text in sorted(events)]
    more = f"    and {len(shown) - MAX_EVENTS} more" if len(shown) > MAX_EVENTS else ""
    return "    ".join(shown[:MAX_EVENTS]) + more


def _hhmm(time_s: float) -> str:
    return clock(time_s).split(" ")[1]


def _headline(trace: Trace, metrics: Mapping[str, Any] | None) -> str:
    numbers = dict(metrics or {})
    glucose = trace.get("TruthGlucose")[:-1]
    glucose = glucose[~np.isnan(glucose)]
    if "tir_70_180" not in numbers and len(glucose):
        numbers["tir_70_180"] = 100 * np.mean((glucose >= 70) & (glucose <= 180))
        numbers["tbr_70"] = 100 * np.mean(glucose < 70)
        numbers["tar_180"] = 100 * np.mean(glucose > 180)
        numbers["mean_glucose"] = np.mean(glucose)
    days = max(len(trace) - 1, 1) * STEP_SECONDS / DAY
    for key, drug in (("insulin_u_per_day", "Insulin"), ("pramlintide_ug_per_day", "Pram")):
        delivered = trace.get(f"{drug}Delivered")
        if key not in numbers and not np.isnan(delivered).all():
            numbers[key] = float(np.nansum(delivered)) / days
    texts = (
        ("tir_70_180", "in range 70–180: {:.1f} %"),
        ("tbr_70", "below 70: {:.1f} %"),
        ("tar_180", "above 180: {:.1f} %"),
        ("mean_glucose", "mean {:.0f} mg/dL"),
        ("insulin_u_per_day", "insulin {:.1f} U/day"),
        ("pramlintide_ug_per_day", "pramlintide {:.0f} µg/day"),
    )
    parts = [text.format(numbers[key]) for key, text in texts if numbers.get(key) is not None]
    hazards = (numbers.get("safety") or {}).get("hazards") or {}
    found = [f"{name}×{count}" for name, count in hazards.items() if count]
    if found:
        parts.append(f"HAZARDS {' '.join(found)}")
    return "    ".join(parts) or "nothing recorded"


# --------------------------------------------------------------------------------------------------------------- plots


def _glucose(axis: Any, trace: Trace) -> None:
    hours = trace.time_s
    true, cgm = trace.get("TruthGlucose"), trace.get("GlucoseConc")
    axis.axhspan(70, 180, color="#dff3e3", zorder=0)
    for limit in (70, 180):
        axis.axhline(limit, color="#5aa469", lw=0.9, zorder=1)
    long = len(trace) > LONG_RUN / STEP_SECONDS
    axis.plot(hours, cgm, ".", color=CGM, ms=2 if long else 4, zorder=2, label="CGM as the firmware saw it")
    axis.plot(hours, true, color=TRUTH, lw=1.0 if long else 1.8, zorder=3, label="true (plasma)")
    high = np.nanmax(np.concatenate([true, cgm, [250.0]])) if len(trace) else 250.0
    top = 50 * np.ceil((high + 15) / 50)
    axis.set_ylim(40, top)
    near, raised = 0.022 * STEP_SECONDS * len(trace), False
    before = -near
    for meal in trace.meals:
        raised, before = meal.time_s - before < near and not raised, meal.time_s
        axis.plot([meal.time_s], [46], marker="^", color=as_hex(GREEN), ms=5 if long else 8, clip_on=False, zorder=4)
        if not long:
            axis.annotate(
                f"{meal.carbs_g:.0f} g",
                (meal.time_s, 46),
                xytext=(0, 16 if raised else 7),
                textcoords="offset points",
                ha="center",
                fontsize=8,
                color="#3b7d45",
            )
    if trace.meals:
        axis.plot([], [], marker="^", ls="", color=as_hex(GREEN), ms=7, label="meal")
    axis.set_ylabel("glucose [mg/dL]")
    legend(axis)


def _drug(axis: Any, trace: Trace, drug: str, unit: str, colour: str, span_s: float) -> None:
    name = "insulin" if drug == "Insulin" else "pramlintide"
    every = 12 if span_s > LONG_RUN else 1
    edges, delivered = binned(trace.time_s, trace.basal_delivered(drug), every)
    _, commanded = binned(trace.time_s, trace.get(f"{drug}RateCommanded"), every)
    axis.stairs(
        np.nan_to_num(delivered), edges, fill=True, color=DELIVERED, alpha=0.55, lw=0, label=f"delivered [{unit}/h]"
    )
    axis.stairs(commanded, edges, baseline=None, color=colour, lw=1.3, label=f"commanded [{unit}/h]")
    top = max(float(np.nanmax(np.concatenate([delivered, commanded, [0.0]]))), 1.0)
    top = max(top, _boluses(axis, trace, drug, unit, colour, labelled=every == 1))
    axis.set_ylim(0, top * 1.18)
    axis.set_ylabel(f"{name}\n[{unit}/h]" + (", hourly mean" if every > 1 else ""))
    handles = list(axis.get_legend_handles_labels())
    plasma = trace.get("TruthPramlintide")
    if drug == "Pram" and not np.isnan(plasma).all():
        other = axis.twinx()
        edges, mean = binned(trace.time_s, plasma, every)
        other.plot(edges[:-1], mean, color=PLASMA, lw=1.0, ls=(0, (3, 1.5)), label="plasma [pmol/L], right")
        other.set_ylim(0, max(float(np.nanmax(plasma)), 1.0) * 1.18)
        other.tick_params(axis="y", colors=PLASMA, labelsize=8, pad=1)
        for held, more in zip(handles, other.get_legend_handles_labels(), strict=True):
            held.extend(more)
    legend(axis, handles, offset=1.033 if drug == "Pram" else 1.01)


def _boluses(axis: Any, trace: Trace, drug: str, unit: str, colour: str, *, labelled: bool) -> float:
    """Stems for boluses: an open diamond at the dose commanded, a dot at the dose delivered; returns the highest."""
    commanded, delivered = (np.nan_to_num(trace.get(f"{drug}Bolus{what}")) for what in ("Commanded", "Delivered"))
    rows = np.flatnonzero(commanded > 0)
    if not len(rows):
        return 0.0
    times = trace.time_s[rows]
    axis.vlines(times, 0, commanded[rows], color=colour, lw=1.0, zorder=3)
    axis.plot(times, commanded[rows], "D", mfc="white", mec=colour, ms=6, zorder=4, label=f"bolus commanded [{unit}]")
    given = np.flatnonzero(delivered > 0)
    axis.plot(
        trace.time_s[given], delivered[given], "o", color=DELIVERED, ms=4, zorder=5, label=f"bolus delivered [{unit}]"
    )
    if labelled:
        for time_s, dose in zip(times, commanded[rows], strict=True):
            axis.annotate(
                f"{dose:.3g} {unit}",
                (time_s, dose),
                xytext=(5, 2),
                textcoords="offset points",
                fontsize=8,
                color=colour,
            )
    return float(max(commanded.max(), delivered.max())) * 1.05


# --------------------------------------------------------------------------------------------------------------- lines


def _alarm_lines(trace: Trace) -> list[tuple[str, str]]:
    """Alarms as text with their colour: when raised, when over; the gravest when there are too many."""
    end_s = float(trace.time_s[-1]) if len(trace) else 0.0
    bars = alarm_bars(trace, end_s + 1)
    chosen = bars
    if len(bars) > MAX_LINES:
        order = list(PRIORITY.values())
        gravest = sorted(bars, key=lambda bar: order.index(bar.colour) if bar.colour in order else len(order))
        chosen = sorted(gravest[: MAX_LINES - 1])
    lines = []
    for bar in chosen:
        over = "not over" if bar.end_s > end_s else f"until {clock(bar.end_s)}"
        lines.append((f"{clock(bar.start_s)}  {bar.text}, {over}", bar.colour))
    if len(bars) > len(chosen):
        lines.append((f"and {len(bars) - len(chosen)} more alarms, see recording.rrd", "#6b7280"))
    return lines


def _write_lines(figure: Any, lines: Sequence[tuple[str, str]], rows: int, height: float) -> None:
    top = (0.12 + height - 0.2) / 10
    figure.text(0.05, top, "Alarms", fontsize=9.5, fontweight="bold", va="center")
    for index, (text, colour) in enumerate(lines):
        column, row = divmod(index, rows)
        figure.text(0.094 + 0.30 * column, top - 0.019 * row, text, fontsize=9.5, color=colour, va="center")
