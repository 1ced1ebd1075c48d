"""A run as one picture, with Matplotlib: for a report, a chat, a machine without a display.

From top to bottom: true glucose against CGM, insulin commanded against delivered, pramlintide commanded against
delivered, then lanes for the states of firmware, pump and sensor, for injected faults and for alarms, and the alarms as
text.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from can_bus.lockstep import STEP_SECONDS
from pumpbench.closeups import CloseUp, close_ups
from pumpbench.story import GREEN, LANES, STATE_COLOURS, alarm_spans, clock, state_changes, title
from pumpbench.trace import Trace

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

HOUR: Final = 3600.0
DAY: Final = 86400.0
TRUTH, CGM, COMMANDED, DELIVERED, PLASMA, FAULT = "#30343b", "#2f7fd6", "#1557a8", "#f08a1d", "#7b4fa3", "#d62f2a"
PRAM: Final = "#0b7a75"
PRIORITY: Final = {"High": "#d62f2a", "Medium": "#e07b00", "Low": "#b79500", "Info": "#6b7280"}
MAX_LINES: Final = 12
"""Alarm lines at the bottom of the picture; the rest is counted."""

MAX_EVENTS: Final = 6
"""Events told above a close-up."""

MAX_LANES: Final = 5
"""Lanes of faults, and of alarms; what is left shares one more."""

LONG_RUN: Final = 2.5 * DAY
"""From here on doses are drawn as means over an hour."""


class Bar(NamedTuple):
    """A coloured stretch [start_s, end_s) of a lane."""

    start_s: float
    end_s: float
    text: str
    colour: Any


class Lane(NamedTuple):
    """A row of bars with a name."""

    name: str
    bars: list[Bar]


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
        axis.plot([meal.time_s], [46], marker="^", color=_hex(GREEN), ms=5 if long else 8, clip_on=False, zorder=4)
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
        axis.plot([], [], marker="^", ls="", color=_hex(GREEN), ms=7, label="meal")
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


def binned(time_s: Array, values: Array, every: int) -> tuple[Array, Array]:
    """Edges and means of bins of `every` steps, over the steps that lead somewhere (all but the last instant)."""
    values = values[:-1]
    if not len(values):
        return np.array([0.0, STEP_SECONDS]), np.array([np.nan])
    bins = -(-len(values) // every)
    padded = np.full(bins * every, np.nan)
    padded[: len(values)] = values
    table = padded.reshape(bins, every)
    counts = (~np.isnan(table)).sum(axis=1)
    means = np.divide(np.nansum(table, axis=1), counts, out=np.full(bins, np.nan), where=counts > 0)
    edges = time_s[0] + STEP_SECONDS * np.minimum(np.arange(bins + 1) * every, len(values))
    return edges, means


def legend(axis: Any, handles: Sequence[list[Any]] = (), offset: float = 1.01) -> None:
    """Beside the plot, where it covers no data."""
    shown = handles or axis.get_legend_handles_labels()
    if shown[0]:
        axis.legend(
            *shown, loc="upper left", bbox_to_anchor=(offset, 1.02), frameon=False, fontsize=9, handlelength=1.6
        )


# --------------------------------------------------------------------------------------------------------------- lanes


def lanes_of(trace: Trace) -> list[Lane]:
    """States of firmware, pump and sensor, injected faults and alarms as rows of bars."""
    end_s = float(trace.time_s[-1]) if len(trace) else 0.0
    lanes = []
    names = [lane for lane in LANES if lane[0] != "CtrlMode"]
    for signal, what in (("InsulinOcclusion", "insulin line"), ("PramOcclusion", "pramlintide line")):
        if np.nan_to_num(trace.get(signal)).any():
            names.append((signal, "PUMP_Status", what))
    for signal, message, what in names:
        changes = state_changes(trace, signal, message)
        if not changes:
            continue
        ends = [time_s for time_s, _ in changes[1:]] + [end_s]
        colours = STATE_COLOURS[signal]
        bars = [
            Bar(time_s, end, text, _hex(colours.get(text, (150, 150, 150))))
            for (time_s, text), end in zip(changes, ends, strict=True)
            if text and end > time_s
        ]
        lanes.append(Lane(what, bars))
    faults: dict[str, list[Bar]] = {}
    for span in trace.fault_spans():
        faults.setdefault(span.label, []).append(Bar(span.start_s, span.end_s, span.label, FAULT))
    lanes += [Lane(f"fault {bars[0].text.split(' ')[0]}", bars) for bars in list(faults.values())[:MAX_LANES]]
    if len(faults) > MAX_LANES:
        lanes.append(Lane("more faults", [bar for bars in list(faults.values())[MAX_LANES:] for bar in bars]))
    alarms: dict[str, list[Bar]] = {}
    for bar in alarm_bars(trace, end_s):
        alarms.setdefault(bar.text, []).append(bar)
    lanes += [Lane(f"alarm {code}", bars) for code, bars in list(alarms.items())[:MAX_LANES]]
    if len(alarms) > MAX_LANES:
        lanes.append(Lane("more alarms", [bar for bars in list(alarms.values())[MAX_LANES:] for bar in bars]))
    return lanes


def alarm_bars(trace: Trace, end_s: float) -> list[Bar]:
    """Each alarm from its first frame until it is over or, at the latest, until `end_s` (simulated seconds)."""
    return [
        Bar(span.start_s, min(span.end_s, end_s), span.code, PRIORITY.get(span.priority, "#6b7280"))
        for span in alarm_spans(trace)
    ]


def draw_lanes(axis: Any, lanes: Sequence[Lane], span_s: float) -> None:
    """Draw rows of bars into an axis of `span_s` simulated seconds; a name that does not fit goes beside its bar."""
    axis.set_ylim(max(len(lanes), 1) - 0.45, -0.55)
    axis.set_yticks(range(len(lanes)), [lane.name for lane in lanes], fontsize=8)
    axis.tick_params(axis="y", length=0)
    for side in ("top", "right", "left"):
        axis.spines[side].set_visible(False)
    unnamed: dict[str, Any] = {}  # states whose bars are too short for their name
    points = 0.744 * 1600 * 72 / 100  # width of the axis
    for row, lane in enumerate(lanes):
        is_fault, is_alarm = "fault" in lane.name, "alarm" in lane.name
        free_from = -np.inf
        for bar in lane.bars:
            width = max(bar.end_s - bar.start_s, 0.0015 * span_s)
            axis.broken_barh([(bar.start_s, width)], (row - 0.42, 0.84), facecolors=[bar.colour], lw=0)
            needed = 5.4 * len(bar.text) / points * span_s
            if needed < width:
                if bar.start_s >= free_from:
                    axis.text(
                        bar.start_s + width / 2, row, bar.text, ha="center", va="center", fontsize=8, color="white"
                    )
                    free_from = bar.start_s + width
            elif is_fault or lane.name == "more alarms":
                if bar.start_s >= free_from:
                    _beside(axis, row, bar, width, lane.bars, needed)
                    free_from = bar.start_s + width + needed
            elif not is_alarm:
                unnamed.setdefault(bar.text, bar.colour)
    if unnamed:
        patches = [_patch(colour) for colour in unnamed.values()]
        axis.legend(
            patches,
            list(unnamed),
            loc="upper left",
            bbox_to_anchor=(1.005, 1.06),
            frameon=False,
            fontsize=8,
            handlelength=1.0,
            handleheight=0.8,
            labelspacing=0.25,
            ncols=2 if len(unnamed) > 6 else 1,
            columnspacing=0.8,
        )


def _beside(axis: Any, row: int, bar: Bar, width: float, bars: Iterable[Bar], needed: float) -> None:
    after = bar.start_s + width
    if not any(after <= other.start_s < after + needed for other in bars):
        axis.text(after, row, f" {bar.text}", ha="left", va="center", fontsize=8, color=bar.colour)


def _patch(colour: Any) -> Any:
    from matplotlib.patches import Patch  # noqa: PLC0415

    return Patch(facecolor=colour)


def _hex(colour: tuple[int, int, int]) -> str:
    return "#{:02x}{:02x}{:02x}".format(*colour)


def time_axis(axis: Any, start_s: float, end_s: float) -> None:
    """Label an axis of simulated seconds as people read time: hh:mm, days in long runs."""
    span = end_s - start_s
    axis.set_xlim(start_s - 0.004 * span, end_s + 0.004 * span)
    if span <= 1.5 * HOUR:
        step = 600.0
    elif span <= 5 * HOUR:
        step = HOUR / 2
    elif span <= 9 * HOUR:
        step = HOUR
    elif span <= 1.5 * DAY:
        step = 2 * HOUR
    elif span <= LONG_RUN:
        step = 6 * HOUR
    else:
        step = DAY * max(1, round(span / DAY / 20))
    ticks = np.arange(np.ceil(start_s / step) * step, end_s + 1, step)
    if step >= DAY:
        texts = [f"d{tick / DAY:.0f}" for tick in ticks]
    elif span > 1.2 * DAY:
        texts = [clock(tick) for tick in ticks]
    else:
        texts = [clock(tick).split(" ")[1] for tick in ticks]
    axis.set_xticks(ticks, texts)
    where = (
        "day, from midnight" if step >= DAY else "simulated time, day hh:mm" if span > 1.2 * DAY else "simulated time"
    )
    axis.set_xlabel(where, fontsize=9, labelpad=2)


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
