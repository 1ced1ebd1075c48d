"""The same looks without Rerun's viewer, drawn by Matplotlib from a run folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from pumpbench.pictures.axes import legend, time_axis
from pumpbench.pictures.lanes import FAULT, draw_lanes, lanes_of
from pumpbench.pictures.summary import CGM, COMMANDED, DELIVERED, PLASMA, PRAM, TRUTH, write_summary
from pumpbench.recording.columns import BIT_RATE, per_step, wire_bits
from pumpbench.recording.scene import FRAME_MS
from pumpbench.runfolder import METRICS, RunFolder
from pumpbench.story import title

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pumpbench.frames import Frames
    from pumpbench.recording.scene import Scene
    from pumpbench.trace import Trace

    Array = NDArray[Any]

GUT: Final = "#3b8f49"


class Row(NamedTuple):
    """A plot over time: its title, label, value of each step and colour of each line, and the top of its axis."""

    title: str
    lines: Sequence[tuple[str, Array, str]]
    top: float | None = None


def draw_still(folder: Path, scene: Scene, png: Path, layout: str, window: tuple[float, float] | None) -> None:
    """Draw a layout of a run into a PNG of 1600 x 1000 pixels.

    Args:
        folder: the run folder.
        scene: the run.
        png: the picture; overwritten.
        layout: day, bus, patient, or the name of a close-up of the scene.
        window: simulated seconds from, to; the whole run when left out. A close-up has its own.

    Raises:
        OSError: a file of the run is missing or cannot be read.
    """
    png.parent.mkdir(parents=True, exist_ok=True)
    run = RunFolder(folder)
    trace = run.trace
    closeup = next((each for each in scene.close_ups if each.name == layout), None)
    shown = trace if window is None else trace.between(*window)
    if closeup is not None:
        write_summary(trace, png, closeup=closeup)
    elif layout == "bus":
        _draw_rows(shown, _bus(shown, run.frames, scene.frames_top), png, drawstyle="steps-post")
    elif layout == "patient":
        _draw_rows(shown, _patient(shown), png)
    else:
        judged = window is None and (folder / METRICS).is_file()  # an unfinished run has no outcome
        write_summary(shown, png, run.metrics if judged else None)


def _patient(trace: Trace) -> list[Row]:
    return [
        Row("glucose [mg/dL]", [("CGM", trace.get("GlucoseConc"), CGM), ("plasma", trace.get("TruthGlucose"), TRUTH)]),
        Row("stomach [g]", [("content", trace.get("TruthQsto") / 1000, GUT)]),
        Row("emptying η [%]", [("of the normal rate", trace.get("TruthEta") * 100, PLASMA)]),
        Row("Ra [mg/kg/min]", [("glucose from the gut", trace.get("TruthRa"), DELIVERED)]),
        Row("insulin [mU/L]", [("in plasma", trace.get("TruthInsulin"), COMMANDED)]),
        Row("on board [U]", [("as the firmware counts", trace.get("InsulinOnBoard"), PLASMA)]),
        Row("pram. [pmol/L]", [("in plasma", trace.get("TruthPramlintide"), PRAM)]),
    ]


def _bus(trace: Trace, frames: Frames, frames_top: float) -> list[Row]:
    inside = np.isin(frames.step, trace.step)
    counts, busy, damaged = [], [], []
    for name, channel, colour in (("plant's bus", 1, TRUTH), ("device's bus", 0, GUT)):
        heard = frames.select(np.flatnonzero((frames.channel == channel) & inside))
        if len(heard):
            counts.append((name, per_step(trace, heard.step), colour))
            busy.append((name, per_step(trace, heard.step, 1000 * wire_bits(heard) / BIT_RATE), colour))
            damaged.append((f"damaged, {name}", per_step(trace, heard.step[~heard.intact]), colour))
    counters = [
        ("lost frames", trace.get("LostFrameCount"), DELIVERED),
        ("checksum errors", trace.get("E2eErrorCount"), FAULT),
        ("out of sequence", trace.get("SequenceErrorCount"), PLASMA),
        ("saturations", trace.get("SaturationCount"), PRAM),
    ]
    return [
        Row("frames per step", counts, frames_top),
        Row("ms per step at 500 kbit/s", busy, FRAME_MS * frames_top),
        Row("damaged frames per step", damaged),
        Row("counted by the firmware", counters),
    ]


def _draw_rows(trace: Trace, rows: Sequence[Row], png: Path, drawstyle: str = "default") -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    lanes = lanes_of(trace)
    figure = Figure(figsize=(16, 10), dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    lane_height = 0.25 * len(lanes) + 0.1
    heights = [(8.6 - lane_height) / len(rows)] * len(rows)
    axes = figure.subplots(len(rows) + 1, 1, sharex=True, height_ratios=[*heights, lane_height]).tolist()
    figure.subplots_adjust(left=0.094, right=0.838, top=0.94, bottom=0.06, hspace=0.12)
    figure.text(0.094, 0.965, title(trace.info), fontsize=16, fontweight="bold", va="center")
    start_s, end_s = (float(trace.time_s[0]), float(trace.time_s[-1])) if len(trace) else (0.0, 0.0)
    for axis, row in zip(axes, rows, strict=False):
        for name, values, colour in row.lines:
            axis.plot(trace.time_s, values, color=colour, lw=1.4, drawstyle=drawstyle, label=name)
        if row.top is not None:
            axis.set_ylim(0, row.top)
        axis.set_ylabel(row.title, fontsize=9)
        axis.grid(axis="x", color="#e3e3e3", lw=0.8)
        for span in trace.fault_spans():
            axis.axvspan(span.start_s, span.end_s, color=FAULT, alpha=0.10, lw=0, zorder=0)
        legend(axis)
    draw_lanes(axes[-1], lanes, end_s - start_s)
    time_axis(axes[-1], start_s, end_s)
    figure.savefig(png, dpi=100)
