"""What happened in a run: alarms, injected faults and meals, as the frames tell."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter

from can_bus import codec
from can_bus.lockstep import STEP_SECONDS
from pumpbench.frames import Frames
from pumpbench.signals import decode, labels


@dataclass(frozen=True)
class AlarmEvent:
    """An alarm that changed its state; the fields but time and instance are names of the DBC.

    Attributes:
        time_s: simulated seconds.
        node: who raises it, CTRL or PUMP.
        code: what it is about.
        state: Pending, Confirmed, Snoozed or Inactive.
        priority: Info, Low, Medium or High.
        instance: number that tells it from others of the same node.
    """

    time_s: float
    node: str
    code: str
    state: str
    priority: str
    instance: int


@dataclass(frozen=True)
class FaultEvent:
    """An announcement of FAULT_Inject; kind and target are names of the DBC.

    Attributes:
        time_s: simulated seconds.
        kind: e.g. Drop; None = the fault is over.
        target: whose frames.
        message: name of the message it acts on, "" for all of the target.
        count: for how many frames, 0 = until cleared.
        param: kind-specific number.
    """

    time_s: float
    kind: str
    target: str
    message: str
    count: int
    param: int = 0


@dataclass(frozen=True)
class MealEvent:
    """True carbohydrate eaten from `time_s` on (s), in g."""

    time_s: float
    carbs_g: float


@dataclass(frozen=True)
class FaultSpan:
    """A stretch of simulated time [start_s, end_s) in which a fault was at work; `label` says which."""

    label: str
    start_s: float
    end_s: float


def _boots(frames: Frames) -> list[float]:
    """When the device has started anew, as it said."""
    decoded = decode(frames, "HB_CTRL", 0)
    boot_up = codec.choice("HB_CTRL", "NmtCtrl", "BootUp")
    rows = decoded.rows[decoded.raw["NmtCtrl"] == boot_up]
    return [float(time_s) for time_s in frames.time_s[rows]]


def alarms(frames: Frames, source: int) -> list[AlarmEvent]:
    """Every change of an alarm of CTRL and PUMP, in order of time.

    Args:
        frames: the record.
        source: the channel on which the pump speaks for itself.
    """
    found = _alarms_of(frames, "CTRL", 0, _boots(frames)) + _alarms_of(frames, "PUMP", source)
    return sorted(found, key=lambda event: event.time_s)


def _alarms_of(frames: Frames, node: str, channel: int, boots: Sequence[float] = ()) -> list[AlarmEvent]:
    """The alarms of a node; one that starts anew no longer raises what it raised in an earlier life."""
    message, prefix = f"{node}_Alarm", f"{node.capitalize()}Alarm"
    decoded = decode(frames, message, channel)
    codes, states, priorities = (
        [labels(message, prefix + part).get(raw, str(raw)) for raw in decoded.raw[prefix + part].tolist()]
        for part in ("Code", "State", "Priority")
    )
    times, instances = frames.time_s[decoded.rows].tolist(), decoded.raw[f"{prefix}Instance"].tolist()
    said = [
        AlarmEvent(time_s, node, code, state, priority, instance)
        for time_s, code, state, priority, instance in zip(times, codes, states, priorities, instances, strict=True)
    ]
    stream = sorted(
        [*((event.time_s, event) for event in said), *((time_s, None) for time_s in boots)], key=itemgetter(0)
    )
    found: list[AlarmEvent] = []
    last: dict[int, AlarmEvent] = {}
    for time_s, event in stream:
        if event is None:
            standing = (before for before in last.values() if before.state != "Inactive")
            found += [replace(before, time_s=time_s, state="Inactive") for before in standing]
            last.clear()
            continue
        before = last.get(event.instance)
        last[event.instance] = event
        if event.state != "Inactive" if before is None else replace(before, time_s=time_s) != event:
            found.append(event)
    return found


def faults(frames: Frames) -> list[FaultEvent]:
    """Every announcement of FAULT_Inject, in order of time."""
    targets, kinds = (labels("FAULT_Inject", name) for name in ("FaultTarget", "FaultKind"))
    by_id = {message.can_id: message.name for message in codec.messages().values()}
    found: dict[int, list[tuple[int, FaultEvent]]] = {}
    for channel in (0, 1):
        decoded = decode(frames, "FAULT_Inject", channel)
        raw = {name: column.tolist() for name, column in decoded.raw.items()}
        for index, row in enumerate(decoded.rows.tolist()):
            ident = raw["FaultCanId"][index]
            event = FaultEvent(
                time_s=float(frames.time_s[row]),
                kind=kinds.get(raw["FaultKind"][index], str(raw["FaultKind"][index])),
                target=targets.get(raw["FaultTarget"][index], str(raw["FaultTarget"][index])),
                message="" if ident == 0 else by_id.get(ident, f"0x{ident:03X}"),
                count=raw["FaultCount"][index],
                param=raw["FaultParam"][index],
            )
            found.setdefault(channel, []).append((int(frames.step[row]), event))
    return sorted(_without_echoes(found.get(0, []), found.get(1, [])), key=lambda event: event.time_s)


def _without_echoes(device: list[tuple[int, FaultEvent]], plant: list[tuple[int, FaultEvent]]) -> list[FaultEvent]:
    """Events of both buses, once each: the same announcement in the same step on the other bus is the same event."""

    def key(step: int, event: FaultEvent) -> tuple[int, FaultEvent]:
        return step, replace(event, time_s=0.0)

    events = [event for _, event in plant]
    echoes = Counter(key(*each) for each in plant)
    for step, event in device:
        if echoes[key(step, event)]:
            echoes[key(step, event)] -= 1
        else:
            events.append(event)
    return events


def fault_spans(faults: Sequence[FaultEvent], end_of_run: float) -> list[FaultSpan]:
    """When which fault was at work, as far as FAULT_Inject tells until the end of the run (simulated seconds).

    A report is drawn as the step it was made in; a count of 0 lasts until the target's fault is cleared (kind None)
    or the run ends. Announcements of the same fault that touch each other are one span.
    """
    spans: list[FaultSpan] = []
    for index, event in enumerate(faults):
        if event.kind == "None":
            continue
        start = STEP_SECONDS * (event.time_s // STEP_SECONDS)
        end = start + STEP_SECONDS
        if event.count == 0:
            clears = (
                later.time_s
                for later in faults[index + 1 :]
                if later.kind == "None" and later.target == event.target and later.message in ("", event.message)
            )
            end = next(clears, end_of_run)
        spans.append(FaultSpan(f"{event.kind} {event.message or event.target}", start, min(end, end_of_run)))
    return _joined(spans)


def _joined(spans: Iterable[FaultSpan]) -> list[FaultSpan]:
    result: dict[str, list[FaultSpan]] = {}
    for span in sorted(spans, key=lambda span: (span.label, span.start_s)):
        known = result.setdefault(span.label, [])
        if known and span.start_s <= known[-1].end_s:
            known[-1] = FaultSpan(span.label, known[-1].start_s, max(known[-1].end_s, span.end_s))
        else:
            known.append(span)
    return sorted((span for known in result.values() for span in known), key=lambda span: span.start_s)
