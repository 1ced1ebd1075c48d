"""What a recorder left that was killed, or whose disk was full, made readable."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from pumpbench.candump import read_candump
from pumpbench.frames import Frames
from pumpbench.identity import stated
from pumpbench.recorder.journal import read_journal, unused
from pumpbench.runfolder import LOG, PARTIAL, RUN, RunFolder, RunFolderError


def repair(partial: Path) -> Path:
    """Write run.json, bus.log, trace.parquet and recording.rrd of an unfinished run folder anew; returns the folder.

    It stays unfinished: its name ends in `.partial`, and run.json says so.

    Raises:
        RunFolderError: there is nothing to repair, or it is still being recorded.
        NotWritten: a file cannot be written.
    """
    partial = Path(partial).absolute()
    if not partial.is_dir() or not partial.name.endswith(PARTIAL):
        raise RunFolderError(f"{partial} is no unfinished run folder (DIR{PARTIAL})")
    try:
        with unused(partial):
            frames, info = _left(partial)
            RunFolder(partial.with_name(partial.name.removesuffix(PARTIAL))).write_partial(frames, info)
    except BlockingIOError:
        raise RunFolderError(f"{partial} is still being recorded") from None
    return partial


def _left(partial: Path) -> tuple[Frames, dict[str, Any]]:
    """The frames that were kept, and what run.json says.

    Raises:
        RunFolderError: there are none.
    """
    info = _info(partial)
    try:
        capture = read_journal(partial)
        if capture is None:
            return read_candump(partial / LOG), info
    except FileNotFoundError:
        raise RunFolderError(f"{partial} holds neither a journal nor a {LOG}") from None
    except OSError as error:
        raise RunFolderError(f"cannot read {error.filename or partial}: {error.strerror}") from None
    except ValueError as error:
        raise RunFolderError(str(error)) from None
    return capture.finish(), info | {"device": stated(capture.device_info())}


def _info(partial: Path) -> dict[str, Any]:
    """What run.json says; it is written before the first frame, and a full disk may have left nothing of it."""
    try:
        info = json.loads((partial / RUN).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return info if isinstance(info, dict) else {}
