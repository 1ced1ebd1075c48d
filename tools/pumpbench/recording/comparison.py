"""Two runs in one recording, on one axis of time: A in blue, B in orange, and in red where they part."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from can_bus.lockstep import STEP_SECONDS
from pumpbench.comparison import account
from pumpbench.comparison.report import Report, frame_lines
from pumpbench.recording.columns import Logger
from pumpbench.recording.file import write_stream
from pumpbench.story import BLUE, GREY, ORANGE, RED, STATE_COLOURS, YELLOW, state_changes
from pumpbench.trace import Trace

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

COLOURS: Final = (BLUE, ORANGE)
KINDS: Final = {"changed": RED, "missing": BLUE, "extra": ORANGE, "moved": GREY}
"""Where only one of the runs has the frames, the lane has the colour of that run."""

CLOSE_S: Final = 3600.0
"""Shown before and behind the first difference in its close-up."""

MAX_LANES: Final = 12
"""Messages with a lane of their own; the report counts all of them."""

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
        self.stretches = account.stretches(report.comparison)
        self.dry = not any(
            np.nan_to_num(trace.get(name)).any()
            for trace in self.traces
            for name in ("PramRateCommanded", "PramBolusCommanded")
        )

    # ---- content

    def fill(self, recording: Any) -> None:
        """Log everything."""
        names = self.report.names
        recording.send_recording_name(f"{names[0]} {self.report.a.name} against {names[1]} {self.report.b.name}")
        logger = Logger(recording)
        for limit in (70.0, 180.0):
            self._level(logger, f"glucose/limit_{limit:.0f}", limit)
        for name, trace, colour in zip(names, self.traces, COLOURS, strict=True):
            logger.line(f"glucose/true_{name}", trace, trace.get("TruthGlucose"), f"true, {name}", colour)
            logger.points(f"glucose/cgm_{name}", trace.time_s, trace.get("GlucoseConc"), f"CGM, {name}", colour)
            for drug, folder, unit in (("Insulin", "insulin", "U"), ("Pram", "pramlintide", "µg")):
                rate, bolus = trace.get(f"{drug}RateCommanded"), trace.get(f"{drug}BolusCommanded")
                logger.line(f"{folder}/rate_{name}", trace, rate, f"rate, {name} [{unit}/h]", colour, step=True)
                given = np.where(bolus > 0, bolus, np.nan)
                logger.points(
                    f"{folder}/bolus_{name}", trace.time_s, given, f"bolus, {name} [{unit}]", colour, "diamond", 5.0
                )
            logger.line(f"iob/{name}", trace, trace.get("InsulinOnBoard"), name, colour)
            for signal, message in (("CtrlState", "CTRL_Status"), ("PumpState", "PUMP_Status")):
                changes = state_changes(trace, signal, message)
                logger.states(f"state/{signal}_{name}", changes, STATE_COLOURS[signal])
        self._apart(logger)
        self._differences(logger)
        for path, (low, high) in self._ranges().items():
            self._mark(logger, f"{path}/first", low, high)
        logger.document("report", f"```text\n{self.report.text()}\n```\n")

    def _level(self, logger: Logger, path: str, level: float) -> None:
        logger.send(path, np.array([0.0, self.end_s]), logger.rr.Scalars.columns(scalars=np.full(2, level)))
        style = logger.rr.SeriesLines(names=f"limit {level:.0f}", colors=[GREY], widths=[1.0])
        logger.recording.log(path, style, static=True)

    def _apart(self, logger: Logger) -> None:
        """What the quantities are apart, and the doses have come to be."""
        a, b = self.traces
        steps, in_a, in_b = np.intersect1d(a.step, b.step, return_indices=True)
        time_s = steps * float(STEP_SECONDS)
        name = f"{self.report.names[1]} - {self.report.names[0]}"
        for path, column, total, text in APART:
            values = b.get(column)[in_b] - a.get(column)[in_a]
            if total:
                values = np.cumsum(np.nan_to_num(values))
            if np.isnan(values).all():
                continue
            logger.send(f"apart/{path}", time_s, logger.rr.Scalars.columns(scalars=values))
            style = logger.rr.SeriesLines(names=f"{text}, {name}", colors=[YELLOW], widths=[2.0])
            logger.recording.log(f"apart/{path}", style, static=True)

    def _differences(self, logger: Logger) -> None:
        words = dict(zip(KINDS, ("differs", *(f"only {name}" for name in self.report.names), "moved"), strict=True))
        colours = {words[kind]: colour for kind, colour in KINDS.items()}
        for number, (message, runs) in enumerate([*self.stretches.items()][:MAX_LANES], 1):
            changes: list[tuple[float, str]] = []
            for run in runs:
                if changes and changes[-1][0] == run.start_s:
                    changes.pop()
                changes += [(run.start_s, words[run.kind]), (run.end_s, "")]
            logger.states(f"differs/{number:02}_{message}", changes, colours)
        lines = frame_lines(self.report, MAX_LINES)
        if lines:
            logger.send(
                "frames",
                np.array([line.time_s for line in lines]),
                logger.rr.TextLog.columns(
                    text=[line.text for line in lines],
                    level=[words[line.kind] for line in lines],
                    color=[colours[words[line.kind]] for line in lines],
                ),
            )

    def _mark(self, logger: Logger, path: str, low: float, high: float) -> None:
        """A vertical line where the runs part: two points as good as at one time."""
        if self.first_s is None:
            return
        ends = np.array([self.first_s, self.first_s + 1e-6])
        logger.send(path, ends, logger.rr.Scalars.columns(scalars=np.array([low, high])))
        style = logger.rr.SeriesLines(names="first difference", colors=[RED], widths=[1.5])
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
        plots += [plot(f"{self.report.names[1]} minus {self.report.names[0]}: {text}", [f"apart/{path}"], None, window)
                  for path, _, _, text in APART if path != "pramlintide" or not self.dry]  # fmt: skip
        shares = [3.0, 2.2, *([] if self.dry else [2.0]), *[1.4] * (len(plots) - (2 if self.dry else 3))]
        lane_view = lanes("What differs, and states", ["differs/**", "state/**"], window)
        left = rrb.Vertical(*plots, lane_view, row_shares=[*shares, 1.4 + 0.3 * min(len(self.stretches), MAX_LANES)])
        right = rrb.Vertical(
            rrb.TextDocumentView(name="What differs", origin="/report"),
            log("Frames that differ", "frames"),
            row_shares=[6, 4],
        )
        return rrb.Horizontal(left, right, column_shares=[56, 44], name=name)

    def _ranges(self) -> dict[str, tuple[float, float]]:
        glucose = self._top(("TruthGlucose", "GlucoseConc"), 300.0)
        return {
            "glucose": (40.0, glucose + 20.0),
            "insulin": (0.0, 1.1 * self._top(("InsulinRateCommanded", "InsulinBolusCommanded"), 2.0)),
            "pramlintide": (0.0, 1.1 * self._top(("PramRateCommanded", "PramBolusCommanded"), 5.0)),
        }

    def _top(self, columns: Iterable[str], least: float) -> float:
        return max([least, *(_highest(trace, column) for trace in self.traces for column in columns)])


APART: Final = (
    ("glucose", "TruthGlucose", False, "glucose [mg/dL]"),
    ("insulin", "InsulinDelivered", True, "insulin delivered so far [U]"),
    ("pramlintide", "PramDelivered", True, "pramlintide delivered so far [µg]"),
)
"""Path, column of the trace, whether its differences add up, what it is."""


def _highest(trace: Trace, column: str) -> float:
    values = np.nan_to_num(trace.get(column))
    return float(values.max()) if len(values) else 0.0
