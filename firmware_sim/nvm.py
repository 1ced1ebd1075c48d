"""The non-volatile memory: two banks with CRC and generation, over bytes that can lose power at any instant.

A record is written to the bank that does not hold the newest one, its CRC last and in a write of its own: a cut leaves
the older record whole (requirements RST-01 and RST-02).
"""

import binascii
from collections.abc import Callable, Iterator, Sequence
from typing import Protocol

MAGIC = 0x504E564D
LAYOUT = 2
"""Version of what the words mean; a record of another one is not taken up."""

HEADER_WORDS = 7
"""Magic, layout, generation, writes of bank 0, writes of bank 1, number of words, CRC of these six."""

ERASED = 0xFF
MODULUS = 1 << 32
HALF = MODULUS >> 1


class NvmError(ValueError):
    """A memory that cannot hold the records, or a file that is no memory; the text says what was expected."""


class PowerLost(Exception):
    """The supply failed in the middle of a write: what was written so far stays."""


class Kept(Protocol):
    """A part of the device that survives a reset."""

    def save(self) -> list[int]:
        """Words for the non-volatile memory."""

    def restore(self, words: Iterator[int]) -> None:
        """Take back what `save` wrote."""


class Memory(Protocol):
    """Bytes that keep what is written; erased ones are 0xFF."""

    @property
    def size(self) -> int:
        """Number of bytes."""

    def read(self, offset: int, length: int) -> bytes:
        """Some bytes."""

    def write(self, offset: int, data: bytes) -> None:
        """Write some bytes, in order."""


class RamMemory:
    """A memory whose power can be made to fail, and whose bits can be flipped.

    Attributes:
        bytes_written: so far.
        writes: calls of `write` so far.
    """

    def __init__(self, size: int, torn_garbage: bool = False) -> None:
        self._data = bytearray([ERASED]) * size
        self._size = size
        self._torn_garbage = torn_garbage
        self._left: int | None = None
        self.bytes_written = 0
        self.writes = 0

    @property
    def size(self) -> int:
        """Number of bytes."""
        return self._size

    def read(self, offset: int, length: int) -> bytes:
        """Some bytes."""
        return bytes(self._data[offset : offset + length])

    def write(self, offset: int, data: bytes) -> None:
        """Write some bytes, in order.

        Raises:
            NvmError: not all of them are in the memory; none is written.
            PowerLost: after as many bytes as `power_fails_after` allowed.
        """
        if offset < 0 or offset + len(data) > self._size:
            raise NvmError(f"{len(data)} bytes at {offset}, but the memory has {self._size} bytes")
        self.writes += 1
        allowed = len(data) if self._left is None else min(self._left, len(data))
        self._put(offset, data[:allowed])
        self.bytes_written += allowed
        if self._left is not None:
            self._left -= allowed
            if allowed < len(data):
                place = offset + allowed
                if self._torn_garbage:
                    self._put(place, bytes([self.read(place, 1)[0] & 0xF0 | data[allowed] & 0x0F]))
                raise PowerLost(f"power lost at byte {place}")

    def power_fails_after(self, n_bytes: int | None) -> None:
        """Let the supply fail after so many more bytes, and stay away until this is called again; None: never."""
        self._left = n_bytes

    def flip(self, bit_offset: int) -> None:
        """Flip one bit."""
        place = bit_offset >> 3
        self._put(place, bytes([self.read(place, 1)[0] ^ 1 << (bit_offset & 7)]))

    def _put(self, offset: int, data: bytes) -> None:
        self._data[offset : offset + len(data)] = data


class FileMemory(RamMemory):
    """A memory in a file, made of erased bytes if it does not exist.

    The firmware does not import os, so what only os can do is handed in by who opens the file. Without `sync` the
    memory survives the end of the process, not that of the machine.

    Args:
        path: of the file.
        size: bytes that it has.
        opener: as of the built-in open; a file for its owner alone takes one that gives mode 0600 to os.open.
        sync: called with the descriptor after every write, such as os.fsync.

    Raises:
        NvmError: the file has another size.
    """

    def __init__(
        self,
        path: str,
        size: int,
        *,
        opener: Callable[[str, int], int] | None = None,
        sync: Callable[[int], object] | None = None,
        torn_garbage: bool = False,
    ) -> None:
        super().__init__(0, torn_garbage)
        self._size = size
        self._sync = sync
        try:
            self._file = open(path, "r+b", buffering=0, opener=opener)  # noqa: SIM115
        except FileNotFoundError:
            self._file = open(path, "x+b", buffering=0, opener=opener)  # noqa: SIM115
        found = self._file.seek(0, 2)
        if found == 0:  # also what is left when the process ended between making the file and filling it
            self._put(0, bytes([ERASED]) * size)
        elif found != size:
            self._file.close()
            raise NvmError(f"{path}: {found} bytes, but a memory of {size} bytes was expected")

    def read(self, offset: int, length: int) -> bytes:
        """Some bytes; fewer if the file was cut short meanwhile."""
        self._file.seek(offset)
        return self._file.read(length)

    def close(self) -> None:
        """Give the file back."""
        self._file.close()

    def _put(self, offset: int, data: bytes) -> None:
        self._file.seek(offset)
        while data:  # an unbuffered write may take a part only
            data = data[self._file.write(data) :]
        if self._sync is not None:
            self._sync(self._file.fileno())


def bank_size(words: int) -> int:
    """Bytes of a bank whose records have at most so many words."""
    return 4 * (HEADER_WORDS + words + 1)


def memory_size(words: int) -> int:
    """Bytes of a memory whose records have at most so many words."""
    return 2 * bank_size(words)


class _Bank:
    """What one bank holds.

    Attributes:
        written: it is not erased.
        generation: as its header tells; None if the header cannot be trusted.
        wear: writes of both banks, as its header tells.
        words: of its record; None if it is not intact.
    """

    def __init__(self, data: bytes, capacity: int) -> None:
        self.written = data.strip(bytes([ERASED])) != b""
        self.generation: int | None = None
        self.wear = [0, 0]
        self.words: list[int] | None = None
        start = 4 * HEADER_WORDS
        magic, layout, generation, wear_0, wear_1, count, check = _unpack(data[:start])
        # The header has its own CRC so that a record that is damaged further on still tells whether it was the newest.
        if magic != MAGIC or layout != LAYOUT or check != binascii.crc32(data[: start - 4]) or count > capacity:
            return
        self.generation = generation
        self.wear = [wear_0, wear_1]
        end = start + 4 * count
        if _unpack(data[end : end + 4]) == [binascii.crc32(data[:end])]:
            self.words = [word - MODULUS if word >= HALF else word for word in _unpack(data[start:end])]


class Nvm:
    """Records of signed 32-bit words in two banks.

    Attributes:
        fallbacks: times `load` found the newest bank damaged and took the older one. A bank whose header is damaged
            too counts as the newest: nothing tells that it was not.
        blank: nothing was ever written.
        damaged: something was written, and no bank is intact.

    Raises:
        NvmError: the memory is smaller than two banks.
    """

    def __init__(self, memory: Memory, capacity_words: int) -> None:
        if memory.size < memory_size(capacity_words):
            raise NvmError(f"a memory of {memory.size} bytes, but two banks take {memory_size(capacity_words)} bytes")
        self._memory = memory
        self._capacity = capacity_words
        self._wear = [0, 0]
        self.fallbacks = 0
        self._scan()

    def wear(self, bank: int) -> int:
        """How often a bank was written; a cut write counts where its header still tells of it."""
        return self._wear[bank]

    def intact(self) -> bool:
        """Whether there is a record to start from, or never was one."""
        self._scan()
        return not self.damaged

    def load(self) -> list[int] | None:
        """The newest intact record; None if there is none. Takes any content of the memory."""
        banks, newest = self._scan()
        if newest is None:
            return None
        if banks[1 - newest].written and banks[1 - newest].words is None:
            self.fallbacks += not _is_newer(banks[newest].generation, banks[1 - newest].generation)
        return banks[newest].words

    def store(self, words: Sequence[int]) -> bool:
        """Write a record to the bank that does not hold the newest intact one, if it says anything new.

        The same words again are written only where the other bank is damaged, so that there are two again.

        Returns:
            Whether it was written.

        Raises:
            ValueError: too many words, or one that is no signed 32-bit integer.
        """
        if len(words) > self._capacity:
            raise ValueError(f"a record of {len(words)} words, but a bank holds {self._capacity}")
        for index, word in enumerate(words):
            if not -HALF <= word < HALF:
                raise ValueError(f"word {index} of the record is {word}, no signed 32-bit integer")
        # Read anew rather than remembered: a bank damaged since is not the one to rely on while writing the other.
        banks, newest = self._scan()
        bank, generation = 0, 0
        if newest is not None:
            bank = 1 - newest
            generation = ((banks[newest].generation or 0) + 1) % MODULUS
            if banks[newest].words == list(words) and (banks[bank].words is not None or not banks[bank].written):
                return False
        self._wear[bank] = min(self._wear[bank] + 1, MODULUS - 1)
        header = _pack([MAGIC, LAYOUT, generation, *self._wear, len(words)])
        body = header + _pack([binascii.crc32(header), *words])
        offset = bank * bank_size(self._capacity)
        self._memory.write(offset, body)
        self._memory.write(offset + len(body), _pack([binascii.crc32(body)]))
        self.blank = self.damaged = False
        return True

    def _scan(self) -> tuple[list[_Bank], int | None]:
        """Both banks, and which of them is the newest intact one."""
        size = bank_size(self._capacity)
        # Filled up, so that a memory that gives fewer bytes than asked for reads as erased there.
        data = [self._memory.read(bank * size, size).ljust(size, bytes([ERASED])) for bank in range(2)]
        banks = [_Bank(content, self._capacity) for content in data]
        newest: int | None = None
        for bank, found in enumerate(banks):
            self._wear = [max(self._wear[each], found.wear[each]) for each in range(2)]
            if found.words is not None and (newest is None or _is_newer(found.generation, banks[newest].generation)):
                newest = bank
        self.blank = not any(found.written for found in banks)
        self.damaged = not self.blank and newest is None
        return banks, newest


def _is_newer(generation: int | None, than: int | None) -> bool:
    """Whether a generation follows another by less than half the circle; an unknown one neither follows nor leads."""
    return generation is not None and than is not None and 0 < (generation - than) % MODULUS < HALF


def _pack(words: Sequence[int]) -> bytes:
    return b"".join((word % MODULUS).to_bytes(4, "little") for word in words)


def _unpack(data: bytes) -> list[int]:
    return [int.from_bytes(data[i : i + 4], "little") for i in range(0, len(data), 4)]
