"""What is in a recording: a whole run as columns, not row by row, so that a day takes milliseconds.

Glucose against CGM, commanded against delivered for both drugs, the stomach, states, alarms and injected faults as
lanes, what happened as text, the bus with its error counters, and the table of raw frames.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from can_bus import codec
from can_bus.frame import CAN_EFF_FLAG, CAN_RTR_FLAG
from can_bus.lockstep import STEP_SECONDS
from pumpbench.closeups import close_ups
from pumpbench.events import FaultSpan
from pumpbench.frames import Frames
from pumpbench.signals import decode, signals
from pumpbench.story import (
    BLUE,
    GREEN,
    GREY,
    LANES,
    LINE_LANES,
    ORANGE,
    PINK,
    PRIORITY_COLOURS,
    PURPLE,
    RED,
    STATE_COLOURS,
    TEAL,
    YELLOW,
    Note,
    hue,
    notes,
    state_changes,
    without_reminders,
)
from pumpbench.trace import Trace

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

TIMELINE: Final = "sim_time"
Colour = tuple[int, int, int]
LONG_RUN: Final = 2.5 * 86400
"""Simulated seconds from which on points and lines are thinner."""
BIT_RATE: Final = 500_000
"""Bits a second, to tell how long a step's frames would take on a real bus."""


def log_run(recording: Any, trace: Trace, frames: Frames, metrics: Mapping[str, Any] | None = None) -> None:
    """Log a whole run into a `rerun.RecordingStream`.

    Args:
        recording: the stream; anything it is connected to gets the data.
        trace: the decoded run.
        frames: every frame of it.
        metrics: content of metrics.json.
    """
    logger = Run(recording)
    logger.run(trace, frames)
    logger.tables(frames)
    logger.close_ups(trace)
    logger.properties(trace.info, metrics or {})


class Logger:
    """Writes columns under entity paths."""

    def __init__(self, recording: Any) -> None:
        import rerun as rr  # noqa: PLC0415

        self.rr = rr
        self.recording = recording

    # ---- what to send of what there is: all of it, unless the recording grows

    def fresh(self, path: str, time_s: Array, known: Array) -> Array:
        """Mask of the rows of a series to send."""
        del path, time_s
        return np.ones(len(known), bool)

    def fresh_states(self, path: str, changes: list[tuple[float, str]]) -> list[tuple[float, str]]:
        """The changes of a lane to send."""
        del path
        return changes

    def palette(self, path: str, colours: dict[str, Colour]) -> dict[str, Colour]:
        """The colours of a lane's states."""
        del path
        return colours

    def style(self, path: str, what: Any, key: tuple[str, ...] = ()) -> None:
        """How an entity looks; otherwise than before only if `key` is another one."""
        del key
        self.recording.log(path, what, static=True)

    # ---- what there is

    def send(self, path: str, time_s: Array, columns: Any) -> None:
        """Columns of components at these simulated seconds."""
        self.recording.send_columns(path, indexes=[self.rr.TimeColumn(TIMELINE, duration=time_s)], columns=columns)

    def scalars(self, path: str, time_s: Array, values: Array, *, gaps: bool = True) -> bool:
        """A series; with `gaps`, missing values break the line, else they are left out."""
        known = ~np.isnan(values)
        if not known.any():
            return False
        rows = self.fresh(path, time_s, known) & (known | gaps)
        if rows.any():
            self.send(path, time_s[rows], self.rr.Scalars.columns(scalars=values[rows]))
        return True

    def line(
        self,
        path: str,
        trace: Trace,
        values: Array,
        name: str,
        colour: Colour,
        width: float = 2.0,
        *,
        step: bool = False,
    ) -> None:
        """A series drawn as a line; `step` holds each value until the next one."""
        if self.scalars(path, trace.time_s, values):
            mode = (
                self.rr.components.InterpolationMode.StepAfter if step else self.rr.components.InterpolationMode.Linear
            )
            style = self.rr.SeriesLines(names=name, colors=[colour], widths=[width], interpolation_mode=mode)
            self.style(path, style)

    def points(
        self,
        path: str,
        time_s: Array,
        values: Array,
        name: str,
        colour: Colour,
        marker: str = "circle",
        size: float = 2.0,
    ) -> None:
        """A series drawn as markers; missing values are left out."""
        if self.scalars(path, time_s, values, gaps=False):
            style = self.rr.SeriesPoints(names=name, colors=[colour], markers=[marker], marker_sizes=[size])
            self.style(path, style)

    def document(self, path: str, markdown: str) -> None:
        """A page of text, for the whole recording."""
        self.recording.log(path, self.rr.TextDocument(markdown, media_type="text/markdown"), static=True)

    def texts(self, path: str, lines: Sequence[tuple[float, str, str, Colour]]) -> None:
        """Lines of a log: time (simulated s), text, level, colour."""
        if lines:
            time_s, text, level, colour = zip(*lines, strict=True)
            self.send(path, np.array(time_s), self.rr.TextLog.columns(text=text, level=level, color=colour))

    def states(self, path: str, changes: list[tuple[float, str]], colours: Mapping[str, Colour]) -> None:
        """A lane: when each state begins (simulated s) and its name, "" for a gap; colours by name."""
        palette = self.palette(path, {name: colours.get(name, hue(name)) for _, name in changes if name})
        changes = self.fresh_states(path, changes)
        if not changes:
            return
        times, names = zip(*changes, strict=True)
        shown = sorted(palette)
        configuration = self.rr.StateConfiguration(values=shown, labels=shown, colors=[palette[name] for name in shown])
        self.style(path, configuration, tuple(shown))
        self.send(path, np.array(times), self.rr.StateChange.columns(state=list(names)))


class Run(Logger):
    """Logs all there is of a run."""

    # ---- what is known of it: how it ended, unless it is still on (`pumpbench.recording.live`)

    def limit(self, path: str, trace: Trace, level: float) -> None:
        """A horizontal line."""
        self.send(path, np.array([0.0, _end_s(trace)]), self.rr.Scalars.columns(scalars=np.full(2, level)))

    def is_over(self, span: FaultSpan, trace: Trace) -> bool:
        """Whether the end of a fault is known."""
        del span, trace
        return True

    def fresh_notes(self, trace: Trace) -> list[Note]:
        """The lines of the log to send."""
        return notes(trace)

    def usual(self, lane: str, counts: Array) -> float | None:
        """How many frames of a message a step has, as a rule; None if that can't be said yet."""
        del lane
        return float(np.median(counts))

    # ---- what there is

    def run(self, trace: Trace, frames: Frames) -> None:
        """Everything but the raw frames and the close-ups."""
        self.glucose(trace)
        self.drugs(trace)
        self.stomach(trace)
        self.lanes(trace)
        self.log(trace)
        self.bus(trace, frames)

    def close_ups(self, trace: Trace) -> None:
        """What happened in each of them, as a page."""
        for number, closeup in enumerate(close_ups(trace), 1):
            self.document(f"closeup/{number}", closeup.text(trace))

    def properties(self, info: Mapping[str, Any], metrics: Mapping[str, Any]) -> None:
        """What is known of the run as a whole."""
        flat = {key: value for key, value in info.items() if isinstance(value, str | int | float)}
        if flat:
            self.recording.send_property("run", self.rr.AnyValues(**flat))
        parts = [
            f"## {heading}\n\n```json\n{json.dumps(content, indent=2, default=str)}\n```\n"
            for heading, content in (("Outcome (metrics.json)", metrics), ("Run (run.json)", info))
            if content
        ]
        if parts:
            self.document("run", "\n".join(parts))

    def glucose(self, trace: Trace) -> None:
        """Glucose, its measurement, limits and meals."""
        for level, colour in ((70.0, RED), (180.0, ORANGE)):
            path = f"limits/{level:.0f}"
            self.limit(path, trace, level)
            self.style(path, self.rr.SeriesLines(names=f"limit {level:.0f}", colors=[colour], widths=[1.0]))
        long = _end_s(trace) >= LONG_RUN
        self.line("glucose/true", trace, trace.get("TruthGlucose"), "true", GREY, 1.5 if long else 2.5)
        self.line("glucose/interstitial", trace, trace.get("TruthInterstitial"), "interstitial", PURPLE, 0.8)
        dot = 0.8 if long else 2.0  # else they hide the line
        self.points("glucose/cgm", trace.time_s, trace.get("GlucoseConc"), "CGM", BLUE, size=dot)
        meals = np.array([meal.time_s for meal in trace.meals])
        self.points("glucose/meal", meals, np.full(len(meals), 48.0), "meal (see log)", GREEN, "up", 5.0)

    def drugs(self, trace: Trace) -> None:
        """Commanded against delivered, and what is in the body."""
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
        """Emptying, content, and what appears in the blood."""
        self.line("stomach/eta", trace, trace.get("TruthEta") * 100, "emptying η [%]", PINK)
        self.line("stomach/content", trace, trace.get("TruthQsto") / 1000, "content [g]", GREEN)
        self.line("stomach/appearance", trace, trace.get("TruthRa"), "Ra [mg/kg/min]", ORANGE)

    def lanes(self, trace: Trace) -> None:
        """States of the nodes, alarms, faults."""
        for order, (signal, message, what) in enumerate((*LANES, *LINE_LANES), start=1):
            if (signal, message, what) in LANES or np.nan_to_num(trace.get(signal)).any():
                changes = state_changes(trace, signal, message)
                self.states(f"state/{order}_{what}", changes, STATE_COLOURS.get(signal, {}))
        self.alarms(trace)
        spans: dict[str, list[tuple[float, str]]] = {}
        for span in trace.fault_spans():
            kind = span.label.split(" ", 1)[0]
            ending = [(span.end_s, "")] if self.is_over(span, trace) else []
            spans.setdefault(span.label, []).extend([(span.start_s, kind), *ending])
        for label, changes in spans.items():
            self.states(f"fault/{label.replace(' ', '_')}", changes, {label.split(" ", 1)[0]: RED})

    def alarms(self, trace: Trace) -> None:
        """A lane for each alarm code of each node: the state of its newest instance, in the colour of its priority."""
        lanes: dict[str, list[tuple[float, str]]] = {}
        standing: dict[str, set[int]] = {}
        tints: dict[str, dict[str, tuple[int, int, int]]] = {}
        for alarm in without_reminders(trace.alarms):
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

    def log(self, trace: Trace) -> None:
        """What happened, as text."""
        self.texts("log", [(line.time_s, line.text, line.kind, line.colour) for line in self.fresh_notes(trace)])

    def bus(self, trace: Trace, frames: Frames) -> None:
        """How much there was on the wire, which messages, what was damaged or missed."""
        names = {0: "device", 1: "plant"}
        for channel in sorted(set(frames.channel.tolist())):
            of = names.get(channel, str(channel))
            colour, width = (GREEN, 3.5) if channel == 0 else (GREY, 1.2)  # the same most of the time
            heard = frames.select(np.flatnonzero(frames.channel == channel))
            count = per_step(trace, heard.step)
            self.line(f"bus/frames/{channel}", trace, count, f"frames, {of}", colour, width, step=True)
            busy = per_step(trace, heard.step, 1000 * wire_bits(heard) / BIT_RATE)
            self.line(f"bus/load/{channel}", trace, busy, f"ms, {of}", colour, width, step=True)
            refused = per_step(trace, heard.step[~heard.intact])
            if refused.any():
                self.line(f"bus/errors/refused_{channel}", trace, refused, f"damaged frames, {of}", RED, step=True)
            self.rates(channel, trace, heard)
        for signal, what, colour in (
            ("LostFrameCount", "lost", ORANGE),
            ("E2eErrorCount", "checksum errors", RED),
            ("SequenceErrorCount", "out of sequence", PURPLE),
            ("SaturationCount", "saturations", YELLOW),
        ):
            self.line(f"bus/errors/{signal}", trace, trace.get(signal), what, colour, step=True)

    def rates(self, channel: int, trace: Trace, frames: Frames) -> None:
        """A lane for each message: how many of it a step brought, in orange if not the usual number.

        The cyclic ones come first: a gap in such a lane is a frame that is missing.
        """
        for message in codec.messages().values():
            counts = per_step(trace, frames.step[frames.can_id == message.can_id])
            if not counts.any():
                continue
            usual = self.usual(f"{channel}/{message.name}", counts)
            if usual is None:
                continue
            starts = np.flatnonzero(np.append(True, counts[1:] != counts[:-1]))
            changes = [(float(trace.time_s[row]), f"{counts[row]:.0f}" if counts[row] else "") for row in starts]
            colours = {
                f"{count:.0f}": BLUE if not usual else GREEN if count == usual else ORANGE for count in set(counts)
            }
            self.states(f"rate/can{channel}/{1 if usual else 2}_{message.name}", changes, colours)

    def tables(self, frames: Frames) -> None:
        """The raw frames of each bus."""
        for channel in sorted(set(frames.channel.tolist())):
            self.table(f"can/can{channel}", frames.select(np.flatnonzero(frames.channel == channel)))

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


def _end_s(trace: Trace) -> float:
    return max(float(trace.time_s[-1]), STEP_SECONDS) if len(trace) else float(STEP_SECONDS)


def per_step(trace: Trace, step: Array, weight: Array | None = None) -> Array:
    """The sum of something over each step of a trace: of frames, if no `weight` is given."""
    first = int(trace.step[0]) if len(trace) else 0
    return np.bincount(step - first, weight, minlength=len(trace)).astype(float)


def wire_bits(frames: Frames) -> Array:
    """Bits that each frame takes on the wire at most, with the stuff bits of the worst case and the gap behind it."""
    extended, remote = (frames.can_id & flag != 0 for flag in (CAN_EFF_FLAG, CAN_RTR_FLAG))
    stuffed = np.where(extended, 54, 34) + 8 * np.where(remote, 0, frames.length.astype("i8"))
    unstuffed = 13  # the delimiters of CRC and acknowledgement, the acknowledgement, end of frame and gap
    bits: Array = stuffed + (stuffed - 1) // 4 + unstuffed
    return bits


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
