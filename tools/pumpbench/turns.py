"""The lockstep read out of the frames of a bus: to which step and turn each belongs, and its simulated time.

A frame that comes after a SYNC_Done belongs to the turn of the next token (the plant's batch precedes its token), one
between a token and its SYNC_Done to that turn. Of a device that sends no SYNC_Done (a free run) all frames up to the
batch of the next token do. The roll call before the first turn is repeated by the wall clock and is no part of the
record.
"""

from __future__ import annotations

import functools
import itertools
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from can_bus import codec
from can_bus.lockstep import STEP_SECONDS, Done
from pumpbench.frames import device_ids, intact

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

FRAME_MICROSECONDS: Final = 250
"""Simulated time between two frames of a turn, about what a frame takes at 500 kbit/s."""


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


class Assigned(NamedTuple):
    """For each frame of a channel: whether it belongs to the record, its step, its turn, its time in microseconds.

    `closed` is the last step to which nothing more will be said, -1 for none.
    """

    keep: Array
    step: Array
    turn: Array
    micros: Array
    closed: int


def assign(can_id: Array, length: Array, data: Array) -> Assigned:
    """Read the lockstep of one channel."""
    words = np.ascontiguousarray(data).view("<u8").reshape(-1)
    good = intact(can_id, length, data)
    tokens = _read_tokens(can_id, good, words)
    done = np.flatnonzero((can_id == codec.message("SYNC_Done").can_id) & good)
    keep = _without_roll_call(can_id, words, tokens, done)
    tokens = [token for token in tokens if keep[token.row] and token.phase != _phases()["Init"]]
    done = done[keep[done]]
    turns = _turns(tokens, done)
    count = len(can_id)
    if not turns:
        zeros = np.zeros(count, "i8")
        return Assigned(keep, zeros, zeros, np.arange(count) * FRAME_MICROSECONDS, -1)

    phases = _phases()
    rows = np.arange(count)
    turn_of = np.searchsorted(_ends(turns, done, can_id), rows)  # the first turn that ends at or after the row
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
    return Assigned(keep, np.array(steps)[turn_of], np.array(numbers)[turn_of], micros, _closed(turns, done, words))


def _ends(turns: list[_Token], done: Array, can_id: Array) -> Array:
    """The last row of each turn."""
    phases = _phases()
    starts = np.array([token.row for token in turns])
    limits = np.append(starts[1:], len(can_id))
    ends = limits - 1
    answered_from = next((token.row for token in turns if token.phase == phases["Step"]), len(can_id))
    if not np.any(done > answered_from):  # a free run
        for index, (start, limit) in enumerate(zip(starts, limits, strict=True)):
            ends[index] = _batch_start(can_id, start + 1, limit) - 1
        return ends
    first = np.searchsorted(done, starts)
    for index, (start, limit) in enumerate(zip(starts, limits, strict=True)):
        if first[index] < len(done) and done[first[index]] < limit:
            ends[index] = done[first[index]]
        else:  # unanswered: the next batch starts where the plant's side speaks again
            others = np.flatnonzero(np.isin(can_id[start + 1 : limit], _bench_ids()))
            if len(others):
                ends[index] = start + others[0]
    return ends


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
    own = np.flatnonzero(np.isin(can_id[start:limit], list(device_ids())))
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
