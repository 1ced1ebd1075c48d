"""What the frames of a run say, as columns of physical values: one row per step.

`decode` turns all frames of a message into arrays at once; `Trace.from_frames` picks one value per step and adds what
spans several frames: doses commanded and delivered per step, alarm and fault events, meals.

The device's bus (channel 0) is what counts, because it is what the firmware saw. Only what the other side alone can
know (the pump's totals, the plant's truth, the pump's own alarms, the injected faults) is taken from the plant's bus
when a gateway lies between the two.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

import dbc
from can_bus import codec
from can_bus.lockstep import STEP_SECONDS
from pumpbench.capture import Frames

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

PARQUET_NAME: Final = "trace.parquet"
_NO_VALUE: Final = frozenset({"SNA", "Error"})
HORMONES: Final = ("Insulin", "Pramlintide")


@dataclass(frozen=True)
class Signal:
    """A signal of the DBC, ready for arrays.

    Attributes:
        name: as in the DBC.
        unit: "" for none.
        comment: the DBC's comment.
        choices: names of raw codes (also of SNA and Error).
        invalid: raw codes that say "no value".
        is_enumeration: whether its values are names, not a quantity.
        page: value of the multiplexer this signal belongs to, or None.
    """

    name: str
    unit: str
    comment: str
    choices: Mapping[int, str]
    invalid: tuple[int, ...]
    is_enumeration: bool
    page: int | None
    shift: int
    mask: int
    sign: int
    scale: float
    offset: float

    def raw(self, words: Array) -> Array:
        """Raw values as signed 64-bit integers, from payloads as 64-bit words."""
        bits = (words >> np.uint64(self.shift)) & np.uint64(self.mask)
        return (bits.astype("i8") ^ self.sign) - self.sign

    def physical(self, raw: Array) -> Array:
        """Physical values; NaN where the raw code says that there is none."""
        values = raw * self.scale + self.offset
        values = values.astype("f8")
        if self.invalid:
            values[np.isin(raw, self.invalid)] = np.nan
        return values

    def text(self, raw: int) -> str:
        """A raw value in physical units, with the unit and no more digits than the scale has."""
        value = f"{raw * self.scale + self.offset:.10g}"
        return f"{value} {self.unit}" if self.unit else value

    def label(self, code: float) -> str:
        """The name of a value of an enumeration, or the number as text; "" for NaN."""
        return "" if math.isnan(code) else self.choices.get(int(code), f"{code:g}")


@functools.cache
def signals(message: str) -> dict[str, Signal]:
    """The signals of a message by name, without CHECKSUM and COUNTER."""
    table = dbc.load().get_message_by_name(message)
    packed = codec.message(message)
    result = {}
    for signal in table.signals:
        if signal.name not in packed.fields:
            continue
        packing = packed.fields[signal.name]
        choices = {int(code): str(label) for code, label in (signal.choices or {}).items()}
        marked = signal.dbc.attributes.get("SigInvalidRaw")
        invalid = {code for code, label in choices.items() if label in _NO_VALUE}
        if marked is not None and marked.value != -1:
            invalid.add(int(marked.value))
        result[signal.name] = Signal(
            name=signal.name,
            unit="" if signal.unit in (None, "-") else str(signal.unit),
            comment=str(signal.comment or ""),
            choices=choices,
            invalid=tuple(sorted(invalid)),
            is_enumeration=bool(set(choices.values()) - _NO_VALUE),
            page=signal.multiplexer_ids[0] if signal.multiplexer_ids else None,
            shift=packing.shift,
            mask=packing.mask,
            sign=packing.sign,
            scale=signal.scale,
            offset=signal.offset,
        )
    return result


def labels(message: str, signal: str) -> Mapping[int, str]:
    """Names of the raw codes of an enumeration."""
    return signals(message)[signal].choices


class Decoded(NamedTuple):
    """All believable frames of one message.

    Attributes:
        rows: their positions in `Frames`.
        raw: signal -> raw integers.
        valid: signal -> mask of the frames that carry the signal (all, unless it is multiplexed).
    """

    rows: Array
    raw: dict[str, Array]
    valid: dict[str, Array]


def decode(frames: Frames, message: str, channel: int | None = None) -> Decoded:
    """Decode every frame of a message that passes its checks (id, length, checksum).

    Args:
        frames: the record.
        message: name in the DBC.
        channel: only this bus; None for all.
    """
    packed = codec.message(message)
    mask = (frames.can_id == packed.can_id) & frames.intact
    if channel is not None:
        mask &= frames.channel == channel
    rows = np.flatnonzero(mask)
    words = frames.word[rows]
    table = signals(message)
    raw = {name: signal.raw(words) for name, signal in table.items()}
    always = np.ones(len(rows), bool)
    valid = {
        name: always if signal.page is None or packed.selector is None else raw[packed.selector] == signal.page
        for name, signal in table.items()
    }
    return Decoded(rows, raw, valid)


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


@dataclass(eq=False)
class Trace:
    """A run, one row per step.

    Attributes:
        columns: by signal name (`PUMP_BolusState`: with suffix `[Insulin]` or `[Pramlintide]`); physical values as
            float64, NaN where the step had none; enumerations as their raw code.
        step: sampling instant k.
        time_s: 300 k, simulated seconds.
        units, comments: of each column.
        alarms, faults, meals: events in order of time.
        info: what run.json says of the run.
    """

    columns: dict[str, Array]
    step: Array
    time_s: Array
    alarms: list[AlarmEvent] = field(default_factory=list)
    faults: list[FaultEvent] = field(default_factory=list)
    meals: list[MealEvent] = field(default_factory=list)
    info: dict[str, Any] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)
    comments: dict[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.step)

    def get(self, name: str) -> Array:
        """A column, or NaNs when no frame ever carried it."""
        column = self.columns.get(name)
        return np.full(len(self), np.nan) if column is None else column

    def basal_delivered(self, drug: str) -> Array:
        """Rate the pump delivered besides boluses, as a mean over each step.

        Args:
            drug: "Insulin" (result in U/h) or "Pram" (ug/h).
        """
        bolus = self.get(f"{drug}BolusDelivered")
        rest = self.get(f"{drug}Delivered") - np.where(np.isnan(bolus), 0.0, bolus)
        rate: Array = np.round(np.maximum(rest, 0.0) * 3600 / STEP_SECONDS, 6)
        return rate

    @classmethod
    def from_frames(cls, frames: Frames, info: Mapping[str, Any] | None = None) -> Trace:
        """Decode a record.

        Args:
            frames: as `Capture.finish` gives them.
            info: what run.json will hold.
        """
        builder = _Builder(frames)
        builder.signals()
        builder.rates()
        builder.doses()
        return cls(
            columns=builder.columns,
            step=builder.steps,
            time_s=builder.steps * float(STEP_SECONDS),
            alarms=_alarms(frames, builder.source),
            faults=_faults(frames),
            meals=_meals(builder),
            info=dict(info or {}),
            units=builder.units,
            comments=builder.comments,
        )

    def between(self, start_s: float, end_s: float) -> Trace:
        """The steps of a stretch of simulated time, with the events that lie in it.

        Alarms that were raised before are part of it as if raised at its start, because they still hold.
        """
        rows = (self.time_s >= start_s) & (self.time_s <= end_s)
        standing: dict[tuple[str, int], AlarmEvent] = {}
        for alarm in self.alarms:
            if alarm.time_s < start_s:
                standing[alarm.node, alarm.instance] = replace(alarm, time_s=start_s)
        standing = {key: alarm for key, alarm in standing.items() if alarm.state != "Inactive"}
        return replace(
            self,
            columns={name: column[rows] for name, column in self.columns.items()},
            step=self.step[rows],
            time_s=self.time_s[rows],
            alarms=[*standing.values(), *(alarm for alarm in self.alarms if start_s <= alarm.time_s <= end_s)],
            faults=[fault for fault in self.faults if start_s <= fault.time_s <= end_s],
            meals=[meal for meal in self.meals if start_s <= meal.time_s <= end_s],
        )

    def fault_spans(self) -> list[FaultSpan]:
        """When which fault was at work, as far as FAULT_Inject tells.

        A report is drawn as the step it was made in; a count of 0 lasts until the target's fault is cleared (kind None)
        or the run ends. Announcements of the same fault that touch each other are one span.
        """
        end_of_run = float(self.time_s[-1]) if len(self) else 0.0
        spans: list[FaultSpan] = []
        for index, event in enumerate(self.faults):
            if event.kind == "None":
                continue
            start = STEP_SECONDS * (event.time_s // STEP_SECONDS)
            end = start + STEP_SECONDS
            if event.count == 0:
                clears = (
                    later.time_s
                    for later in self.faults[index + 1 :]
                    if later.kind == "None" and later.target == event.target and later.message in ("", event.message)
                )
                end = next(clears, end_of_run)
            spans.append(FaultSpan(f"{event.kind} {event.message or event.target}", start, min(end, end_of_run)))
        return _joined(spans)

    def save(self, path: Path) -> None:
        """Write the trace as parquet, with unit and comment as metadata of each column, events and info of the file.

        Raises:
            OSError: the file cannot be written.
        """
        import pyarrow as pa  # noqa: PLC0415
        import pyarrow.parquet as pq  # noqa: PLC0415

        arrays, schema = [pa.array(self.step.astype("i4")), pa.array(self.time_s)], []
        schema.append(pa.field("step", pa.int32(), metadata={"comment": "sampling instant k"}))
        schema.append(pa.field("time_s", pa.float64(), metadata={"unit": "s", "comment": "simulated time"}))
        for name, column in self.columns.items():
            arrays.append(pa.array(column, from_pandas=True))
            notes = {"unit": self.units.get(name, ""), "comment": self.comments.get(name, "")}
            schema.append(pa.field(name, pa.float64(), metadata=notes))
        events = {key: [asdict(event) for event in getattr(self, key)] for key in ("alarms", "faults", "meals")}
        metadata = {"pumpbench.info": json.dumps(self.info), "pumpbench.events": json.dumps(events)}
        pq.write_table(pa.table(arrays, schema=pa.schema(schema, metadata=metadata)), path, compression="zstd")

    @classmethod
    def load(cls, path: Path) -> Trace:
        """Read a trace back.

        Args:
            path: a run folder, or its parquet file.

        Raises:
            FileNotFoundError: no such file.
            ValueError: the file is no trace; the text names it.
        """
        import pyarrow as pa  # noqa: PLC0415
        import pyarrow.parquet as pq  # noqa: PLC0415

        path = Path(path)
        file = path / PARQUET_NAME if path.is_dir() else path
        if not file.is_file():
            raise FileNotFoundError(f"{file} is missing")
        try:
            table = pq.read_table(file)
            metadata = table.schema.metadata or {}
            info = json.loads(metadata[b"pumpbench.info"])
            events = json.loads(metadata[b"pumpbench.events"])
            columns = {
                name: table.column(name).to_numpy().astype("f8") for name in table.column_names if name not in _INDEX
            }
            step, time_s = (table.column(name).to_numpy() for name in _INDEX)
        except (pa.ArrowException, KeyError, ValueError) as error:
            raise ValueError(f"{file} is not a trace of pumpbench: {error}") from None
        notes = {name: table.schema.field(name).metadata or {} for name in columns}
        return cls(
            columns=columns,
            step=step,
            time_s=time_s,
            alarms=[AlarmEvent(**event) for event in events["alarms"]],
            faults=[FaultEvent(**event) for event in events["faults"]],
            meals=[MealEvent(**event) for event in events["meals"]],
            info=info,
            units={name: note.get(b"unit", b"").decode() for name, note in notes.items()},
            comments={name: note.get(b"comment", b"").decode() for name, note in notes.items()},
        )


_INDEX: Final = ("step", "time_s")


def _joined(spans: Iterable[FaultSpan]) -> list[FaultSpan]:
    result: dict[str, list[FaultSpan]] = {}
    for span in sorted(spans, key=lambda span: (span.label, span.start_s)):
        known = result.setdefault(span.label, [])
        if known and span.start_s <= known[-1].end_s:
            known[-1] = FaultSpan(span.label, known[-1].start_s, max(known[-1].end_s, span.end_s))
        else:
            known.append(span)
    return sorted((span for known in result.values() for span in known), key=lambda span: span.start_s)


class _Builder:
    """Collects the columns of a trace."""

    def __init__(self, frames: Frames) -> None:
        self.frames = frames
        first, last = (int(frames.step.min()), int(frames.step.max())) if len(frames) else (0, -1)
        self.steps: Array = np.arange(first, last + 1)
        self.first = first
        self.columns: dict[str, Array] = {}
        self.units: dict[str, str] = {}
        self.comments: dict[str, str] = {}
        self.source = 1 if np.any(frames.channel == 1) else 0  # the bus of the plant's side

    def add(self, name: str, values: Array, unit: str, comment: str) -> None:
        self.columns[name], self.units[name], self.comments[name] = values, unit, comment

    def per_step(self, rows: Array, values: Array) -> Array:
        """One value per step, of the last row in it; NaN where there is none."""
        column = np.full(len(self.steps), np.nan)
        steps = self.frames.step[rows]
        last = np.flatnonzero(np.append(steps[1:] != steps[:-1], True)) if len(steps) else np.zeros(0, int)
        column[steps[last] - self.first] = values[last]
        return column

    def signals(self) -> None:
        present = set(np.unique(self.frames.can_id).tolist())
        for message in codec.messages().values():
            if message.can_id not in present:
                continue
            anywhere = message.name in (
                "PLANT_Truth",
                "FAULT_Inject",
            )  # they tell of the run, the device need not see them
            decoded = decode(self.frames, message.name, None if anywhere else 0)
            if not len(decoded.rows):
                continue
            if message.name == "PUMP_BolusState":
                codes = {label: code for code, label in labels(message.name, "BolusStateHormone").items()}
                for hormone in HORMONES:
                    chosen = decoded.raw["BolusStateHormone"] == codes[hormone]
                    self.message(message.name, decoded, chosen, f"[{hormone}]")
            else:
                self.message(message.name, decoded, np.ones(len(decoded.rows), bool), "")

    def message(self, message: str, decoded: Decoded, chosen: Array, suffix: str) -> None:
        for name, signal in signals(message).items():
            mask = decoded.valid[name] & chosen
            if not mask.any():
                continue
            values = signal.physical(decoded.raw[name][mask])
            self.add(name + suffix, self.per_step(decoded.rows[mask], values), signal.unit, signal.comment)

    def doses(self) -> None:
        """Doses per step: what the device asked for on its bus, and what the pump says it delivered on its own."""
        totals = decode(self.frames, "PUMP_Delivered", self.source)
        states = decode(self.frames, "PUMP_BolusState", self.source)
        commands = decode(self.frames, "PUMP_BolusCmd", 0)
        boot = self.per_step(totals.rows, totals.raw["PumpBootCount"].astype("f8")) if len(totals.rows) else None
        drugs = (
            ("Insulin", "InsulinTotal", "InsulinBolus", "U"),
            ("Pram", "PramTotal", "PramlintideBolus", "ug"),
        )
        for hormone, (short, total, bolus, unit) in zip(HORMONES, drugs, strict=True):
            if boot is not None:
                values = signals("PUMP_Delivered")[total].physical(totals.raw[total])
                delivered = _increments(self.per_step(totals.rows, values), boot)
                self.add(f"{short}Delivered", delivered, unit, f"{hormone} delivered from this step to the next")
            code = next(c for c, label in labels("PUMP_BolusState", "BolusStateHormone").items() if label == hormone)
            scale = signals("PUMP_BolusCmd")[bolus].scale
            chosen = states.raw["BolusStateHormone"] == code
            if chosen.any():
                rows = states.rows[chosen]
                ids = self.per_step(rows, states.raw["BolusStateId"][chosen].astype("f8"))
                state = signals("PUMP_BolusState")["BolusDeliveredRaw"]
                amounts = self.per_step(rows, state.physical(states.raw["BolusDeliveredRaw"][chosen]) * scale)
                amounts[ids == codec.choice("PUMP_BolusState", "BolusStateId", "SNA")] = 0.0
                self.add(
                    f"{short}BolusDelivered",
                    _increments(amounts, ids),
                    unit,
                    f"{hormone} delivered as bolus from this step to the next",
                )
            asked = self.commanded(commands, hormone, bolus)
            self.add(f"{short}BolusCommanded", asked, unit, f"{hormone} boluses committed in this step, each id once")

    def rates(self) -> None:
        """The rates in words of the pump: what a suspension or a return to the schedule means in U/h and ug/h."""
        operation = self.columns.get("BasalOp")
        if operation is None:
            return
        resume, suspend = (codec.choice("PUMP_BasalCmd", "BasalOp", name) for name in ("ResumeSchedule", "Suspend"))
        stored = self.columns.get("CfgBasal", np.full(1, np.nan))
        schedule = stored[~np.isnan(stored)][-1:]
        for name, signal, resting, unit in (
            ("InsulinRateCommanded", "InsulinRate", float(schedule[0]) if len(schedule) else math.nan, "U/h"),
            ("PramRateCommanded", "PramlintideRate", 0.0, "ug/h"),
        ):
            rate = self.columns.get(signal, np.full(len(self.steps), np.nan)).copy()
            rate[operation == suspend] = 0.0
            rate[operation == resume] = resting
            self.add(name, rate, unit, "Rate asked for: a suspension is 0, a return to the schedule the stored basal")

    def commanded(self, commands: Decoded, hormone: str, signal_name: str) -> Array:
        result = np.zeros(len(self.steps))
        signal = signals("PUMP_BolusCmd")[signal_name]
        chosen = np.flatnonzero(commands.raw["BolusHormone"] == codec.choice("PUMP_BolusCmd", "BolusHormone", hormone))
        program, commit = (codec.choice("PUMP_BolusCmd", "BolusOp", name) for name in ("Program", "Commit"))
        ops, ids = commands.raw["BolusOp"][chosen].tolist(), commands.raw["BolusId"][chosen].tolist()
        doses = signal.physical(commands.raw[signal_name][chosen]).tolist()
        steps = self.frames.step[commands.rows[chosen]].tolist()
        programmed: dict[int, float] = {}
        committed: set[int] = set()
        for step, op, ident, dose in zip(steps, ops, ids, doses, strict=True):
            if op == program:
                programmed[ident] = dose
            elif op == commit and ident not in committed:
                committed.add(ident)
                amount = programmed.get(ident, 0.0) if math.isnan(dose) else dose
                result[step - self.first] += 0.0 if math.isnan(amount) else amount
        return result


def _increments(totals: Array, epochs: Array) -> Array:
    """What a total grows from each row to the next; it starts again from 0 when the epoch changes.

    Over rows without a value the growth is spread evenly; the last row, and rows before the first or after the last
    value, have none (NaN).
    """
    result = np.full(len(totals), np.nan)
    known = np.flatnonzero(~np.isnan(totals) & ~np.isnan(epochs))
    if len(known) < 2:
        return result
    values = totals[known]
    grown = np.where(np.diff(epochs[known]) == 0, np.diff(values), values[1:])
    gaps = np.diff(known)
    result[known[0] : known[-1]] = np.repeat(grown / gaps, gaps)
    return result


def _boots(frames: Frames) -> list[float]:
    """When the device has started anew, as it said."""
    decoded = decode(frames, "HB_CTRL", 0)
    boot_up = codec.choice("HB_CTRL", "NmtCtrl", "BootUp")
    rows = decoded.rows[decoded.raw["NmtCtrl"] == boot_up]
    return [float(time_s) for time_s in frames.time_s[rows]]


def _alarms(frames: Frames, source: int) -> list[AlarmEvent]:
    events: list[AlarmEvent] = []
    for node, channel, prefix in (("CTRL", 0, "CtrlAlarm"), ("PUMP", source, "PumpAlarm")):
        message = f"{node}_Alarm"
        decoded = decode(frames, message, channel)
        names = [labels(message, prefix + part) for part in ("Code", "State", "Priority")]
        inactive = codec.choice(message, f"{prefix}State", "Inactive")
        columns = (decoded.raw[prefix + part].tolist() for part in ("Code", "State", "Priority"))
        instances: list[int | None] = decoded.raw[f"{prefix}Instance"].tolist()
        times = frames.time_s[decoded.rows].tolist()
        stream = list(zip(times, instances, zip(*columns, strict=True), strict=True))
        if node == "CTRL":
            stream = sorted([*stream, *((time_s, None, ()) for time_s in _boots(frames))], key=lambda each: each[0])
        last: dict[int, Any] = {}
        for time_s, instance, now in stream:
            changes: list[tuple[int, Any]] = []
            if instance is None:  # a device that starts anew no longer raises what it raised in an earlier life
                changes = [
                    (old, (code, inactive, rest)) for old, (code, state, rest) in last.items() if state != inactive
                ]
                last.clear()
            else:
                before = last.get(instance)
                last[instance] = now
                if now != before and (before is not None or now[1] != inactive):
                    changes = [(instance, now)]
            for number, values in changes:
                code, state, priority = (each.get(raw, str(raw)) for each, raw in zip(names, values, strict=True))
                events.append(AlarmEvent(time_s, node, code, state, priority, number))
    return sorted(events, key=lambda event: event.time_s)


def _faults(frames: Frames) -> list[FaultEvent]:
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

    def key(step: int, event: FaultEvent) -> tuple[object, ...]:
        return (step, event.kind, event.target, event.message, event.count, event.param)

    events = [event for _, event in plant]
    seen: dict[tuple[object, ...], int] = {}
    for step, event in plant:
        seen[key(step, event)] = seen.get(key(step, event), 0) + 1
    for step, event in device:
        if seen.get(key(step, event), 0) > 0:
            seen[key(step, event)] -= 1
        else:
            events.append(event)
    return events


def _meals(builder: _Builder) -> list[MealEvent]:
    carbs = builder.columns.get("TruthMealCarbs")
    if carbs is None:
        return []
    rows = np.flatnonzero(np.nan_to_num(carbs) > 0)
    return [MealEvent(float(builder.steps[row] * STEP_SECONDS), float(carbs[row])) for row in rows]
