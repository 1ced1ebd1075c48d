"""What differs between two runs, counted and put into words of the domain: frames, glucose, doses, states, alarms."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from can_bus import codec
from can_bus.lockstep import STEP_SECONDS
from pumpbench.comparison.align import Comparison, Kind
from pumpbench.events import AlarmEvent
from pumpbench.signals import labels
from pumpbench.trace import Trace

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]


class MessageCount(NamedTuple):
    """How many frames of a message differ, of the frames of A and of B that were compared."""

    message: str
    changed: int
    missing: int
    extra: int
    moved: int
    frames: tuple[int, int]


def per_message(comparison: Comparison) -> list[MessageCount]:
    """The messages that differ, in order of their first difference."""
    counts: dict[int, dict[str, int]] = {}
    for difference in comparison.differences:
        frames, row = comparison.place(difference)
        kinds = counts.setdefault(int(frames.can_id[row]), dict.fromkeys(("changed", "missing", "extra", "moved"), 0))
        kinds[difference.kind] += 1
    return [
        MessageCount(
            _name(can_id),
            **kinds,
            frames=(
                int(np.count_nonzero(comparison.a.can_id[comparison.compared[0]] == can_id)),
                int(np.count_nonzero(comparison.b.can_id[comparison.compared[1]] == can_id)),
            ),
        )
        for can_id, kinds in counts.items()
    ]


class Stretch(NamedTuple):
    """Simulated seconds [start_s, end_s) in which a message differs in every step, and how."""

    start_s: float
    end_s: float
    kind: Kind


def stretches(comparison: Comparison) -> dict[str, list[Stretch]]:
    """When which message differs, in order of their first difference."""
    steps: dict[str, dict[int, Kind]] = {}
    for difference in comparison.differences:
        frames, row = comparison.place(difference)
        steps.setdefault(_name(int(frames.can_id[row])), {}).setdefault(int(frames.step[row]), difference.kind)
    result: dict[str, list[Stretch]] = {}
    for message, kinds in steps.items():
        runs = result[message] = []
        for step, kind in sorted(kinds.items()):
            start_s, end_s = float(step * STEP_SECONDS), float((step + 1) * STEP_SECONDS)
            if runs and runs[-1].end_s == start_s and runs[-1].kind == kind:
                runs[-1] = runs[-1]._replace(end_s=end_s)
            else:
                runs.append(Stretch(start_s, end_s, kind))
    return result


def _name(can_id: int) -> str:
    known = codec.messages_by_id().get(can_id)
    return f"0x{can_id:X}" if known is None else known.name


class Quantity(NamedTuple):
    """A column of the trace that a reader asks about first; `message` where its values are names."""

    what: str
    column: str
    message: str = ""
    totalled: bool = False  # per step, so that its sum over the run means something


QUANTITIES: Final = (
    Quantity("glucose", "TruthGlucose"),
    Quantity("CGM", "GlucoseConc"),
    Quantity("insulin rate commanded", "InsulinRateCommanded"),
    Quantity("insulin bolus commanded", "InsulinBolusCommanded", totalled=True),
    Quantity("insulin delivered", "InsulinDelivered", totalled=True),
    Quantity("pramlintide rate commanded", "PramRateCommanded"),
    Quantity("pramlintide bolus commanded", "PramBolusCommanded", totalled=True),
    Quantity("pramlintide delivered", "PramDelivered", totalled=True),
    Quantity("insulin on board", "InsulinOnBoard"),
    Quantity("state of the firmware", "CtrlState", "CTRL_Status"),
    Quantity("mode of the firmware", "CtrlMode", "CTRL_Status"),
    Quantity("limits at work", "LimiterBits"),
    Quantity("state of the pump", "PumpState", "PUMP_Status"),
    Quantity("state of the sensor", "CgmState", "CGM_Reading"),
)


@dataclass(frozen=True)
class Parting:
    """Where a quantity first differs, and how far it goes.

    Attributes:
        what: in words.
        unit: "" for names and counts.
        time_s: simulated seconds of the first difference.
        a, b: the values there; a number, a name, or None for "no value".
        steps: how many steps differ.
        largest: (|a - b|, simulated seconds), of quantities with a value on both sides.
        totals: of A and B over the steps both have; None where a sum means nothing.
    """

    what: str
    unit: str
    time_s: float
    a: float | str | None
    b: float | str | None
    steps: int
    largest: tuple[float, float] | None = None
    totals: tuple[float, float] | None = None


def partings(a: Trace, b: Trace) -> list[Parting]:
    """The quantities that differ over the steps both runs have, and the alarms, in order of time."""
    _, in_a, in_b = np.intersect1d(a.step, b.step, return_indices=True)
    found: list[Parting] = []
    for quantity in QUANTITIES:
        if quantity.column not in a.columns and quantity.column not in b.columns:
            continue
        ours, theirs = a.get(quantity.column)[in_a], b.get(quantity.column)[in_b]
        rows = np.flatnonzero(~((ours == theirs) | (np.isnan(ours) & np.isnan(theirs))))
        if len(rows):
            found.append(_parting(quantity, a.units | b.units, a.time_s[in_a], ours, theirs, rows))
    last = min((float(trace.time_s[-1]) for trace in (a, b) if len(trace)), default=0.0)
    alarms = _alarms([event for event in a.alarms if event.time_s <= last], [e for e in b.alarms if e.time_s <= last])
    return sorted([*found, *alarms], key=lambda parting: parting.time_s)


def _parting(
    quantity: Quantity, units: Mapping[str, str], time_s: Array, ours: Array, theirs: Array, rows: Array
) -> Parting:
    row = int(rows[0])
    names = labels(quantity.message, quantity.column) if quantity.message else None
    apart = np.abs(ours[rows] - theirs[rows])
    known = np.flatnonzero(~np.isnan(apart))
    most = int(known[np.argmax(apart[known])]) if len(known) and names is None else None
    return Parting(
        what=quantity.what,
        unit="" if names is not None else units.get(quantity.column, ""),
        time_s=float(time_s[row]),
        a=_value(float(ours[row]), names),
        b=_value(float(theirs[row]), names),
        steps=len(rows),
        largest=None if most is None else (float(apart[most]), float(time_s[rows[most]])),
        totals=(float(np.nansum(ours)), float(np.nansum(theirs))) if quantity.totalled else None,
    )


def _value(value: float, names: Mapping[int, str] | None) -> float | str | None:
    if math.isnan(value):
        return None
    return value if names is None else names.get(int(value), f"{value:g}")


def _alarms(a: list[AlarmEvent], b: list[AlarmEvent]) -> list[Parting]:
    """The first change of an alarm that the other run does not have there; an instance is but a number."""
    told = [[(event.time_s // 1, f"{event.node} {event.code} {event.state}") for event in events] for events in (a, b)]
    both = min(map(len, told))
    place = next((i for i in range(both) if told[0][i] != told[1][i]), both)
    if place == both and len(told[0]) == len(told[1]):
        return []
    next_ones = [events[place] if place < len(events) else None for events in told]
    time_s = min(each[0] for each in next_ones if each is not None)
    here = [each[1] if each is not None and each[0] == time_s else None for each in next_ones]
    count = len(set(told[0]) ^ set(told[1]))
    return [Parting("alarms", "", time_s, here[0], here[1], count)]


# ---- run.json

CONSEQUENCES: Final = frozenset({"trace_sha256", "frames", "complete"})
"""Of run.json: what follows from the frames and explains nothing."""


class Setting(NamedTuple):
    """A key of run.json, nested ones with a dot, that is not the same in both; None where it is missing."""

    key: str
    a: Any
    b: Any


def settings(a: Mapping[str, Any], b: Mapping[str, Any]) -> list[Setting]:
    """What two runs were asked for, where it differs; empty if one of them is a bare log, which does not say."""
    if not a or not b:
        return []
    ours, theirs = _flat(a), _flat(b)
    return [
        Setting(key, ours.get(key), theirs.get(key))
        for key in [*ours, *(key for key in theirs if key not in ours)]
        if key not in CONSEQUENCES and ours.get(key) != theirs.get(key)
    ]


def _flat(info: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    result: dict[str, Any] = {}
    for key, value in info.items():
        if isinstance(value, Mapping):
            result |= _flat(value, f"{prefix}{key}.")
        else:
            result[prefix + key] = value
    return result


def lines(setting: Setting) -> list[tuple[str, str]]:
    """The values of a setting as texts of A and B; of lists (faults) what the other one lacks, one a line."""
    if not isinstance(setting.a, list) or not isinstance(setting.b, list):
        return [(_text(setting.a), _text(setting.b))]
    ours = [_text(each) for each in setting.a if each not in setting.b]
    theirs = [_text(each) for each in setting.b if each not in setting.a]
    return list(itertools.zip_longest(ours, theirs, fillvalue="-"))


def _text(value: Any) -> str:
    if value is None:
        return "-"
    return value if isinstance(value, str) else json.dumps(value)
