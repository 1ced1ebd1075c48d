"""Frames off the bus, put into simulated time.

While a run is on, `Capture` only appends bytes. Afterwards `Capture.finish` reads the lockstep out of the frames
themselves (SYNC_Step and SYNC_Done) and gives every frame its step, its turn and its time, so that a record depends on
nothing but what was on the wire: not on the transport, and not on when a frame happened to be read.

A frame that comes after a SYNC_Done belongs to the turn of the next token (the plant's batch precedes its token), one
between a token and its SYNC_Done to that turn. Of a device that sends no SYNC_Done (a free run) all frames up to the
batch of the next token do. The roll call before the first turn is repeated by the wall clock and is
no part of the record.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from can_bus import codec
from can_bus.frame import (
    CAN_EFF_FLAG,
    CAN_ERR_FLAG,
    CAN_RTR_FLAG,
    CAN_SFF_MASK,
    MAX_DATA,
    Frame,
    pack,
)
from can_bus.lockstep import STEP_SECONDS, Done

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

FRAME_MICROSECONDS: Final = 250
"""Simulated time between two frames of a turn, about what a frame takes at 500 kbit/s."""

_RECORD: Final = np.dtype([("can_id", "<u4"), ("length", "u1"), ("pad", "V3"), ("data", "u1", (MAX_DATA,))])
_FLAGS: Final = CAN_EFF_FLAG | CAN_ERR_FLAG
_HASHED: Final = np.dtype([("channel", "u1"), ("step", "<u4"), ("can_id", "<u4"), ("length", "u1"), ("data", "V8")])


@dataclass(frozen=True, eq=False)
class Frames:
    """All frames of a run in canonical order: by step; within a step channel 0 in bus order, then channel 1.

    Attributes:
        channel: 0 = the device's bus, 1 = the plant's bus (only with a gateway between).
        can_id: identifier with the flag bits of Linux (EFF, RTR, ERR).
        length: number of data bytes.
        data: (n, 8) bytes, zero beyond `length`.
        step: sampling instant k the frame belongs to.
        time_s: simulated seconds: SimTime of the turn's token plus 0.25 ms for each frame before it.
        turn: -1 for the configuration before step 0, 0 for a step's first turn, then counting up.
    """

    channel: Array
    can_id: Array
    length: Array
    data: Array
    step: Array
    time_s: Array
    turn: Array

    def __len__(self) -> int:
        return len(self.can_id)

    @classmethod
    def none(cls) -> Frames:
        """No frames at all."""
        kinds = ("u1", "u4", "u1", "u1", "i4", "f8", "i2")
        columns = [np.zeros(0, kind) for kind in kinds]
        columns[3] = np.zeros((0, MAX_DATA), "u1")
        return cls(*columns)

    @property
    def word(self) -> Array:
        """The payloads as little-endian 64-bit integers."""
        return np.ascontiguousarray(self.data).view("<u8").reshape(-1)

    def select(self, rows: Array) -> Frames:
        """The frames chosen by a mask or an array of positions, in that order."""
        return Frames(*(getattr(self, field.name)[rows] for field in fields(self)))

    def at_step(self, step: int) -> Frames:
        """The same frames, as if they belonged to another step."""
        return replace(self, step=np.full_like(self.step, step))

    def in_order(self) -> Frames:
        """The same frames in canonical order; those of a step and channel stay as they are."""
        return self.select(np.lexsort((self.channel, self.step)))

    def frame(self, row: int) -> Frame:
        """One frame as the bus carries it."""
        return Frame(int(self.can_id[row]), self.data[row, : self.length[row]].tobytes())

    def frames(self, channel: int = 0) -> list[Frame]:
        """All frames of a channel as the bus carries them, in bus order."""
        rows = np.flatnonzero(self.channel == channel)
        ids, lengths, data = self.can_id[rows].tolist(), self.length[rows].tolist(), self.data[rows].tobytes()
        return [
            Frame(can_id, data[8 * row : 8 * row + length])
            for row, (can_id, length) in enumerate(zip(ids, lengths, strict=True))
        ]

    def sha256(self) -> str:
        """Hash over channel, step, id, length and data (padded with zeros) of all frames, packed as `<BIIB8s`."""
        packed = np.zeros(len(self), _HASHED)
        packed["channel"], packed["step"] = self.channel, self.step
        packed["can_id"], packed["length"] = self.can_id, self.length
        packed["data"] = np.ascontiguousarray(self.data).view("V8").reshape(-1)
        return hashlib.sha256(packed.tobytes()).hexdigest()

    @functools.cached_property
    def intact(self) -> Array:
        """Which frames a receiver may believe: an id of the DBC, its length, and an E2E checksum that fits."""
        return _intact(self.can_id, self.length, self.data)


class Capture:
    """Collects the frames of a run as they come: bytes in, analysis afterwards.

    Args:
        keep: gets the channel and the packed records of every batch, e.g. to keep them on a disk.
    """

    def __init__(self, keep: Callable[[int, bytes], None] | None = None) -> None:
        self._buffers: dict[int, bytearray] = {}
        self._keep = keep

    def __len__(self) -> int:
        return sum(map(len, self._buffers.values())) // _RECORD.itemsize

    def extend(self, channel: int, frames: Sequence[Frame]) -> None:
        """Append frames in the order the bus showed them.

        Args:
            channel: 0 for the device's bus, 1 for the plant's bus when a gateway lies between.
            frames: what arrived since the last call.

        Raises:
            ValueError: a frame has more than 8 data bytes.
            OSError: `keep` could not; the batch is in memory all the same.
        """
        self.extend_packed(channel, records := pack(frames))
        if self._keep is not None:
            self._keep(channel, records)

    def extend_packed(self, channel: int, records: bytes) -> None:
        """Append frames that are packed already (`can_bus.frame.pack`)."""
        self._buffers.setdefault(channel, bytearray()).extend(records)

    def device_info(self) -> dict[str, int] | None:
        """Raw values of the device's CTRL_Info; None without one.

        It answers the roll call, which is no part of the record but tells which firmware this is.
        """
        message = codec.message("CTRL_Info")
        record = np.frombuffer(bytes(self._buffers.get(0, b"")), _RECORD)
        record = record[(record["can_id"] == message.can_id) & (record["length"] == message.length)]
        good = np.flatnonzero(_intact(record["can_id"], record["length"], record["data"]))
        return message.unpack(record["data"][good[0]].tobytes()) if len(good) else None

    def finish(self) -> Frames:
        """Put all frames collected so far into simulated time and canonical order; more may be appended afterwards."""
        return _canonical({channel: np.frombuffer(bytes(raw), _RECORD) for channel, raw in self._buffers.items()})


class NewRun(Exception):
    """The roll was called anew and another run has begun on the bus: what was heard before is no part of it.

    Attributes:
        taken: for each channel, how many frames of the whole record belong to the run before.
    """

    def __init__(self, taken: list[int]) -> None:
        super().__init__("another run has begun on the bus")
        self.taken = taken


class Follower:
    """Puts frames into simulated time while the run is still on, each once its step is over.

    A step is over when the device has closed its last turn, or when the next one has begun. What `Capture.finish` says
    of a frame is said here too, from the frames so far: only a window of them is looked at, back to the last step that
    was over.
    """

    def __init__(self, channels: int) -> None:
        """Args: channels: how many buses are recorded, the device's first."""
        self._raw = [bytearray() for _ in range(channels)]
        self._handed = [0] * channels  # of the frames in the window
        self._before = [0] * channels  # frames that the window has left behind

    def extend(self, channel: int, records: bytes) -> None:
        """Append packed records as the bus showed them, whole ones."""
        self._raw[channel] += records

    def take(self, *, over: bool = False) -> Frames:
        """The frames that were not handed out before and whose step is over on every bus, in canonical order.

        Args:
            over: nothing more will come; all that is left is handed out.

        Raises:
            NewRun: a new run has begun; a new follower has to begin behind the frames it names.
        """
        windows = [_place(np.frombuffer(bytes(raw), _RECORD)) for raw in self._raw]
        for window, handed in zip(windows, self._handed, strict=True):
            if not window.keep[:handed].all():
                raise NewRun([sum(each) for each in zip(self._before, self._handed, strict=True)])
        closed = min(window.closed for window in windows)
        parts = []
        for channel, window in enumerate(windows):
            handed = len(window.step) if over else int(np.searchsorted(window.step, closed, side="right"))
            rows = window.keep.copy()
            rows[: self._handed[channel]] = rows[handed:] = False
            parts.append(window.columns(channel, rows))
            # behind the roll call, or the next window would take it for the start of another run
            context = np.flatnonzero(window.keep & (window.step >= closed))
            start = int(context[0]) if closed >= 0 and len(context) else 0
            del self._raw[channel][: start * _RECORD.itemsize]
            self._handed[channel] = max(handed, self._handed[channel]) - start
            self._before[channel] += start
        return _joined(parts)


# --------------------------------------------------------------------------------------------- what the frames say


@functools.cache
def _crc_table() -> Array:
    table = np.zeros(256, "u1")
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x2F if crc & 0x80 else crc << 1) & 0xFF
        table[byte] = crc
    return table


def _intact(can_id: Array, length: Array, data: Array) -> Array:
    """Which frames have an id and a length of the DBC and, where protected, a fitting checksum (E2E Profile 2)."""
    good = np.zeros(len(can_id), bool)
    table = _crc_table()
    for message in codec.messages().values():
        rows = np.flatnonzero((can_id == message.can_id) & (length == message.length))
        if not len(rows):
            continue
        if message.data_ids is None:
            good[rows] = True
            continue
        payload = data[rows]
        crc = np.full(len(rows), 0xFF, "u1")
        for column in range(1, message.length):
            crc = table[crc ^ payload[:, column]]
        data_ids = np.frombuffer(message.data_ids, "u1")
        crc = table[crc ^ data_ids[payload[:, 1] & 0xF]]
        good[rows] = crc ^ 0xFF == payload[:, 0]
    return good


class _Token(NamedTuple):
    """A SYNC_Step that opens a turn."""

    row: int
    phase: int
    step: int
    time_s: int


@functools.cache
def _phases() -> dict[str, int]:
    return {
        label: codec.choice("SYNC_Step", "SyncPhase", label) for label in ("Init", "Step", "Continue", "End", "Config")
    }


@functools.cache
def _bench_ids() -> Array:
    """Ids of the plant's side, which are silent while the device has the turn."""
    names = ("PLANT", "CGM", "PUMP", "UI")
    return np.array([message.can_id for message in codec.messages().values() if message.sender in names], "u4")


@functools.cache
def _device_ids() -> Array:
    return np.array([message.can_id for message in codec.messages().values() if message.sender == "CTRL"], "u4")


def _signal(message: str, name: str, words: Array) -> list[int]:
    field = codec.message(message).fields[name]
    return [int(word) >> field.shift & field.mask for word in words]


def _read_tokens(can_id: Array, good: Array, words: Array) -> list[_Token]:
    rows = np.flatnonzero((can_id == codec.message("SYNC_Step").can_id) & good)
    picked = words[rows]
    return [
        _Token(*fields)
        for fields in zip(
            rows.tolist(),
            _signal("SYNC_Step", "SyncPhase", picked),
            _signal("SYNC_Step", "StepIndex", picked),
            _signal("SYNC_Step", "SimTime", picked),
            strict=True,
        )
    ]


def _without_roll_call(can_id: Array, words: Array, tokens: list[_Token], done: Array) -> Array:
    """Mask of the frames after the roll call that starts the run: the last one that calibration or step 0 follows.

    A device that is slow may answer earlier calls behind it; the run starts with the answer to this one. An Init token
    anywhere else is an injected fault, or a call nobody answered.
    """
    keep = np.ones(len(can_id), bool)
    phases = _phases()
    called, call, opening = -1, -1, len(can_id)
    for token, following in itertools.zip_longest(tokens, tokens[1:]):
        if token.phase != phases["Init"]:
            continue
        if following is None:
            if called < 0 and all(other.phase == phases["Init"] for other in tokens):
                keep[:] = False  # nothing but the roll call: there was no run
        elif following.phase == phases["Config"] or (following.phase != phases["Init"] and following.step == 0):
            called, call, opening = token.row, token.step, following.row
    if called < 0:
        return keep
    late = done[(done > called) & (done < opening)]
    answers = late[np.array(_signal("SYNC_Done", "DoneStepIndex", words[late]), "i8") == call]
    keep[: (answers[0] if len(answers) else called) + 1] = False
    # answers to earlier calls that arrive late are no part of the record either
    answer_ids = [codec.message(name).can_id for name in ("SYNC_Done", "CTRL_Info")]
    keep[:opening] &= ~np.isin(can_id[:opening], answer_ids)
    return keep


def _turns(tokens: list[_Token], done: Array) -> list[_Token]:
    """The tokens that open a turn: without repetitions, and without those an injected fault put out of order."""
    turns: list[_Token] = []
    config = _phases()["Config"]
    steps = np.array([token.step for token in tokens])
    first = next((token.step for token in tokens if token.phase != config), 0)
    for index, read in enumerate(tokens):
        token = read._replace(step=first, time_s=STEP_SECONDS * first) if read.phase == config else read
        if turns:
            current = turns[-1]
            answered = np.searchsorted(done, token.row) > np.searchsorted(done, current.row)
            if token.step < current.step or (token[1:] == current[1:] and not answered):
                continue
            if token.step > current.step + 1:  # believed only if the count goes on from there
                later = steps[index + 1 :]
                if not np.any(later >= token.step) or np.any((later > current.step) & (later < token.step)):
                    continue
        turns.append(token)
    return turns


class _Assigned(NamedTuple):
    """For each frame of a channel: whether it belongs to the record, its step, its turn, its time in microseconds.

    `closed` is the last step to which nothing more will be said, -1 for none.
    """

    keep: Array
    step: Array
    turn: Array
    micros: Array
    closed: int


def _assign(can_id: Array, length: Array, data: Array) -> _Assigned:
    """Read the lockstep of one channel."""
    words = np.ascontiguousarray(data).view("<u8").reshape(-1)
    good = _intact(can_id, length, data)
    tokens = _read_tokens(can_id, good, words)
    done = np.flatnonzero((can_id == codec.message("SYNC_Done").can_id) & good)
    keep = _without_roll_call(can_id, words, tokens, done)
    tokens = [token for token in tokens if keep[token.row] and token.phase != _phases()["Init"]]
    done = done[keep[done]]
    turns = _turns(tokens, done)
    count = len(can_id)
    if not turns:
        zeros = np.zeros(count, "i8")
        return _Assigned(keep, zeros, zeros, np.arange(count) * FRAME_MICROSECONDS, -1)

    phases = _phases()
    starts = np.array([token.row for token in turns])
    limits = np.append(starts[1:], count)
    ends = limits - 1  # last row of each turn
    if not np.any(done > next((token.row for token in turns if token.phase == phases["Step"]), count)):
        for index, (start, limit) in enumerate(zip(starts, limits, strict=True)):
            ends[index] = _batch_start(can_id, start + 1, limit) - 1
    else:
        first = np.searchsorted(done, starts)
        for index, (start, limit) in enumerate(zip(starts, limits, strict=True)):
            if first[index] < len(done) and done[first[index]] < limit:
                ends[index] = done[first[index]]
            else:  # unanswered: the next batch starts where the plant's side speaks again
                others = np.flatnonzero(np.isin(can_id[start + 1 : limit], _bench_ids()))
                if len(others):
                    ends[index] = start + others[0]
    rows = np.arange(count)
    turn_of = np.searchsorted(ends, rows)  # the first turn that ends at or after the row
    steps: list[int] = []
    numbers: list[int] = []
    bases: list[int] = []
    base = 0
    for token in turns:
        if token.phase == phases["Config"] and not steps:
            number = -1
        else:
            number = numbers[-1] + 1 if steps and steps[-1] == token.step else 0
        inside = 0 <= token.time_s - STEP_SECONDS * token.step < STEP_SECONDS
        base = max(base, token.time_s if inside else STEP_SECONDS * token.step + max(number, 0))
        steps.append(token.step)
        numbers.append(number)
        bases.append(base)
    # a batch whose token never came (the run was cut off), or what is said after the end
    over = turns[-1].phase == phases["End"]
    steps.append(steps[-1] if over else steps[-1] + 1)
    numbers.append(numbers[-1] if over else 0)
    bases.append(base if over else max(base, STEP_SECONDS * steps[-1]))
    base_of = np.array(bases)[turn_of]
    kept = np.flatnonzero(keep)
    micros = np.zeros(count, "i8")
    micros[kept] = _microseconds(base_of[kept])
    return _Assigned(keep, np.array(steps)[turn_of], np.array(numbers)[turn_of], micros, _closed(turns, done, words))


def _closed(turns: list[_Token], done: Array, words: Array) -> int:
    """The last step that is over: one that the device has closed, or one before the last token's."""
    last = turns[-1]
    if last.phase != _phases()["Config"]:  # the calibration is no step of its own
        answers = words[done[done > last.row]]
        steps, statuses = (_signal("SYNC_Done", name, answers) for name in ("DoneStepIndex", "DoneStatus"))
        if any(said == last.step and status != Done.CONTINUE for said, status in zip(steps, statuses, strict=True)):
            return last.step  # and no answer to a roll call
    return max((token.step for token in turns if token.step < last.step), default=-1)


def _batch_start(can_id: Array, start: int, limit: int) -> int:
    """First row of the plant's batch at the end of these rows: what stands behind the last frame of the device."""
    own = np.flatnonzero(np.isin(can_id[start:limit], _device_ids()))
    return start + int(own[-1]) + 1 if len(own) else start


def _microseconds(base_s: Array) -> Array:
    """Time of each frame: base plus 250 us per frame before it, closer only where that would reach the next base."""
    values, firsts, counts = np.unique(base_s, return_index=True, return_counts=True)
    spacing = np.full(len(values), FRAME_MICROSECONDS, "i8")
    room = np.diff(values) * 1_000_000
    spacing[:-1] = np.minimum(spacing[:-1], np.maximum(room // counts[:-1], 1))
    group = np.repeat(np.arange(len(values)), counts)
    micros: Array = base_s.astype("i8") * 1_000_000 + (np.arange(len(base_s)) - firsts[group]) * spacing[group]
    return micros


class _Window(NamedTuple):
    """Frames of one channel as they came, with what `_assign` says of them."""

    can_id: Array
    length: Array
    data: Array
    keep: Array
    step: Array
    turn: Array
    micros: Array
    closed: int

    def columns(self, channel: int, rows: Array) -> tuple[Array, ...]:
        """The columns of `Frames` for the frames that a mask chooses."""
        return (
            np.full(int(rows.sum()), channel, "u1"),
            self.can_id[rows],
            self.length[rows],
            self.data[rows],
            self.step[rows].astype("i4"),
            self.micros[rows] / 1e6,
            self.turn[rows].astype("i2"),
        )


def _place(record: Array) -> _Window:
    can_id, length = record["can_id"].astype("u4"), record["length"].astype("u1")
    # what no CAN bus can carry is written down as the nearest that it can, so that a log says the same
    too_long = (can_id & ~np.uint32(CAN_RTR_FLAG) > CAN_SFF_MASK) & (can_id & _FLAGS == 0)
    can_id[too_long] |= np.uint32(CAN_EFF_FLAG)
    carried = (np.arange(MAX_DATA) < length[:, None]) & (can_id & CAN_RTR_FLAG == 0)[:, None]
    data = record["data"].reshape(-1, MAX_DATA) * carried.astype("u1")
    return _Window(can_id, length, data, *_assign(can_id, length, data))


def _canonical(records: dict[int, Array]) -> Frames:
    windows = ((channel, _place(records[channel])) for channel in sorted(records))
    return _joined([window.columns(channel, window.keep) for channel, window in windows])


def _joined(parts: Sequence[tuple[Array, ...]]) -> Frames:
    return concatenated([Frames(*columns) for columns in parts]).in_order()


def concatenated(parts: Sequence[Frames]) -> Frames:
    """These frames, one after the other."""
    parts = parts or [Frames.none()]
    return Frames(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Frames)))


# ------------------------------------------------------------------------------------------------------ log files


def write_candump(frames: Frames, path: Path, names: Sequence[str] = ("can0", "can1")) -> None:
    """Write the frames as a candump log (`candump -L`), time-stamped with simulated seconds.

    python-can, `cantools decode`, can-utils and SavvyCAN read it.

    Args:
        frames: what to write.
        path: the file; overwritten.
        names: interface name of channel 0 and of channel 1.
    """
    order = np.argsort(frames.time_s, kind="stable")
    micros = np.rint(frames.time_s[order] * 1e6).astype("i8").tolist()
    channels, ids = frames.channel[order].tolist(), frames.can_id[order].tolist()
    lengths, data = frames.length[order].tolist(), frames.data[order].tobytes().hex().upper()
    flags = _FLAGS
    with path.open("w", encoding="ascii", newline="\n") as file:
        for row, (micro, channel, can_id, length) in enumerate(zip(micros, channels, ids, lengths, strict=True)):
            seconds, fraction = divmod(micro, 1_000_000)
            if not can_id & (flags | CAN_RTR_FLAG):
                text = f"{can_id:03X}#{data[16 * row : 16 * row + 2 * length]}"
            else:
                bare = can_id & ~CAN_RTR_FLAG
                name = f"{bare if bare & CAN_ERR_FLAG else bare & ~CAN_EFF_FLAG:08X}" if bare & flags else f"{bare:03X}"
                payload = f"R{length or ''}" if can_id & CAN_RTR_FLAG else data[16 * row : 16 * row + 2 * length]
                text = f"{name}#{payload}"
            file.write(f"({seconds}.{fraction:06d}) {names[channel]} {text}\n")


class LogLine(NamedTuple):
    """One line of a candump log."""

    time_s: float
    interface: str
    frame: Frame
    is_rx: bool
    """False only where the log says that this machine sent the frame."""


def _parse_line(line: str) -> LogLine:
    """Take a line of a candump log apart.

    Raises:
        ValueError, IndexError: it is none.
    """
    stamp, name, frame, *direction = line.split()
    if stamp[0] != "(" or stamp[-1] != ")" or direction not in ([], ["R"], ["T"]):
        raise ValueError(line)
    time_s = float(stamp[1:-1])
    ident, _, payload = frame.partition("#")
    can_id = int(ident, 16)
    if len(ident) == 8 and not can_id & CAN_ERR_FLAG:
        can_id |= CAN_EFF_FLAG
    if payload[:1] in ("R", "r"):
        can_id, data = can_id | CAN_RTR_FLAG, bytes(int(payload[1:] or 0))
    else:
        data = bytes.fromhex(payload)
    if len(data) > MAX_DATA or not 0 <= can_id <= 0xFFFFFFFF or not math.isfinite(time_s):
        raise ValueError(line)
    return LogLine(time_s, name, Frame(can_id, data), direction != ["T"])


def read_lines(path: Path) -> Iterator[LogLine]:
    """Read a candump log line by line, as it is.

    Raises:
        ValueError: a line is no frame of classic CAN; the text says which.
        OSError: the file cannot be read.
    """
    with path.open(encoding="ascii", errors="replace") as file:
        for number, line in enumerate(file, 1):
            if not line.strip():
                continue
            try:
                parsed = _parse_line(line)
            except (ValueError, IndexError):
                raise ValueError(f"{path}:{number}: not a line of a candump log: {line.strip()[:60]!r}") from None
            yield parsed


def read_candump(path: Path, names: Sequence[str] = ("can0", "can1")) -> Frames:
    """Read a candump log back; step, turn and time come from the SYNC frames in it, not from its time stamps.

    Args:
        path: the log.
        names: interface name of channel 0 and of channel 1; other interfaces are numbered in the order of their names.

    Raises:
        ValueError: a line is no frame of classic CAN; the text says which.
        OSError: the file cannot be read.
    """
    found: dict[str, list[Frame]] = {}
    for line in read_lines(path):
        found.setdefault(line.interface, []).append(line.frame)
    capture = Capture()
    channels = list(names) if set(found) <= set(names) else sorted(found)
    for name, frames in found.items():
        capture.extend(channels.index(name), frames)
    return capture.finish()
