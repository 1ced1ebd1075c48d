"""The wire's only source of truth: pumpbench.dbc, and how to load it.

Nothing else in this project defines an id, a scale, a range or a limit of a frame. Other people's tools (candump with
cantools, CANalyzer, generated C code) read the same file.
"""

import functools
import zlib
from pathlib import Path
from typing import Any

DBC_PATH = Path(__file__).with_name("pumpbench.dbc")


@functools.cache
def load() -> Any:
    """The database as `cantools.database.can.Database`, loaded strictly.

    Raises:
        cantools.database.Error: the file is not a valid DBC, or a signal overlaps another or leaves its message.
    """
    import cantools  # noqa: PLC0415  (0.1 s: only who needs a codec pays for it)

    return cantools.database.load_file(DBC_PATH, strict=True)


@functools.cache
def protocol_version() -> tuple[int, int]:
    """Major and minor version of the protocol, from the attribute ProtocolVersion."""
    major, minor = str(load().dbc.attributes["ProtocolVersion"].value).split(".")
    return int(major), int(minor)


@functools.cache
def crc32() -> int:
    """CRC-32 (zlib) of the DBC file with Unix line ends, as PLANT_Info.PlantDbcCrc states it."""
    return zlib.crc32(DBC_PATH.read_bytes().replace(b"\r\n", b"\n"))
