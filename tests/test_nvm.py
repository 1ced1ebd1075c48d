"""The two banks under every cut, every flipped bit and any garbage: a record that was stored, or none."""

import binascii
import copy
import os
import stat
import struct
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_sim.nvm import (
    HEADER_WORDS,
    LAYOUT,
    MAGIC,
    FileMemory,
    Nvm,
    NvmError,
    PowerLost,
    RamMemory,
    bank_size,
    memory_size,
)

CAPACITY = 4
BANK = bank_size(CAPACITY)
SIZE = memory_size(CAPACITY)
WORDS = st.lists(st.integers(-(2**31), 2**31 - 1), max_size=CAPACITY)


def record(generation: int, words: Sequence[int], wear: tuple[int, int] = (1, 1), layout: int = LAYOUT) -> bytes:
    """The layout once more, written down apart from the code."""
    header = struct.pack("<6I", MAGIC, layout, generation, *wear, len(words))
    body = header + struct.pack(f"<I{len(words)}i", binascii.crc32(header), *words)
    return body + struct.pack("<I", binascii.crc32(body))


def two_banks(first: bytes, second: bytes) -> RamMemory:
    memory = RamMemory(SIZE)
    memory.write(0, first)
    memory.write(BANK, second)
    return memory


def private(path: str, flags: int) -> int:
    return os.open(path, flags, 0o600)


def test_what_is_stored_comes_back_as_it_is_laid_out() -> None:
    memory = RamMemory(SIZE)
    nvm = Nvm(memory, CAPACITY)
    words = [-(2**31), -1, 0, 2**31 - 1]
    assert nvm.store(words) is True
    assert nvm.load() == words
    expected = record(0, words, (1, 0))
    assert memory.read(0, len(expected)) == expected
    assert (nvm.blank, nvm.damaged, nvm.fallbacks) == (False, False, 0)


def test_the_commit_word_is_a_write_of_its_own_and_the_last() -> None:
    writes: list[tuple[int, int]] = []

    class Watched(RamMemory):
        def write(self, offset: int, data: bytes) -> None:
            writes.append((offset, len(data)))
            super().write(offset, data)

    memory = Watched(SIZE)
    Nvm(memory, CAPACITY).store([1, 2])
    assert writes == [(0, 4 * (HEADER_WORDS + 2)), (4 * (HEADER_WORDS + 2), 4)]
    assert (memory.writes, memory.bytes_written) == (2, 4 * (HEADER_WORDS + 3))


def test_erased_is_blank() -> None:
    nvm = Nvm(RamMemory(SIZE), CAPACITY)
    assert nvm.load() is None
    assert (nvm.blank, nvm.damaged, nvm.fallbacks) == (True, False, 0)


def test_banks_take_turns_and_their_wear_survives() -> None:
    memory = RamMemory(SIZE)
    for k in range(7):
        assert Nvm(memory, CAPACITY).store([k])
    nvm = Nvm(memory, CAPACITY)
    assert (nvm.wear(0), nvm.wear(1)) == (4, 3)
    assert nvm.load() == [6]


def test_wear_ends_at_its_greatest_instead_of_starting_again() -> None:
    memory = two_banks(record(5, [1], (2**32 - 1, 3)), record(6, [2], (2**32 - 1, 4)))
    nvm = Nvm(memory, CAPACITY)
    assert nvm.store([3])
    assert (nvm.wear(0), nvm.wear(1), nvm.load()) == (2**32 - 1, 4, [3])


def test_the_wear_of_a_cut_write_is_known_from_its_header() -> None:
    memory = RamMemory(SIZE)
    nvm = Nvm(memory, CAPACITY)
    nvm.store([1])
    memory.power_fails_after(4 * HEADER_WORDS)
    with pytest.raises(PowerLost):
        nvm.store([2])
    again = Nvm(memory, CAPACITY)
    assert (again.wear(0), again.wear(1), again.load()) == (1, 1, [1])


def test_the_same_words_are_not_written_again() -> None:
    memory = RamMemory(SIZE)
    nvm = Nvm(memory, CAPACITY)
    for words in ([1, 2], [3]):
        assert nvm.store(words) is True
        before = memory.bytes_written
        assert nvm.store(words) is False
        assert Nvm(memory, CAPACITY).store(tuple(words)) is False
        assert memory.bytes_written == before


def test_the_same_words_are_written_where_the_other_bank_is_damaged() -> None:
    memory = two_banks(record(1, [1]), record(2, [2]))
    memory.flip(0)
    nvm = Nvm(memory, CAPACITY)
    assert nvm.store([2]) is True
    memory.flip(8 * BANK)
    assert nvm.load() == [2]


@pytest.mark.parametrize(("word", "index"), [(2**31, 0), (-(2**31) - 1, 2)])
def test_a_word_that_is_no_int32_is_named(word: int, index: int) -> None:
    memory = RamMemory(SIZE)
    words = [0, 0, 0]
    words[index] = word
    with pytest.raises(ValueError, match=f"word {index} of the record is {word}"):
        Nvm(memory, CAPACITY).store(words)
    assert memory.writes == 0


def test_too_many_words_and_too_small_a_memory() -> None:
    with pytest.raises(ValueError, match="5 words, but a bank holds 4"):
        Nvm(RamMemory(SIZE), CAPACITY).store([0] * 5)
    with pytest.raises(NvmError, match=f"{SIZE - 1} bytes, but two banks take {SIZE} bytes"):
        Nvm(RamMemory(SIZE - 1), CAPACITY)


@pytest.mark.parametrize("torn_garbage", [False, True])
@pytest.mark.parametrize("generation", [None, 0, 1, 2, 0xFF, 2**31 - 1, 2**32 - 2, 2**32 - 1])
def test_a_cut_at_every_byte_leaves_the_old_record_or_the_new(generation: int | None, torn_garbage: bool) -> None:
    start = RamMemory(SIZE, torn_garbage)
    old: list[int] | None = None
    if generation is not None:
        old = [7, -7, 70]
        start.write(0, record(generation - 1 & 0xFFFFFFFF, [5, 6, 7, 8]))
        start.write(BANK, record(generation, old))
    new = [-9, 2**31 - 1]
    total = len(record(0, new))
    for cut in range(total + 1):
        memory = copy.deepcopy(start)
        memory.power_fails_after(cut)
        if cut < total:
            with pytest.raises(PowerLost):
                Nvm(memory, CAPACITY).store(new)
        else:
            assert Nvm(memory, CAPACITY).store(new)
        memory.power_fails_after(None)
        nvm = Nvm(memory, CAPACITY)
        if cut < total - 4:
            assert nvm.load() == old
        assert nvm.load() in (old, new)
        assert nvm.load() == new or cut < total
        assert nvm.blank is (cut == 0 and old is None and not torn_garbage)
        assert nvm.store([cut]) and Nvm(memory, CAPACITY).load() == [cut]
        assert nvm.store([cut, 1]) and Nvm(memory, CAPACITY).load() == [cut, 1]


def test_power_stays_away_until_it_is_given_back() -> None:
    memory = RamMemory(4, torn_garbage=True)
    memory.power_fails_after(2)
    with pytest.raises(PowerLost, match="byte 2"):
        memory.write(0, b"\x12\x34\x56\x78")
    assert (memory.read(0, 4), memory.bytes_written) == (b"\x12\x34\xf6\xff", 2)
    with pytest.raises(PowerLost):
        memory.write(0, b"\x00")
    memory.power_fails_after(None)
    memory.write(3, b"\x09")
    assert memory.read(3, 1) == b"\x09"


@pytest.mark.parametrize("offset", [-1, SIZE - 1])
def test_a_write_beyond_the_memory_is_refused_in_whole(offset: int) -> None:
    memory = RamMemory(SIZE)
    with pytest.raises(NvmError, match=f"the memory has {SIZE} bytes"):
        memory.write(offset, b"\0\0")
    assert memory.read(0, SIZE) == b"\xff" * SIZE


RECORD_BITS = 8 * len(record(0, [0, 0, 0]))


@pytest.mark.parametrize("newest", [0, 1])
@pytest.mark.parametrize("generation", [3, 2**32 - 1])
def test_every_flipped_bit_of_the_newest_bank_is_a_fallback(newest: int, generation: int) -> None:
    older, newer = [1, -2, 3], [4, -5, 6]
    banks = [record(generation, older), record(generation + 1 & 0xFFFFFFFF, newer)]
    memory = two_banks(banks[1 - newest], banks[newest])
    for bit in range(RECORD_BITS):
        memory.flip(8 * BANK * newest + bit)
        nvm = Nvm(memory, CAPACITY)
        assert (nvm.load(), nvm.fallbacks, nvm.damaged) == (older, 1, False), bit
        assert (nvm.load(), nvm.fallbacks) == (older, 2)
        memory.flip(8 * BANK * newest + bit)
    assert Nvm(memory, CAPACITY).load() == newer


@pytest.mark.parametrize("newest", [0, 1])
def test_a_flipped_bit_of_the_older_bank_takes_nothing_away(newest: int) -> None:
    """It is no fallback where the header tells the bank's age; where it does not, the worse is supposed."""
    banks = [record(3, [1, -2, 3]), record(4, [4, -5, 6])]
    memory = two_banks(banks[1 - newest], banks[newest])
    for bit in range(RECORD_BITS):
        memory.flip(8 * BANK * (1 - newest) + bit)
        nvm = Nvm(memory, CAPACITY)
        assert nvm.load() == [4, -5, 6]
        assert nvm.fallbacks == (bit < 32 * HEADER_WORDS), bit
        memory.flip(8 * BANK * (1 - newest) + bit)


def test_both_banks_damaged() -> None:
    memory = two_banks(record(1, [1]), record(2, [2]))
    memory.flip(8 * 4 * HEADER_WORDS)
    memory.flip(8 * (BANK + 4 * HEADER_WORDS))
    nvm = Nvm(memory, CAPACITY)
    assert nvm.load() is None
    assert (nvm.blank, nvm.damaged, nvm.fallbacks) == (False, True, 0)
    assert nvm.store([3])
    assert (nvm.load(), nvm.damaged) == ([3], False)


def test_the_only_record_damaged_is_not_blank() -> None:
    memory = RamMemory(SIZE)
    nvm = Nvm(memory, CAPACITY)
    assert nvm.store([1]) and nvm.intact()
    memory.flip(8)
    assert not nvm.intact()
    nvm = Nvm(memory, CAPACITY)
    assert (nvm.load(), nvm.blank, nvm.damaged) == (None, False, True)


def test_a_bank_damaged_while_running_is_not_relied_on() -> None:
    """The newest bank goes bad between two stores: the next one must not overwrite the only intact record."""
    memory = two_banks(record(1, [1]), record(2, [2]))
    nvm = Nvm(memory, CAPACITY)
    assert nvm.load() == [2]
    memory.flip(8 * BANK)
    memory.power_fails_after(20)
    with pytest.raises(PowerLost):
        nvm.store([3])
    assert Nvm(memory, CAPACITY).load() == [1]


@pytest.mark.parametrize("content", [record(9, [9], layout=LAYOUT + 1), b"\0" * BANK, record(9, [9])[:-1] + b"\0"])
def test_another_layout_and_no_record_are_not_taken(content: bytes) -> None:
    assert Nvm(two_banks(record(1, [1]), content), CAPACITY).load() == [1]


def test_a_count_beyond_the_bank_is_no_record() -> None:
    memory = RamMemory(SIZE)
    memory.write(0, record(1, [0] * (CAPACITY + 1)))
    nvm = Nvm(memory, CAPACITY)
    assert (nvm.load(), nvm.damaged) == (None, True)


@pytest.mark.parametrize("newest", [0, 1])
@pytest.mark.parametrize("older", [0, 41, 2**31 - 1, 2**31, 2**32 - 1])
def test_generations_are_compared_around_the_circle(older: int, newest: int) -> None:
    banks = [record(older, [1]), record((older + 1) % 2**32, [2])]
    nvm = Nvm(two_banks(banks[1 - newest], banks[newest]), CAPACITY)
    assert nvm.load() == [2]
    assert nvm.store([3])
    assert nvm.load() == [3]


def test_file_memory_survives_reopening(tmp_path: Path) -> None:
    path = tmp_path / "nvm.bin"
    with closing(FileMemory(str(path), SIZE, opener=private)) as memory:
        assert memory.read(0, SIZE) == b"\xff" * SIZE
        assert (memory.size, stat.S_IMODE(path.stat().st_mode)) == (SIZE, 0o600)
        assert Nvm(memory, CAPACITY).store([1, -1])
    with closing(FileMemory(str(path), SIZE)) as memory:
        assert Nvm(memory, CAPACITY).load() == [1, -1]
        memory.power_fails_after(9)
        with pytest.raises(PowerLost):
            Nvm(memory, CAPACITY).store([2])
    assert path.stat().st_size == SIZE
    with closing(FileMemory(str(path), SIZE)) as memory:
        nvm = Nvm(memory, CAPACITY)
        assert (nvm.load(), nvm.fallbacks) == ([1, -1], 1)
        memory.flip(0)
        assert (nvm.load(), nvm.damaged) == (None, True)


def test_file_memory_is_forced_out_where_asked(tmp_path: Path) -> None:
    synced: list[int] = []

    def sync(descriptor: int) -> None:
        os.fsync(descriptor)
        synced.append(descriptor)

    with closing(FileMemory(str(tmp_path / "nvm.bin"), SIZE, sync=sync)) as memory:
        Nvm(memory, CAPACITY).store([1])
    assert len(synced) == 3  # the erased bytes, the record, its commit word


def test_a_file_of_another_size_is_refused_and_an_empty_one_filled(tmp_path: Path) -> None:
    path = tmp_path / "nvm.bin"
    path.write_bytes(b"\xff" * (SIZE + 1))
    with pytest.raises(NvmError, match=rf"{path}: {SIZE + 1} bytes, but a memory of {SIZE} bytes was expected"):
        FileMemory(str(path), SIZE)
    path.write_bytes(b"")
    with closing(FileMemory(str(path), SIZE)) as memory:
        assert memory.read(0, SIZE) == b"\xff" * SIZE


def test_a_file_cut_short_meanwhile_is_read(tmp_path: Path) -> None:
    path = tmp_path / "nvm.bin"
    with closing(FileMemory(str(path), SIZE)) as memory:
        nvm = Nvm(memory, CAPACITY)
        nvm.store([1])
        nvm.store([2])
        for size in range(SIZE, -1, -1):
            os.truncate(path, size)
            assert nvm.load() in ([2], [1], None)
        assert nvm.blank


@given(content=st.binary(min_size=SIZE, max_size=SIZE))
def test_garbage_never_raises(content: bytes) -> None:
    memory = RamMemory(SIZE)
    memory.write(0, content)
    nvm = Nvm(memory, CAPACITY)
    assert nvm.load() is None
    assert nvm.store([1])
    assert nvm.load() == [1]


@given(
    header=st.tuples(*[st.sampled_from([0, 1, CAPACITY, CAPACITY + 1, 2**31, 2**32 - 1])] * 4),
    rest=st.binary(max_size=4 * CAPACITY + 4),
)
def test_garbage_behind_a_valid_header_never_raises(header: tuple[int, ...], rest: bytes) -> None:
    front = struct.pack("<6I", MAGIC, LAYOUT, *header)
    memory = RamMemory(SIZE)
    memory.write(0, front + struct.pack("<I", binascii.crc32(front)) + rest)
    nvm = Nvm(memory, CAPACITY)
    assert nvm.load() is None or header[3] <= CAPACITY
    assert nvm.store([1])
    assert nvm.load() == [1]


@settings(max_examples=200)
@given(
    steps=st.lists(
        st.tuples(
            WORDS,
            st.none() | st.integers(0, BANK),
            st.none() | st.tuples(st.integers(0, 1), st.lists(st.integers(0, 8 * BANK - 1), min_size=1, max_size=3)),
        ),
        max_size=12,
    ),
    torn_garbage=st.booleans(),
)
def test_no_record_that_was_not_stored(
    steps: list[tuple[list[int], int | None, tuple[int, list[int]] | None]], torn_garbage: bool
) -> None:
    memory = RamMemory(SIZE, torn_garbage)
    tried: list[list[int]] = []
    whole = 0  # written whole since there last was none
    harmed = False  # a bank may be damaged: only one between two whole stores
    for words, cut, flips in steps:
        tried.append(words)
        memory.power_fails_after(cut)
        try:
            written = Nvm(memory, CAPACITY).store(words)
        except PowerLost:
            harmed = True
        else:
            assert Nvm(memory, CAPACITY).load() == words
            harmed = False
            whole += written
        memory.power_fails_after(None)
        if flips is not None and not harmed:
            for bit in flips[1]:
                memory.flip(8 * BANK * flips[0] + bit)
            harmed = True
        found = Nvm(memory, CAPACITY).load()
        assert found is None or found in tried
        if found is None:
            assert whole < 2
            whole = 0


def test_generations_count_one_by_one() -> None:
    memory = RamMemory(SIZE)
    nvm = Nvm(memory, CAPACITY)
    for number in range(4):
        nvm.store([number])
    assert memory.read(BANK, len(record(3, [3]))) == record(3, [3], (2, 2))


@pytest.mark.parametrize("content", [b"", bytes(range(200))])
def test_after_the_first_record_nothing_is_blank_or_damaged(content: bytes) -> None:
    memory = RamMemory(SIZE)
    memory.write(0, content[:SIZE])
    nvm = Nvm(memory, CAPACITY)
    assert (nvm.blank, nvm.damaged) == (content == b"", content != b"")
    nvm.store([1])
    assert (nvm.blank, nvm.damaged) == (False, False)


@pytest.mark.parametrize("distance", [0, 1 << 31])
def test_of_two_banks_that_neither_follow_the_first_is_taken(distance: int) -> None:
    """Nothing the firmware writes; whatever it is, it is one of both and always the same."""
    nvm = Nvm(two_banks(record(5, [1]), record(5 + distance, [2])), CAPACITY)
    assert nvm.load() == [1]


def test_what_lies_behind_the_banks_is_no_record() -> None:
    memory = RamMemory(SIZE + BANK)
    memory.write(SIZE, record(9, [9]))
    nvm = Nvm(memory, CAPACITY)
    assert nvm.blank
    assert nvm.load() is None


@pytest.mark.parametrize("torn_garbage", [None, False, True])
def test_the_byte_in_which_the_power_fails(tmp_path: Path, torn_garbage: bool | None) -> None:
    options = {} if torn_garbage is None else {"torn_garbage": torn_garbage}
    with closing(FileMemory(str(tmp_path / "nvm"), SIZE, **options)) as file:
        for memory in (RamMemory(SIZE, **options), file):
            memory.power_fails_after(1)
            with pytest.raises(PowerLost):
                memory.write(0, b"\x11\x22\x33")
            assert memory.read(0, 3) == (b"\x11\xf2\xff" if torn_garbage else b"\x11\xff\xff")


def test_a_file_is_opened_as_asked_and_written_through(tmp_path: Path) -> None:
    path = tmp_path / "nvm"
    opened: list[str] = []

    def opener(name: str, flags: int) -> int:
        opened.append(name)
        return private(name, flags)

    for number in range(2):
        with closing(FileMemory(str(path), SIZE, opener=opener)) as memory:
            memory.write(8, bytes([number]))
            assert path.read_bytes()[8] == number  # what a killed process leaves behind
            assert memory.read(8, 3) == bytes([number, 255, 255])
    assert len(opened) == 3  # looked for, made, found


def test_a_file_that_lost_its_erased_end_keeps_its_record(tmp_path: Path) -> None:
    path = tmp_path / "nvm"
    with closing(FileMemory(str(path), SIZE)) as memory:
        nvm = Nvm(memory, CAPACITY)
        nvm.store([1])
        nvm.store([2])
        with path.open("r+b") as file:
            file.truncate(SIZE - 8)
        assert nvm.load() == [2]
        assert nvm.fallbacks == 0
