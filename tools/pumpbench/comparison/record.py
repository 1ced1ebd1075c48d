"""A record to compare: a run folder, or a log in candump format."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from can_bus import codec
from pumpbench.candump import read_candump
from pumpbench.frames import Frames
from pumpbench.identity import other_dbc
from pumpbench.runfolder import RunFolder
from pumpbench.trace import Trace


class RecordError(ValueError):
    """What was given is no record; the text says what it is."""


@dataclass(frozen=True, eq=False)
class Record:
    """One of two runs.

    Attributes:
        name: what to call it.
        frames: all of it.
        info: content of run.json; empty for a bare log.
    """

    name: str
    frames: Frames
    info: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def load(cls, path: Path) -> Record:
        """Read a run folder, or a log.

        Raises:
            RunFolderError: the folder is unfinished or damaged.
            RecordError: no such file, or it is no candump log.
        """
        if path.is_dir():
            folder = RunFolder.load(path)
            return cls(str(path), folder.frames, folder.info)
        if not path.exists():
            RunFolder.load(path)  # knows what to say of a folder that is not there
        try:
            frames = read_candump(path)
        except OSError as error:
            raise RecordError(f"cannot read {path}: {error.strerror}") from None
        except ValueError as error:
            raise RecordError(str(error)) from None
        token = codec.message("SYNC_Step")
        if not (frames.intact & (frames.can_id == token.can_id)).any():
            raise RecordError(f"{path} has no {token.name} of a run in it: without one no frame has its instant")
        return cls(str(path), frames)

    @functools.cached_property
    def trace(self) -> Trace:
        """The record decoded, one row per step."""
        return Trace.from_frames(self.frames, self.info)

    @property
    def foreign_dbc(self) -> str | None:
        """A warning, if its frames were written by another DBC than the one that decodes them."""
        foreign = other_dbc(self.info)
        return None if foreign is None else f"{self.name} {foreign}, which decodes it here"
