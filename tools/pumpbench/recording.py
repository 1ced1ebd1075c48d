"""A run as a Rerun recording: everything at one glance, and every frame to zoom into.

The recording is written in one go from columns, not row by row: a day takes milliseconds. Its blueprint shows glucose
against CGM, commanded against delivered for both drugs, the stomach, states and injected faults as lanes, the alarms,
the bus with its error counters, and the table of raw frames.

Only this module and `pumpbench.snapshot` know Rerun.
"""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from can_bus import codec
from can_bus.lockstep import STEP_SECONDS
from pumpbench.capture import Frames
from pumpbench.trace import Trace, decode, labels, signals

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

APPLICATION: Final = "pumpbench"
TIMELINE: Final = "sim_time"

GREY, WHITE, BLUE, ORANGE = (150, 150, 150), (205, 205, 205), (64, 156, 255), (255, 152, 38)
GREEN, RED, YELLOW, PURPLE, TEAL, PINK = (
    (88, 190, 96),
    (229, 57, 53),
    (240, 200, 60),
    (171, 104, 220),
    (38, 178, 172),
    (236, 96, 160),
)

STATE_COLOURS: Final[Mapping[str, Mapping[str, tuple[int, int, int]]]] = {
    "CtrlState": {
        "Init": GREY,
        "Auto": GREEN,
        "Degraded": YELLOW,
        "SafeBasal": ORANGE,
        "Suspended": PURPLE,
        "Fault": RED,
        "DeliveryUncertain": PINK,
    },
    "PumpState": {
        "Off": GREY,
        "Priming": TEAL,
        "Waiting": TEAL,
        "Running": GREEN,
        "Suspended": PURPLE,
        "Stopped": ORANGE,
        "Fault": RED,
    },
    "CgmState": {
        "Warmup": GREY,
        "Ok": GREEN,
        "CalibrationNeeded": YELLOW,
        "TempInvalid": YELLOW,
        "BelowRange": ORANGE,
        "AboveRange": ORANGE,
        "SensorFault": RED,
        "Expired": PURPLE,
    },
    "InsulinOcclusion": {"Clear": GREEN, "Suspected": YELLOW, "Occluded": RED},
    "PramOcclusion": {"Clear": GREEN, "Suspected": YELLOW, "Occluded": RED},
}
"""Colours of the states, by name; the summary picture uses the same ones."""

LANES: Final[tuple[tuple[str, str, str], ...]] = (
    ("CtrlState", "CTRL_Status", "firmware"),
    ("PumpState", "PUMP_Status", "pump"),
    ("CgmState", "CGM_Reading", "sensor"),
    ("CtrlMode", "CTRL_Status", "strategy"),
)
"""State lanes: signal, message, what a reader calls it."""


PRIORITY_COLOURS: Final = {"High": RED, "Medium": ORANGE, "Low": YELLOW}

GLUCOSE: Final = ("TruthGlucose", "GlucoseConc")


class RecordingError(RuntimeError):
    """The recording could not be written or does not verify; the text says why."""


def clock(time_s: float) -> str:
    """Simulated time as people read it: `d0 13:05` is 13:05 on the first day."""
    minutes = int(time_s // 60)
    return f"d{minutes // 1440} {minutes // 60 % 24:02d}:{minutes % 60:02d}"


@dataclass(frozen=True)
class Note:
    """A line of the log: when (simulated s), which kind (ALARM, FAULT, MEAL, STATE), what, and its colour."""

    time_s: float
    kind: str
    text: str
    colour: tuple[int, int, int]


def notes(trace: Trace) -> list[Note]:
    """What happened, in order of time: alarms, injected faults, meals, changes of the firmware's state."""
    found = [
        Note(
            alarm.time_s,
            "ALARM",
            f"{alarm.node} {alarm.code} {'over' if alarm.state == 'Inactive' else alarm.state.lower()}"
            f" ({alarm.priority.lower()})",
            GREY if alarm.state == "Inactive" else PRIORITY_COLOURS.get(alarm.priority, WHITE),
        )
        for alarm in trace.alarms
    ]
    for span in trace.fault_spans():
        minutes = round((span.end_s - span.start_s) / 60)
        found.append(Note(span.start_s, "FAULT", f"{span.label} for {minutes} min", RED))
    found += [Note(meal.time_s, "MEAL", f"{meal.carbs_g:.0f} g of carbohydrate", GREEN) for meal in trace.meals]
    for start, text in state_changes(trace, "CtrlState", "CTRL_Status"):
        if text:
            found.append(Note(start, "STATE", f"firmware {text}", STATE_COLOURS["CtrlState"].get(text, GREY)))
    found.sort(key=lambda note: note.time_s)
    return [Note(note.time_s, note.kind, f"{clock(note.time_s)}  {note.text}", note.colour) for note in found]


def state_changes(trace: Trace, signal: str, message: str) -> list[tuple[float, str]]:
    """When a state begins and its name; "" where the step had no frame that says it."""
    column = trace.columns.get(signal)
    if column is None:
        return []
    names = labels(message, signal)
    codes = np.where(np.isnan(column), -1, column).astype(int)
    if len(codes) > 1 and codes[-1] == -1:
        codes = codes[:-1]  # the final instant asks for no answer
    starts: Array = np.flatnonzero(np.append(True, codes[1:] != codes[:-1])[: len(codes)])
    return [
        (float(trace.time_s[row]), "" if codes[row] == -1 else names.get(int(codes[row]), str(codes[row])))
        for row in starts
    ]


# ------------------------------------------------------------------------------------------------------- what is in it


def log_run(recording: Any, trace: Trace, frames: Frames, metrics: Mapping[str, Any] | None = None) -> None:
    """Log a whole run into a `rerun.RecordingStream`.

    Args:
        recording: the stream; anything it is connected to gets the data.
        trace: the decoded run.
        frames: every frame of it.
        metrics: content of metrics.json.
    """
    logger = _Logger(recording)
    logger.run(trace, frames)
    logger.properties(trace.info, metrics or {})


class _Logger:
    """Writes columns under entity paths."""

    def __init__(self, recording: Any) -> None:
        import rerun as rr  # noqa: PLC0415

        self.rr = rr
        self.recording = recording

    def run(self, trace: Trace, frames: Frames) -> None:
        end_s = max(float(trace.time_s[-1]), STEP_SECONDS) if len(trace) else float(STEP_SECONDS)
        self.glucose(trace, end_s)
        self.drugs(trace)
        self.stomach(trace)
        self.lanes(trace, end_s)
        self.log(trace)
        self.bus(trace, frames)

    def send(self, path: str, time_s: Array, columns: Any) -> None:
        self.recording.send_columns(path, indexes=[self.rr.TimeColumn(TIMELINE, duration=time_s)], columns=columns)

    def scalars(self, path: str, time_s: Array, values: Array, *, gaps: bool = True) -> bool:
        """A series; with `gaps`, missing values break the line, else they are left out."""
        known = ~np.isnan(values)
        if not known.any():
            return False
        rows = slice(None) if gaps else known
        self.send(path, time_s[rows], self.rr.Scalars.columns(scalars=values[rows]))
        return True

    def line(
        self,
        path: str,
        trace: Trace,
        values: Array,
        name: str,
        colour: tuple[int, int, int],
        width: float = 2.0,
        *,
        step: bool = False,
    ) -> None:
        if self.scalars(path, trace.time_s, values):
            mode = (
                self.rr.components.InterpolationMode.StepAfter if step else self.rr.components.InterpolationMode.Linear
            )
            style = self.rr.SeriesLines(names=name, colors=[colour], widths=[width], interpolation_mode=mode)
            self.recording.log(path, style, static=True)

    def points(
        self,
        path: str,
        time_s: Array,
        values: Array,
        name: str,
        colour: tuple[int, int, int],
        marker: str = "circle",
        size: float = 2.0,
    ) -> None:
        if self.scalars(path, time_s, values, gaps=False):
            style = self.rr.SeriesPoints(names=name, colors=[colour], markers=[marker], marker_sizes=[size])
            self.recording.log(path, style, static=True)

    def properties(self, info: Mapping[str, Any], metrics: Mapping[str, Any]) -> None:
        flat = {key: value for key, value in info.items() if isinstance(value, str | int | float)}
        if flat:
            self.recording.send_property("run", self.rr.AnyValues(**flat))
        parts = [
            f"## {heading}\n\n```json\n{json.dumps(content, indent=2, default=str)}\n```\n"
            for heading, content in (("Outcome (metrics.json)", metrics), ("Run (run.json)", info))
            if content
        ]
        if parts:
            self.recording.log("run", self.rr.TextDocument("\n".join(parts), media_type="text/markdown"), static=True)

    def glucose(self, trace: Trace, end_s: float) -> None:
        for limit, colour in ((70.0, RED), (180.0, ORANGE)):
            path = f"limits/{limit:.0f}"
            self.send(path, np.array([0.0, end_s]), self.rr.Scalars.columns(scalars=np.full(2, limit)))
            style = self.rr.SeriesLines(names=f"limit {limit:.0f}", colors=[colour], widths=[1.0])
            self.recording.log(path, style, static=True)
        self.line("glucose/true", trace, trace.get("TruthGlucose"), "true", WHITE)
        self.line("glucose/interstitial", trace, trace.get("TruthInterstitial"), "interstitial", GREY, 1.0)
        self.points("glucose/cgm", trace.time_s, trace.get("GlucoseConc"), "CGM", BLUE)
        meals = np.array([meal.time_s for meal in trace.meals])
        self.points("glucose/meal", meals, np.full(len(meals), 48.0), "meal (see log)", GREEN, "up", 5.0)

    def drugs(self, trace: Trace) -> None:
        for name, drug, colour, unit in (("insulin", "Insulin", BLUE, "U"), ("pramlintide", "Pram", TEAL, "ug")):
            commanded, delivered = trace.get(f"{drug}RateCommanded"), trace.basal_delivered(drug)
            self.line(f"{name}/delivered", trace, delivered, f"delivered [{unit}/h]", ORANGE, 3.5, step=True)
            self.line(f"{name}/rate_commanded", trace, commanded, f"commanded [{unit}/h]", colour, 1.8, step=True)
            for kind, tint, marker in (("Commanded", colour, "diamond"), ("Delivered", ORANGE, "circle")):
                bolus = trace.get(f"{drug}Bolus{kind}")
                given = np.where(bolus > 0, bolus, np.nan)
                path = f"{name}/bolus_{kind.lower()}"
                self.points(path, trace.time_s, given, f"bolus {kind.lower()} [{unit}]", tint, marker, 4.0)
        self.line("body/plasma_insulin", trace, trace.get("TruthInsulin"), "insulin [mU/L]", BLUE)
        self.line("body/plasma_pramlintide", trace, trace.get("TruthPramlintide"), "pramlintide [pmol/L]", TEAL)
        self.line("body/insulin_on_board", trace, trace.get("InsulinOnBoard"), "IOB, firmware [U]", PURPLE)

    def stomach(self, trace: Trace) -> None:
        self.line("stomach/eta", trace, trace.get("TruthEta") * 100, "emptying η [%]", PINK)
        self.line("stomach/content", trace, trace.get("TruthQsto") / 1000, "content [g]", GREEN)
        self.line("stomach/appearance", trace, trace.get("TruthRa") * 10, "Ra [0.1 mg/kg/min]", GREY, 1.0)

    def lanes(self, trace: Trace, end_s: float) -> None:
        lanes = [lane for lane in LANES if lane[0] in trace.columns]
        for signal, what in (("InsulinOcclusion", "insulin_line"), ("PramOcclusion", "pramlintide_line")):
            if np.nan_to_num(trace.get(signal)).any():
                lanes.append((signal, "PUMP_Status", what))
        for order, (signal, message, what) in enumerate(lanes):
            changes = state_changes(trace, signal, message)
            self.states(f"state/{order + 1}_{what}", changes, STATE_COLOURS.get(signal, {}))
        self.alarms(trace)
        spans: dict[str, list[tuple[float, str]]] = {}
        for span in trace.fault_spans():
            kind = span.label.split(" ", 1)[0]
            spans.setdefault(span.label, []).extend([(span.start_s, kind), (span.end_s, "")])
        for label, changes in spans.items():
            self.states(f"fault/{label.replace(' ', '_')}", changes, {label.split(" ", 1)[0]: RED})

    def alarms(self, trace: Trace) -> None:
        """A lane for each alarm code of each node: the state of its newest instance, in the colour of its priority."""
        lanes: dict[str, list[tuple[float, str]]] = {}
        standing: dict[str, set[int]] = {}
        tints: dict[str, dict[str, tuple[int, int, int]]] = {}
        for alarm in trace.alarms:
            lane = f"alarm/{alarm.code}_{alarm.node}"
            instances = standing.setdefault(lane, set())
            if alarm.state == "Inactive":
                instances.discard(alarm.instance)
                if not instances:
                    lanes.setdefault(lane, []).append((alarm.time_s, ""))
            else:
                instances.add(alarm.instance)
                tints.setdefault(lane, {})[alarm.state] = PRIORITY_COLOURS.get(alarm.priority, GREY)
                lanes.setdefault(lane, []).append((alarm.time_s, alarm.state))
        for lane, changes in lanes.items():
            self.states(lane, changes, tints.get(lane, {}))

    def states(self, path: str, changes: list[tuple[float, str]], colours: Mapping[str, tuple[int, int, int]]) -> None:
        if not changes:
            return
        times, names = zip(*changes, strict=True)
        shown = sorted({name for name in names if name})
        self.recording.log(
            path,
            self.rr.StateConfiguration(
                values=shown, labels=shown, colors=[colours.get(name, _hue(name)) for name in shown]
            ),
            static=True,
        )
        self.send(path, np.array(times), self.rr.StateChange.columns(state=list(names)))

    def log(self, trace: Trace) -> None:
        lines = notes(trace)
        if lines:
            self.send(
                "log",
                np.array([line.time_s for line in lines]),
                self.rr.TextLog.columns(
                    text=[line.text for line in lines],
                    level=[line.kind for line in lines],
                    color=[line.colour for line in lines],
                ),
            )

    def bus(self, trace: Trace, frames: Frames) -> None:
        names = {0: "device", 1: "plant"}
        first = int(trace.step[0]) if len(trace) else 0
        for channel in sorted(set(frames.channel.tolist())):
            rows = frames.channel == channel
            for path, what, mask, colour in (
                ("frames", "frames/step", rows, GREEN if channel == 0 else GREY),
                ("refused", "damaged", rows & ~frames.intact, RED),
            ):
                count = np.bincount(frames.step[mask] - first, minlength=len(trace)).astype(float)
                if path == "frames" or count.any():
                    label = f"{what}, {names.get(channel, channel)}"
                    self.line(f"bus/{path}_{channel}", trace, count, label, colour, step=True)
            self.table(f"can/can{channel}", frames.select(np.flatnonzero(rows)))
        for signal, what, colour in (
            ("LostFrameCount", "lost", ORANGE),
            ("E2eErrorCount", "checksum errors", RED),
            ("SequenceErrorCount", "out of sequence", PURPLE),
            ("SaturationCount", "saturations", YELLOW),
        ):
            self.line(f"bus/{signal}", trace, trace.get(signal), what, colour, step=True)

    def table(self, path: str, frames: Frames) -> None:
        """Every frame of a bus as a row: id, name and bytes, and a line of text with the decoded values."""
        by_id = {message.can_id: message.name for message in codec.messages().values()}
        ids, index = np.unique(frames.can_id, return_inverse=True)
        texts = np.array([f"0x{ident:03X}" for ident in ids.tolist()])[index].tolist()
        known = np.array([by_id.get(ident, "unknown") for ident in ids.tolist()])[index].tolist()
        data, lengths = frames.data.tobytes().hex(" ").upper(), frames.length.tolist()
        payloads = [data[24 * row : 24 * row + max(3 * length - 1, 0)] for row, length in enumerate(lengths)]
        values = describe(frames)
        lines = [
            f"{time_s:.5f}  {ident[2:]}#{payload.replace(' ', '')}  {value}"
            for time_s, ident, payload, value in zip(frames.time_s.tolist(), texts, payloads, values, strict=True)
        ]
        good = frames.intact.tolist()
        levels = [name if fine else f"{name}!" for name, fine in zip(known, good, strict=True)]
        self.send(
            path,
            frames.time_s,
            [
                *self.rr.TextLog.columns(text=lines, level=levels),
                *self.rr.AnyValues.columns(id=texts, data=payloads, step=frames.step.astype("i8")),
            ],
        )


def describe(frames: Frames) -> list[str]:
    """What each frame says, as `Signal=value unit` for every signal it carries; "" for a frame not to be believed."""
    result = np.full(len(frames), "", object)
    for message in codec.messages().values():
        decoded = decode(frames, message.name)
        if not len(decoded.rows):
            continue
        parts: list[list[str]] = []
        for name, signal in signals(message.name).items():
            raw = decoded.raw[name]
            codes, index = np.unique(raw, return_inverse=True)
            if signal.choices:
                texts = [signal.choices.get(code) or signal.text(code) for code in codes.tolist()]
            else:
                texts = [signal.text(code) for code in codes.tolist()]
            column = np.array([f"{name}={text}" for text in texts], object)[index]
            column[~decoded.valid[name]] = ""
            parts.append(column.tolist())
        result[decoded.rows] = [" ".join(filter(None, row)) for row in zip(*parts, strict=True)]
    texts_out: list[str] = result.tolist()
    return texts_out


def _hue(name: str) -> tuple[int, int, int]:
    """A calm colour for a name without a meaning of its own (strategies)."""
    palette = [(96, 125, 139), (121, 134, 203), (77, 150, 170), (141, 110, 99), (130, 150, 110)]
    return palette[sum(name.encode()) % len(palette)]


# --------------------------------------------------------------------------------------------------------- how it looks


def blueprint(
    start_s: float,
    end_s: float,
    *,
    gateway: bool = False,
    bus_top: float = 60.0,
    glucose_top: float = 320.0,
    lanes: int = 6,
) -> Any:
    """The layout of a recording as a `rerun.blueprint.Blueprint`, with all time axes linked.

    Args:
        start_s, end_s: simulated seconds the axes show at first.
        gateway: whether a second bus, the plant's, was recorded.
        bus_top: upper end of the axis of frames per step.
        glucose_top: upper end of the axis of glucose, mg/dL; the same for all runs that stay below it, to compare them.
        lanes: number of alarms, faults and states to make room for.
    """
    import rerun as rr  # noqa: PLC0415
    import rerun.blueprint as rrb  # noqa: PLC0415

    left_margin, right_margin = 0.17 * (end_s - start_s), 0.01 * (end_s - start_s)  # the legends stand on the left
    nanos = [round(time_s * 1e9) for time_s in (start_s - left_margin, end_s + right_margin)]
    window = rr.TimeRange(
        start=rr.TimeRangeBoundary.absolute(nanos=nanos[0]), end=rr.TimeRangeBoundary.absolute(nanos=nanos[1])
    )
    axis = rrb.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal)
    legend = rrb.PlotLegend(corner=rrb.Corner2D.LeftTop)
    tip = rrb.PlotInteraction(tooltip_mode="All")

    def plot(name: str, contents: Iterable[str], y_range: tuple[float, float] | None = None) -> Any:
        return rrb.TimeSeriesView(
            name=name,
            contents=[f"+ /{path}" for path in contents],
            axis_x=axis,
            axis_y=rrb.ScalarAxis(range=y_range) if y_range else None,
            plot_legend=legend,
            interaction=tip,
        )

    left = rrb.Vertical(
        plot("Glucose [mg/dL]", ["glucose/**", "limits/**"], (40, glucose_top)),
        plot("Insulin: commanded against delivered", ["insulin/**"]),
        plot("Pramlintide: commanded against delivered", ["pramlintide/**"]),
        plot("Stomach", ["stomach/**"]),
        rrb.StateTimelineView(
            name="Alarms, injected faults, states",
            contents=["+ /alarm/**", "+ /fault/**", "+ /state/**"],
            time_view=axis,
        ),
        row_shares=[3.4, 2.4, 2.4, 1.9, min(1.2 + 0.5 * lanes, 6.0)],
    )
    log_columns = rrb.TextLogColumns(
        timeline_columns=[rrb.components.TimelineColumn(TIMELINE, visible=False)], text_log_columns=["loglevel", "body"]
    )
    frame_columns = rrb.TextLogColumns(
        timeline_columns=[rrb.components.TimelineColumn(TIMELINE, visible=False)], text_log_columns=["loglevel", "body"]
    )
    tables = [rrb.TextLogView(name="Frames, device's bus", origin="/can/can0", columns=frame_columns)]
    if gateway:
        tables.append(rrb.TextLogView(name="Frames, plant's bus", origin="/can/can1", columns=frame_columns))
    tables.append(rrb.DataframeView(name="Raw", origin="/can/can0"))
    right = rrb.Vertical(
        rrb.TextLogView(name="Alarms, faults, meals, states", origin="/log", columns=log_columns),
        rrb.Tabs(
            plot("Bus: frames per step, firmware's counters", ["bus/**"], (0, bus_top)),
            plot("Plasma levels, insulin on board", ["body/**"]),
            active_tab=0,
        ),
        rrb.Tabs(*tables, rrb.TextDocumentView(name="Run", origin="/run"), active_tab=0),
        row_shares=[4, 3.5, 4],
    )
    return _linked(rrb, rr)(
        rrb.Horizontal(left, right, column_shares=[64, 36]),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="paused"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.TopPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
        window=window,
    )


def _linked(rrb: Any, rr: Any) -> Callable[..., Any]:
    """A blueprint class that also sets the range of the axis all views are linked to."""

    class LinkedBlueprint(rrb.Blueprint):  # type: ignore[misc]
        """The viewer keeps the linked range in a view of its own, whose id has been the same since 0.36."""

        _GLOBAL_VIEW = "view/5c0dca6a-e63f-9cf7-f657-2602590474cc/TimeAxis"

        def __init__(self, *parts: Any, window: Any, **options: Any) -> None:
            super().__init__(*parts, **options)
            self._window = window

        def _log_to_stream(self, stream: Any) -> None:
            super()._log_to_stream(stream)
            stream.log(self._GLOBAL_VIEW, rrb.TimeAxis(view_range=self._window))

    return LinkedBlueprint


# -------------------------------------------------------------------------------------------------------- to a file


def title(info: Mapping[str, Any]) -> str:
    """One line that says which run this is."""
    parts = [str(info[key]) for key in ("patient", "strategy", "scenario") if info.get(key)]
    if info.get("seed") is not None:
        parts.append(f"seed {info['seed']}")
    return ", ".join(parts) or "pumpbench run"


def rerun_binary() -> Path:
    """The viewer and tool box that comes with rerun-sdk (the `rerun` command itself is only a shim around it)."""
    import rerun_cli  # noqa: PLC0415

    return Path(rerun_cli.__file__).with_name("rerun.exe" if os.name == "nt" else "rerun")


def quiet_environment(scratch: Path) -> dict[str, str]:
    """Environment for the Rerun binary: no analytics, no chatter.

    Args:
        scratch: an existing directory it may write its configuration to.
    """
    settings = scratch / "rerun" / "analytics.json"
    settings.parent.mkdir(parents=True, exist_ok=True)
    settings.write_text(json.dumps({"analytics_enabled": False, "analytics_id": "none", "metadata": {}}))
    return os.environ | {"XDG_CONFIG_HOME": str(scratch), "RUST_LOG": "error", "NO_COLOR": "1"}


def write_recording(trace: Trace, frames: Frames, path: Path, metrics: Mapping[str, Any] | None = None) -> None:
    """Write the run with its blueprint as an .rrd file, compacted and verified.

    Args:
        trace: the decoded run.
        frames: every frame of it.
        path: the file; overwritten.
        metrics: content of metrics.json, shown beside the run's data.

    Raises:
        RecordingError: Rerun could not write the file or does not accept it.
    """
    import rerun as rr  # noqa: PLC0415

    end_s = float(trace.time_s[-1]) if len(trace) else 0.0
    layout = blueprint(
        0.0 if not len(trace) else float(trace.time_s[0]),
        max(end_s, STEP_SECONDS),
        gateway=bool(np.any(frames.channel == 1)),
        bus_top=3.0 * _usual_frames(frames),
        lanes=_lane_count(trace),
        glucose_top=max(320.0, *(np.nanmax(np.append(trace.get(name), 0.0)) + 20 for name in GLUCOSE)),
    )
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".recording-") as directory:
        raw, final = Path(directory) / "raw.rrd", Path(directory) / "recording.rrd"
        strict = rr.strict_mode()
        rr.set_strict_mode(True)  # else a value Rerun does not like is only a warning, and missing
        try:
            with rr.RecordingStream(APPLICATION, recording_id=_recording_id(trace, frames)) as recording:
                recording.save(raw, default_blueprint=layout)
                rr.set_log_time_enabled(False, recording=recording)
                recording.send_recording_name(title(trace.info))
                log_run(recording, trace, frames, metrics)
                recording.flush(timeout_sec=60)
        except (RuntimeError, TypeError, ValueError) as error:
            raise RecordingError(f"Rerun could not write {path.name}: {error}") from error
        finally:
            rr.set_strict_mode(strict)
        environment = quiet_environment(Path(directory))
        _rrd(["optimize", str(raw), "-o", str(final)], environment)
        _rrd(["verify", str(final)], environment)
        final.replace(path)


def _lane_count(trace: Trace) -> int:
    states = sum(signal in trace.columns for signal, _, _ in LANES)
    return states + len({span.label for span in trace.fault_spans()}) + len({(a.code, a.node) for a in trace.alarms})


def _usual_frames(frames: Frames) -> float:
    counts = np.bincount(frames.step[frames.channel == 0]) if len(frames) else np.zeros(0)
    return float(np.median(counts[counts > 0])) if counts.any() else 20.0


def _recording_id(trace: Trace, frames: Frames) -> str:
    """The same run gets the same id; the viewer joins recordings of one id, so whatever differs must show in it."""
    about = zlib.crc32(json.dumps(trace.info, sort_keys=True, default=str).encode())
    return f"{frames.sha256()[:24]}-{about:08x}"


def _rrd(arguments: list[str], environment: dict[str, str]) -> None:
    result = subprocess.run(
        [rerun_binary(), "rrd", *arguments], env=environment, capture_output=True, text=True, check=False
    )
    if result.returncode:
        lines = (result.stderr or result.stdout).strip().splitlines() or ["no message"]
        raise RecordingError(f"rerun rrd {arguments[0]} failed: {lines[-1]}")
