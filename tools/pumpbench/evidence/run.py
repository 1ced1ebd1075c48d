"""A run folder as evidence: everything is worked out anew from the frames, and held against what the folder says.

The frames in bus.log are what was recorded, and `trace_sha256` says whether they still are. Outcome, hazards, events
and pictures are computed from them; metrics.json and trace.parquet only have to agree.
"""

from __future__ import annotations

import enum
import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from can_bus.lockstep import STEP_SECONDS
from pumpbench.identity import other_dbc
from pumpbench.outcome import measure
from pumpbench.runfolder import FILES, RUN, RunFolder, RunFolderError, plain
from pumpbench.story import AlarmSpan, alarm_spans, clock, state_changes
from pumpbench.trace import Trace

RELATIVE_ERROR = 1e-9
"""Of numbers in metrics.json that are the same: another version of numpy may sum in another order."""


class Level(enum.StrEnum):
    """How a reader should take something: as it should be, to be looked at, wrong."""

    GOOD = "good"
    OPEN = "open"
    BAD = "bad"


class Verdict(NamedTuple):
    """What came of a run, in a line."""

    level: Level
    text: str


class Device(BaseModel):
    """What a device says of itself; see `pumpbench.identity.stated`."""

    version: str | None
    build: int | None
    protocol: str | None


class Info(BaseModel):
    """The keys of run.json that the page shows; those with a default are missing where a bus was only listened to."""

    model_config = ConfigDict(frozen=True)

    complete: Literal[True]
    trace_sha256: str
    frames: int
    pumpbench: str | None = None
    protocol: str | None = None
    dbc_crc32: str | None = None
    python: str | None = None
    packages: dict[str, str] = {}
    firmware: str | None = None
    firmware_sha256: dict[str, str] = {}
    device: Device | None = None
    patient: str | None = None
    physiology: str | None = None
    pramlintide: str | None = None
    variability: tuple[str, ...] = ()
    strategy: str | None = None
    scenario: str | None = None
    days: float | None = None
    steps: int | None = None
    seed: int | None = None
    sensor: str | None = None
    bus: str | None = None
    free_running: bool = False
    faults: tuple[dict[str, Any], ...] = ()
    parameters: dict[str, str] = {}


class File(NamedTuple):
    """A file of a run folder, with its size in bytes."""

    name: str
    size: int
    sha256: str


@dataclass(frozen=True)
class Evidence:
    """One run.

    Attributes:
        folder: as it was given.
        info: of run.json.
        files: all of the folder's.
        doubts: what does not agree within the folder; nothing, if it is as it was written.
        trace: from the frames; None where these are not those that were recorded.
        metrics: the same of what metrics.json should hold; empty then.
    """

    folder: Path
    info: Info
    files: tuple[File, ...]
    doubts: tuple[str, ...]
    trace: Trace | None = None
    metrics: Mapping[str, Any] = field(default_factory=dict)

    @property
    def safety(self) -> Mapping[str, Any]:
        """Counters, ledger and hazards; empty where the frames are not those that were recorded."""
        found: Mapping[str, Any] = self.metrics.get("safety", {})
        return found

    @property
    def hazards(self) -> dict[str, int | None]:
        """H1 to H8 with their counts; None: not judged."""
        return dict(self.safety.get("hazards", {}))

    @property
    def counted(self) -> int | None:
        """The sum of them; None where one was not judged."""
        counts = list(self.hazards.values())
        return sum(count or 0 for count in counts) if counts and None not in counts else None

    @property
    def alarms(self) -> list[AlarmSpan]:
        """Every alarm from when it was raised to when it was over."""
        return [] if self.trace is None else alarm_spans(self.trace)

    @property
    def uncertain_minutes(self) -> float:
        """How long the device did not know whether a bolus was given (CtrlState DeliveryUncertain), simulated."""
        if self.trace is None:
            return 0.0
        changes = state_changes(self.trace, "CtrlState", "CTRL_Status")
        ends = [time_s for time_s, _ in changes[1:]] + [float(self.trace.time_s[-1])]
        spans = zip(changes, ends, strict=True)
        return sum(end_s - start_s for (start_s, name), end_s in spans if name == "DeliveryUncertain") / 60

    @property
    def verdict(self) -> Verdict:
        """Wrong, if the folder was changed, a hazard was counted or a ledger does not close."""
        if self.doubts:
            return Verdict(Level.BAD, f"not as it was recorded: {'; '.join(self.doubts)}")
        counted = [f"{name} × {count}" for name, count in self.hazards.items() if count]
        broken = [drug for drug, ledger in self.safety["ledger"].items() if not ledger["closes"]]
        texts, level = [], Level.GOOD
        if counted:
            first = self.safety["first_hazards"][0]
            since = clock(first["step"] * STEP_SECONDS)
            texts.append(f"hazards counted: {', '.join(counted)}, the first ({first['hazard']}) at {since}")
        unjudged = [name for name, count in self.hazards.items() if count is None]
        if unjudged:
            level = Level.OPEN
            texts.append(f"not judged: {', '.join(unjudged)}")
        elif not counted:
            texts.append("no hazard counted")
        texts.append(f"the ledger of {' and '.join(broken)} does not close" if broken else "both ledgers close")
        texts.append(_told(self.alarms))
        uncertain = [alarm for alarm in self.alarms if alarm.code == "DeliveryUncertain"]
        if uncertain or self.uncertain_minutes:
            standing = any(math.isinf(alarm.end_s) for alarm in uncertain)
            level = Level.OPEN if standing else level
            since = f" (alarm at {', '.join(clock(alarm.start_s) for alarm in uncertain)})" if uncertain else ""
            texts.append(f"delivery uncertain{since}{', still so at the end' if standing else ''}")
        else:
            texts.append("no delivery uncertain")
        return Verdict(Level.BAD if counted or broken else level, "; ".join(texts))


def _told(alarms: list[AlarmSpan]) -> str:
    high = sum(alarm.priority == "High" for alarm in alarms)
    return f"{len(alarms) or 'no'} alarm{'s' * (len(alarms) != 1)}{f', {high} of high priority' if high else ''}"


def load(path: Path) -> Evidence:
    """Read a run folder and work everything out anew.

    Raises:
        RunFolderError: it is missing, unfinished or damaged, or of another DBC, whose frames mean something else.
    """
    folder = RunFolder.load(path)
    try:
        info = Info.model_validate(folder.info)
    except ValidationError as error:
        problem = error.errors()[0]
        where = ".".join(map(str, problem["loc"]))
        raise RunFolderError(f"{path / RUN}: {where}: {problem['msg']} (found {problem['input']!r})") from None
    foreign = other_dbc(folder.info)
    if foreign is not None:
        its = info.pumpbench or "which it does not say"
        raise RunFolderError(f"{path} {foreign}; take the pumpbench that recorded it ({its})")
    files = tuple(_file(path / name) for name in FILES)
    frames = folder.logged
    if frames.sha256() != info.trace_sha256:
        doubt = (
            f"bus.log was changed: its frames have trace_sha256 {frames.sha256()}, run.json says {info.trace_sha256}"
        )
        return Evidence(path, info, files, (doubt,))
    trace = Trace.from_frames(frames, folder.info)
    metrics = plain(measure(trace, frames))
    unlike = {
        "metrics.json": _unlike(folder.metrics, metrics),
        "trace.parquet": _unlike_traces(folder.trace, trace),
    }
    doubts = [
        f"{name} does not agree with bus.log in {', '.join(places[:5])}{' and more' * (len(places) > 5)}: it was "
        f"changed, or pumpbench {info.pumpbench or '(which?)'} worked it out in another way"
        for name, places in unlike.items()
        if places
    ]
    return Evidence(path, info, files, tuple(doubts), trace, metrics)


def _file(path: Path) -> File:
    with path.open("rb") as file:
        return File(path.name, path.stat().st_size, hashlib.file_digest(file, "sha256").hexdigest())


def _unlike(said: Any, found: Any, name: str = "") -> list[str]:
    """Where two JSON values differ, as paths."""
    if isinstance(said, dict) and isinstance(found, dict):
        keys = dict.fromkeys([*found, *said])
        inner = [_unlike(said.get(key), found.get(key), f"{name}.{key}".strip(".")) for key in keys]
        return [place for places in inner for place in places]
    if isinstance(said, float) and isinstance(found, float):
        return [] if math.isclose(said, found, rel_tol=RELATIVE_ERROR) else [name]
    return [] if said == found else [name]


def _unlike_traces(said: Trace, found: Trace) -> list[str]:
    """Columns and events in which two traces differ, and where what they say of the run does."""
    names = sorted(said.columns.keys() ^ found.columns.keys())
    if not np.array_equal(said.step, found.step):
        names.append("step")
    names += [
        name
        for name in said.columns.keys() & found.columns.keys()
        if not np.array_equal(said.columns[name], found.columns[name], equal_nan=True)
    ]
    names += [name for name in ("alarms", "faults", "meals") if getattr(said, name) != getattr(found, name)]
    return sorted(names) + _unlike(said.info, found.info, "run.json")
