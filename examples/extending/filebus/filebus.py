"""A bus that is a file: every frame is appended to it, and everybody reads on from where they joined."""

import os
import struct
import time

import can

from can_bus.frame import Frame, from_message, to_message

RECORD = struct.Struct("<IB3x8sQ")  # identifier with Linux's flags, length, data, who sent it


class FileBus(can.BusABC):
    """Appending is atomic: all see the same order, and nothing is lost. Nobody is woken, everybody has to look."""

    def __init__(self, channel: str, **options: object) -> None:
        self._file = os.open(channel, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o600)
        self._offset = os.fstat(self._file).st_size
        self._me = int.from_bytes(os.urandom(8), "little")
        super().__init__(channel, **options)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Append one record."""
        can_id, data = from_message(msg)
        os.write(self._file, RECORD.pack(can_id, len(data), data, self._me))

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        end = None if timeout is None else time.monotonic() + timeout
        while True:
            while len(record := os.pread(self._file, RECORD.size, self._offset)) == RECORD.size:
                self._offset += RECORD.size
                can_id, length, data, sender = RECORD.unpack(record)
                if sender != self._me:
                    return to_message(Frame(can_id, data[:length])), False
            if end is not None and time.monotonic() >= end:
                return None, False
            time.sleep(0.0002)
