"""Two runs as one picture, with Matplotlib: glucose, doses and states of both, and where they part."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from can_bus.lockstep import STEP_SECONDS
from pumpbench.comparison.lanes import APART, COLOURS, PARTED, WIDTHS, message_lanes, state_lanes
from pumpbench.comparison.report import Report
from pumpbench.pictures.axes import LONG_RUN, binned, legend, time_axis
from pumpbench.pictures.lanes import draw_lanes
from pumpbench.trace import Trace

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]


Traces = tuple[Trace, Trace]

DRUGS: Final = {"Insulin": ("insulin", "U"), "Pram": ("pramlintide", "µg")}
STEPS_PER_HOUR: Final = 3600 // STEP_SECONDS


class _Style(NamedTuple):
    """How A and B are told from each other; in long runs by thin lines, and doses as means of an hour."""

    names: tuple[str, str]
    widths: Sequence[float]
    hourly: bool

    def sides(self, traces: Traces) -> Iterable[tuple[str, Trace, str, float]]:
        """Name, trace, colour and line width of either."""
        return zip(self.names, traces, COLOURS, self.widths, strict=True)


def write_picture(report: Report, path: Path) -> None:
    """Draw both runs into a PNG of 1600 x 1000 pixels.

    Args:
        report: of the comparison.
        path: the picture; overwritten.

    Raises:
        OSError: the file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    traces = report.a.trace, report.b.trace
    start_s = min((float(trace.time_s[0]) for trace in traces if len(trace)), default=0.0)
    end_s = max([start_s + STEP_SECONDS, *(float(trace.time_s[-1]) for trace in traces if len(trace))])
    drugs = ["Insulin"]
    drugs += ["Pram"] if any(_given(trace, "Pram") for trace in traces) else []
    lanes = state_lanes(report) + message_lanes(report)
    long = end_s - start_s > LONG_RUN
    style = _Style(report.names, [0.4 * width for width in WIDTHS] if long else WIDTHS, hourly=long)
    figure = Figure(figsize=(16, 10), dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    lane_height = 0.27 * len(lanes) + 0.1
    rest = 10 - 1.55 - lane_height
    shares = [0.38 * rest, *[0.4 / len(drugs) * rest] * len(drugs), *[0.22 / len(drugs) * rest] * len(drugs)]
    axes = figure.subplots(len(shares) + 1, 1, sharex=True, height_ratios=[*shares, lane_height]).tolist()
    figure.subplots_adjust(left=0.115, right=0.838, top=0.9, bottom=0.05, hspace=0.09)
    title, story = report.headline(), ""
    first = report.comparison.first
    if first is not None:
        story = f"first difference: {report.where(first)}"
    figure.text(0.115, 0.968, title, fontsize=14, fontweight="bold", va="center")
    figure.text(0.115, 0.941, story, fontsize=11.5, va="center", color=PARTED)
    called = "   ".join(f"{name} = {record.name}" for name, record in _called(report))
    figure.text(0.115, 0.916, called, fontsize=11.5, va="center", color="#444444")
    _glucose(axes[0], style, traces)
    for place, drug in enumerate(drugs):
        _doses(axes[1 + place], style, traces, drug)
        _apart(axes[1 + len(drugs) + place], style, traces, drug)
    draw_lanes(axes[-1], lanes, end_s - start_s)
    for axis in axes:
        if first is not None:
            frames, row = report.comparison.place(first)
            axis.axvline(frames.time_s[row], color=PARTED, lw=1.4, zorder=5)
    for axis in axes[:-1]:
        axis.grid(axis="x", color="#e3e3e3", lw=0.8)
        axis.set_axisbelow(True)
    time_axis(axes[-1], start_s, end_s)
    figure.savefig(path, dpi=100)


def _called(report: Report) -> list[tuple[str, Any]]:
    return [
        (name, record) for name, record in zip(report.names, (report.a, report.b), strict=True) if name != record.name
    ]


def _glucose(axis: Any, style: _Style, traces: Traces) -> None:
    axis.axhspan(70, 180, color="#dff3e3", zorder=0)
    for name, trace, colour, width in style.sides(traces):
        axis.plot(trace.time_s, trace.get("TruthGlucose"), color=colour, lw=width, label=f"true, {name}")
        if not style.hourly:
            axis.plot(trace.time_s, trace.get("GlucoseConc"), ".", color=colour, ms=width + 1, label=f"CGM, {name}")
    axis.set_ylabel("glucose [mg/dL]")
    legend(axis)


def _doses(axis: Any, style: _Style, traces: Traces, drug: str) -> None:
    word, unit = DRUGS[drug]
    for name, trace, colour, width in style.sides(traces):
        rate, look = trace.get(f"{drug}RateCommanded"), {"color": colour, "lw": width}
        if style.hourly:
            edges, means = binned(trace.time_s, rate, STEPS_PER_HOUR)
            axis.stairs(means, edges, baseline=None, label=f"rate, {name}, mean of an hour", **look)
        else:
            axis.step(trace.time_s, rate, where="post", label=f"rate, {name}", **look)
        bolus = trace.get(f"{drug}BolusCommanded")
        given = np.flatnonzero(np.nan_to_num(bolus) > 0)
        if len(given):
            label = f"bolus, {name} [{unit}]"
            axis.plot(trace.time_s[given], bolus[given], "D", color=colour, ms=3 + width, mec="white", label=label)
    axis.set_ylabel(f"{word}\ncommanded [{unit}/h]", fontsize=8.5)
    axis.set_ylim(bottom=0)
    legend(axis)


def _apart(axis: Any, style: _Style, traces: Traces, drug: str) -> None:
    """How much more of a drug B has delivered than A since the start."""
    a, b = traces
    word, unit = DRUGS[drug]
    steps, in_a, in_b = np.intersect1d(a.step, b.step, return_indices=True)
    apart = np.cumsum(np.nan_to_num(b.get(f"{drug}Delivered")[in_b] - a.get(f"{drug}Delivered")[in_a]))
    label = f"{word} delivered\nso far [{unit}]"
    axis.plot(steps * float(STEP_SECONDS), apart, color=APART, lw=1.8, label=label)
    axis.axhline(0, color="#888888", lw=0.8)
    axis.set_ylabel(f"{style.names[1]} minus\n{style.names[0]}", fontsize=8.5)
    legend(axis)


def _given(trace: Trace, drug: str) -> bool:
    return any(np.nan_to_num(trace.get(f"{drug}{what}")).any() for what in ("RateCommanded", "BolusCommanded"))
