"""Log files in candump format (`candump -L`), which python-can, `cantools decode`, can-utils and SavvyCAN read."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from can_bus.frame import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, MAX_DATA, Frame
from pumpbench.capture import Capture
from pumpbench.frames import Frames

_FLAGS: Final = CAN_EFF_FLAG | CAN_ERR_FLAG


def write_candump(frames: Frames, path: Path, names: Sequence[str] = ("can0", "can1")) -> None:
    """Write the frames as a candump log (`candump -L`), time-stamped with simulated seconds.

    python-can, `cantools decode`, can-utils and SavvyCAN read it.

    Args:
        frames: what to write.
        path: the file; overwritten.
        names: interface name of channel 0 and of channel 1.
    """
    order = np.argsort(frames.time_s, kind="stable")
    micros = np.rint(frames.time_s[order] * 1e6).astype("i8").tolist()
    channels, ids = frames.channel[order].tolist(), frames.can_id[order].tolist()
    lengths, data = frames.length[order].tolist(), frames.data[order].tobytes().hex().upper()
    flags = _FLAGS
    with path.open("w", encoding="ascii", newline="\n") as file:
        for row, (micro, channel, can_id, length) in enumerate(zip(micros, channels, ids, lengths, strict=True)):
            seconds, fraction = divmod(micro, 1_000_000)
            if not can_id & (flags | CAN_RTR_FLAG):
                text = f"{can_id:03X}#{data[16 * row : 16 * row + 2 * length]}"
            else:
                bare = can_id & ~CAN_RTR_FLAG
                name = f"{bare if bare & CAN_ERR_FLAG else bare & ~CAN_EFF_FLAG:08X}" if bare & flags else f"{bare:03X}"
                payload = f"R{length or ''}" if can_id & CAN_RTR_FLAG else data[16 * row : 16 * row + 2 * length]
                text = f"{name}#{payload}"
            file.write(f"({seconds}.{fraction:06d}) {names[channel]} {text}\n")


class LogLine(NamedTuple):
    """One line of a candump log."""

    time_s: float
    interface: str
    frame: Frame
    is_rx: bool
    """False only where the log says that this machine sent the frame."""


def _parse_line(line: str) -> LogLine:
    """Take a line of a candump log apart.

    Raises:
        ValueError, IndexError: it is none.
    """
    stamp, name, frame, *direction = line.split()
    if stamp[0] != "(" or stamp[-1] != ")" or direction not in ([], ["R"], ["T"]):
        raise ValueError(line)
    time_s = float(stamp[1:-1])
    ident, hash_, payload = frame.partition("#")
    if not hash_:
        raise ValueError(line)
    can_id = int(ident, 16)
    if len(ident) == 8 and not can_id & CAN_ERR_FLAG:
        can_id |= CAN_EFF_FLAG
    if payload[:1] in ("R", "r"):
        can_id, data = can_id | CAN_RTR_FLAG, bytes(int(payload[1:] or 0))
    else:
        data = bytes.fromhex(payload)
    if len(data) > MAX_DATA or not 0 <= can_id <= 0xFFFFFFFF or not math.isfinite(time_s):
        raise ValueError(line)
    return LogLine(time_s, name, Frame(can_id, data), direction != ["T"])


def read_lines(path: Path) -> Iterator[LogLine]:
    """Read a candump log line by line, as it is.

    Raises:
        ValueError: a line is no frame of classic CAN; the text says which.
        OSError: the file cannot be read.
    """
    with path.open(encoding="ascii", errors="replace") as file:
        for number, line in enumerate(file, 1):
            if not line.strip():
                continue
            try:
                parsed = _parse_line(line)
            except (ValueError, IndexError):
                raise ValueError(f"{path}:{number}: not a line of a candump log: {line.strip()[:60]!r}") from None
            yield parsed


def read_candump(path: Path, names: Sequence[str] = ("can0", "can1")) -> Frames:
    """Read a candump log back; step, turn and time come from the SYNC frames in it, not from its time stamps.

    Args:
        path: the log.
        names: interface name of channel 0 and of channel 1; other interfaces are numbered in the order of their names.

    Raises:
        ValueError: a line is no frame of classic CAN; the text says which.
        OSError: the file cannot be read.
    """
    found: dict[str, list[Frame]] = {}
    for line in read_lines(path):
        found.setdefault(line.interface, []).append(line.frame)
    capture = Capture()
    channels = list(names) if set(found) <= set(names) else sorted(found)
    for name, frames in found.items():
        capture.extend(channels.index(name), frames)
    return capture.finish()
