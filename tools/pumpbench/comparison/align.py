"""Which frames of one record are those of another, and which are not.

Frames are paired within a sampling instant, bus by bus and message by message, so that one that is missing or extra is
one difference and what comes after it is still compared with its like. What is compared is what a frame says: in an
intact frame its signals, in a damaged or foreign one all its bytes. COUNTER goes on by one with every frame of a
message, so one frame more or less shifts all that follow: a shift that missing and extra frames explain is counted as
renumbered and is no difference, any other is one.
"""

from __future__ import annotations

import bisect
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

import numpy as np

from can_bus import codec
from can_bus.codec import COUNTER_MODULUS, CodecError
from pumpbench.frames import Frames, device_ids

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

Kind = Literal["changed", "missing", "extra", "moved"]
"""Both have the frame but it says something else; only A has it; only B has it; both have it, at another place."""

OWN: Final = ("CTRL_Info", "CTRL_Diag", "UDS_Response", "SYNC_Done.ExecTime")
"""What every firmware counts and tells for itself: not to be compared between two implementations."""

_CHECKSUM: Final = 0xFF
_COUNTER: Final = 0xF00
_COUNTER_SHIFT: Final = 8


@dataclass(frozen=True)
class Ignore:
    """What is left out of a comparison.

    Attributes:
        messages: ids of whole messages.
        signals: (id, page of the multiplexer or None, bits of the payload).
    """

    messages: frozenset[int] = frozenset()
    signals: tuple[tuple[int, int | None, int], ...] = ()

    @classmethod
    def of(cls, names: Iterable[str]) -> Ignore:
        """From names like `CTRL_Info`, `SYNC_Done.ExecTime`, or `own` for all of `OWN`.

        Raises:
            CodecError: the DBC has no such message or signal.
        """
        from pumpbench.signals import signals  # noqa: PLC0415

        messages, bits = set(), []
        for name in (part for given in names for part in (OWN if given == "own" else (given,))):
            message, _, signal = name.partition(".")
            packed = codec.message(message)
            if not signal:
                messages.add(packed.can_id)
                continue
            known = signals(message)
            if signal not in known:
                raise CodecError(f"{message} has no signal {signal!r} to ignore; it has {', '.join(known)}")
            field = known[signal]
            bits.append((packed.can_id, field.page, field.mask << field.shift))
        return cls(frozenset(messages), tuple(bits))

    def covers(self, can_id: int, shift: int, page: int | None) -> bool:
        """Whether a signal, told by its first bit and its page, is not compared."""
        return can_id in self.messages or any(
            ident == can_id and page in (None, selected) and bits >> shift & 1 for ident, selected, bits in self.signals
        )


class Difference(NamedTuple):
    """One frame that is not the same in both; the numbers are positions in the records A and B."""

    kind: Kind
    a: int | None
    b: int | None


@dataclass(frozen=True, eq=False)
class Comparison:
    """What came of a comparison.

    Attributes:
        a, b: the records.
        differences: in the order in which the frames were on the bus.
        renumbered: frames that differ in COUNTER and CHECKSUM alone, since one before them is missing or extra.
        compared: positions of the frames of A and of B that were looked at.
        one_sided: channels that only one of the records has, with its name, "A" or "B".
        ignore: what was left out.
    """

    a: Frames
    b: Frames
    differences: Sequence[Difference]
    renumbered: int
    compared: tuple[Array, Array]
    one_sided: dict[int, str]
    ignore: Ignore

    @property
    def same(self) -> bool:
        """Nothing differs but what was ignored."""
        return not self.differences and not self.one_sided

    @property
    def first(self) -> Difference | None:
        """Where the two part."""
        return self.differences[0] if self.differences else None

    def place(self, difference: Difference) -> tuple[Frames, int]:
        """The record and the position in it that tell where a difference is: A's, if A has the frame."""
        if difference.a is not None:
            return self.a, difference.a
        assert difference.b is not None
        return self.b, difference.b


def compare(a: Frames, b: Frames, ignore: Ignore | None = None, channel: int | None = None) -> Comparison:
    """Compare two records.

    Args:
        a, b: as `Capture.finish` and `read_candump` give them.
        ignore: what may differ.
        channel: compare this bus only; None: all that both have.
    """
    ignore = ignore or Ignore()
    channels = [{int(each) for each in np.unique(frames.channel)} for frames in (a, b)]
    if channel is not None:
        channels = [known & {channel} for known in channels]
    one_sided = {} if not len(a) or not len(b) else {
        each: "A" if each in channels[0] else "B" for each in sorted(channels[0] ^ channels[1])
    }  # fmt: skip
    sides = _Side.of(a, ignore), _Side.of(b, ignore)
    differences: list[Difference] = []
    renumbered = 0
    compared: list[list[Array]] = [[], []]
    for each in sorted((channels[0] | channels[1]) - one_sided.keys()):
        rows = [side.rows(each) for side in sides]
        for known, chosen in zip(compared, rows, strict=True):
            known.append(chosen)
        pairs, found = _pair_bus(sides, rows)
        wrong, shifted = _count(sides, rows, pairs)
        changed = {(difference.a, difference.b) for difference in found}
        differences += found
        differences += [Difference("changed", *pair) for pair in wrong if pair not in changed]
        renumbered += shifted
    differences.sort(key=lambda difference: _order(a, b, difference))
    ours, theirs = (np.concatenate([np.zeros(0, int), *chosen]) for chosen in compared)
    return Comparison(a, b, differences, renumbered, (ours, theirs), one_sided, ignore)


def _order(a: Frames, b: Frames, difference: Difference) -> tuple[int, ...]:
    """When a frame was on the bus: instant, turn, the plant's side before the device, the sender's bus first."""
    frames, row = (a, difference.a) if difference.a is not None else (b, difference.b)
    device, channel = int(frames.can_id[row]) in device_ids(), int(frames.channel[row])
    return int(frames.step[row]), int(frames.turn[row]), device, channel if device else -channel, int(row or 0)


# ---- what a frame says


@dataclass(frozen=True, eq=False)
class _Side:
    """A record made ready: what each frame says, without COUNTER, CHECKSUM and whatever is ignored."""

    frames: Frames
    content: Array  # of each frame, as (id, length and whether it is intact, payload)
    page: Array  # of the multiplexer, -1 where there is none
    counter: Array  # -1 where a frame has none to be believed
    ignored: Array

    @classmethod
    def of(cls, frames: Frames, ignore: Ignore) -> _Side:
        words, intact = frames.word.copy(), frames.intact
        page, counter = np.full(len(frames), -1), np.full(len(frames), -1)
        for can_id in np.unique(frames.can_id).tolist():
            message = codec.messages_by_id().get(can_id)
            if message is None:
                continue
            rows = np.flatnonzero((frames.can_id == can_id) & intact)
            said = words[rows]
            if message.selector is not None:
                field = message.fields[message.selector]
                page[rows] = said >> np.uint64(field.shift) & np.uint64(field.mask)
            if message.data_ids is not None:
                counter[rows] = (said & np.uint64(_COUNTER)) >> np.uint64(_COUNTER_SHIFT)
                words[rows] &= _without(_COUNTER | _CHECKSUM)
        for can_id, selected, bits in ignore.signals:
            rows = (frames.can_id == can_id) & intact
            words[rows & (page == selected) if selected is not None else rows] &= _without(bits)
        content = np.zeros(len(frames), [("can_id", "u4"), ("form", "u4"), ("word", "u8")])
        content["can_id"], content["word"] = frames.can_id, words
        content["form"] = frames.length.astype("u4") << 1 | intact
        return cls(frames, content, page, counter, np.isin(frames.can_id, list(ignore.messages)))

    def rows(self, channel: int) -> Array:
        """The frames of a bus that count."""
        return np.flatnonzero((self.frames.channel == channel) & ~self.ignored)


def _without(bits: int) -> np.uint64:
    return np.uint64(0xFFFF_FFFF_FFFF_FFFF ^ bits)


def contents(frames: Frames, ignore: Ignore) -> tuple[list[Any], list[int]]:
    """What the frames say one by one, and their COUNTER (-1 where there is none); ignored messages are left out."""
    side = _Side.of(frames, ignore)
    return side.content[~side.ignored].tolist(), side.counter[~side.ignored].tolist()


# ---- pairing


def _pair_bus(sides: tuple[_Side, _Side], rows: Sequence[Array]) -> tuple[Array, list[Difference]]:
    """The frames of a bus that belong together, as an array of two columns, and what differs but for COUNTER."""
    said = [side.content[chosen] for side, chosen in zip(sides, rows, strict=True)]
    steps = [side.frames.step[chosen] for side, chosen in zip(sides, rows, strict=True)]
    every = np.union1d(*steps)
    starts, ends = ([np.searchsorted(each, every, side=end) for each in steps] for end in ("left", "right"))
    pairs: list[Array] = []
    differences: list[Difference] = []
    for start_a, end_a, start_b, end_b in zip(starts[0], ends[0], starts[1], ends[1], strict=True):
        ours, theirs = rows[0][start_a:end_a], rows[1][start_b:end_b]
        if len(ours) == len(theirs) and np.array_equal(said[0][start_a:end_a], said[1][start_b:end_b]):
            pairs.append(np.column_stack((ours, theirs)))
            continue
        keys = [
            list(zip(side.page[chosen].tolist(), side.content[chosen].tolist(), strict=True))
            for side, chosen in zip(sides, (ours, theirs), strict=True)
        ]
        paired, found = _pair_step(*keys)
        pairs.append(np.column_stack((ours[[i for i, _ in paired]], theirs[[j for _, j in paired]])))
        differences += [
            Difference(kind, None if i is None else int(ours[i]), None if j is None else int(theirs[j]))
            for kind, i, j in found
        ]
    return np.concatenate(pairs) if pairs else np.zeros((0, 2), int), differences


_Key = tuple[int, tuple[int, int, int]]
_Found = tuple[Kind, int | None, int | None]


def _pair_step(a: Sequence[_Key], b: Sequence[_Key]) -> tuple[list[tuple[int, int]], list[_Found]]:
    """The same for the frames of one instant: each is paired with its like of the same message and page."""
    by_message: dict[tuple[int, int], tuple[list[int], list[int]]] = {}
    for side, keys in enumerate((a, b)):
        for place, (page, (can_id, _, _)) in enumerate(keys):
            by_message.setdefault((can_id, page), ([], []))[side].append(place)
    pairs: list[tuple[int, int]] = []
    found: list[_Found] = []
    for ours, theirs in by_message.values():
        matched, missing, extra = _matched([a[place] for place in ours], [b[place] for place in theirs])
        found += [("missing", ours[i], None) for i in missing]
        found += [("extra", None, theirs[j]) for j in extra]
        pairs += [(ours[i], theirs[j]) for i, j in matched]
    found += [("changed", i, j) for i, j in pairs if a[i] != b[j]]
    pairs.sort()
    settled = _longest_rise([j for _, j in pairs])
    found += [("moved", i, j) for i, j in pairs if j not in settled and a[i] == b[j]]
    return pairs, found


def _matched(a: Sequence[_Key], b: Sequence[_Key]) -> tuple[list[tuple[int, int]], list[int], list[int]]:
    """Places in two sequences that belong together, and those of either one that have no match."""
    size = min(len(a), len(b))
    head = next((place for place in range(size) if a[place] != b[place]), size)
    tail = next((place for place in range(size - head) if a[-1 - place] != b[-1 - place]), size - head)
    matched = [(place, place) for place in range(head)]
    matched += [(len(a) - place, len(b) - place) for place in range(tail, 0, -1)]
    missing: list[int] = []
    extra: list[int] = []
    # without the equal ends, because difflib takes the square of the time for a flood of equal frames
    matcher = SequenceMatcher(None, a[head : len(a) - tail], b[head : len(b) - tail], autojunk=False)
    for _, i, i_end, j, j_end in matcher.get_opcodes():
        both = min(i_end - i, j_end - j)
        matched += [(head + i + place, head + j + place) for place in range(both)]
        missing += range(head + i + both, head + i_end)
        extra += range(head + j + both, head + j_end)
    return matched, missing, extra


def _longest_rise(numbers: Sequence[int]) -> set[int]:
    """The members of a longest rising subsequence: the frames that kept their order."""
    tails: list[int] = []
    ends: list[int] = []  # place in numbers of each tail
    before: list[int] = []
    for place, number in enumerate(numbers):
        length = bisect.bisect_left(tails, number)
        before.append(ends[length - 1] if length else -1)
        tails[length : length + 1] = [number]
        ends[length : length + 1] = [place]
    result: set[int] = set()
    place = ends[-1] if ends else -1
    while place >= 0:
        result.add(numbers[place])
        place = before[place]
    return result


def _count(sides: tuple[_Side, _Side], rows: Sequence[Array], pairs: Array) -> tuple[list[tuple[int, int]], int]:
    """Pairs whose COUNTERs have no reason to differ, and the number of those that have one.

    The reason is a frame of the same message that only one side has, or that the sender of one side began to count anew
    a while ago.
    """
    wrong: list[tuple[int, int]] = []
    shifted = 0
    counters = [side.counter[pairs[:, column]] for column, side in enumerate(sides)]
    numbered = (counters[0] >= 0) & (counters[1] >= 0)
    apart = (counters[1] - counters[0]) % COUNTER_MODULUS
    ids = sides[0].frames.can_id[pairs[:, 0]]
    for can_id in np.unique(ids[numbered & (apart != 0)]).tolist():
        chosen = np.flatnonzero(numbered & (ids == can_id))
        ordinal = [
            np.searchsorted(here[side.frames.can_id[here] == can_id], pairs[chosen, column])
            for column, (side, here) in enumerate(zip(sides, rows, strict=True))
        ]
        unexplained = (apart[chosen] - (ordinal[1] - ordinal[0])) % COUNTER_MODULUS
        usual = 0, 0
        for place, offset, rest in zip(chosen.tolist(), apart[chosen].tolist(), unexplained.tolist(), strict=True):
            if offset and offset != usual[0] and rest != usual[1]:
                wrong.append((int(pairs[place, 0]), int(pairs[place, 1])))
            elif offset:
                shifted += 1
            usual = offset, rest
    return wrong, shifted
