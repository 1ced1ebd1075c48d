"""Where in a run to look closer: a stretch of time around every fault and every alarm that is more than information."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from can_bus.lockstep import STEP_SECONDS
from pumpbench.story import alarm_spans, clock, notes
from pumpbench.trace import Trace

HOUR: Final = 3600.0
BEFORE: Final = 1.0 * HOUR
"""Shown before it begins, in simulated seconds: what was normal."""

AFTER: Final = 1.5 * HOUR
"""Shown after it is over: how the loop comes back."""

ALARM_LONGEST: Final = 1.0 * HOUR
"""An alarm is about its beginning: it may stand for days."""

LONGEST: Final = 8.0 * HOUR
"""A close-up of more is none: of a longer fault the beginning is shown."""

MAX_CLOSE_UPS: Final = 8
"""A reader does not look at more, and each takes 80 kB of the recording. The gravest are kept."""

GRAVITY: Final = {"High": 0, "fault": 1, "Medium": 2, "Low": 3}


@dataclass(frozen=True)
class CloseUp:
    """A stretch of a run that deserves a look of its own.

    Attributes:
        name: when it began and what it was, as `13:00 Drop CGM_Reading, CgmLost`; with its day in a run of several.
        start_s, end_s: simulated seconds.
    """

    name: str
    start_s: float
    end_s: float

    def file_name(self, number: int) -> str:
        """Name of its picture, the close-up being the `number`th of its run."""
        slug = re.sub(r"[^A-Za-z0-9_]+", "-", self.name.replace(":", "")).strip("-")
        return f"fault-{number}-{slug}.png"

    def text(self, trace: Trace) -> str:
        """What happened in it, as a table in Markdown."""
        rows = [
            f"| {clock(note.time_s)} | {note.kind.lower()} | {note.what} |"
            for note in notes(trace)
            if self.start_s <= note.time_s <= self.end_s
        ]
        return "\n".join(["| when | | what |", "|---|---|---|", *rows, ""])


def _step(time_s: float) -> float:
    """The beginning of the step a time lies in."""
    return STEP_SECONDS * (time_s // STEP_SECONDS)


@dataclass(frozen=True)
class _Event:
    start_s: float
    end_s: float
    gravity: int
    label: str


def close_ups(trace: Trace, most: int = MAX_CLOSE_UPS) -> list[CloseUp]:
    """The close-ups of a run in order of time, the gravest when there are more than `most`."""
    if not len(trace):
        return []
    first_s, last_s = float(trace.time_s[0]), float(trace.time_s[-1])
    groups: list[tuple[float, float, list[_Event]]] = []
    for event in sorted(_events(trace), key=lambda event: event.start_s):
        start_s, end_s = event.start_s - BEFORE, min(event.end_s + AFTER, event.start_s - BEFORE + LONGEST)
        if groups:
            since, until, events = groups[-1]
            joined = max(until, end_s)
            if start_s <= until and (joined - since <= LONGEST or event.start_s < until):
                groups[-1] = since, min(joined, since + LONGEST), [*events, event]
                continue
        groups.append((start_s, end_s, [event]))
    gravest = sorted(groups, key=lambda group: min(event.gravity for event in group[2]))[:most]
    return [
        CloseUp(_name(events, last_s), max(_step(start_s), first_s), min(_step(end_s), last_s))
        for start_s, end_s, events in sorted(gravest, key=lambda group: group[0])
    ]


def _events(trace: Trace) -> Iterable[_Event]:
    for span in trace.fault_spans():
        yield _Event(span.start_s, span.end_s, GRAVITY["fault"], span.label)
    for alarm in alarm_spans(trace):
        if alarm.priority in GRAVITY:
            yield _Event(
                alarm.start_s, min(alarm.end_s, alarm.start_s + ALARM_LONGEST), GRAVITY[alarm.priority], alarm.code
            )


def _name(events: list[_Event], last_s: float) -> str:
    labels = list(dict.fromkeys(event.label for event in events))
    more = f" +{len(labels) - 2}" if len(labels) > 2 else ""
    when = clock(events[0].start_s)
    return f"{when if last_s > 24 * HOUR else when.split()[1]} {', '.join(labels[:2])}{more}"
