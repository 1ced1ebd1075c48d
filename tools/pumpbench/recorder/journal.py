"""The journal: what a recorder has heard, on the disk while the run is still on.

A file per bus of packed frames (`can_bus.frame.pack`: Linux' `struct can_frame`, 16 bytes) as the bus showed them.
Every batch is handed to the system before the next one is read, so that a recorder that is killed leaves what it heard.
A loss of power may cost the last seconds: nothing waits for the disk.
"""

from __future__ import annotations

import contextlib
import fcntl
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from can_bus.frame import RECORD_SIZE
from pumpbench.capture import Capture

NAMES: Final = ("can0.frames", "can1.frames")
"""File names by channel."""


class Journal:
    """A journal being written.

    Args:
        folder: where the files go; existing ones are replaced.
        channels: number of buses.

    Raises:
        OSError: a file cannot be made.
    """

    def __init__(self, folder: Path, channels: int) -> None:
        with contextlib.ExitStack() as stack:
            self._files = [stack.enter_context((folder / name).open("wb", buffering=0)) for name in NAMES[:channels]]
            fcntl.flock(self._files[0], fcntl.LOCK_EX)
            self._stack = stack.pop_all()

    def keep(self, channel: int, records: bytes) -> None:
        """Append packed frames.

        Raises:
            OSError: the disk is full, or failed; a frame may be torn then.
        """
        left = memoryview(records)
        while left:
            left = left[self._files[channel].write(left) :]

    def close(self) -> None:
        """Close the files; nothing is left to write."""
        self._stack.close()


def read_journal(folder: Path) -> Capture | None:
    """All whole frames of the journal in a folder; None if there is none.

    Raises:
        OSError: a file cannot be read.
    """
    capture = Capture()
    files = [(channel, folder / name) for channel, name in enumerate(NAMES) if (folder / name).is_file()]
    for channel, file in files:
        records = file.read_bytes()
        capture.extend_packed(channel, records[: len(records) // RECORD_SIZE * RECORD_SIZE])
    return capture if files else None


@contextlib.contextmanager
def unused(folder: Path) -> Iterator[None]:
    """See to it that nobody writes the journal in a folder.

    Raises:
        BlockingIOError: somebody does.
    """
    file = folder / NAMES[0]
    if not file.is_file():
        yield
        return
    with file.open("rb") as held:
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
