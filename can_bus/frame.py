"""One classic CAN frame, and the 16 bytes it travels in.

The byte layout is Linux' `struct can_frame` in little endian, on a hub's stream as well as on a raw
SocketCAN socket, so a C program can `read()` it straight into the struct of `<linux/can.h>`.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import Final, NamedTuple

import can

CAN_EFF_FLAG: Final = 0x80000000
CAN_RTR_FLAG: Final = 0x40000000
CAN_ERR_FLAG: Final = 0x20000000
CAN_SFF_MASK: Final = 0x000007FF
CAN_EFF_MASK: Final = 0x1FFFFFFF
MAX_DATA: Final = 8
TOO_LONG: Final = "not a classic CAN frame: more than 8 data bytes"

RECORD: Final = struct.Struct("<IB3x8s")
RECORD_SIZE: Final = RECORD.size
_SIZES = tuple(range(MAX_DATA + 1))
_ZEROS = bytes(MAX_DATA)
_pack_record = RECORD.pack
_iter_records = RECORD.iter_unpack
_new = tuple.__new__


class Frame(NamedTuple):
    """A classic CAN frame: `can_id` with the Linux flag bits, and up to 8 data bytes.

    In a remote frame the length of `data` is the DLC and its bytes are zero. A frame has no time stamp and
    no channel: in lockstep the time is inside the frames. The constructor does not check anything; `pack`
    and `to_message` do.
    """

    can_id: int
    data: bytes

    @property
    def is_error(self) -> bool:
        """Whether this is an error frame (it reports an event of the bus, no node sent it as data)."""
        return bool(self.can_id & CAN_ERR_FLAG)

    @property
    def is_remote(self) -> bool:
        """Whether this is a remote transmission request."""
        return bool(self.can_id & CAN_RTR_FLAG)

    @property
    def is_extended(self) -> bool:
        """Whether the identifier has 29 bits."""
        return bool(self.can_id & CAN_EFF_FLAG)

    @property
    def identifier(self) -> int:
        """The identifier without flag bits (of an error frame: the error class bits)."""
        mask = CAN_EFF_MASK if self.can_id & (CAN_EFF_FLAG | CAN_ERR_FLAG) else CAN_SFF_MASK
        return self.can_id & mask


def pack(frames: Iterable[Frame]) -> bytes:
    """Return the frames as consecutive 16-byte `struct can_frame` records.

    Raises ValueError for more than 8 data bytes or an id that does not fit 32 bits. It does not check that a
    standard id stays below 0x800: a faulty node can send such a frame too.
    """
    try:
        return b"".join([_pack_record(can_id, _SIZES[len(data)], data) for can_id, data in frames])
    except (struct.error, IndexError) as error:
        reason = "more than 8 data bytes" if isinstance(error, IndexError) else error
        raise ValueError(f"not a classic CAN frame: {reason}") from error


def unpack(buffer: bytes | bytearray) -> list[Frame]:
    """Return the frames in `buffer`, whose length must be a multiple of 16.

    Bytes beyond the DLC and the padding are ignored; the data of remote frames becomes zero bytes.
    """
    return [
        _new(Frame, (can_id, (data if not can_id & CAN_RTR_FLAG else _ZEROS)[:size]))
        for can_id, size, data in _iter_records(buffer)
    ]


def to_message(frame: Frame, timestamp: float = 0.0, channel: str | None = None, is_rx: bool = True) -> can.Message:
    """Return the frame as a python-can message; raises ValueError when it is no valid classic frame."""
    can_id, data = frame
    if len(data) > MAX_DATA:
        raise ValueError(TOO_LONG)
    remote = bool(can_id & CAN_RTR_FLAG)
    return can.Message(
        timestamp=timestamp,
        arbitration_id=frame.identifier,
        is_extended_id=bool(can_id & CAN_EFF_FLAG),
        is_remote_frame=remote,
        is_error_frame=bool(can_id & CAN_ERR_FLAG),
        channel=channel,
        dlc=len(data),
        data=None if remote else data,
        is_rx=is_rx,
    )


def from_message(message: can.Message) -> Frame:
    """Return a python-can message as a frame; the time stamp, channel and direction are not kept.

    Raises ValueError for CAN FD messages and for messages whose data is longer than 8 bytes.
    """
    if message.is_fd:
        raise ValueError("CAN FD frames do not exist on this bus (classic CAN, at most 8 data bytes)")
    can_id = message.arbitration_id
    if message.is_extended_id:
        can_id |= CAN_EFF_FLAG
    if message.is_error_frame:
        can_id |= CAN_ERR_FLAG
    if message.is_remote_frame:
        can_id |= CAN_RTR_FLAG
        data = bytes(message.dlc)
    else:
        data = bytes(message.data)
    if len(data) > MAX_DATA:
        raise ValueError(TOO_LONG)
    return Frame(can_id, data)
