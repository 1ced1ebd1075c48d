"""A run as a Rerun recording while it is still on: a file and a server at once, a step at a time.

What is drawn, and how, is that of a whole run (`pumpbench.recording.columns`); here is only what to send of it. Each
time a window of the run is looked at: the frames of the last hour, and of those before it the few that still count (the
calibration, alarms that stand, faults that are at work). So the work does not grow with the run.

What a step delivered is known when the next one has begun; a series is therefore sent up to its last known value.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from can_bus import codec
from can_bus.lockstep import STEP_SECONDS
from pumpbench.events import FaultSpan
from pumpbench.frames import Frames, concatenated
from pumpbench.recording.columns import Colour, Run
from pumpbench.recording.file import APPLICATION
from pumpbench.recording.scene import PROPERTY, Scene
from pumpbench.recording.tool import RecordingError
from pumpbench.signals import decode
from pumpbench.story import Note, notes, title
from pumpbench.trace import Trace

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    Array = NDArray[Any]

LOOPBACK: Final = "127.0.0.1"
MEMORY: Final = "256MiB"
"""What the server keeps for viewers who come later; the oldest goes first."""

CONTEXT_STEPS: Final = 12
"""Steps that are looked at again: a gap in the pump's totals is spread over its steps if it is no longer."""

SETTLED_STEPS: Final = 6
"""Steps after which it is known how often which message comes as a rule."""

SHOWN_SECONDS: Final = 12 * 3600.0

_KEYS: Final[Mapping[str, tuple[str, ...]]] = {
    "CFG_Param": ("CfgIndex",),
    "CTRL_Alarm": ("CtrlAlarmInstance", "CtrlAlarmState"),
    "PUMP_Alarm": ("PumpAlarmInstance", "PumpAlarmState"),
    "FAULT_Inject": ("FaultTarget", "FaultCanId", "FaultKind"),
}
"""Messages whose last frame for each value of these signals counts for longer than the window."""


class LiveRecording:
    """A recording that grows.

    Args:
        path: the file.
        port: of the server, on the loopback interface alone; the caller has seen that it is free.
        info: content of run.json as far as it is known.
        gateway: whether the plant's bus is recorded as well.

    Raises:
        RecordingError: the file cannot be written; so for all that follow.
    """

    def __init__(self, path: Path, port: int, info: Mapping[str, Any], *, gateway: bool) -> None:
        import rerun as rr  # noqa: PLC0415

        from pumpbench.recording.layout import live_blueprint  # noqa: PLC0415

        rr.set_strict_mode(True)
        self._window = _Window()
        self._stream = rr.RecordingStream(APPLICATION)
        scene = Scene(gateway=gateway)
        with _errors():
            self._stream.set_sinks(
                rr.FileSink(path),
                rr.GrpcServerSink(LOOPBACK, port, server_memory_limit=MEMORY),
                default_blueprint=live_blueprint(scene, SHOWN_SECONDS),
            )
            rr.set_log_time_enabled(False, recording=self._stream)
            self._stream.send_recording_name(f"{title(info)} (live)")
            self._stream.send_property(PROPERTY, rr.AnyValues(json=scene.as_json()))
            self._logger = _Live(self._stream)
            self._logger.properties(info, {})
        self.flush()

    def draw(self, frames: Frames) -> None:
        """Draw frames that `pumpbench.capture.Follower` has handed out."""
        if not len(frames):
            return
        with _errors():
            standing, recent = self._window.with_new(frames)
            self._logger.run(Trace.from_frames(concatenated([standing, recent]).in_order()), recent)
            self._logger.tables(frames)

    def flush(self) -> None:
        """Hand everything to the file and the server."""
        with _errors():
            self._stream.flush(timeout_sec=60)  # a dead file writer is told here and nowhere else

    def close(self) -> None:
        """Complete the file and close the server."""
        self.flush()
        self._stream.disconnect()


@contextlib.contextmanager
def _errors() -> Iterator[None]:
    try:
        yield
    except (RuntimeError, TypeError, ValueError) as error:
        raise RecordingError(f"Rerun could not draw: {error}") from error


class _Window:
    """The frames that decide what a step means."""

    def __init__(self) -> None:
        self._recent = Frames.none()
        self._standing: dict[tuple[int, ...], Frames] = {}

    def with_new(self, frames: Frames) -> tuple[Frames, Frames]:
        """The window with these frames at its end: what still counts, as if said at its beginning, and the rest."""
        last = int(frames.step.max())
        both = concatenated([self._recent, frames]).in_order()
        old = both.step <= last - CONTEXT_STEPS
        standing = concatenated([each.at_step(int(both.step[0])) for each in self._standing.values()])
        self._remember(both.select(np.flatnonzero(old)))
        self._recent = both.select(np.flatnonzero(~old))
        return standing, both

    def _remember(self, frames: Frames) -> None:
        """Keep what still counts of frames that leave the window."""
        found: list[tuple[int, tuple[int, ...]]] = []
        for message, names in _KEYS.items():
            decoded = decode(frames, message)
            ident = codec.message(message).can_id
            columns = [frames.channel[decoded.rows].tolist(), *(decoded.raw[name].tolist() for name in names)]
            found += [(row, (ident, *key)) for row, *key in zip(decoded.rows.tolist(), *columns, strict=True)]
        boots = decode(frames, "HB_CTRL", 0)
        boot_up = codec.choice("HB_CTRL", "NmtCtrl", "BootUp")
        found += [(row, ()) for row in boots.rows[boots.raw["NmtCtrl"] == boot_up].tolist()]
        alarm = codec.message("CTRL_Alarm").can_id
        for row, key in sorted(found):
            if key:
                self._standing.pop(key, None)  # to the end: the order of the last ones counts
                self._standing[key] = frames.select(np.array([row]))
            else:  # a device that starts anew raises nothing that it raised before
                self._standing = {key: each for key, each in self._standing.items() if key[0] != alarm}


class _Live(Run):
    """Sends of a window what was not sent before."""

    def __init__(self, recording: Any) -> None:
        super().__init__(recording)
        self._sent: dict[str, float] = {}
        self._states: dict[str, tuple[float, str]] = {}
        self._colours: dict[str, dict[str, Colour]] = {}
        self._styles: dict[str, tuple[str, ...]] = {}
        self._usual: dict[str, float | None] = {}
        self._settled = False
        self._told_s = -np.inf

    def fresh(self, path: str, time_s: Array, known: Array) -> Array:
        last = float(time_s[np.flatnonzero(known)[-1]])
        rows: Array = (time_s > self._sent.get(path, -np.inf)) & (time_s <= last)
        self._sent[path] = max(last, self._sent.get(path, -np.inf))
        return rows

    def limit(self, path: str, trace: Trace, level: float) -> None:
        self.scalars(path, trace.time_s, np.full(len(trace), level))

    def run(self, trace: Trace, frames: Frames) -> None:
        super().run(trace, frames)
        self._settled |= len(trace) >= SETTLED_STEPS

    def usual(self, lane: str, counts: Array) -> float | None:
        if self._settled:
            return self._usual.get(lane, 0.0)
        if len(counts) < SETTLED_STEPS:
            return None
        self._usual[lane] = super().usual(lane, counts)
        return self._usual[lane]

    def is_over(self, span: FaultSpan, trace: Trace) -> bool:
        return span.end_s < float(trace.time_s[-1])

    def fresh_states(self, path: str, changes: list[tuple[float, str]]) -> list[tuple[float, str]]:
        last_s, last = self._states.get(path, (-np.inf, ""))
        found = []
        for time_s, state in changes:
            if time_s > last_s and state != last:
                found.append((time_s, state))
                last_s, last = self._states[path] = time_s, state
        return found

    def fresh_notes(self, trace: Trace) -> list[Note]:
        until = float(trace.time_s[-1]) + STEP_SECONDS
        found = [note for note in notes(trace, running=True) if self._told_s <= note.time_s < until]
        self._told_s = until
        return found

    def palette(self, path: str, colours: dict[str, Colour]) -> dict[str, Colour]:
        known = self._colours.setdefault(path, {})
        known.update(colours)
        return known

    def style(self, path: str, what: Any, key: tuple[str, ...] = ()) -> None:
        if self._styles.get(path) != key:
            super().style(path, what)
            self._styles[path] = key
