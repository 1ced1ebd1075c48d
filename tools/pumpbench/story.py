"""What happened in a run, in words and colours: what every picture, recording and page of it tells alike."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from pumpbench.events import AlarmEvent
from pumpbench.signals import labels
from pumpbench.trace import Trace

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

# Middle tones: the native viewer is dark, the one in the browser light.
GREY, BLUE, ORANGE = (150, 150, 150), (64, 156, 255), (255, 152, 38)
GREEN, RED, YELLOW, PURPLE, TEAL, PINK = (
    (88, 190, 96),
    (229, 57, 53),
    (214, 190, 30),
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

LINE_LANES: Final[tuple[tuple[str, str, str], ...]] = (
    ("InsulinOcclusion", "PUMP_Status", "insulin_line"),
    ("PramOcclusion", "PUMP_Status", "pramlintide_line"),
)
"""Lanes that are shown where something is wrong with a line."""

PRIORITY_COLOURS: Final = {"High": RED, "Medium": ORANGE, "Low": YELLOW}


def clock(time_s: float) -> str:
    """Simulated time as people read it: `d0 13:05` is 13:05 on the first day."""
    minutes = int(time_s // 60)
    return f"d{minutes // 1440} {minutes // 60 % 24:02d}:{minutes % 60:02d}"


@dataclass(frozen=True)
class Note:
    """A line of the log: when (simulated s), which kind (ALARM, FAULT, MEAL, STATE), what, and its colour."""

    time_s: float
    kind: str
    what: str
    colour: tuple[int, int, int]

    @property
    def text(self) -> str:
        """When and what."""
        return f"{clock(self.time_s)}  {self.what}"


@dataclass(frozen=True)
class AlarmSpan:
    """An alarm from its first frame (simulated s) until it was over, inf if never; names are those of the DBC."""

    start_s: float
    end_s: float
    node: str
    code: str
    priority: str


def alarm_spans(trace: Trace) -> list[AlarmSpan]:
    """Every alarm once, in order of time."""
    standing: dict[tuple[str, int], AlarmEvent] = {}
    spans = []
    for alarm in trace.alarms:
        key = alarm.node, alarm.instance
        if alarm.state != "Inactive":
            standing.setdefault(key, alarm)
        elif key in standing:
            spans.append(_span(standing.pop(key), alarm.time_s))
    spans += [_span(alarm, math.inf) for alarm in standing.values()]
    return sorted(spans, key=lambda span: (span.start_s, span.end_s, span.code))


def _span(raised: AlarmEvent, end_s: float) -> AlarmSpan:
    return AlarmSpan(raised.time_s, end_s, raised.node, raised.code, raised.priority)


def without_reminders(alarms: Iterable[AlarmEvent]) -> list[AlarmEvent]:
    """Each alarm raised, confirmed and over once: that a node repeats it while it stands says nothing new."""
    told: dict[tuple[str, int], set[str]] = {}
    found = []
    for alarm in alarms:
        states = told.setdefault((alarm.node, alarm.instance), set())
        if alarm.state == "Inactive":
            states.clear()
        elif alarm.state in states:
            continue
        states.add(alarm.state)
        found.append(alarm)
    return found


def notes(trace: Trace, *, running: bool = False) -> list[Note]:
    """What happened, in order of time: alarms, injected faults, meals, changes of the firmware's state.

    Args:
        trace: the run.
        running: it is still on, so that nobody knows how long a fault will last.
    """
    found = [
        Note(
            alarm.time_s,
            "ALARM",
            f"{alarm.node} {alarm.code} {'over' if alarm.state == 'Inactive' else alarm.state.lower()}"
            f" ({alarm.priority.lower()})",
            GREY if alarm.state == "Inactive" else PRIORITY_COLOURS.get(alarm.priority, GREY),
        )
        for alarm in without_reminders(trace.alarms)
    ]
    for span in trace.fault_spans():
        duration = "" if running else f" for {round((span.end_s - span.start_s) / 60)} min"
        found.append(Note(span.start_s, "FAULT", f"{span.label}{duration}", RED))
    found += [Note(meal.time_s, "MEAL", f"{meal.carbs_g:.0f} g of carbohydrate", GREEN) for meal in trace.meals]
    for start, text in state_changes(trace, "CtrlState", "CTRL_Status"):
        if text:
            found.append(Note(start, "STATE", f"firmware {text}", STATE_COLOURS["CtrlState"].get(text, GREY)))
    return sorted(found, key=lambda note: note.time_s)


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


def hue(name: str) -> tuple[int, int, int]:
    """A calm colour for a name without a meaning of its own (strategies)."""
    palette = [(96, 125, 139), (121, 134, 203), (77, 150, 170), (141, 110, 99), (130, 150, 110)]
    return palette[sum(name.encode()) % len(palette)]


def title(info: Mapping[str, Any]) -> str:
    """One line that says which run this is."""
    parts = [str(info[key]) for key in ("patient", "strategy", "scenario") if info.get(key)]
    if info.get("seed") is not None:
        parts.append(f"seed {info['seed']}")
    return ", ".join(parts) or "pumpbench run"
