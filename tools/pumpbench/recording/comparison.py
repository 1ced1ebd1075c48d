"""Two runs in one recording, on one axis of time: A in blue, B in orange, and in red where they part."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from can_bus.lockstep import STEP_SECONDS
from pumpbench.comparison.lanes import (
    APART,
    COLOURS,
    KINDS,
    PARTED,
    WIDTHS,
    message_lanes,
    state_lanes,
    words,
)
from pumpbench.comparison.report import Report, frame_lines
from pumpbench.pictures.lanes import Lane
from pumpbench.recording.columns import Logger
from pumpbench.recording.file import write_stream
from pumpbench.story import GREY
from pumpbench.trace import Trace

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

QUANTITIES: Final = (
    ("insulin", "InsulinDelivered", True, "insulin delivered so far [U]"),
    ("pramlintide", "PramDelivered", True, "pramlintide delivered so far [µg]"),
    ("glucose", "TruthGlucose", False, "glucose [mg/dL]"),
)
"""Path, column of the trace, whether its differences add up, what it is."""

CLOSE_S: Final = 3600.0
"""Shown before and behind the first difference in its close-up."""

MAX_LINES: Final = 20_000
"""Differing frames in the table."""


def write_comparison(report: Report, path: Path) -> None:
    """Write both runs with a blueprint of their own as an .rrd file.

    Args:
        report: of the comparison.
        path: the file; overwritten.

    Raises:
        RecordingError: Rerun could not write the file or does not accept it.
    """
    scene = _Scene(report)
    hashes = [frames.sha256()[:12] for frames in (report.comparison.a, report.comparison.b)]
    about = zlib.crc32(report.json().encode())
    write_stream(path, f"{'-'.join(hashes)}-{about:08x}", scene.blueprint(), scene.fill)


class _Scene:
    """What is to be seen."""

    def __init__(self, report: Report) -> None:
        self.report = report
        self.traces = report.a.trace, report.b.trace
        first = report.comparison.first
        frames, row = (None, 0) if first is None else report.comparison.place(first)
        self.first_s = None if frames is None else float(frames.time_s[row])
        self.end_s = max([float(STEP_SECONDS), *(float(trace.time_s[-1]) for trace in self.traces if len(trace))])
        self.states, self.messages = state_lanes(report), message_lanes(report)
        self.dry = not any(
            np.nan_to_num(trace.get(name)).any()
            for trace in self.traces
            for name in ("PramRateCommanded", "PramBolusCommanded")
        )

        self.apart = dict(self._apart())

    def _apart(self) -> Iterator[tuple[str, tuple[Array, Array]]]:
        a, b = self.traces
        steps, in_a, in_b = np.intersect1d(a.step, b.step, return_indices=True)
        for path, column, total, _ in QUANTITIES:
            values = b.get(column)[in_b] - a.get(column)[in_a]
            if total:
                values = np.cumsum(np.nan_to_num(values))
            if np.nan_to_num(values).any():
                yield path, (steps * float(STEP_SECONDS), values)

    # ---- content

    def fill(self, recording: Any) -> None:
        """Log everything."""
        names = self.report.names
        recording.send_recording_name(f"{names[0]} {self.report.a.name} against {names[1]} {self.report.b.name}")
        logger = Logger(recording)
        for limit in (70.0, 180.0):
            self._level(logger, f"glucose/limit_{limit:.0f}", limit)
        for name, trace, colour, width in zip(names, self.traces, map(_rgb, COLOURS), WIDTHS, strict=True):
            logger.line(f"glucose/true_{name}", trace, trace.get("TruthGlucose"), f"true, {name}", colour, width)
            logger.points(f"glucose/cgm_{name}", trace.time_s, trace.get("GlucoseConc"), f"CGM, {name}", colour)
            for drug, folder, unit in (("Insulin", "insulin", "U"), ("Pram", "pramlintide", "µg")):
                rate, bolus = trace.get(f"{drug}RateCommanded"), trace.get(f"{drug}BolusCommanded")
                logger.line(f"{folder}/rate_{name}", trace, rate, f"rate, {name} [{unit}/h]", colour, width, step=True)
                given = np.where(bolus > 0, bolus, np.nan)
                logger.points(
                    f"{folder}/bolus_{name}", trace.time_s, given, f"bolus, {name} [{unit}]", colour, "diamond", 5.0
                )
        self._log_apart(logger)
        self._differences(logger)
        for path, (low, high) in self._ranges().items():
            self._mark(logger, f"{path}/first", low, high)
        logger.document("report", f"```text\n{self.report.text()}\n```\n")

    def _level(self, logger: Logger, path: str, level: float) -> None:
        logger.send(path, np.array([0.0, self.end_s]), logger.rr.Scalars.columns(scalars=np.full(2, level)))
        style = logger.rr.SeriesLines(names=f"limit {level:.0f}", colors=[GREY], widths=[1.0])
        logger.recording.log(path, style, static=True)

    def _log_apart(self, logger: Logger) -> None:
        """What the quantities are apart, and the doses have come to be."""
        name = f"{self.report.names[1]} minus {self.report.names[0]}"
        for path, (time_s, values) in self.apart.items():
            logger.send(f"apart/{path}/all", time_s, logger.rr.Scalars.columns(scalars=values))
            style = logger.rr.SeriesLines(names=name, colors=[_rgb(APART)], widths=[2.0])
            logger.recording.log(f"apart/{path}/all", style, static=True)

    def _differences(self, logger: Logger) -> None:
        named, colours = words(self.report), {kind: _rgb(colour) for kind, colour in KINDS.items()}
        for folder, lanes in (("state", self.states), ("differs", self.messages)):
            for number, lane in enumerate(lanes, 1):
                changes: list[tuple[float, str]] = []
                for bar in sorted(lane.bars):
                    if changes and changes[-1][0] == bar.start_s:
                        changes.pop()
                    changes += [(bar.start_s, bar.text), (bar.end_s, "")]
                path = f"{folder}/{number:02}_{lane.name.replace(', ', '_').replace(' ', '_')}"
                logger.states(path, changes, {bar.text: _rgb(bar.colour) for bar in lane.bars})
        lines = frame_lines(self.report, MAX_LINES)
        logger.texts("frames", [(line.time_s, line.text, named[line.kind], colours[line.kind]) for line in lines])

    def _mark(self, logger: Logger, path: str, low: float, high: float) -> None:
        """A vertical line where the runs part: two points as good as at one time."""
        if self.first_s is None:
            return
        ends = np.array([self.first_s, self.first_s + 1e-6])
        logger.send(path, ends, logger.rr.Scalars.columns(scalars=np.array([low, high])))
        style = logger.rr.SeriesLines(
            names="first difference",
            colors=[_rgb(PARTED)],
            widths=[1.5],
            aggregation_policy=logger.rr.components.AggregationPolicy.Off,  # else the viewer makes one point of the two
        )
        logger.recording.log(path, style, static=True)

    # ---- looks

    def blueprint(self) -> Any:
        """Two tabs: the whole run, and an hour around the first difference."""
        import rerun.blueprint as rrb  # noqa: PLC0415

        from pumpbench.recording.layout import linked  # noqa: PLC0415

        whole = (0.0, self.end_s)
        tabs = [self._tab("Both runs", None)]
        if self.first_s is not None:
            tabs.append(self._tab("First difference", (self.first_s - CLOSE_S, self.first_s + CLOSE_S)))
        return linked(rrb.Tabs(*tabs, active_tab=0), whole)

    def _tab(self, name: str, window: tuple[float, float] | None) -> Any:
        import rerun.blueprint as rrb  # noqa: PLC0415

        from pumpbench.recording.layout import lanes, log, plot  # noqa: PLC0415

        ranges = self._ranges()
        plots = [plot("Glucose [mg/dL]", ["glucose/**"], ranges["glucose"], window)]
        plots.append(plot("Insulin commanded [U/h, U]", ["insulin/**"], ranges["insulin"], window))
        if not self.dry:
            plots.append(plot("Pramlintide commanded [µg/h, µg]", ["pramlintide/**"], ranges["pramlintide"], window))
        difference = f"{self.report.names[1]} minus {self.report.names[0]}"
        apart = [
            plot(f"{difference}: {text}", [f"apart/{path}/**"], ranges[f"apart/{path}"], window)
            for path, _, _, text in QUANTITIES
            if f"apart/{path}" in ranges
        ]
        parts = [*plots, *([rrb.Tabs(*apart, active_tab=0)] if apart else [])]
        parts += [lanes("States", ["state/**"], window), lanes("Messages that differ", ["differs/**"], window)]
        shares = [3.4, 2.2, *([] if self.dry else [2.0]), *([1.7] if apart else []), self._share(self.states)]
        left = rrb.Vertical(*parts, row_shares=[*shares, self._share(self.messages)])
        right = rrb.Vertical(
            rrb.TextDocumentView(name="What differs", origin="/report"),
            log("Frames that differ", "frames"),
            row_shares=[6, 4],
        )
        return rrb.Horizontal(left, right, column_shares=[56, 44], name=name)

    @staticmethod
    def _share(lanes: Sequence[Lane]) -> float:
        return min(0.8 + 0.45 * len(lanes), 4.4)

    def _ranges(self) -> dict[str, tuple[float, float]]:
        """The ends of the axes, which are those of the mark."""
        ranges = {
            "glucose": (40.0, self._top(("TruthGlucose", "GlucoseConc"), 300.0) + 20.0),
            "insulin": (0.0, 1.1 * self._top(("InsulinRateCommanded", "InsulinBolusCommanded"), 2.0)),
            "pramlintide": (0.0, 1.1 * self._top(("PramRateCommanded", "PramBolusCommanded"), 5.0)),
        }
        for path, (_, values) in self.apart.items():
            most = 1.1 * float(np.nanmax(np.abs(values)))
            ranges[f"apart/{path}"] = (-most, most)
        return ranges

    def _top(self, columns: Iterable[str], least: float) -> float:
        return max([least, *(_highest(trace, column) for trace in self.traces for column in columns)])


def _rgb(colour: str) -> tuple[int, int, int]:
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return red, green, blue


def _highest(trace: Trace, column: str) -> float:
    values = np.nan_to_num(trace.get(column))
    return float(values.max()) if len(values) else 0.0
