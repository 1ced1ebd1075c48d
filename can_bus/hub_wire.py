r"""What travels on a hub's stream socket. A C client fits in 30 lines.

Everything is little endian and 16 bytes long.

1. The client connects (Unix stream socket, or TCP on the loopback) and sends one *hello*::

       struct hello { char magic[8]; uint16_t version; uint16_t flags; uint32_t pid; };
       /* magic "HILBUS\r\n", version 1, flags bit 0: send me my own frames too, pid: for the hub's log, or 0 */

2. The hub answers with one *welcome* of the same layout (pid: the hub's). From now on the client misses nothing.
3. From then on both sides send `struct can_frame` of `<linux/can.h>`, one after the other, nothing between::

       struct record { uint32_t can_id; uint8_t len; uint8_t pad[3]; uint8_t data[8]; };   /* len <= 8 */

   `can_id` carries the flag bits CAN_EFF_FLAG, CAN_RTR_FLAG, CAN_ERR_FLAG. Many records in one `write` are one
   batch and are switched together; a reader must expect several records, or part of one, per `read`.
4. Before the hub closes a connection it sends a *goodbye* when it still can: a record with `can_id` 0xFFFFFFFF and
   `len` 0xFF, whose data are two uint32_t, a reason and a detail. In place of the welcome it means "refused".
   An end of the stream without goodbye means that the hub died.

::

    int s = socket(AF_UNIX, SOCK_STREAM, 0);
    struct sockaddr_un a = {.sun_family = AF_UNIX, .sun_path = "/tmp/bus"};
    connect(s, (struct sockaddr *)&a, sizeof a);
    struct hello h = {"HILBUS\r\n", 1, 0, getpid()};
    write(s, &h, 16);
    recv(s, &h, 16, MSG_WAITALL);              /* welcome, or a goodbye: compare the magic */
    struct can_frame f = {.can_id = 0x123, .len = 2, .data = {1, 2}};
    write(s, &f, 16);
    while (recv(s, &f, 16, MSG_WAITALL) == 16 && f.len <= 8) handle(&f);
"""

from __future__ import annotations

import os
import struct
from enum import IntEnum
from typing import Final

MAGIC: Final = b"HILBUS\r\n"
VERSION: Final = 1
FLAG_ECHO: Final = 1

HELLO: Final = struct.Struct("<8sHHI")
GOODBYE: Final = struct.Struct("<IB3xII")
GOODBYE_ID: Final = 0xFFFFFFFF
GOODBYE_LEN: Final = 0xFF
LEN_OFFSET: Final = 4


class Reason(IntEnum):
    """Why a hub ended a connection, as it stands in the goodbye."""

    CLOSED = 1
    OVERRUN = 2
    MALFORMED = 3
    VERSION = 4
    NOT_A_CLIENT = 5


_TEXT: Final = {
    Reason.CLOSED: "the hub was closed",
    Reason.OVERRUN: "this reader was too slow: the hub's queue for it was full and {detail} frames were discarded",
    Reason.MALFORMED: "the hub received a record with a length of {detail}, more than the 8 bytes of classic CAN",
    Reason.VERSION: f"the hub speaks version {{detail}} of the protocol, this client version {VERSION}",
    Reason.NOT_A_CLIENT: "the hub did not understand the hello of this client",
}


def hello(flags: int) -> bytes:
    """Return a hello (or a welcome) of this process."""
    return HELLO.pack(MAGIC, VERSION, flags, os.getpid())


def goodbye(reason: Reason, detail: int = 0) -> bytes:
    """Return the goodbye record."""
    return GOODBYE.pack(GOODBYE_ID, GOODBYE_LEN, reason, min(detail, 0xFFFFFFFF))


def goodbye_text(record: bytes) -> str | None:
    """Return the reason in words when these 16 bytes are a goodbye, else None."""
    can_id, length, reason, detail = GOODBYE.unpack(record)
    if can_id != GOODBYE_ID or length != GOODBYE_LEN:
        return None
    try:
        return _TEXT[Reason(reason)].format(detail=detail)
    except ValueError:
        return f"the hub ended the connection (reason {reason}, detail {detail})"
