"""States, faults and alarms of a run as rows of coloured bars below its plots."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from pumpbench.story import LANES, STATE_COLOURS, alarm_spans, state_changes
from pumpbench.trace import Trace

FAULT: Final = "#d62f2a"
PRIORITY: Final = {"High": "#d62f2a", "Medium": "#e07b00", "Low": "#b79500", "Info": "#6b7280"}
MAX_LANES: Final = 5
"""Lanes of faults, and of alarms; what is left shares one more."""


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
            Bar(time_s, end, text, as_hex(colours.get(text, (150, 150, 150))))
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


def as_hex(colour: tuple[int, int, int]) -> str:
    """A colour as Matplotlib takes it."""
    return "#{:02x}{:02x}{:02x}".format(*colour)
