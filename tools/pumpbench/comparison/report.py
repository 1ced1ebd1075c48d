"""A comparison told: the first difference signal by signal with the frames before it, and an account of the rest."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np

from can_bus import codec
from can_bus.faults import clock
from can_bus.frame import Frame
from pumpbench.comparison import account
from pumpbench.comparison.align import Comparison, Difference, Ignore, Kind
from pumpbench.comparison.record import Record
from pumpbench.signals import Signal, frame_text, signals

BEFORE: Final = 5
"""Frames shown before the first difference."""

BUSES: Final = {0: "the device's bus", 1: "the plant's bus"}

WORDS: Final = {
    "changed": "both have it, and it says something else",
    "missing": "only {a} has it",
    "extra": "only {b} has it",
    "moved": "both have it, at different places",
}


class SignalRow(NamedTuple):
    """A signal in both frames, in physical values; "" where a frame does not carry it."""

    name: str
    a: str
    b: str
    unit: str
    differs: bool


def moment(time_s: float) -> str:
    """Simulated time to the microsecond, `1+02:03:04.000250` on the second day."""
    seconds, micros = divmod(round(time_s * 1e6), 1_000_000)
    days = f"{seconds // 86400}+" if seconds >= 86400 else ""
    return f"{days}{seconds // 3600 % 24:02}:{seconds // 60 % 60:02}:{seconds % 60:02}.{micros:06}"


def signal_rows(a: Frame | None, b: Frame | None, ignore: Ignore) -> list[SignalRow]:
    """Two frames of a message signal by signal; empty if neither is one of the DBC."""
    sides = [_signals(frame) for frame in (a, b)]
    rows = []
    for name in dict.fromkeys(name for side in sides for name in side):
        fields = [side.get(name) for side in sides]
        ours, theirs = ("" if field is None else field.text for field in fields)
        known = next(field for field in fields if field is not None)
        differs = a is not None and b is not None and ours != theirs and not _ignored(known, ignore)
        rows.append(SignalRow(name, ours, theirs, known.unit, differs))
    return rows


class _Field(NamedTuple):
    text: str
    unit: str
    signal: Signal | None = None
    can_id: int = 0


def _ignored(field: _Field, ignore: Ignore) -> bool:
    return field.signal is not None and ignore.covers(field.can_id, field.signal.shift, field.signal.page)


def _signals(frame: Frame | None) -> dict[str, _Field]:
    message = None if frame is None else codec.messages_by_id().get(frame.can_id)
    if frame is None or message is None or len(frame.data) != message.length:
        return {}
    table = signals(message.name)
    result = {
        name: _Field(_physical(table[name], raw), table[name].unit, table[name], message.can_id)
        for name, raw in message.unpack(frame.data).items()
    }
    if message.data_ids is not None:
        counter = frame.data[1] & 0xF
        right = codec.protect(message, int.from_bytes(frame.data, "little") & ~0xFFF, counter)[0] == frame.data[0]
        result["COUNTER"] = _Field(str(counter), "")
        result["CHECKSUM"] = _Field("right" if right else "wrong", "")
    return result


def _physical(signal: Signal, raw: int) -> str:
    return signal.choices.get(raw) or f"{raw * signal.scale + signal.offset:.10g}"


@dataclass(frozen=True)
class Report:
    """A comparison in words.

    Attributes:
        comparison: what is told.
        a, b: the records, for what only they know: names and settings.
        names: what the two are called in a sentence.
    """

    comparison: Comparison
    a: Record
    b: Record
    names: tuple[str, str] = ("A", "B")

    # ---- as text

    def text(self) -> str:
        """All of it."""
        parts = [self.headline()]
        warnings = [record.foreign_dbc for record in (self.a, self.b) if record.foreign_dbc]
        parts += ["\n".join(warnings)] if warnings else []
        if self.comparison.first is not None:
            parts += [self.first(), self._counts()]
            parts += [text] if (text := self._partings()) else []
        if not self.comparison.same and (text := self._settings()):
            parts.append(text)
        return "\n\n".join(parts)

    def headline(self) -> str:
        """The verdict in a line."""
        comparison, (a, b) = self.comparison, self.names
        sizes = [len(rows) for rows in comparison.compared]
        if comparison.same:
            apart = ", apart from what is ignored" if comparison.ignore != Ignore() else ""
            return f"the same: {sizes[0]} frames{apart}"
        lone = [f"only {_call(side, self.names)} has {BUSES[each]}" for each, side in comparison.one_sided.items()]
        if comparison.first is None:
            return f"different: {', '.join(lone)}; the {sizes[0]} frames that can be compared are the same"
        count = len(comparison.differences)
        frames = f"{count} difference{'s' * (count != 1)} between {sizes[0]} frames of {a} and {sizes[1]} of {b}"
        more = f"; {comparison.renumbered} more differ in COUNTER alone" if comparison.renumbered else ""
        return f"different: {'; '.join([frames, *lone])}{more}"

    def first(self) -> str:
        """Where the two part: the frames before, the frame in both, and its signals side by side."""
        difference = self.comparison.first
        assert difference is not None
        frames, row = self.comparison.place(difference)
        a, b = self.pair(difference)
        lines = [f"first difference: {self.where(difference)}"]
        before = self.before(difference)
        if before:
            lines += ["", "  before it, the same in both:"]
            lines += [f"    {moment(frames.time_s[each])}  {_line(frames.frame(each))}" for each in before]
        width = max(map(len, self.names))
        lines += ["", f"  here {WORDS[difference.kind].format(a=self.names[0], b=self.names[1])}:"]
        for name, frame, record, place in (
            (self.names[0], a, self.comparison.a, difference.a),
            (self.names[1], b, self.comparison.b, difference.b),
        ):
            if frame is not None and place is not None:
                lines.append(f"  {name:<{width}}  {moment(record.time_s[place])}  {_raw(frame)}")
            else:
                lines.append(f"  {name:<{width}}  -")
        rows = signal_rows(a, b, self.comparison.ignore)
        if rows:
            table: list[tuple[str, ...]] = [("", _message(frames.frame(row)), *self.names, "unit")]
            table += [(">" if each.differs else "", each.name, each.a, each.b, each.unit) for each in rows]
            lines += ["", *_columns(table, indent=2)]
        return "\n".join(lines)

    def where(self, difference: Difference) -> str:
        """Message, instant, turn and bus of a difference."""
        frames, row = self.comparison.place(difference)
        step, turn, channel = int(frames.step[row]), int(frames.turn[row]), int(frames.channel[row])
        in_turn = "calibration" if turn < 0 else f"turn {turn}"
        when = clock(int(frames.time_s[row]))
        return f"{_message(frames.frame(row))} at {when}, step {step}, {in_turn}, can{channel} ({BUSES[channel]})"

    def before(self, difference: Difference) -> list[int]:
        """Positions of the frames before it on its bus, in the record that `Comparison.place` names.

        Without the plant's truth, which is for the record and causes nothing.
        """
        frames, row = self.comparison.place(difference)
        earlier = np.flatnonzero(frames.channel[:row] == frames.channel[row])
        left_out = {*self.comparison.ignore.messages, codec.message("PLANT_Truth").can_id}
        return [int(each) for each in earlier[~np.isin(frames.can_id[earlier], list(left_out))][-BEFORE:]]

    def pair(self, difference: Difference) -> tuple[Frame | None, Frame | None]:
        """The frame in A and in B."""
        a = None if difference.a is None else self.comparison.a.frame(difference.a)
        b = None if difference.b is None else self.comparison.b.frame(difference.b)
        return a, b

    def _counts(self) -> str:
        table: list[tuple[str, ...]] = [
            ("message", "changed", f"only {self.names[0]}", f"only {self.names[1]}", "moved", "of")
        ]
        for count in account.per_message(self.comparison):
            numbers = (count.changed, count.missing, count.extra, count.moved)
            sizes = " and ".join(dict.fromkeys(map(str, count.frames)))
            table.append((count.message, *(str(number) if number else "-" for number in numbers), sizes))
        return "\n".join(["frames that differ, from there to the end:", *_columns(table, indent=2, right=range(1, 5))])

    def _partings(self) -> str:
        found = account.partings(self.a.trace, self.b.trace)
        if not found:
            return ""
        table = [("first difference of", "at", *self.names, "unit", "steps", "largest")]
        totals = []
        for each in found:
            most = "" if each.largest is None else f"{each.largest[0]:.4g} at {clock(int(each.largest[1]))}"
            values = (_told(each.a), _told(each.b))
            table.append((each.what, clock(int(each.time_s)), *values, each.unit, str(each.steps), most))
            if each.totals is not None:
                totals.append((each.what, *(f"{total:.2f}" for total in each.totals), each.unit))
        lines = ["what it came to:", *_columns(table, indent=2, right=(5,))]
        if totals:
            heading = ("in total, of the steps both have", *self.names, "unit")
            lines += ["", *_columns([heading, *totals], indent=2, right=(1, 2))]
        return "\n".join(lines)

    def _settings(self) -> str:
        found = account.settings(self.a.info, self.b.info)
        if not found:
            return "run.json gives no reason: the same settings on both sides" if self.a.info and self.b.info else ""
        table = [("run.json", *self.names)]
        table += [(each.key, *values) for each in found for values in account.lines(each)]
        return "\n".join(_columns(table))

    # ---- as data

    def data(self) -> dict[str, Any]:
        """The same for programs; times in simulated seconds."""
        comparison = self.comparison
        differing = comparison.first is not None
        return {
            "same": comparison.same,
            "a": {"name": self.a.name, "frames": len(comparison.compared[0])},
            "b": {"name": self.b.name, "frames": len(comparison.compared[1])},
            "differences": len(comparison.differences),
            "renumbered": comparison.renumbered,
            "one_sided": {f"can{each}": _call(side, self.names) for each, side in comparison.one_sided.items()},
            "first": self._first_data(comparison.first) if comparison.first is not None else None,
            "messages": [_without_frames(count) for count in account.per_message(comparison)],
            "quantities": [each.__dict__ for each in account.partings(self.a.trace, self.b.trace)] if differing else [],
            "settings": [each._asdict() for each in account.settings(self.a.info, self.b.info)],
        }

    def json(self) -> str:
        """`data` as text."""
        return json.dumps(self.data(), indent=2) + "\n"

    def _first_data(self, difference: Difference) -> dict[str, Any]:
        frames, row = self.comparison.place(difference)
        a, b = self.pair(difference)
        return {
            "kind": difference.kind,
            "message": _message(frames.frame(row)),
            "time_s": float(frames.time_s[row]),
            "step": int(frames.step[row]),
            "turn": int(frames.turn[row]),
            "channel": int(frames.channel[row]),
            "a": None if a is None else _raw(a),
            "b": None if b is None else _raw(b),
            "signals": [each._asdict() for each in signal_rows(a, b, self.comparison.ignore)],
            "before": [_line(frames.frame(each)) for each in self.before(difference)],
        }


class FrameLine(NamedTuple):
    """A frame that differs, in one line."""

    time_s: float
    kind: Kind
    text: str


def frame_lines(report: Report, limit: int) -> list[FrameLine]:
    """The first frames that differ, with their times and what either side says."""
    lines = []
    for difference in report.comparison.differences[:limit]:
        frames, row = report.comparison.place(difference)
        a, b = report.pair(difference)
        rows = signal_rows(a, b, report.comparison.ignore)
        apart = " ".join(f"{each.name}={each.a}|{each.b}" for each in rows if each.differs)
        told = apart or frame_text(frames.frame(row)).partition(" ")[2]
        text = f"{moment(frames.time_s[row])}  can{frames.channel[row]} {_message(frames.frame(row))}  {told}"
        lines.append(FrameLine(float(frames.time_s[row]), difference.kind, text))
    return lines


def _call(side: str, names: Sequence[str]) -> str:
    return names["AB".index(side)]


def _without_frames(count: account.MessageCount) -> dict[str, Any]:
    fields = count._asdict()
    fields["frames_a"], fields["frames_b"] = fields.pop("frames")
    return fields


def _message(frame: Frame) -> str:
    known = codec.messages_by_id().get(frame.can_id)
    return f"frame 0x{frame.identifier:X}" if known is None else known.name


def _raw(frame: Frame) -> str:
    return f"{frame.identifier:03X}#{frame.data.hex().upper()}"


def _line(frame: Frame) -> str:
    return f"{_raw(frame):<20}  {frame_text(frame)}"


def _told(value: float | str | None) -> str:
    if value is None:
        return "-"
    return value if isinstance(value, str) else f"{value:.6g}"


def _columns(rows: Sequence[Sequence[str]], indent: int = 0, right: Iterable[int] = ()) -> list[str]:
    """The rows as lines of a table; `right` are columns of numbers."""
    flush = set(right)
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = (
        "  ".join(
            f"{cell:>{width}}" if column in flush else f"{cell:<{width}}"
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    )
    return [" " * indent + line.rstrip() for line in lines]
