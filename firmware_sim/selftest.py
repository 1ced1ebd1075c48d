"""What the device checks of itself (requirement STA-02): its program, its memory, its calibration."""

import binascii
import enum
from collections.abc import Mapping

from .control import core, lags, limits, observer, prandial
from .control.fixed import Ints
from .control.strategies import s1, s2, s3, s4

PATTERNS = (0, -1, 0x55555555, -0x55555556)
"""Words that leave no stuck bit unseen."""


class Failure(enum.IntFlag):
    """What failed; the alarm SelfTest tells it."""

    NONE = 0
    PROGRAM = 1
    RAM = 2
    MEMORY = 4
    PARAMETERS = 8


def program_crc() -> int:
    """CRC-32 over the code of the control path, as a boot loader takes it over its flash."""
    crc = 0
    for module in (core, lags, limits, observer, prandial, s1, s2, s3, s4):
        crc = _names_crc(vars(module), crc)
    return crc


def _names_crc(names: Mapping[str, object], crc: int) -> int:
    for name in sorted(names):
        value = names[name]
        code = getattr(value, "__code__", None)
        if code is not None:
            crc = binascii.crc32(name.encode() + code.co_code, crc)
        elif isinstance(value, int):
            crc = binascii.crc32(f"{name}={value}".encode(), crc)
    return crc


PROGRAM_CRC = program_crc()
"""What the control path was when it was loaded."""


def check_program() -> Failure:
    """Whether the control path is what was loaded."""
    return Failure.NONE if program_crc() == PROGRAM_CRC else Failure.PROGRAM


def check_ram(*arrays: Ints) -> Failure:
    """Whether every word of the working memory holds what is written; what was in it is put back."""
    for array in arrays:
        kept = list(array)
        for pattern in PATTERNS:
            array[:] = [pattern] * len(kept)
            if list(array) != [pattern] * len(kept):
                return Failure.RAM
        array[:] = kept
        if list(array) != kept:
            return Failure.RAM
    return Failure.NONE
