"""A recorded run without its plant: what the device heard goes into a device once more, and the answers are compared.

The record's own lockstep says what is whose: on the device's bus everything up to a token is heard, everything from
there to SYNC_Done is said. The recorded inputs answer the recorded commands, not those of the device that is
tested now: from the first difference on they are no longer what a pump and a patient would have made of it.

A device that lost its power in the run loses it here at the same place: HB_CTRL BootUp shows where, and the gateway's
report behind it what became of the memory.
"""

from __future__ import annotations

import functools
import json
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from can_bus import codec
from can_bus.faults import MemoryState, clock
from can_bus.frame import MAX_DATA, Frame
from plant_server.server import judge_version, stated_version
from pumpbench.comparison.align import Ignore, compare, contents
from pumpbench.comparison.record import Record
from pumpbench.comparison.report import Report
from pumpbench.conformance.connect import connected
from pumpbench.conformance.device import Device
from pumpbench.conformance.driver import Bench, Silent, Violation
from pumpbench.conformance.registry import Need
from pumpbench.frames import Frames, device_ids
from pumpbench.identity import SOMEBODY_ELSES
from pumpbench.rewind import boots_up
from pumpbench.rig import RigError
from pumpbench.rig.buses import SERIAL
from pumpbench.signals import labels
from pumpbench.turns import FRAME_MICROSECONDS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

NAMES: Final = ("recorded", "replayed")

MEMORIES: Final[dict[str, MemoryState]] = {"NodeReset": "kept", "BrownOut": "torn", "NodeMemoryLost": "lost"}
"""FaultKind of the gateway's report (`can_bus.faults.Restart.code`) -> what became of the device's memory."""


class ReplayError(ValueError):
    """The record cannot be replayed; the text says where and why."""


class Power(NamedTuple):
    """The recorded device lost its power and came back."""

    memory: MemoryState


@dataclass(frozen=True, eq=False)
class Turn:
    """One turn of the device.

    Attributes:
        step, number: as in `Frames`.
        time_s: simulated seconds of its first frame.
        heard: what the device got, the token last, and where it was started anew.
        said: its answers.
        rows: positions in the record of the frames that are compared: all but diagnostics and `late`.
        late: what others said while the device had the turn; it gets that behind its answer.
    """

    step: int
    number: int
    time_s: float
    heard: list[Frame | Power]
    said: list[Frame]
    rows: list[int]
    late: list[Frame]

    @property
    def where(self) -> str:
        """For messages."""
        if self.number < 0:
            return "the calibration"
        further = f", further turn {self.number}" if self.number else ""
        return f"step {self.step} ({clock(int(self.time_s))}{further})"


@dataclass(frozen=True, eq=False)
class Replay:
    """What came of a replay.

    Attributes:
        report: the comparison of the recorded answers with the new ones.
        turns: how many turns were replayed, of how many.
        broken: the rule the device broke so that no turn could follow, None if it broke none.
        silent: what was awaited of a device that has died or fallen silent, None if it answered.
    """

    report: Report
    turns: tuple[int, int]
    broken: str | None = None
    silent: str | None = None

    @property
    def same(self) -> bool:
        """Every recorded answer came again."""
        return self.report.comparison.same and self.broken is None and self.silent is None

    def text(self) -> str:
        """The outcome in words, with the first difference decoded."""
        done, of = self.turns
        if self.same:
            return f"{self.report.headline()}, {done} turns"
        parts = [] if self.report.comparison.same else [self.report.text()]
        parts += [text for text in (self.broken, self.silent) if text is not None]
        if done < of:
            parts.append(f"{done} of {of} turns were replayed")
        return "\n\n".join(parts)

    def json(self) -> str:
        """The outcome for programs."""
        done, of = self.turns
        more = {"same": self.same, "turns": done, "of_turns": of, "broken": self.broken, "silent": self.silent}
        return json.dumps(self.report.data() | more, indent=2) + "\n"

    def assert_same(self) -> None:
        """The device answered as recorded."""
        __tracebackhide__ = True
        assert self.same, self.text()


def replay(
    record: Record | Path,
    *,
    bus: str = "inproc",
    firmware: str | None = None,
    ignore: Iterable[str] = (),
    keep_going: bool = False,
    timeout: float = 5.0,
    connect_timeout: float = 10.0,
    reset_hook: str | None = None,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> Replay:
    """Feed a record into a firmware.

    Args:
        record: the run, or where it is: a run folder, or a log in candump format of the device's bus.
        bus: `inproc`, `hub`, or the URL of the device's bus.
        firmware: the command that starts it; None for the reference; "none" for a device that runs by itself.
        ignore: messages and signals that may differ, see `Ignore.of`.
        keep_going: compare on after the first difference.
        timeout: seconds to wait for the end of a turn.
        connect_timeout: seconds to wait for the first answer.
        reset_hook: command that resets a device which runs by itself.
        progress: called with the number of turns done and of all.

    Raises:
        RecordError, RunFolderError, ReplayError, CodecError, RigError, BusUrlError: what is wrong with the arguments.
        PlantError: the device speaks another major version of the protocol.
        BusLost: the bus is gone.
    """
    record = record if isinstance(record, Record) else Record.load(record)
    left_out = Ignore.of(ignore)
    if firmware is None and bus.startswith(SERIAL):
        raise RigError(f"only one program can open {bus}: give --firmware {SOMEBODY_ELSES}, or the command at its end")
    turns = turns_of(record)
    with connected(bus, firmware, timeout=timeout, reset_hook=reset_hook) as (device, memory):
        _check_power(turns, device, memory, by_itself=firmware == SOMEBODY_ELSES)
        return feed(record, turns, device, left_out, keep_going=keep_going, patience=connect_timeout, progress=progress)


def feed(
    record: Record,
    turns: list[Turn],
    device: Device,
    ignore: Ignore,
    *,
    keep_going: bool = False,
    patience: float = 10.0,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> Replay:
    """The same with a device at hand and the turns taken apart; `patience` is for its first answer, in seconds."""
    tape: list[Frame] = []
    lengths: list[int] = []  # frames of each turn on the tape
    broken = silent = None
    where = "the roll call"
    try:
        _call_roll(device, patience)
        for turn in turns:
            where = turn.where
            heard, answers = _take(turn, device)
            tape += heard
            lengths.append(len(heard))
            if not keep_going and answers != turn.said and _says(answers, ignore) != _says(turn.said, ignore):
                break
            progress(len(lengths), len(turns))
    except Silent as error:
        silent = f"{where}: expected {error}"
    except Violation as error:
        broken = f"{where}: expected {error}"
    done = turns[: len(lengths)]
    ours = record.frames.select(np.array([row for turn in done for row in turn.rows], int))
    theirs = _as_frames(tape, done, lengths)
    made = replace(record, frames=ours), Record(NAMES[1], theirs)
    return Replay(Report(compare(ours, theirs, ignore), *made, NAMES), (len(done), len(turns)), broken, silent)


def _call_roll(device: Device, patience: float) -> None:
    """Call the roll until the device answers, as the plant does before a run.

    Raises:
        Silent: it does not.
        PlantError: it speaks another major version.
    """
    over = time.monotonic() + patience
    while True:
        device.renew()
        try:
            turn = Bench(device, start=False).call_roll()
            break
        except Silent as silent:
            if time.monotonic() > over:
                raise Silent(f"an answer within {patience:g} s; the last call: expected {silent}") from None
    info = turn.all("CTRL_Info")
    judge_version(stated_version(info[-1]) if info else None, turn.done["DoneStatus"])


def _take(turn: Turn, device: Device) -> tuple[list[Frame], list[Frame]]:
    """Let the device take a turn.

    Returns:
        All frames of the turn in the order of the record, and of these what the device said; both without diagnostics.

    Raises:
        Silent, Violation: it did not answer, or out of turn.
    """
    frames: list[Frame] = []
    answers: list[Frame] = []
    booted: list[Frame] = []
    for each in turn.heard:
        if isinstance(each, Power):
            booted += device.restart(each.memory)
            frames += booted
            continue
        answers += [said for said in device.receive(each) if said.can_id not in _diagnostics()]
        if each.can_id not in _diagnostics():
            frames.append(each)
    if turn.said and not answers:
        raise Silent("SYNC_Done; nothing came")
    for frame in turn.late:
        device.receive(frame)
    return frames + answers, booted + answers


def _says(frames: list[Frame], ignore: Ignore) -> object:
    """What answers come to in a comparison."""
    return contents(_as_frames(frames, [None], [len(frames)]), ignore)


def _as_frames(frames: list[Frame], turns: Sequence[Turn | None], lengths: Sequence[int]) -> Frames:
    """Frames with the instant, turn and time of the recorded turn they belong to."""

    def column(kind: str, of: Callable[[Turn], float]) -> Array:
        return np.repeat(np.array([0 if turn is None else of(turn) for turn in turns], kind), lengths)

    places = np.concatenate([np.zeros(0, int), *(np.arange(length) for length in lengths)])
    return Frames(
        channel=np.zeros(len(frames), "u1"),
        can_id=np.array([frame.can_id for frame in frames], "u4"),
        length=np.array([len(frame.data) for frame in frames], "u1"),
        data=np.frombuffer(b"".join(frame.data.ljust(MAX_DATA, b"\0") for frame in frames), "u1").reshape(-1, MAX_DATA),
        step=column("i4", lambda turn: turn.step),
        time_s=column("f8", lambda turn: turn.time_s) + places * FRAME_MICROSECONDS / 1e6,
        turn=column("i2", lambda turn: turn.number),
    )


# ---- the record taken apart


@functools.cache
def _diagnostics() -> frozenset[int]:
    """A tester is answered at any time, so that the place of these frames says nothing."""
    return frozenset(codec.message(name).can_id for name in ("UDS_Request", "UDS_Response"))


def turns_of(record: Record) -> list[Turn]:
    """Take a record apart into the turns of its device.

    Raises:
        ReplayError: it has no turns, does not begin with a calibration, or the device restarted for no recorded reason.
    """
    frames = record.frames
    if record.info.get("free_running"):
        raise ReplayError(f"{record.name} is a free run: its device was on its own clock and had no turns to replay")
    rows = np.flatnonzero(frames.channel == 0)
    borders = np.flatnonzero(np.diff(frames.step[rows]) | np.diff(frames.turn[rows])) + 1
    turns = [turn for group in np.split(rows, borders) if (turn := _turn(record, group.tolist())) is not None]
    if not turns or turns[0].number >= 0:
        raise ReplayError(f"{record.name} does not begin with a calibration: a device cannot be brought to its start")
    if not any(turn.said for turn in turns):
        raise ReplayError(f"{record.name}: nothing in it is answered; is the log that of the device's bus?")
    return turns


def _turn(record: Record, rows: list[int]) -> Turn | None:
    """The turn of these frames; None if the run was cut off before its token."""
    frames = record.frames
    turn = Turn(int(frames.step[rows[0]]), int(frames.turn[rows[0]]), float(frames.time_s[rows[0]]), [], [], [], [])
    token = codec.message("SYNC_Step").can_id
    tokens = [place for place, row in enumerate(rows) if frames.can_id[row] == token and frames.intact[row]]
    if not tokens:
        return None
    # what has the device's ids before the token is an impostor's; a token may come twice before it is answered
    answer = next((place for place in range(tokens[0], len(rows)) if _is_own(frames, rows[place])), len(rows))
    for place, row in enumerate(rows):
        frame = frames.frame(row)
        if boots_up(frame):
            following = rows[place + 1 : next((each for each in tokens if each > place), 0)]
            turn.heard.append(Power(_memory(record, turn, [frames.frame(each) for each in following])))
            turn.said.append(frame)
        elif place < answer and frame.can_id != codec.message("UDS_Response").can_id:
            turn.heard.append(frame)
        elif not _is_own(frames, row):
            turn.late.append(frame)
            continue
        elif frame.can_id not in _diagnostics():
            turn.said.append(frame)
        if frame.can_id not in _diagnostics():
            turn.rows.append(row)
    return turn


def _is_own(frames: Frames, row: int) -> bool:
    return int(frames.can_id[row]) in device_ids()


def _memory(record: Record, turn: Turn, following: list[Frame]) -> MemoryState:
    """What became of the device's memory, as the gateway reports between BootUp and the token.

    Raises:
        ReplayError: nobody reports that it cut the device's power.
    """
    report = codec.message("FAULT_Inject")
    for frame in following:
        if frame.can_id == report.can_id and len(frame.data) == report.length:
            kind = report.unpack(frame.data)["FaultKind"]
            memory = MEMORIES.get(labels(report.name, "FaultKind").get(kind, ""))
            if memory is not None:
                return memory
    raise ReplayError(
        f"{record.name}: the device started anew in {turn.where} and no fault tells why, so that nobody knows when to "
        "restart it here"
    )


def _check_power(turns: list[Turn], device: Device, offers: frozenset[Need], *, by_itself: bool) -> None:
    """Whether what was done to the recorded device's power can be done to this one.

    Raises:
        ReplayError: it cannot.
    """
    for turn in turns:
        for event in turn.heard:
            if not isinstance(event, Power):
                continue
            if not device.can_restart:
                raise ReplayError(f"the device lost its power in {turn.where}: give --reset-hook to switch this one")
            if event.memory != "kept" and by_itself:
                raise ReplayError(f"the device's memory was {event.memory} in {turn.where}, which no reset hook can do")
            if event.memory == "torn" and "nvm" in offers and "memory" not in offers:
                raise ReplayError(
                    f"the device's memory was torn in {turn.where}, which can be done to the reference firmware only"
                )
