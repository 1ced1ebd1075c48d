"""What the frames of a run say, as columns of physical values: one row per step.

`Trace.from_frames` picks one value of each signal per step and adds what spans several frames: doses commanded and
delivered per step, and the events (`pumpbench.events`).

The device's bus (channel 0) is what counts, because it is what the firmware saw. Only what the other side alone can
know (the pump's totals, the plant's truth, the pump's own alarms, the injected faults) is taken from the plant's bus
when a gateway lies between the two.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from can_bus import codec
from can_bus.lockstep import STEP_SECONDS
from pumpbench import events
from pumpbench.events import AlarmEvent, FaultEvent, FaultSpan, MealEvent
from pumpbench.frames import Frames
from pumpbench.signals import Decoded, decode, labels, signals

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

PARQUET_NAME: Final = "trace.parquet"
HORMONES: Final = ("Insulin", "Pramlintide")

_OF_THE_RUN: Final = ("PLANT_Truth", "FAULT_Inject")
"""Messages that tell of the run; the device need not see them."""


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
            alarms=events.alarms(frames, builder.source),
            faults=events.faults(frames),
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
        """When which fault was at work, as far as FAULT_Inject tells."""
        return events.fault_spans(self.faults, float(self.time_s[-1]) if len(self) else 0.0)

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
        told = {key: [asdict(event) for event in getattr(self, key)] for key in ("alarms", "faults", "meals")}
        metadata = {"pumpbench.info": json.dumps(self.info), "pumpbench.events": json.dumps(told)}
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
            told = json.loads(metadata[b"pumpbench.events"])
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
            alarms=[AlarmEvent(**event) for event in told["alarms"]],
            faults=[FaultEvent(**event) for event in told["faults"]],
            meals=[MealEvent(**event) for event in told["meals"]],
            info=info,
            units={name: note.get(b"unit", b"").decode() for name, note in notes.items()},
            comments={name: note.get(b"comment", b"").decode() for name, note in notes.items()},
        )


_INDEX: Final = ("step", "time_s")


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
            decoded = decode(self.frames, message.name, None if message.name in _OF_THE_RUN else 0)
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


def _meals(builder: _Builder) -> list[MealEvent]:
    carbs = builder.columns.get("TruthMealCarbs")
    if carbs is None:
        return []
    rows = np.flatnonzero(np.nan_to_num(carbs) > 0)
    return [MealEvent(float(builder.steps[row] * STEP_SECONDS), float(carbs[row])) for row in rows]
