"""How long a receive waits, as a socket option: one system call less than `poll` and receive."""

from __future__ import annotations

import struct
from typing import Final

SHORT: Final = 0.1
"""Seconds; SO_RCVTIMEO counts in jiffies of up to 10 ms: for waits below this use `poll`, which is exact."""

_TIMEVAL: Final = struct.Struct("@ll")


def timeval(seconds: float | None) -> bytes:
    """A struct timeval; None is for ever, which is zero to the kernel, so that no time becomes the shortest wait."""
    micros = 0 if seconds is None else min(max(1, round(seconds * 1e6)), 10**15)
    return _TIMEVAL.pack(micros // 1_000_000, micros % 1_000_000)
