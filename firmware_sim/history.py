"""What the device did in the last 24 hours, one record per step, kept over a loss of power (requirement DIA-02).

A ring of 288 records in an area of its own behind the two banks of `nvm`: those are written as a whole in every step
and would have to be ten times as large. A record has its place by its step and a CRC of its own. It is written last,
when what it tells of is stored and before any frame leaves: a cut loses that record and no other. What is read is a
copy in RAM.
"""

import binascii
from collections.abc import Sequence
from typing import NamedTuple

from .nvm import ERASED, Memory

STEPS = 288

LAYOUT = 1
"""Start of the CRC: a record of another layout counts as none."""


class Record(NamedTuple):
    """One step; raw values as in the DBC where a signal of that name exists."""

    step: int
    boots: int  # resets within the run
    cause: int  # of the newest start, HB_CTRL.ResetCauseCtrl
    state: int  # CTRL_Status.CtrlState
    mode: int  # CTRL_Status.CtrlMode
    op: int  # PUMP_BasalCmd.BasalOp, 0 = no set-point was sent
    glucose: int  # that was dosed on, 0.1 mg/dL; -1 = none
    iob: int  # CTRL_Status.InsulinOnBoard
    rate: int  # PUMP_BasalCmd.InsulinRate
    pram_rate: int  # PUMP_BasalCmd.PramlintideRate
    bolus: int  # insulin that was committed, 0.01 U
    pram_bolus: int  # pramlintide that was committed, 0.1 ug
    delivered: int  # insulin since the step before as the totals tell, mU; an estimate without them; -1 = not known
    pram_delivered: int  # pramlintide since the last total, 0.01 ug
    limiters: int  # CTRL_Status.LimiterBits
    alarms: int  # in force after the step, a bit per CtrlAlarmCode


WIDTHS = (4, 2, 1, 1, 1, 1, 2, 2, 2, 2, 2, 2, 4, 4, 2, 4)
"""Bytes of each field: signed, big-endian, a value that does not fit at its limit."""

PACKED = sum(WIDTHS)
SIZE = PACKED + 4
"""Bytes of a record in the memory: its fields and their CRC-32, little-endian."""

AREA = STEPS * SIZE
"""Bytes of the whole ring."""


def pack(record: Record) -> bytes:
    """The fields of a record, one after the other."""
    packed = b""
    for value, width in zip(record, WIDTHS, strict=True):
        limit = 1 << (8 * width - 1)
        packed += max(-limit, min(value, limit - 1)).to_bytes(width, "big", signed=True)
    return packed


def unpack(packed: bytes) -> Record:
    """The record of `PACKED` bytes."""
    values, start = [], 0
    for width in WIDTHS:
        values.append(int.from_bytes(packed[start : start + width], "big", signed=True))
        start += width
    return Record(*values)


def _crc(packed: bytes) -> bytes:
    return binascii.crc32(packed, LAYOUT).to_bytes(4, "little")


class History:
    """The ring.

    Args:
        memory: to keep it in; None: it ends with this life.
        offset: of its area there.
    """

    def __init__(self, memory: Memory | None, offset: int) -> None:
        self._memory = memory
        self._offset = offset
        self._ring: list[Record | None] = [None] * STEPS
        if memory is not None:
            self._ring = [self._load(memory, place) for place in range(STEPS)]

    def _load(self, memory: Memory, place: int) -> Record | None:
        data = memory.read(self._offset + place * SIZE, SIZE)
        packed, crc = data[:PACKED], data[PACKED:]
        if crc != _crc(packed):
            return None
        record = unpack(packed)
        return record if record.step % STEPS == place else None

    def write(self, record: Record) -> None:
        """Keep a record; once more for the same step replaces it, and the step of a day before gives way."""
        place = record.step % STEPS
        if self._ring[place] == record:
            return
        self._ring[place] = record
        if self._memory is not None:
            packed = pack(record)
            self._memory.write(self._offset + place * SIZE, packed + _crc(packed))

    def clear(self) -> None:
        """Forget everything, for the steps of another run begin."""
        if any(self._ring):
            self._ring = [None] * STEPS
            if self._memory is not None:
                self._memory.write(self._offset, bytes([ERASED]) * AREA)

    def records(self) -> Sequence[Record]:
        """Those of the last 24 h, the oldest first."""
        found = sorted(record for record in self._ring if record is not None)
        return [record for record in found if record.step > found[-1].step - STEPS]

    def at(self, place: int) -> Record | None:
        """The record in one of the `STEPS` places: that of a step which leaves `place` when divided by `STEPS`."""
        record = self._ring[place]
        return record if record in self.records() else None
