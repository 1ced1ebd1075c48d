"""The device's power switch: what a fault of the node does to the firmware of a run (`can_bus.faults.NodeControl`)."""

import os
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from can_bus.faults import MemoryState
from can_bus.frame import Frame
from firmware_sim.nvm import ERASED, HEADER_WORDS, FileMemory, Memory, RamMemory, bank_size

if TYPE_CHECKING:
    from firmware_sim.firmware import Firmware
    from pumpbench.rig.processes import Child


def tear(memory: Memory, words: int) -> None:
    """Leave the record that the reference firmware would write next half written, as a power cut in that write would.

    It goes where the newest record is not; that one was whole before any frame that depends on it left.

    Args:
        memory: two banks for records of at most so many `words` (`firmware_sim.nvm`); nothing happens to a blank one.
    """
    size = bank_size(words)
    generations = [int.from_bytes(memory.read(bank * size + 8, 4), "little") for bank in range(2)]
    written = [memory.read(bank * size, 4) != bytes([ERASED]) * 4 for bank in range(2)]
    if not any(written):
        return
    first_is_newer = (generations[0] - generations[1]) % (1 << 32) < 1 << 31
    newest = 0 if written[0] and (not written[1] or first_is_newer) else 1
    written_words = int.from_bytes(memory.read(newest * size + 4 * (HEADER_WORDS - 2), 4), "little")
    half = 4 * (HEADER_WORDS + min(written_words, words) // 2)
    begun = memory.read(newest * size, half)
    memory.write((1 - newest) * size, begun + bytes([ERASED]) * (size - half))


def erase(memory: Memory) -> None:
    """Leave the memory blank."""
    memory.write(0, bytes([ERASED]) * memory.size)


def powered_on(memory: Memory, state: MemoryState) -> "Firmware":
    """The reference firmware after its power has come back.

    Args:
        memory: its own, to which `state` is done first.
        state: what the loss of power has made of it.
    """
    from firmware_sim.firmware import NVM_WORDS, Cause, Firmware  # noqa: PLC0415

    if state == "torn":
        tear(memory, NVM_WORDS)
    elif state == "lost":
        erase(memory)
    return Firmware(memory, Cause.POWER_ON if state == "kept" else Cause.BROWN_OUT)


class InProcess:
    """The reference firmware in this process, with a memory that outlives it."""

    def __init__(self) -> None:
        from firmware_sim.firmware import NVM_BYTES, Firmware  # noqa: PLC0415

        self._memory = RamMemory(NVM_BYTES)
        self.firmware: Firmware = Firmware(self._memory)
        self.said: list[Frame] = []  # by a firmware that has just started

    @property
    def memory(self) -> bytes:
        """All of the non-volatile memory."""
        return self._memory.read(0, self._memory.size)

    def cut(self) -> None:
        """The gateway lets nothing in or out any more; what is in RAM is forgotten at the start."""

    def start(self, memory: MemoryState) -> None:
        """A new life."""
        self.firmware = powered_on(self._memory, memory)
        self.said += self.firmware.start()

    def freeze(self) -> None:
        """Nobody calls it."""

    def thaw(self) -> None:
        """It is called again."""


class Process:
    """A firmware in a process of its own.

    Args:
        launch: starts it and returns the child.
        nvm: the file of its memory.

    Attributes:
        lock: held while the process is being replaced.
        expected_dead: it has no power, so that its end is no accident.
    """

    def __init__(self, launch: Callable[[MemoryState], "Child"], nvm: Path) -> None:
        self._launch = launch
        self._nvm = nvm
        self.lock = threading.Lock()
        self.expected_dead = False
        self.child = launch("kept")

    def check(self) -> None:
        """Raise if it has ended without being asked to.

        Raises:
            NodeDied: it has.
        """
        with self.lock:
            if not self.expected_dead:
                self.child.check()

    def cut(self) -> None:
        """SIGKILL, to it and to whatever it started."""
        with self.lock:
            self.expected_dead = True
            self.child.kill()

    def start(self, memory: MemoryState) -> None:
        """Start the same command again.

        Raises:
            NodeDied: it cannot be started.
            ValueError: its memory is not one of the reference firmware, so that nobody knows how to tear it.
        """
        with self.lock:
            if memory == "lost":
                self._nvm.unlink(missing_ok=True)
            elif memory == "torn" and self._nvm.exists():
                self._tear()
            self.child = self._launch(memory)
            self.expected_dead = False

    def _tear(self) -> None:
        from firmware_sim.firmware import NVM_BYTES, NVM_WORDS  # noqa: PLC0415

        size = self._nvm.stat().st_size
        if size != NVM_BYTES:
            raise ValueError(
                f"{self._nvm}: a torn memory needs the layout of the reference firmware, {NVM_BYTES} bytes"
            )
        memory = FileMemory(str(self._nvm), size)
        tear(memory, NVM_WORDS)
        memory.close()

    def freeze(self) -> None:
        """SIGSTOP."""
        os.killpg(self.child.process.pid, signal.SIGSTOP)

    def thaw(self) -> None:
        """SIGCONT."""
        os.killpg(self.child.process.pid, signal.SIGCONT)
