"""The folder a run leaves behind, which opens without this tool.

    run.json          versions, seed, patient, strategy, ..., and `trace_sha256`, the hash over all frames
    bus.log           every frame, candump format, simulated time stamps
    trace.parquet     decoded signals and the plant's truth, one row per step
    metrics.json      the outcome
    recording.rrd     the same for Rerun's viewer
    summary.png       the same as one picture

A folder is written under the name `<out>.partial` and renamed at the end: a folder without `.partial` is complete.
While the run is on it holds run.json, a journal of the frames (`pumpbench.recorder.journal`) and, of a run that is
watched, a recording that grows; `pumpbench.recorder.repair` makes the rest of them.
"""

from __future__ import annotations

import errno
import functools
import json
import math
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from pumpbench.candump import read_candump, write_candump
from pumpbench.frames import Frames
from pumpbench.identity import other_dbc
from pumpbench.recorder import journal
from pumpbench.trace import PARQUET_NAME, Trace

if TYPE_CHECKING:
    from collections.abc import Iterable

RUN, LOG, METRICS, RECORDING, SUMMARY = "run.json", "bus.log", "metrics.json", "recording.rrd", "summary.png"
FILES: Final = (RUN, LOG, PARQUET_NAME, METRICS, RECORDING, SUMMARY)
PARTIAL: Final = ".partial"
_SCRATCH: Final = ".recording-"


class RunFolderError(OSError):
    """A run folder that cannot be written or read; the text names the file and what is wrong with it."""

    def __init__(self, text: str) -> None:
        super().__init__(text)


class NotWritten(RunFolderError):
    """The disk has failed or is full in the middle of it; the text says where what there is of the run is."""


class RunFolder:
    """A run folder being written, or one that was read back.

    Attributes:
        path: where it is, or will be.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @property
    def partial(self) -> Path:
        """Where the files are until the folder is complete."""
        return self.path.with_name(self.path.name + PARTIAL)

    # ---- writing

    @classmethod
    def create(cls, out: Path, overwrite: bool = False) -> RunFolder:
        """Reserve a folder for a run that is about to start; to be called before the work, so that it fails early.

        Args:
            out: the folder; it appears when `write_all` is done.
            overwrite: replace an existing run folder then.

        Raises:
            RunFolderError: the folder exists and is not empty, or cannot be made. Only a run folder is ever replaced.
        """
        folder = cls(Path(out).absolute())
        if folder.path.exists():
            if not folder.path.is_dir():
                raise RunFolderError(f"{out} exists and is not a folder")
            if any(folder.path.iterdir()):
                if not _is_run_folder(folder.path):
                    raise RunFolderError(f"{out} is not empty and is no run folder: it is not touched")
                if not overwrite:
                    raise RunFolderError(f"{out} already holds a run: choose another folder or ask to overwrite")
        if folder.partial.exists():
            if not _is_run_folder(folder.partial, unfinished=True):
                raise RunFolderError(f"{folder.partial} is in the way and no unfinished run folder: it is not touched")
            shutil.rmtree(folder.partial)
        try:
            folder.partial.mkdir(parents=True)
        except OSError as error:
            raise RunFolderError(f"cannot make {folder.partial}: {error.strerror}") from None
        return folder

    def begin(self, info: Mapping[str, Any], channels: int) -> journal.Journal:
        """Write what is known before the first frame, and open the journal.

        Raises:
            NotWritten: a file could not be written.
        """
        self._write(RUN, lambda path: _dump({**info, "complete": False}, path))
        try:
            return journal.Journal(self.partial, channels)
        except OSError as error:
            raise self.failed("the journal", error) from error

    def write_all(
        self, frames: Frames, info: Mapping[str, Any], metrics: Mapping[str, Any], trace: Trace | None = None
    ) -> None:
        """Write all files and give the folder its name.

        Args:
            frames: every frame of the run.
            info: content of run.json; `trace_sha256` and `frames` are added.
            metrics: content of metrics.json.
            trace: the decoded run, if the caller already has it.

        Raises:
            NotWritten: a file could not be written (a full disk); what was written stays in `<out>.partial`.
        """
        from pumpbench.pictures.summary import write_summary  # noqa: PLC0415
        from pumpbench.recording.file import write_recording  # noqa: PLC0415

        info = self._info(frames, info, complete=True)
        trace = Trace.from_frames(frames) if trace is None else trace
        trace.info = info
        self._write(RUN, lambda path: _dump(info, path))
        self._write(LOG, lambda path: write_candump(frames, path))
        self._write(PARQUET_NAME, trace.save)
        self._write(METRICS, lambda path: _dump(metrics, path))
        self._write(RECORDING, lambda path: write_recording(trace, frames, path, metrics))
        self._write(SUMMARY, lambda path: write_summary(trace, path, metrics))
        self._remove_journal()
        self._rename()

    def write_partial(self, frames: Frames, info: Mapping[str, Any]) -> None:
        """Write what there is of a run that was cut off; the folder keeps its name with `.partial`.

        Raises:
            NotWritten: a file could not be written.
        """
        from pumpbench.recording.file import write_recording  # noqa: PLC0415

        info = self._info(frames, info, complete=False)
        trace = Trace.from_frames(frames, info)
        self._write(RUN, lambda path: _dump(info, path))
        self._write(LOG, lambda path: write_candump(frames, path))
        self._write(PARQUET_NAME, trace.save)
        self._write(RECORDING, lambda path: write_recording(trace, frames, path))
        self._remove_journal()

    def discard(self) -> None:
        """Remove the unfinished folder, e.g. of a run that never began."""
        shutil.rmtree(self.partial, ignore_errors=True)

    @staticmethod
    def _info(frames: Frames, info: Mapping[str, Any], *, complete: bool) -> dict[str, Any]:
        return {**info, "complete": complete, "frames": len(frames), "trace_sha256": frames.sha256()}

    def _write(self, name: str, write: Callable[[Path], None]) -> None:
        path = self.partial / name
        try:
            write(path)
        except (OSError, RuntimeError) as error:
            raise self.failed(name, error) from error

    def failed(self, name: str, error: Exception) -> NotWritten:
        """What to say of a file of this folder that could not be written."""
        free = shutil.disk_usage(self.partial).free if self.partial.exists() else 0
        full = getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT) or "No space left" in str(error)
        full = full or free < 1_000_000
        reason = f"the disk is full ({free // 1024} KiB free)" if full else getattr(error, "strerror", "") or str(error)
        return NotWritten(f"cannot write {name}: {reason}; what there is of the run is in {self.partial}")

    def _remove_journal(self) -> None:
        """The log holds all of it."""
        for name in journal.NAMES:
            (self.partial / name).unlink(missing_ok=True)

    def _rename(self) -> None:
        old = None
        if self.path.exists():
            old = self.path.with_name(self.path.name + ".replaced")
            shutil.rmtree(old, ignore_errors=True)
            self.path.rename(old)
        self.partial.rename(self.path)
        if old is not None:
            shutil.rmtree(old, ignore_errors=True)

    # ---- reading

    @classmethod
    def load(cls, directory: Path) -> RunFolder:
        """Open a complete run folder; its files are read when they are asked for.

        Raises:
            RunFolderError: no such folder, it is unfinished, or a file is missing.
        """
        path = Path(directory)
        if not path.is_dir():
            hint = f"; an unfinished one is {path}{PARTIAL}" if Path(f"{path}{PARTIAL}").is_dir() else ""
            raise RunFolderError(f"there is no run folder {path}{hint}")
        missing = [name for name in FILES if not (path / name).is_file()]
        if missing:
            what = "is unfinished" if path.name.endswith(PARTIAL) else "is not a complete run folder"
            raise RunFolderError(f"{path} {what}: {', '.join(missing)} missing")
        return cls(path)

    @functools.cached_property
    def info(self) -> dict[str, Any]:
        """Content of run.json.

        Raises:
            RunFolderError: the file is missing or corrupt; so for all that follow.
        """
        return self._json(RUN)

    @functools.cached_property
    def metrics(self) -> dict[str, Any]:
        """Content of metrics.json."""
        return self._json(METRICS)

    @functools.cached_property
    def logged(self) -> Frames:
        """Every frame in bus.log, whether or not it is the one that was recorded."""
        path = self.path / LOG
        try:
            return read_candump(path)
        except OSError as error:
            raise RunFolderError(f"cannot read {path}: {error.strerror}") from None
        except ValueError as error:
            raise RunFolderError(str(error)) from None

    @functools.cached_property
    def frames(self) -> Frames:
        """Every frame, from bus.log, checked against the hash in run.json."""
        path, frames = self.path / LOG, self.logged
        if "trace_sha256" in self.info and frames.sha256() != self.info["trace_sha256"]:
            changed = f"was changed: its frames do not have the hash that {RUN} states"
            raise RunFolderError(f"{path} {other_dbc(self.info) or changed}")
        return frames

    @functools.cached_property
    def trace(self) -> Trace:
        """The decoded run, from trace.parquet."""
        try:
            return Trace.load(self.path)
        except (OSError, ValueError) as error:
            raise RunFolderError(str(error)) from None

    @property
    def recording(self) -> Path:
        """Rerun's file."""
        return self.path / RECORDING

    @property
    def summary(self) -> Path:
        """The picture."""
        return self.path / SUMMARY

    def _json(self, name: str) -> dict[str, Any]:
        path = self.path / name
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise RunFolderError(f"cannot read {path}: {error.strerror}") from None
        except ValueError as error:
            raise RunFolderError(f"{path} is corrupt: {error}") from None
        if not isinstance(content, dict):
            raise RunFolderError(f"{path} is corrupt: it holds no object")
        return content


def _dump(content: Mapping[str, Any], path: Path) -> None:
    """Write JSON; on a full disk an older file stays as it is."""
    new = path.with_name(f"{_SCRATCH}{path.name}")
    new.write_text(json.dumps(plain(content), indent=2, allow_nan=False) + "\n", encoding="utf-8")
    new.replace(path)


def plain(value: Any) -> Any:
    """Only what JSON has: numbers of numpy become numbers, NaN becomes null, a path or anything else its text."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, str | int | float | None) else str(value)


def _is_run_folder(path: Path, *, unfinished: bool = False) -> bool:
    names = _names(path.iterdir())
    return names <= {*FILES, *journal.NAMES} if unfinished else RUN in names


def _names(entries: Iterable[Path]) -> set[str]:
    """Names of the entries, without the scratch files and folders a killed recorder may leave."""
    return {entry.name for entry in entries if not entry.name.startswith(_SCRATCH)}
