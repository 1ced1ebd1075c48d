"""A candump log in the format of another tool: whatever python-can can write, chosen by the file's suffix."""

import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import can
from can.io.logger import MESSAGE_WRITERS
from can.util import channel2int

from can_bus.frame import to_message
from pumpbench.candump import LogLine, read_lines
from pumpbench.runfolder import LOG

SIMULATED_BEFORE: Final = 631152000.0
"""Time stamps before 1990 are no wall-clock time: the rule of python-can's BLF files, used for all formats here."""

WITHOUT_CHANNEL: Final = frozenset({".csv", ".db"})
"""Formats of python-can that do not say on which bus a frame was."""

WITHOUT: Final = {".trc": ("remote", "error")}
"""Frames that python-can's writer of a format drops, with a warning for each."""


class ConvertError(ValueError):
    """What was asked for cannot be converted; the text says why."""


class Converted(NamedTuple):
    """What is in the new file."""

    frames: int
    channels: dict[str, int]
    """Interface of the log -> channel, counted from 0 as python-can does; most formats write it counted from 1."""
    left_out: int
    """Frames of a kind that the format does not have."""


def convert(source: Path, out: Path, *, overwrite: bool = False, only: str | None = None) -> Converted:
    """Write a candump log as another file; it is there as a whole or not at all.

    Args:
        source: a log, or a run folder, whose bus.log is meant.
        out: the file; its suffix says the format.
        overwrite: replace an existing file.
        only: the interface whose frames are wanted; None: all.

    Raises:
        ConvertError: there is no such log, format or interface, or the file exists.
        OSError: the log cannot be read or the file not be written.
    """
    log = source / LOG if source.is_dir() else source
    if not log.is_file():
        raise ConvertError(f"there is no {LOG} in {source}" if source.is_dir() else f"there is no file {source}")
    if out.is_dir() or (out.exists() and not overwrite):
        raise ConvertError(f"{out} is a folder" if out.is_dir() else f"{out} exists; give --overwrite to replace it")
    suffix = _suffix(out)
    try:
        lines = list(read_lines(log))
    except ValueError as error:
        raise ConvertError(str(error)) from None
    if only is not None:
        names = {line.interface for line in lines}
        if only not in names:
            raise ConvertError(f"{log} has no interface {only!r}; it has {', '.join(sorted(names)) or 'no frames'}")
        lines = [line for line in lines if line.interface == only]
    channels = _channels(sorted({line.interface for line in lines}))
    if suffix.removesuffix(".gz") in WITHOUT_CHANNEL and len(channels) > 1:
        raise ConvertError(
            f"{suffix} does not say on which bus a frame was; {log} has {', '.join(channels)}: choose one with --only"
        )
    wanted = [line for line in lines if _kind(line) not in WITHOUT.get(suffix.removesuffix(".gz"), ())]
    out.parent.mkdir(parents=True, exist_ok=True)
    # A folder beside it: some of python-can's writers look at the whole name, and want a suffix and no other dot in it.
    folder = Path(tempfile.mkdtemp(prefix=f".{out.name}-", suffix=".partial", dir=out.parent))
    partial = folder / f"log{suffix}"
    try:
        _write(partial, out, wanted, channels)
        partial.replace(out)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return Converted(len(wanted), channels, len(lines) - len(wanted))


def _suffix(out: Path) -> str:
    """The format, with a `.gz` behind it if the file is to be compressed.

    Raises:
        ConvertError: python-can has no such format.
    """
    suffix = "".join(out.suffixes[-2:] if out.suffix.lower() == ".gz" else out.suffixes[-1:]).lower()
    if suffix.removesuffix(".gz") not in MESSAGE_WRITERS:
        there_is = ", ".join(sorted(MESSAGE_WRITERS))
        raise ConvertError(f"{out}: no log format has the suffix {suffix!r}; there is {there_is}")
    return suffix


def _channels(names: Sequence[str]) -> dict[str, int]:
    """A number for each interface: the one in its name, unless that leaves any without one of its own."""
    numbers = {name: channel2int(name) for name in names}
    if None not in numbers.values() and len(set(numbers.values())) == len(numbers):
        return {name: number for name, number in numbers.items() if number is not None}
    return {name: number for number, name in enumerate(names)}


def _kind(line: LogLine) -> str:
    if line.frame.is_error:
        return "error"
    return "remote" if line.frame.is_remote else "data"


def _write(path: Path, final: Path, lines: Sequence[LogLine], channels: dict[str, int]) -> None:
    try:
        writer: Any = can.Logger(path)
    except (NotImplementedError, ValueError) as error:  # .mf4 needs a package that we do not, some cannot be compressed
        raise ConvertError(f"{final}: {error}") from None
    with writer:
        if isinstance(writer, can.TRCWriter):
            writer.filepath = str(final.absolute())  # it goes into the file's header
        if lines and lines[0].time_s < SIMULATED_BEFORE:
            _keep_stamps(writer)
        named = isinstance(writer, can.CanutilsLogWriter)
        for time_s, interface, frame, is_rx in lines:
            message = to_message(frame, time_s, interface, is_rx)
            message.channel = interface if named else channels[interface]
            writer.on_message_received(message)
    if isinstance(writer, can.SqliteWriter) and writer.num_frames != len(lines):  # its thread has met the error
        raise OSError(f"cannot write {final}: {writer.num_frames} of {len(lines)} frames were stored")


def _keep_stamps(writer: Any) -> None:
    """Have simulated time written as it is: these would count from the first frame."""
    if isinstance(writer, can.BLFWriter):
        writer.start_timestamp = 0.0
    elif isinstance(writer, can.ASCWriter):
        writer.log_event("Start of simulated time", 0.0)
    elif isinstance(writer, can.TRCWriter):
        writer.first_timestamp = 0.0
        writer.write_header(0.0)
