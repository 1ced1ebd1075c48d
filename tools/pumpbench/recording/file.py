"""The recording of a run as a file."""

from __future__ import annotations

import json
import tempfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from can_bus.lockstep import STEP_SECONDS
from pumpbench.capture import Frames
from pumpbench.recording.columns import log_run
from pumpbench.recording.layout import blueprint
from pumpbench.recording.tool import RecordingError, quiet_environment, rrd
from pumpbench.story import LANES, title
from pumpbench.trace import Trace

APPLICATION: Final = "pumpbench"
GLUCOSE: Final = ("TruthGlucose", "GlucoseConc")


def write_recording(trace: Trace, frames: Frames, path: Path, metrics: Mapping[str, Any] | None = None) -> None:
    """Write the run with its blueprint as an .rrd file, compacted and verified.

    Args:
        trace: the decoded run.
        frames: every frame of it.
        path: the file; overwritten.
        metrics: content of metrics.json, shown beside the run's data.

    Raises:
        RecordingError: Rerun could not write the file or does not accept it.
    """
    import rerun as rr  # noqa: PLC0415

    end_s = float(trace.time_s[-1]) if len(trace) else 0.0
    layout = blueprint(
        0.0 if not len(trace) else float(trace.time_s[0]),
        max(end_s, STEP_SECONDS),
        gateway=bool(np.any(frames.channel == 1)),
        bus_top=3.0 * _usual_frames(frames),
        lanes=_lane_count(trace),
        glucose_top=max(320.0, *(np.nanmax(np.append(trace.get(name), 0.0)) + 20 for name in GLUCOSE)),
    )
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".recording-") as directory:
        raw, final = Path(directory) / "raw.rrd", Path(directory) / "recording.rrd"
        strict = rr.strict_mode()
        rr.set_strict_mode(True)  # else a value Rerun does not like is only a warning, and missing
        try:
            with rr.RecordingStream(APPLICATION, recording_id=_recording_id(trace, frames)) as recording:
                recording.save(raw, default_blueprint=layout)
                rr.set_log_time_enabled(False, recording=recording)
                recording.send_recording_name(title(trace.info))
                log_run(recording, trace, frames, metrics)
                recording.flush(timeout_sec=60)
        except (RuntimeError, TypeError, ValueError) as error:
            raise RecordingError(f"Rerun could not write {path.name}: {error}") from error
        finally:
            rr.set_strict_mode(strict)
        environment = quiet_environment(Path(directory))
        rrd(["optimize", str(raw), "-o", str(final)], environment)
        rrd(["verify", str(final)], environment)
        final.replace(path)


def _lane_count(trace: Trace) -> int:
    states = sum(signal in trace.columns for signal, _, _ in LANES)
    return states + len({span.label for span in trace.fault_spans()}) + len({(a.code, a.node) for a in trace.alarms})


def _usual_frames(frames: Frames) -> float:
    counts = np.bincount(frames.step[frames.channel == 0]) if len(frames) else np.zeros(0)
    return float(np.median(counts[counts > 0])) if counts.any() else 20.0


def _recording_id(trace: Trace, frames: Frames) -> str:
    """The same run gets the same id; the viewer joins recordings of one id, so whatever differs must show in it."""
    about = zlib.crc32(json.dumps(trace.info, sort_keys=True, default=str).encode())
    return f"{frames.sha256()[:24]}-{about:08x}"
